"""Where the viewer looks from first: inside of what encloses, else from the side from which a scene shows its fronts.

Fronts are lit everywhere in these packages and backs are black, so a picture tells what the camera sees. Screenshots
are left for people to look at.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import packages
import pytest
from packages import SCREENSHOTS

from kiln_schemas import conventions
from kiln_schemas.manifest import Manifest, ReferenceView
from kiln_workers.scene.model import Scene
from kiln_workers.shade.first_camera import first_camera

WIDTH, HEIGHT = 64, 36


def first_look(page, capture_name: str) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Where the eye is and what it looks at, and the shares of the picture that show surfaces, and backs of them."""
    packages.SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / f"first_{capture_name}.png")
    eye, target, pixels = page.evaluate(
        """([width, height]) => viewer.then((picture) => {
            picture.background = false;
            const pixels = Array.from(picture.capture(width, height));
            return [picture.camera.position.toArray(), picture.target.toArray(), pixels];
        })""",
        [WIDTH, HEIGHT],
    )
    pixels = np.array(pixels).reshape(HEIGHT, WIDTH, 4)
    covered = pixels[..., 3] > 0.0
    black = covered & (pixels[..., :3].sum(axis=-1) == 0.0)
    return np.array(eye), np.array(target), covered.mean(), black.mean()


def turned(scene: Scene, quarters: int) -> Scene:
    """The scene turned about +Y by quarters of a turn."""
    c, s = np.round(np.cos(quarters * np.pi / 2)), np.round(np.sin(quarters * np.pi / 2))
    matrix = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)
    meshes = (
        replace(mesh, positions=mesh.positions @ matrix.T, normals=mesh.normals @ matrix.T) for mesh in scene.meshes
    )
    return replace(scene, meshes=tuple(meshes))


def look(scene: Scene, name: str, serve, viewer, tmp_path: Path):
    folder = packages.write_package(tmp_path / name, scene, size=32, lobes=2)
    with serve(folder) as url:
        return first_look(viewer.open(url), name)


@pytest.mark.parametrize("quarters", [1])
def test_a_closed_room_is_seen_from_inside(quarters, serve, viewer, tmp_path) -> None:
    scene = turned(packages.room_scene(), quarters)
    eye, target, covered, black = look(scene, f"room_{quarters}", serve, viewer, tmp_path)
    corners = np.concatenate([mesh.positions for mesh in scene.meshes])
    low, high = corners.min(axis=0), corners.max(axis=0)
    assert np.all(eye > low + 0.1) and np.all(eye < high - 0.1)
    assert 0.3 * 2.5 < eye[1] < 0.7 * 2.5
    assert np.linalg.norm(target - eye) > 1.0
    assert covered == 1.0 and black == 0.0


@pytest.mark.parametrize("quarters", [3])
def test_an_open_court_is_seen_from_inside(quarters, serve, viewer, tmp_path) -> None:
    scene = turned(packages.courtyard(), quarters)
    eye, _, covered, black = look(scene, f"courtyard_{quarters}", serve, viewer, tmp_path)
    x, z = np.abs(eye[[0, 2]]) if quarters == 0 else np.abs(eye[[2, 0]])
    assert x < 4.8 and z < 4.0 and 0.3 < eye[1] < 3.2
    assert covered > 0.6 and black < 0.01


@pytest.mark.parametrize("quarters", [0, 2])
def test_a_floor_with_a_wall_is_seen_from_its_open_side(quarters, serve, viewer, tmp_path) -> None:
    eye, _, covered, black = look(
        turned(packages.SCENES["gallery"](), quarters), f"gallery_{quarters}", serve, viewer, tmp_path
    )
    assert eye[1] > 1.0  # above the floor
    assert covered > 0.25 and black < 0.02


def test_a_solid_block_is_seen_from_outside_and_above(serve, viewer, tmp_path) -> None:
    eye, target, covered, black = look(packages.block_scene(), "block", serve, viewer, tmp_path)
    np.testing.assert_allclose(target, [0.0, 3.5, 5.5], atol=1e-5)
    assert eye[1] > 4.0 and eye[2] > 6.5
    assert covered > 0.1 and black < 0.005  # a pixel on an edge


def test_a_stated_camera_goes_first_and_a_very_large_scene_is_not_searched(serve, viewer, tmp_path) -> None:
    folder = packages.write_package(tmp_path / "package", packages.cabinet_scene(), size=8, lobes=2)
    manifest = Manifest.model_validate_json((folder / conventions.MANIFEST_JSON).read_text())
    views = {"front": ReferenceView(camera=packages.camera("cabinet"), white=1.0)}
    (folder / conventions.MANIFEST_JSON).write_text(manifest.model_copy(update={"views": views}).model_dump_json())
    with serve(folder) as url:
        stated = viewer.open(url, viewport={"width": 300, "height": 200})
        asked = viewer.open(f"{url}#camera=1,2,3:0,0.5,0:40", viewport={"width": 300, "height": 200})
        for page, position in ((stated, [0.4, 1.6, 4.2]), (asked, [1, 2, 3])):
            assert page.evaluate("viewer.then(({ camera }) => camera.position.toArray())") == pytest.approx(position)
        camera = asked.evaluate(
            """async () => {
                const { firstCamera } = await import("/static/viewer/page/first_camera.js");
                return firstCamera([{ geometry: { index: { count: 3_000_000 } } }], (await viewer).bounds, 1.5);
            }"""
        )
    assert camera["position"][1] > 1.0 and camera["position"][2] > camera["position"][0] > 0.0


@pytest.mark.parametrize("name", ["room", "courtyard", "gallery", "block"])
def test_a_bake_looks_from_where_the_viewer_does(name, serve, viewer, tmp_path) -> None:
    """The rule is written twice, for the browser and for the picture of a bake's report."""
    scenes = {"room": packages.room_scene, "courtyard": packages.courtyard, "block": packages.block_scene}
    scene = scenes.get(name, packages.SCENES["gallery"])()
    folder = packages.write_package(tmp_path / name, scene, size=32, lobes=2)
    with serve(folder) as url:
        page = viewer.open(url)
        page.evaluate("viewer.then(() => 0)")
        aspect, eye, target, fov = page.evaluate(
            """viewer.then(({ camera, target }) => {
                const canvas = document.querySelector("canvas");
                const aspect = canvas.clientWidth / Math.max(canvas.clientHeight, 1);
                return [aspect, camera.position.toArray(), target.toArray(), camera.fov];
            })"""
        )
    ours = first_camera(scene, aspect)
    assert ours.fov_deg == pytest.approx(fov)
    if name in ("room", "courtyard"):
        # From inside, several views are worth the same by symmetry; rounding chooses.
        corners = np.concatenate([mesh.positions for mesh in scene.meshes])
        assert (np.array(ours.position) > corners.min(axis=0)).all() and (ours.position < corners.max(axis=0)).all()
        assert ours.position[1] == pytest.approx(eye[1], abs=1e-3)
        return
    np.testing.assert_allclose(ours.position, eye, atol=1e-3)
    np.testing.assert_allclose(ours.target, target, atol=1e-3)
