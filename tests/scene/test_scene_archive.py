"""The scene archive: round trip, stable bytes, the hash, and malformed data."""

from dataclasses import replace

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_schemas.settings import PRESETS
from kiln_workers.scene.archive import pack_scene, scene_hash, unpack_scene
from kiln_workers.scene.container import pack, unpack
from kiln_workers.scene.model import Environment, Image, LightKind, Material, PunctualLight, Scene, TextureRef


@pytest.fixture
def scene(two_quads) -> Scene:
    texture = TextureRef(0, ("clamp", "mirror"), (0.25, 0.0), (2.0, 1.0), 0.5)
    return replace(
        two_quads,
        materials=(Material("a", roughness=0.3, base_color_texture=texture, emission=(1.0, 2.0, 3.0)),),
        images=(Image("wood", np.arange(24, dtype=np.uint8).reshape(2, 4, 3), True),),
        lights=(PunctualLight("lamp", LightKind.SPOT, (1.0, 2.0, 3.0), (0.0, 1.0, 0.0)),),
        environment=Environment(np.linspace(0, 1, 96, dtype=np.float32).reshape(4, 8, 3), 1.5, 20.0),
        notes=("something was decided",),
    )


def test_round_trip_and_stable_bytes(scene):
    data = pack_scene(scene)
    back = unpack_scene(data)
    assert pack_scene(back) == data == pack_scene(scene)
    assert back.materials == scene.materials and back.lights == scene.lights and back.notes == scene.notes
    np.testing.assert_array_equal(back.images[0].pixels, scene.images[0].pixels)
    np.testing.assert_array_equal(back.meshes[1].lightmap_uv, scene.meshes[1].lightmap_uv)
    assert (back.environment.scale, back.environment.rotation_deg) == (1.5, 20.0)


def test_names_and_notes_do_not_change_the_hash(scene):
    renamed = replace(
        scene,
        meshes=tuple(replace(mesh, name="x") for mesh in scene.meshes),
        materials=tuple(replace(material, name="y") for material in scene.materials),
        images=tuple(replace(image, name="z") for image in scene.images),
        notes=("b", "a"),
    )
    assert scene_hash(renamed) == scene_hash(scene)


def test_everything_that_light_depends_on_changes_the_hash(scene):
    mesh, image, light, sky = scene.meshes[0], scene.images[0], scene.lights[0], scene.environment
    changed = [
        replace(scene, meshes=(replace(mesh, positions=mesh.positions + 1), *scene.meshes[1:])),
        replace(scene, meshes=(replace(mesh, lightmap_uv=mesh.lightmap_uv * 0.5), *scene.meshes[1:])),
        replace(scene, meshes=(replace(mesh, normals=-mesh.normals), *scene.meshes[1:])),
        replace(scene, meshes=scene.meshes[:1]),
        replace(scene, materials=(replace(scene.materials[0], roughness=0.31),)),
        replace(scene, images=(replace(image, pixels=image.pixels + 1),)),
        replace(scene, images=(replace(image, srgb=False),)),
        replace(scene, lights=(replace(light, intensity=(1.0, 2.0, 3.5)),)),
        replace(scene, environment=replace(sky, scale=1.6)),
        replace(scene, environment=replace(sky, rotation_deg=21.0)),
        replace(scene, environment=replace(sky, pixels=sky.pixels + 1)),
        replace(scene, environment=None),
    ]
    hashes = [scene_hash(scene), *(scene_hash(other) for other in changed)]
    hashes += [scene_hash(scene, PRESETS[name].render) for name in ("draft", "preview")]
    assert len(set(hashes)) == len(hashes)


def test_every_cut_and_random_damage_is_an_input_error_or_a_valid_scene(scene):
    data = pack_scene(scene)
    for length in range(0, len(data) - 64, 97):
        with pytest.raises(InputError):
            unpack_scene(data[:length])
    rng = np.random.default_rng(3)
    outcomes = set()
    for _ in range(300):
        damaged = bytearray(data)
        damaged[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        try:
            unpack_scene(bytes(damaged))
            outcomes.add("read")
        except InputError:
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


def test_references_and_values_are_checked(scene):
    body, arrays = unpack("scene", pack_scene(scene))
    wrong = {
        "faces names vertices": {"mesh0.faces": np.full((2, 3), 9, np.int32)},
        "not finite": {"mesh0.positions": np.full((4, 3), np.nan, np.float32)},
        "shape": {"mesh0.normals": np.zeros((3, 3), np.float32)},
        "no image": {"image0": np.zeros((2, 2, 9), np.uint8)},
    }
    for says, change in wrong.items():
        with pytest.raises(InputError, match=says):
            unpack_scene(pack("scene", body, arrays | change))
    for says, change in {"of 1": {"meshes": [{"name": "m", "material": 4}] * 2}, "meshes": {"meshes": 3}}.items():
        with pytest.raises(InputError, match=says):
            unpack_scene(pack("scene", body | change, arrays))
    with pytest.raises(InputError, match="it is a 'scene'"):
        unpack("texel map", pack_scene(scene))
