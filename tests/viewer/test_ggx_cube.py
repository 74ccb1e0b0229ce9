"""environment_ggx.ktx2 in three.js without our code: ktx-parse reads it, three.js draws it as background and as
`envMap` of its own standard material. Directions are compared one by one, so a mirrored or turned cube is noticed.

three.js' own KTX2Loader does not do: up to release 187 it makes cube maps of compressed formats only, and makes a plane
of an uncompressed one, without complaint.
"""

import numpy as np
import torch

from kiln_schemas.conventions import ENVIRONMENT_GGX_KTX2
from kiln_workers.package import ktx2
from kiln_workers.shade import textures

PAGE = """<!doctype html><title>three.js alone</title><script type="module">
import * as THREE from "/static/viewer/vendor/three/three.module.min.js";
import { read } from "/static/viewer/vendor/ktx-parse/ktx-parse.js";

const file = read(new Uint8Array(await (await fetch("/package/environment_ggx.ktx2")).arrayBuffer()));
const half = (data, side) => {
  const face = new THREE.DataTexture(data, side, side, THREE.RGBAFormat, THREE.HalfFloatType);
  face.needsUpdate = true;
  return face;
};
const faces = (level, side) => {
  const halves = new Uint16Array(level.levelData.slice().buffer);
  return [0, 1, 2, 3, 4, 5].map((k) => half(halves.subarray(k * side * side * 4, (k + 1) * side * side * 4), side));
};
const cube = new THREE.CubeTexture(faces(file.levels[0], file.pixelWidth));
cube.mipmaps = file.levels.slice(1).map((level, m) => ({ image: faces(level, file.pixelWidth >> (m + 1)) }));
Object.assign(cube, {
  type: THREE.HalfFloatType, format: THREE.RGBAFormat, generateMipmaps: false, needsUpdate: true,
  minFilter: THREE.LinearMipmapLinearFilter, magFilter: THREE.LinearFilter,
  isRenderTargetTexture: true,  // OpenGL's face layout: do not mirror
});
const renderer = new THREE.WebGLRenderer();
const target = new THREE.WebGLRenderTarget(1, 1, { type: THREE.FloatType });
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(1, 1, 0.1, 10);
const pixel = () => {
  renderer.setRenderTarget(target);
  renderer.clear();
  renderer.render(scene, camera);
  const out = new Float32Array(4);
  renderer.readRenderTargetPixels(target, 0, 0, 1, 1, out);
  return Array.from(out.slice(0, 3));
};
const look = (direction) => {
  camera.up.set(...(Math.abs(direction[1]) > 0.9 ? [0, 0, 1] : [0, 1, 0]));
  camera.lookAt(...direction);
};
window.seen = (directions) => {
  scene.background = cube;
  return directions.map((direction) => { look(direction); return pixel(); });
};
window.mirrored = (directions) => {
  scene.background = null;
  scene.environment = cube;
  const material = new THREE.MeshStandardMaterial({ color: 0xffffff, metalness: 1, roughness: 0 });
  const ball = new THREE.Mesh(new THREE.SphereGeometry(0.5, 64, 32), material);
  scene.add(ball);
  return directions.map((direction) => {
    // A mirror right ahead shows what is behind the eye.
    const ahead = direction.map((x) => -2 * x);
    ball.position.set(...ahead);
    look(ahead);
    return pixel();
  });
};
window.loaded = true;
</script>"""


def test_stock_three_shows_the_environment_where_it_is(made, serve, browser) -> None:
    folder = made("courtyard")
    faces = ktx2.read(folder / ENVIRONMENT_GGX_KTX2, 2**24).levels[0][0, ..., :3].astype(np.float32)
    directions = np.random.default_rng(2).normal(size=(40, 3))
    directions /= np.abs(directions).max(axis=1, keepdims=True)
    # Away from the edges of faces, which GL filters over and the evaluator does not.
    directions = directions[np.sort(np.abs(directions), axis=1)[:, 1] < 0.9]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = textures.cube(torch.from_numpy(faces), torch.from_numpy(directions.astype(np.float32))).numpy()
    faults: list[str] = []
    with serve(folder) as url:
        page = browser.new_page()
        page.route("**/stock.html", lambda route: route.fulfill(body=PAGE, content_type="text/html"))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(f"{url}stock.html")
        page.wait_for_function("window.loaded")
        seen = np.array(page.evaluate("directions => seen(directions)", directions.tolist()))
        np.testing.assert_allclose(seen, expected, rtol=5e-3, atol=1e-3)
        assert np.abs(seen - expected[::-1]).max() > 0.1
        # three.js convolves the cube once more for its standard material, at a size that it chooses: about the same.
        mirrored = np.array(page.evaluate("directions => mirrored(directions)", directions.tolist()))
        even = expected.max(axis=1) < 3.0 * np.median(expected)  # not at the sun
        ratio = mirrored[even].mean(axis=1) / expected[even].mean(axis=1)
        assert even.sum() > 20
        assert 0.8 < np.median(ratio) < 1.25
        assert np.corrcoef(mirrored[even].mean(axis=1), expected[even].mean(axis=1))[0, 1] > 0.9
        page.close()
    assert faults == []
