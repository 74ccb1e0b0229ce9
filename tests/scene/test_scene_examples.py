"""The bundled examples survive their files, keep their charts, and are lit."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from kiln_schemas.settings import LightmapSettings, UvPolicy
from kiln_schemas.tasks import EnvironmentRef
from kiln_workers.scene.atlas import assign_lightmap_uv
from kiln_workers.scene.examples import ALPHAS, courtyard_scene, gallery_scene, write_examples
from kiln_workers.scene.geometry import face_normals
from kiln_workers.scene.load import check_light, load_scene
from kiln_workers.scene.texels import rasterise_texels


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples")
    assert [path.name for path in write_examples(folder)] == ["gallery.glb", "courtyard.glb", "courtyard.exr"]
    return folder


@pytest.mark.parametrize(("name", "make"), [("gallery", gallery_scene), ("courtyard", courtyard_scene)])
def test_round_trip_through_the_files(folder, name, make):
    sky = EnvironmentRef(file="courtyard.exr") if name == "courtyard" else None
    made, read = make(), check_light(load_scene(folder, f"{name}.glb", sky))
    assert read.notes == () and 3_000 < read.triangles < 25_000
    assert [mesh.name for mesh in read.meshes] == [mesh.name for mesh in made.meshes]
    for a, b in zip(made.meshes, read.meshes, strict=True):
        np.testing.assert_array_equal(a.positions[a.faces], b.positions[b.faces])
        np.testing.assert_array_equal(a.lightmap_uv[a.faces], b.lightmap_uv[b.faces])
        np.testing.assert_allclose(a.normals[a.faces], b.normals[b.faces], atol=1e-6)
        assert made.materials[a.material] == replace(
            read.materials[b.material], emission=made.materials[a.material].emission
        )
        np.testing.assert_allclose(made.materials[a.material].emission, read.materials[b.material].emission, rtol=1e-12)
    if sky is not None:
        np.testing.assert_allclose(read.environment.pixels, made.environment.pixels, rtol=1e-3)


@pytest.mark.parametrize("make", [gallery_scene, courtyard_scene])
@pytest.mark.parametrize("resolution", [32, 64, 256])
def test_their_own_charts_are_final_at_every_resolution(make, resolution):
    scene = assign_lightmap_uv(make(), LightmapSettings(resolution=resolution, uv=UvPolicy.KEEP))
    texels = rasterise_texels(scene, resolution)
    assert texels.covered > 0.6 * resolution**2
    assert len(np.unique(texels.chart)) - 1 == len(scene.meshes)
    alphas = {round(float(alpha), 4) for alpha in np.unique(texels.alpha)}
    assert set(ALPHAS) <= alphas


@pytest.mark.parametrize("make", [gallery_scene, courtyard_scene])
def test_faces_are_wound_as_their_normals_point(make):
    for mesh in make().meshes:
        cosine = np.einsum("fcd,fd->fc", mesh.normals[mesh.faces], face_normals(mesh.positions, mesh.faces))
        assert cosine.min() > 0.2, mesh.name


def test_writing_twice_gives_the_same_bytes(folder, tmp_path):
    for path in write_examples(tmp_path):
        first, second = (hashlib.sha256((f / path.name).read_bytes()).hexdigest() for f in (folder, tmp_path))
        assert first == second
