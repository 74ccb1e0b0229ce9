"""Hidden nodes, vertex colours, UV sets and layers of glTF, as the bake, scene.glb and the archive have them."""

from dataclasses import replace

import numpy as np
import pytest
from rich_scene import rich_scene

from kiln_schemas.settings import LightmapSettings, UvPolicy
from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.archive import pack_scene, unpack_scene
from kiln_workers.scene.atlas import assign_lightmap_uv
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import Material, Mesh, Scene


def test_hidden_nodes_hold_back_no_light(irradiance_in, data):
    np.testing.assert_allclose(irradiance_in("hidden_node.glb", [[0, 0, 0]]), 2.308, rtol=0.01)
    assert "1 hidden nodes left out" in " ".join(load_scene(data, "hidden_node.glb").notes)


@pytest.mark.parametrize("name", ["factor.glb", "vertex.glb"])
def test_a_wall_red_by_its_vertices_tints_as_one_red_by_its_factor(irradiance_in, name):
    np.testing.assert_allclose(irradiance_in(name, [[-1.6, 0, 0]]), [[0.523, 0.368, 0.368]], rtol=0.02)


def test_each_texture_is_looked_up_by_its_own_uv_set(irradiance_in):
    """The half of the panel that glows is told by TEXCOORD_1, mirrored; quadrature over that half."""
    found = irradiance_in("two_uv_sets.glb", [[-0.5, 0, 0], [0.5, 0, 0]])
    np.testing.assert_allclose(found, np.repeat([[4.309], [11.333]], 3, axis=1), rtol=0.02)


def same(one: Scene, other: Scene) -> None:
    for a, b in zip(one.meshes, other.meshes, strict=True):
        for name in ("positions", "normals", "faces", "uv", "lightmap_uv", "colors", "tangents"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        for left, right in zip(a.more_uv, b.more_uv, strict=True):
            np.testing.assert_array_equal(left, right)


def test_scene_glb_carries_all_that_a_surface_has(tmp_path):
    """Written and read again: the same vertices, factors, look-ups and pixels; TEXCOORD_1 stays the light map's."""
    scene = rich_scene()
    (tmp_path / "scene.glb").write_bytes(encode_glb(scene))
    back = load_scene(tmp_path, "scene.glb")
    assert not back.notes
    # UV sets are numbered in the order of their first use, so those of the file may come in another one.
    written, read = scene.materials[0], back.materials[0]
    for name in ("base_color_texture", "metallic_roughness_texture", "emission_texture", "transmission_texture",
                 "normal_texture", "occlusion_texture"):  # fmt: skip
        before, after = getattr(written, name), getattr(read, name)
        np.testing.assert_array_equal(scene.meshes[0].uv_of(before), back.meshes[0].uv_of(after), err_msg=name)
        np.testing.assert_array_equal(scene.images[before.image].pixels, back.images[after.image].pixels)
        assert scene.images[before.image].srgb == back.images[after.image].srgb
        assert replace(before, image=0, uv_set=0) == replace(after, image=0, uv_set=0)
        written, read = replace(written, **{name: None}), replace(read, **{name: None})
    assert written == read
    np.testing.assert_array_equal(scene.meshes[0].colors, back.meshes[0].colors)
    np.testing.assert_allclose(scene.meshes[0].tangents, back.meshes[0].tangents, atol=1e-6)
    np.testing.assert_array_equal(scene.meshes[0].lightmap_uv, back.meshes[0].lightmap_uv)


def test_the_archive_keeps_all_that_a_surface_has():
    scene = rich_scene()
    back = unpack_scene(pack_scene(scene))
    same(scene, back)
    assert back.materials == scene.materials


def test_unwrapping_splits_every_attribute_alike():
    """Vertices of a bent sheet are split at chart borders: colours and UV sets go with their positions."""
    scene = rich_scene()
    bent = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1, 0, 1], [1, 1, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]], np.int32)
    more = (bent[:, 1:] + 5, bent[:, :2] + 9)
    colors = np.concatenate([bent, bent[:, :1]], axis=1)
    mesh = Mesh("bent", bent, np.tile(np.float32([0, 0, 1]), (6, 1)), faces, 0, bent[:, :2].copy(), None, more, colors)
    settings = LightmapSettings(resolution=32, uv=UvPolicy.UNWRAP)
    out = assign_lightmap_uv(replace(scene, meshes=(mesh,)), settings).meshes[0]
    np.testing.assert_array_equal(out.colors[:, :3], out.positions)
    np.testing.assert_array_equal(out.more_uv[0], out.positions[:, 1:] + 5)
    np.testing.assert_array_equal(out.more_uv[1], out.positions[:, :2] + 9)


def test_layers_become_reflectances():
    assert Material("a").dielectric_f0 == pytest.approx((0.04,) * 3)
    assert Material("a", ior=2.0).dielectric_f0 == pytest.approx((1 / 9,) * 3)
    off = Material("a", specular=0.0)
    assert (off.dielectric_f0, off.dielectric_f90) == ((0.0,) * 3, 0.0)
    tinted = Material("a", specular=0.5, specular_color=(0.0, 1.0, 50.0))
    assert tinted.dielectric_f0 == pytest.approx((0.0, 0.02, 0.5))
    assert Material("a", clearcoat=1.0, specular=0.0).dielectric_f0 == pytest.approx((0.04,) * 3)
