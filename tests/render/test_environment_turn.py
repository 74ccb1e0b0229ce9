"""A sun at a known place of the HDR stands where three.js looks it up, in all that uses the environment.

three.js (`equirectUv`): u = atan2(d.z, d.x) / 2 pi + 1/2, v = asin(d.y) / pi + 1/2, v upwards.
"""

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from kiln_schemas.camera import Camera
from kiln_schemas.tasks import EnvironmentRef
from kiln_workers.render.environment import cube_directions, environment_samples, ggx_prefilter, look_up, panorama
from kiln_workers.render.mitsuba_scene import to_mitsuba
from kiln_workers.scene.environment import load_environment, place_environment
from kiln_workers.scene.examples import write_exr
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import Environment, Material, Scene
from kiln_workers.shade.command import read_scene
from kiln_workers.shade.reference import path_trace

HEIGHT, WIDTH = 32, 64


def direction_of(row: int, column: int) -> np.ndarray:
    """Where three.js looks to see a pixel of the image, row 0 at the top: the inverse of `equirectUv`."""
    u, v = (column + 0.5) / WIDTH, 1.0 - (row + 0.5) / HEIGHT
    up, around = np.pi * (v - 0.5), 2.0 * np.pi * (u - 0.5)
    return np.array([np.cos(up) * np.cos(around), np.sin(up), np.cos(up) * np.sin(around)])


def sun_image(row: int, column: int) -> np.ndarray:
    pixels = np.full((HEIGHT, WIDTH, 3), 0.01, np.float32)
    pixels[row, column] = 500.0
    return pixels


PLACES = [(10, 5), (12, 23), (7, 40), (13, 60)]


@pytest.mark.parametrize("row,column", PLACES)
@pytest.mark.parametrize("rotation", [0.0, 90.0, -37.0])
def test_every_user_of_the_environment_sees_the_sun_there(row, column, rotation, quad):
    environment = Environment(sun_image(row, column), rotation_deg=rotation)
    turn = np.deg2rad(rotation)
    x, y, z = direction_of(row, column)
    # About +Y, counter-clockwise seen from above.
    sun = np.array([x * np.cos(turn) + z * np.sin(turn), y, -x * np.sin(turn) + z * np.cos(turn)])

    def towards(directions, values):
        weights = np.maximum(np.asarray(values, np.float64).mean(axis=-1).ravel() - 0.02, 0.0)
        mean = weights @ np.asarray(directions, np.float64).reshape(-1, 3)
        return mean / np.linalg.norm(mean)

    samples = environment_samples(environment, 1)
    found = {"samples": towards(samples.direction, samples.radiance)}
    fine = cube_directions(64)
    found["look-up"] = towards(fine, look_up(environment, fine))
    found["cube"] = towards(cube_directions(32), ggx_prefilter(environment, 32, 2, "cpu")[0])
    picture = panorama(environment)
    grid = np.array([[direction_of(i, j) for j in range(WIDTH)] for i in range(HEIGHT)])
    found["panorama"] = towards(grid, picture)
    world = to_mitsuba(Scene((quad((0, -9, 0), (0, 0, 1), (1, 0, 0)),), (Material("a"),), environment=environment))
    si = mi.SurfaceInteraction3f()
    si = world.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(*fine.reshape(-1, 3).T.astype(np.float32))))
    found["renderer"] = towards(fine, np.array(world.environment().eval(si)).T)
    for name, direction in found.items():
        assert direction @ sun > np.cos(np.deg2rad(2.5)), (name, direction, sun)


def test_a_reference_looks_at_the_sun(tmp_path, quad):
    row, column = 12, 23
    sun = direction_of(row, column)
    scene = Scene((quad((0, -9, 0), (0, 0, 1), (1, 0, 0)),), (Material("a"),))
    scene = Scene(scene.meshes, scene.materials, environment=Environment(sun_image(row, column)))
    camera = Camera(position=(0.0, 0.0, 0.0), target=tuple(float(x) for x in sun), fov_deg=20.0)
    picture = path_trace(scene, camera, 9, 9, 8, 1, device="cpu").picture
    assert np.unravel_index(picture.mean(axis=2).argmax(), (9, 9)) == (4, 4)


def test_formats_place_an_image_as_their_own_programs_do(tmp_path):
    """Mitsuba's centre column looks at +Z: its XML stands a quarter turn away from glTF's."""
    write_exr(tmp_path / "sky.exr", sun_image(12, 32))
    reference = EnvironmentRef(file="sky.exr", rotation_deg=10.0)
    for entry, turned in {"a.glb": 10.0, "a.gltf": 10.0, "a.obj": 10.0, "a.ply": 10.0, "a.xml": -80.0}.items():
        assert load_environment(tmp_path, reference, entry)[0].rotation_deg == turned
        assert place_environment(sun_image(1, 1), 1.0, 10.0, entry).rotation_deg == turned
    body = '<shape type="rectangle"/><emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{body}</scene>')
    ours = load_scene(tmp_path, "scene.xml")
    assert ours.environment is not None
    mine = to_mitsuba(ours).environment()
    theirs = mi.load_dict({"type": "envmap", "filename": str(tmp_path / "sky.exr")})
    fine = cube_directions(32).reshape(-1, 3)
    rays = mi.Ray3f(mi.Point3f(0, 50, 0), mi.Vector3f(*fine.T.astype(np.float32)))
    si = mi.load_dict({"type": "scene", "env": theirs}).ray_intersect(rays)
    np.testing.assert_array_equal(
        np.argmax(np.array(mine.eval(si)).sum(axis=0)), np.argmax(np.array(theirs.eval(si)).sum(axis=0))
    )
    # The commands that read scenes themselves place it alike.
    assert read_scene(tmp_path / "scene.xml", tmp_path / "sky.exr", 1.0, 10.0).environment.rotation_deg == -80.0


def test_the_courtyards_sun_is_in_its_file_where_the_scene_has_it(tmp_path):
    """High on the right, in front: (0.62, 0.68, 0.40), by three.js' formula in the file that is written."""
    from kiln_workers.scene.examples import courtyard_sky

    write_exr(tmp_path / "courtyard.exr", courtyard_sky(256))
    with OpenEXR.File(str(tmp_path / "courtyard.exr")) as file:
        pixels = np.array(file.channels()["RGB"].pixels, np.float32)
    row, column = np.unravel_index(pixels.sum(axis=2).argmax(), pixels.shape[:2])
    u, v = (column + 0.5) / 256, 1.0 - (row + 0.5) / 128
    up, around = np.pi * (v - 0.5), 2.0 * np.pi * (u - 0.5)
    found = np.array([np.cos(up) * np.cos(around), np.sin(up), np.cos(up) * np.sin(around)])
    sun = np.array([0.62, 0.68, 0.40])
    assert found @ sun / np.linalg.norm(sun) > np.cos(np.deg2rad(1.5))
