"""The path-traced reference: cut-outs let light through, and the unit of length does not matter."""

from dataclasses import replace

import numpy as np
import pytest

from kiln_schemas.camera import Camera
from kiln_workers.scene.model import Image, LightKind, Material, Mesh, PunctualLight, Scene, TextureRef
from kiln_workers.shade.reference import path_trace

CAMERA = Camera(position=(0.0, 1.2, 2.5), target=(0.0, 0.0, 0.0), fov_deg=40.0)
HOLE = np.full((4, 4, 4), 255, np.uint8)
HOLE[..., 3] = 0
MATERIALS = (
    Material("floor", (0.6, 0.4, 0.2, 1.0)),
    Material("fence", base_color_texture=TextureRef(0), alpha_cutoff=0.5, double_sided=True),
    Material("lamp", (0.0, 0.0, 0.0, 1.0), emission=(5.0, 5.0, 5.0)),
)
LIGHTS = {
    "point": PunctualLight("point", LightKind.POINT, (30.0, 30.0, 30.0), (0.1, 2.0, 0.1)),
    "spot": PunctualLight("spot", LightKind.SPOT, (30.0, 30.0, 30.0), (0.1, 2.0, 0.1), (0.0, -1.0, 0.0), 0.3, 1.0),
    "sun": PunctualLight("sun", LightKind.DIRECTIONAL, (3.0, 3.0, 3.0), direction=(0.0, -0.8, -0.6)),
}


def quad(o: tuple[float, ...], a: tuple[float, ...], b: tuple[float, ...], material: int) -> Mesh:
    corner, s, t = (np.asarray(v, np.float32) for v in (o, a, b))
    normal = np.cross(s, t) / np.linalg.norm(np.cross(s, t))
    return Mesh(
        name="quad",
        positions=np.stack([corner, corner + s, corner + s + t, corner + t]),
        normals=np.repeat(normal[None], 4, axis=0).astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        material=material,
        uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32),
    )


def floor_under(light: str, fences: int) -> Scene:
    """A floor of 4 x 4 m; above it sheets that are cut out all over, then the light."""
    meshes = [quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), 0)]
    meshes += [quad((-2, 0.5 + 0.2 * k, -2), (0, 0, 4), (4, 0, 0), 1) for k in range(fences)]
    if light == "lamp":
        meshes.append(quad((-0.5, 2, -0.5), (1, 0, 0), (0, 0, 1), 2))
    lights = (LIGHTS[light],) if light in LIGHTS else ()
    return Scene(tuple(meshes), MATERIALS, (Image("hole", HOLE, srgb=True),), lights=lights)


@pytest.mark.parametrize("light", ["point", "spot", "sun", "lamp"])
def test_light_comes_through_cut_outs(light: str) -> None:
    """Fault 20: a lamp above a sheet that is all hole gave 0 in the reference."""
    pictures = [
        path_trace(floor_under(light, fences), CAMERA, 24, 16, 256, 4, device="cpu").picture for fences in (0, 2)
    ]
    assert pictures[0][8:12].mean() > 0.05
    np.testing.assert_allclose(pictures[1].mean(axis=(0, 1)), pictures[0].mean(axis=(0, 1)), rtol=0.02)
    np.testing.assert_allclose(pictures[1][8:12, 6:18].mean(), pictures[0][8:12, 6:18].mean(), rtol=0.02)


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_the_unit_of_length_does_not_matter(scale: float) -> None:
    scene = floor_under("lamp", 0)
    box = quad((-0.3, 0.03, -0.3), (0, 0, 0.6), (0.6, 0, 0), 0)
    scene = replace(scene, meshes=(*scene.meshes, box), lights=(LIGHTS["point"],))
    wanted = path_trace(scene, CAMERA, 24, 16, 64, 3, device="cpu").picture
    scaled = replace(
        scene,
        meshes=tuple(replace(mesh, positions=mesh.positions * np.float32(scale)) for mesh in scene.meshes),
        lights=(
            replace(
                LIGHTS["point"], position=(0.1 * scale, 2.0 * scale, 0.1 * scale), intensity=(30.0 * scale**2,) * 3
            ),
        ),
    )
    camera = Camera(position=(0.0, 1.2 * scale, 2.5 * scale), target=(0.0, 0.0, 0.0), fov_deg=40.0)
    found = path_trace(scaled, camera, 24, 16, 64, 3, device="cpu").picture
    np.testing.assert_allclose(found, wanted, rtol=0.02, atol=0.01 * wanted.max())
