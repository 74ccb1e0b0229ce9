"""environment.exr in npm's three.js: its EXRLoader reads it, `scene.background` and `scene.environment` show it.

The environment has a blob of red, of green and of blue in directions that no mirror and no quarter turn takes to each
other; directions are compared one by one with the environment that the package was made from.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import packages
import pytest
import torch
from playwright.sync_api import ConsoleMessage

from kiln_schemas.conventions import ENVIRONMENT_GGX_KTX2
from kiln_workers.package import ktx2
from kiln_workers.render.environment import look_up
from kiln_workers.scene.model import Environment, Scene
from kiln_workers.shade import textures

PAGE = """<!doctype html><title>three.js from npm</title>
<script type="importmap">
{ "imports": { "three": "/npm/three/build/three.module.js", "three/addons/": "/npm/three/examples/jsm/" } }
</script>
<script type="module">
import * as THREE from "three";
import { EXRLoader } from "three/addons/loaders/EXRLoader.js";

const environment = await new EXRLoader().loadAsync("/package/environment.exr");
environment.mapping = THREE.EquirectangularReflectionMapping;

const renderer = new THREE.WebGLRenderer();
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(1, 1, 0.1, 10);
const ball = new THREE.Mesh(
  new THREE.SphereGeometry(0.5, 64, 32),
  new THREE.MeshStandardMaterial({ color: 0xffffff, metalness: 1 }),
);
scene.add(ball);

const target = new THREE.WebGLRenderTarget(1, 1, { type: THREE.FloatType });
function look(direction) {
  camera.up.set(...(Math.abs(direction[1]) > 0.9 ? [0, 0, 1] : [0, 1, 0]));
  camera.lookAt(...direction);
  renderer.setRenderTarget(target);
  renderer.clear();
  renderer.render(scene, camera);
  const out = new Float32Array(4);
  renderer.readRenderTargetPixels(target, 0, 0, 1, 1, out);
  return Array.from(out.slice(0, 3));
}
window.seen = (directions) => {
  scene.background = environment;
  ball.visible = false;
  return directions.map(look);
};
// The middle of the ball, which shows what is behind the eye.
window.reflected = (directions, roughness) => {
  scene.environment = environment;
  ball.visible = true;
  ball.material.roughness = roughness;
  return directions.map((direction) => {
    const ahead = direction.map((x) => -2 * x);
    ball.position.set(...ahead);
    return look(ahead);
  });
};
window.picture = () => {
  renderer.setRenderTarget(null);
  renderer.setSize(480, 270);
  scene.background = scene.environment = environment;
  ball.position.set(0, 0, 0);
  ball.visible = true;
  ball.material.roughness = 0.2;
  const eye = new THREE.PerspectiveCamera(60, 16 / 9, 0.1, 10);
  eye.position.set(0, 0, 1.6);
  renderer.render(scene, eye);
  return renderer.domElement.toDataURL();
};
window.loaded = true;
</script>"""

AXES = np.array([[0.48, 0.60, 0.64], [-0.80, 0.36, 0.48], [0.36, -0.48, -0.80]])
OTHER_WAYS = {
    "mirrored in x": np.diag([-1, 1, 1]),
    "mirrored in y": np.diag([1, -1, 1]),
    "mirrored in z": np.diag([1, 1, -1]),
    "x and z exchanged": np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0]]),
    "a quarter turn": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "half a turn": np.diag([-1, 1, -1]),
}


WITHIN = {0.0: 0.02, 0.3: 0.1, 0.6: 0.2, 1.0: 0.2}
"""Relative difference of a ball of three.js' standard material, by its roughness; about twice what was found."""


def lopsided(height: int = 128) -> Environment:
    """Three blobs of colour on grey, stored turned by 37 degrees, so that the axes are where the package has them."""
    theta = np.pi * (np.arange(height)[:, None] + 0.5) / height
    phi = 2.0 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height) - np.radians(37.0)
    directions = np.stack(
        np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)), axis=-1
    )
    pixels = 0.1 + 0.35 * np.exp(5.0 * (directions @ AXES.T - 1.0))
    return Environment(pixels.astype(np.float32), scale=2.0, rotation_deg=37.0)


def sphere(count: int) -> np.ndarray:
    """Unit directions [count, 3] and the six axes after them."""
    directions = np.random.default_rng(2).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.concatenate([directions, np.eye(3), -np.eye(3)])


def is_fault(message: ConsoleMessage) -> bool:
    """An error or a warning of the page; what a driver says of its own speed is neither."""
    return message.type in ("error", "warning") and "GL Driver Message (OpenGL, Performance" not in message.text


def prefiltered(folder: Path, directions: np.ndarray, roughness: float) -> np.ndarray:
    """What environment_ggx.ktx2 holds for a roughness, between its mips."""
    levels = ktx2.read(folder / ENVIRONMENT_GGX_KTX2).levels
    lod = (len(levels) - 1) * roughness * (2.0 - roughness)
    lower = min(int(lod), len(levels) - 2)
    wanted = torch.from_numpy(directions.astype(np.float32))
    ends = [
        textures.cube(torch.from_numpy(levels[k][0, ..., :3].astype(np.float32)), wanted).numpy()
        for k in (lower, lower + 1)
    ]
    return ends[0] + (lod - lower) * (ends[1] - ends[0])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return replace(packages.cabinet_scene(), environment=lopsided())


@pytest.fixture(scope="module")
def folder(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packages.write_package(tmp_path_factory.mktemp("lopsided") / "package", scene, size=8, lobes=2)


def test_npms_three_shows_the_environment_where_it_is(scene, folder, serve, browser, node_modules) -> None:
    directions = sphere(60)
    expected = look_up(scene.environment, directions)
    faults: list[str] = []
    with serve(folder) as url:
        page = browser.new_page()
        page.route("**/stock.html", lambda route: route.fulfill(body=PAGE, content_type="text/html"))
        page.route("**/npm/**", lambda route: route.fulfill(path=node_modules / route.request.url.split("/npm/")[1]))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda message: faults.append(message.text) if is_fault(message) else None)
        page.goto(f"{url}stock.html")
        page.wait_for_function("window.loaded")
        seen = np.array(page.evaluate("seen", directions.tolist()))
        packages.SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        balls = {
            roughness: np.array(page.evaluate("([ways, r]) => reflected(ways, r)", [directions.tolist(), roughness]))
            for roughness in WITHIN
        }
        page.evaluate("document.body.append(Object.assign(new Image(), { src: picture() }))")
        page.screenshot(path=packages.SCREENSHOTS / "stock_three.png")
        page.close()
    assert faults == []
    np.testing.assert_allclose(seen, expected, rtol=0.03)  # the most at a pole, between pixels of the first row
    for way, matrix in OTHER_WAYS.items():
        assert np.abs(look_up(scene.environment, directions @ matrix.T) - seen).max() > 0.2, way
    # three.js convolves it anew for its materials, at a size that it chooses: close to what the package holds.
    for roughness, ball in balls.items():
        np.testing.assert_allclose(ball, prefiltered(folder, directions, roughness), rtol=WITHIN[roughness])
