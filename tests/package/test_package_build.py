"""The package as a whole: files, hashes, manifest; and the textures' values against the lobes that were handed in."""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from kiln_schemas.errors import InternalError
from kiln_schemas.manifest import Manifest
from kiln_schemas.settings import Function
from kiln_workers.package import ktx2
from kiln_workers.package.build import build_package
from kiln_workers.package.half import as_stored, layers_to_lobes
from kiln_workers.package.ktx2_validate import validate

WITHOUT_ENVIRONMENT = {
    "lightfield.ktx2",
    "irradiance.exr",
    "irradiance.ktx2",
    "errors.ktx2",
    "scene.glb",
    "report.html",
    "manifest.json",
    *(f"shaders/{stem}.{ending}" for stem in ("sg", "environment", "lightkiln") for ending in ("glsl", "hlsl", "wgsl")),
    "shaders/surface.vert.glsl",
    "shaders/surface.frag.glsl",
    "shaders/surface.hlsl",
    "shaders/surface.wgsl",
}
ENVIRONMENT = ("environment_ggx.ktx2", "environment_u.ktx2", "environment.exr")
WITH_ENVIRONMENT = WITHOUT_ENVIRONMENT | {"visibility.ktx2", *ENVIRONMENT}


def files_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("environment", "names"), [(True, WITH_ENVIRONMENT), (False, WITHOUT_ENVIRONMENT)])
def test_artifacts_manifest_and_folder_agree(environment, names, make_sample, tmp_path: Path) -> None:
    artifacts = build_package(tmp_path, make_sample(environment=environment).given)
    assert {item.name for item in artifacts} == names == files_in(tmp_path)
    manifest = Manifest.model_validate_json((tmp_path / "manifest.json").read_bytes())
    assert manifest.files == tuple(artifacts[:-1])
    assert artifacts[-1].name == "manifest.json"
    for item in artifacts:
        data = (tmp_path / item.name).read_bytes()
        assert (item.sha256, item.size) == (hashlib.sha256(data).hexdigest(), len(data))
    for name in names:
        if name.endswith(".ktx2"):
            assert validate((tmp_path / name).read_bytes()) == [], name
    assert set(manifest.textures) == {name for name in names if name.endswith(".ktx2") or name == "environment.exr"}


def test_the_manifest_says_what_was_baked_and_how_well(make_sample, tmp_path: Path) -> None:
    sample = make_sample()
    build_package(tmp_path, sample.given)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    payload = sample.given.payload
    for function in Function:
        expected = sample.given.metrics[function]
        assert manifest["metrics"][function]["log_mse_rel"] == pytest.approx(expected.log_mse_rel)
        assert manifest["metrics"][function]["log_mse"] == pytest.approx(expected.log_mse)
    assert manifest["exposure"] == {"light_field": 0.7, "visibility": 1.0}
    assert manifest["inputs"] == payload.bundle.files
    assert manifest["scene_hash"] == payload.prepare.scene_hash
    assert manifest["settings"] == payload.settings.model_dump(mode="json")
    assert manifest["left_out"] == {}
    assert manifest["overflows"] == 2
    assert manifest["stage_seconds"] == sample.given.stage_seconds
    state = sample.texel_map.state
    assert manifest["lightmap"]["valid"] == int((state == 1).sum())
    assert manifest["lightmap"]["invalid_texels"] == np.flatnonzero(state == 2).tolist()
    assert manifest["lightmap"]["charts"] == 2
    assert manifest["lightmap"]["speck_share"] == 0.0
    assert manifest["placements"] == [{"mesh": "room", "scale": 0.5, "offset": [0.25, 0.0]}]
    assert manifest["textures"]["environment_u.ktx2"]["alphas"] == [0.04, 0.25, 1.0]
    assert manifest["textures"]["environment_u.ktx2"]["lobe_integrals"] == [3.9, 3.1, 1.5]
    assert manifest["textures"]["environment_u.ktx2"]["normalised"] is False
    assert manifest["textures"]["lightfield.ktx2"]["lobes"] == 4


def test_without_environment_the_manifest_says_what_is_left_out(make_sample, tmp_path: Path) -> None:
    build_package(tmp_path, make_sample(environment=False).given)
    manifest = Manifest.model_validate_json((tmp_path / "manifest.json").read_bytes())
    assert manifest.metrics.visibility is None
    reason = "the scene has no environment"
    assert manifest.left_out == dict.fromkeys(("visibility", *ENVIRONMENT), reason)


@pytest.mark.parametrize("function", list(Function))
def test_lobe_textures_hold_the_lobes_and_continue_into_the_gutter(function, make_sample, tmp_path: Path) -> None:
    sample = make_sample()
    build_package(tmp_path, sample.given)
    name = {"light_field": "lightfield.ktx2", "visibility": "visibility.ktx2"}[function]
    read = layers_to_lobes(ktx2.read(tmp_path / name).levels[0][:, 0])
    lobe_map = sample.given.lobes[function]
    np.testing.assert_array_equal(read[lobe_map.mask], as_stored(lobe_map.lobes[lobe_map.mask]))
    chart = sample.texel_map.chart
    row = int(np.argwhere(chart == 0)[:, 0].mean())
    last = int(np.flatnonzero(chart[row] == 0).max())
    np.testing.assert_array_equal(read[row, last + 1], read[row, last])
    first = int(np.flatnonzero(chart[row] == 1).min())
    np.testing.assert_array_equal(read[row, first - 1], read[row, first])


def test_irradiance_is_kept_where_valid_and_finite_everywhere(make_sample, tmp_path: Path) -> None:
    sample = make_sample()
    build_package(tmp_path, sample.given)
    floats = oiio.ImageBuf(str(tmp_path / "irradiance.exr")).get_pixels(oiio.FLOAT)
    valid = sample.texel_map.state == 1
    np.testing.assert_array_equal(floats[valid], sample.given.irradiance[valid])
    assert np.isfinite(floats).all()
    halves = ktx2.read(tmp_path / "irradiance.ktx2").levels[0][0, 0]
    np.testing.assert_array_equal(halves[..., :3], floats.astype(np.float16))
    assert (halves[..., 3] == 1.0).all()


def test_errors_are_told_where_there_are_lobes(make_sample, tmp_path: Path) -> None:
    given = make_sample().given
    build_package(tmp_path, given)
    told = ktx2.read(tmp_path / "errors.ktx2").levels[0][0, 0]
    for channel, function in enumerate((Function.LIGHT_FIELD, Function.VISIBILITY)):
        errors = given.preview.functions[function].errors
        there = np.isfinite(errors)
        np.testing.assert_array_equal(told[there, channel], errors[there].astype(np.float16))
        assert there.any() and (told[there, 3] == 1.0).all() and (told[~there, channel] == 0.0).all()


def test_environment_textures_read_back(make_sample, tmp_path: Path) -> None:
    given = make_sample().given
    build_package(tmp_path, given)
    cube = ktx2.read(tmp_path / "environment_ggx.ktx2")
    assert (cube.faces, len(cube.levels), cube.is_array) == (6, 4, False)
    for level, mip in zip(cube.levels, given.environment.ggx_mips, strict=True):
        np.testing.assert_array_equal(level[0, ..., :3], mip.astype(np.float16))
    layers = ktx2.read(tmp_path / "environment_u.ktx2")
    assert layers.metadata["lightkiln.alphas"] == "0.04 0.25 1"
    np.testing.assert_array_equal(layers.levels[0][:, 0, ..., :3], given.environment.u_layers.astype(np.float16))
    picture = oiio.ImageBuf(str(tmp_path / "environment.exr"))
    assert picture.spec().format == oiio.HALF
    np.testing.assert_array_equal(picture.get_pixels(oiio.FLOAT), given.environment.panorama.astype(np.float16))


def test_the_same_input_gives_the_same_bytes(make_sample, tmp_path: Path) -> None:
    given = make_sample().given
    first = build_package(tmp_path / "a", given)
    second = build_package(tmp_path / "b", given)
    assert first == second


def test_values_beyond_half_floats_are_clamped_and_counted(make_sample, tmp_path: Path) -> None:
    given = make_sample().given
    bright = given.irradiance.copy()
    bright[np.unravel_index(np.flatnonzero(given.texel_map.state == 1)[:5], given.texel_map.state.shape)] = 1e6
    build_package(tmp_path, dataclasses.replace(given, irradiance=bright))
    halves = ktx2.read(tmp_path / "irradiance.ktx2").levels[0]
    assert halves.max() == 65504.0
    manifest = Manifest.model_validate_json((tmp_path / "manifest.json").read_bytes())
    assert manifest.overflows >= 2 + 15


def test_supercompressed_lobes_hold_the_same_values(make_sample, tmp_path: Path) -> None:
    given = make_sample().given
    build_package(tmp_path / "plain", given)
    build_package(tmp_path / "zstd", dataclasses.replace(given, supercompress=True))
    plain, packed = (tmp_path / name / "lightfield.ktx2" for name in ("plain", "zstd"))
    assert packed.stat().st_size < plain.stat().st_size
    np.testing.assert_array_equal(ktx2.read(packed).levels[0], ktx2.read(plain).levels[0])


def test_a_failed_build_leaves_no_manifest(make_sample, tmp_path: Path) -> None:
    given = make_sample().given
    build_package(tmp_path, given)
    without_uv = tuple(dataclasses.replace(mesh, lightmap_uv=None) for mesh in given.scene.meshes)
    broken = dataclasses.replace(given, scene=dataclasses.replace(given.scene, meshes=without_uv))
    with pytest.raises(InternalError, match="no light-map UV"):
        build_package(tmp_path, broken)
    assert "manifest.json" not in files_in(tmp_path)


def test_arrays_that_contradict_each_other_are_refused_before_anything_is_written(make_sample, tmp_path: Path) -> None:
    given = make_sample().given
    lobe_map = given.lobes[Function.LIGHT_FIELD]
    not_finite = dataclasses.replace(lobe_map, lobes=np.full_like(lobe_map.lobes, np.nan))
    cases = [
        (dataclasses.replace(given, irradiance=given.irradiance[:-1]), "irradiance is"),
        (dataclasses.replace(given, metrics={}), "without metrics"),
        (dataclasses.replace(given, lobes={Function.LIGHT_FIELD: not_finite}), "not finite"),
    ]
    for broken, words in cases:
        with pytest.raises(InternalError, match=words):
            build_package(tmp_path / "p", broken)
    assert not (tmp_path / "p").exists()
