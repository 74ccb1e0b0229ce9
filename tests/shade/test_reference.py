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


@pytest.mark.parametrize("opacity", [0.2, 0.6])
@pytest.mark.parametrize("light", ["point", "spot", "sun", "lamp"])
def test_panes_before_lights_let_through_what_they_do_not_cover(light: str, opacity: float) -> None:
    """Two panes before the floor, each passed on the way of the light and on the way of the eye: (1 - opacity)^4."""
    pane = Material("pane", (0.0, 0.0, 0.0, opacity), specular=0.0, blend=True, double_sided=True)

    def floor(panes: int) -> np.ndarray:
        scene = replace(floor_under(light, panes), materials=(MATERIALS[0], pane, MATERIALS[2]))
        return path_trace(scene, CAMERA, 24, 16, 256, 2, device="cpu").picture[8:12, 6:18].mean(axis=(0, 1))

    np.testing.assert_allclose(floor(2), (1.0 - opacity) ** 4 * floor(0), rtol=0.03)


def ball(material: int, rings: int = 10, columns: int = 16) -> Mesh:
    """A coarse ball of smooth normals with UV and tangents, so that facets and bumps are plain to see."""
    angles = np.linspace(0.05, np.pi - 0.05, rings), np.linspace(0.0, 2.0 * np.pi, columns + 1)
    theta, phi = (angle.ravel() for angle in np.meshgrid(*angles, indexing="ij"))
    unit = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=1)
    tangents = np.stack([-np.sin(phi), np.zeros_like(phi), np.cos(phi), np.ones_like(phi)], axis=1)
    row, column = (index.ravel() for index in np.indices((rings - 1, columns)))
    a, down = row * (columns + 1) + column, columns + 1
    faces = np.concatenate([np.stack([a, a + 1, a + down], 1), np.stack([a + 1, a + down + 1, a + down], 1)])
    uv = np.stack([phi / (2 * np.pi), theta / np.pi], axis=1)
    arrays = (0.6 * unit, unit, uv, tangents)
    positions, normals, uv, tangents = (values.astype(np.float32) for values in arrays)
    return Mesh("ball", positions, normals, faces.astype(np.int32), material, uv=uv, tangents=tangents)


@pytest.mark.parametrize("bumps", [False, True])
@pytest.mark.parametrize("double_sided", [False, True])
def test_what_glows_a_little_is_shaded_as_what_does_not(bumps: bool, double_sided: bool) -> None:
    """Smooth normals and normal maps of emitters were ignored; emission of 1e-6 must not be seen."""
    steps = np.array([[96, 128, 216, 255], [160, 128, 216, 255]], np.uint8)
    images = (Image("bumps", np.tile(steps[:, None], (4, 8, 1)).reshape(8, 8, 4), srgb=False),)

    def picture(emission: float) -> np.ndarray:
        material = Material(
            "ball",
            (0.7, 0.5, 0.3, 1.0),
            roughness=0.4,
            emission=(emission,) * 3,
            double_sided=double_sided,
            normal_texture=TextureRef(0) if bumps else None,
        )
        scene = Scene((ball(0),), (material,), images, lights=(LIGHTS["point"],))
        return path_trace(scene, CAMERA, 48, 32, 256, 1, device="cpu").picture

    plain, glowing = picture(0.0), picture(1e-6)
    inside = plain.max(axis=-1) > 0.02
    assert inside.sum() > 100
    # Along the outline an emitter's normal is bent towards the eye, and along the shadow's edge its faces count.
    off = np.abs(glowing - plain)[inside].max(axis=-1) > 0.1 * plain[inside].max(axis=-1)
    assert off.mean() < 0.1  # 0.62 of facets
    np.testing.assert_allclose(glowing.mean(axis=(0, 1)), plain.mean(axis=(0, 1)), rtol=0.02)
