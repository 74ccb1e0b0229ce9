"""The stages in one process, on a room: what the package's textures hold is what the fit gave."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from e2e_farm import TINY, room, sky
from in_process import Baked, MemoryContext, bake

from kiln_schemas.camera import Camera
from kiln_schemas.errors import Canceled, FitFailed, InputError
from kiln_schemas.gates import Gates
from kiln_schemas.manifest import Manifest
from kiln_schemas.settings import Function, make_settings
from kiln_schemas.tasks import (
    Bundle,
    FitPayload,
    PackagePayload,
    RefineResult,
)
from kiln_workers.fit.metrics import TexelErrors, texel_errors
from kiln_workers.fit.predict import Weights, predict
from kiln_workers.fit.solvers.coherent import Start
from kiln_workers.package import ktx2
from kiln_workers.package.build import LOBE_FILES
from kiln_workers.package.exr import write_rgb
from kiln_workers.package.gates import Judgement
from kiln_workers.package.glb import encode_glb
from kiln_workers.package.half import layers_to_lobes
from kiln_workers.scene.archive import unpack_scene
from kiln_workers.scene.container import pack, unpack
from kiln_workers.scene.model import Environment
from kiln_workers.scene.texel_map import TexelState, unpack_texel_map
from kiln_workers.shade.first_camera import first_camera
from kiln_workers.shade.gbuffer import render_gbuffer
from kiln_workers.shade.image_metrics import flip
from kiln_workers.shade.package import ShadePackage, read_manifest
from kiln_workers.shade.picture import shade
from kiln_workers.shade.reference import path_trace
from kiln_workers.stages import fit as fit_stage
from kiln_workers.stages import gates, package, prepare, refine, render
from kiln_workers.stages.tiles import covered_texels, map_coordinates, plan_tiles, with_render_verdict
from kiln_workers.store.layout import BETWEEN_STEPS
from kiln_workers.store.light_field import LightFieldStore

FRONT = Camera(position=(0.3, 1.1, 3.6), target=(0.0, 0.9, -0.5), fov_deg=45)
GATES = Gates(log_mse_rel=1e-6, visibility_log_mse_rel=0.5, flip={"front": 0.6})
"""One that is missed and two that are met; the loose one makes do with few paths."""


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Baked:
    scene = replace(room(), environment=Environment(sky()))
    settings = make_settings("draft", TINY)
    return bake(tmp_path_factory.mktemp("stages"), scene, settings, gates=GATES, cameras={"front": FRONT})


def _valid(baked: Baked, function: Function) -> Iterator[tuple[tuple[Any, Any], Any, Any]]:
    """(rows, columns), images and normals of the valid texels, tile by tile."""
    texel_map = with_render_verdict(unpack_texel_map(baked.context.blob(baked.prepared.texel_map)), baked.renders)
    store = LightFieldStore.open(baked.prepare_payload.store_url)
    for tile in baked.prepared.tiles:
        inside = covered_texels(texel_map, tile)
        place = map_coordinates(tile, inside)
        valid = texel_map.state[place] == TexelState.VALID
        inside, place = inside[valid], (place[0][valid], place[1][valid])
        yield place, store.read_tile(function, tile, inside), texel_map.normal[place]


def _texture(baked: Baked, name: str) -> Any:
    return layers_to_lobes(ktx2.decode(baked.artifact(name)).levels[0][:, 0])


def test_the_networks_output_is_what_a_package_holds_without_the_descent(tmp_path: Path) -> None:
    """At every valid texel the stored lobes are the network's, up to fp16: axes, sharpness and amplitude."""
    network = ["fit.solver=cnn", "fit.steps=400", "fit.visibility_steps=400"]
    scene = replace(room(), environment=Environment(sky()))
    baked = bake(tmp_path, scene, make_settings("draft", [*TINY, *network]))
    assert not baked.refines
    for fit in baked.fits:
        stored, compared = _texture(baked, LOBE_FILES[fit.function]), 0
        weights = Weights.from_bytes(baked.context.blob(fit.weights))
        for place, images, normals in _valid(baked, fit.function):
            expected = predict(weights, images, normals)
            np.testing.assert_allclose(stored[place], expected, rtol=2.0**-10, atol=2.0**-11)
            compared += len(images)
        assert compared == fit.metrics.texels > 50


@pytest.mark.parametrize("function", list(Function))
def test_a_function_holds_the_refined_lobes(baked: Baked, function: Function) -> None:
    """Every valid texel is in one block; its lobes are the block's up to fp16, and better than those at the start."""
    stored, compared = _texture(baked, LOBE_FILES[function]), 0
    fit = next(fit for fit in baked.fits if fit.function is function)
    start = Start.from_bytes(baked.context.blob(fit.weights))
    texel_map = unpack_texel_map(baked.context.blob(baked.prepared.texel_map))
    for result in baked.refines:
        place, lobes = refine.read_lobes(baked.context.blob(result.lobes), function)
        np.testing.assert_allclose(stored[place], lobes, rtol=2.0**-10, atol=2.0**-11)
        compared += result.texels
    refined, before = [], []
    for place, images, normals in _valid(baked, function):
        refined.append(texel_errors(stored[place].astype(np.float32), images, normals, fit.exposure))
        chart = texel_map.chart[place].astype(np.int64)
        lobes = start.in_scene_units(start.at(np.stack(place, axis=1), chart))
        before.append(texel_errors(lobes, images, normals, fit.exposure))
    errors = TexelErrors.join(refined)
    assert compared == len(errors.error) > fit.metrics.texels > 10
    assert errors.log_mse < TexelErrors.join(before).log_mse
    metrics = Manifest.model_validate_json(baked.artifact("manifest.json")).metrics
    stated = metrics.light_field if function is Function.LIGHT_FIELD else metrics.visibility
    assert stated is not None and stated.log_mse == pytest.approx(errors.log_mse, rel=1e-3)


def without_light(baked: Baked) -> tuple[RefineResult, ...]:
    """The refined blocks with lobes that carry no light."""
    out = []
    for result in baked.refines:
        body, arrays = unpack("lobes", baked.context.blob(result.lobes))
        lobes = arrays["light_field"].copy()
        lobes[..., 4:] = 0.0
        blob = baked.context.put_blob(pack("lobes", body, {**arrays, "light_field": lobes}))
        out.append(result.model_copy(update={"lobes": blob}))
    return tuple(out)


def test_refined_lobes_that_fail_are_refused_or_left_out(
    baked: Baked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """FitFailed with the setting to raise; where nobody would see the light field it is left out instead."""
    payload = payload_of_gates(
        baked,
        **{"renders": baked.renders, "fits": baked.fits, "refines": without_light(baked)},
        store_url=baked.prepare_payload.store_url,
    )
    context = MemoryContext(scratch=tmp_path / "failed", blobs=dict(baked.context.blobs))
    context.scratch.mkdir()
    with pytest.raises(FitFailed, match="100% of the") as caught:
        package.run(payload, context)
    assert "fit.refine_steps (now 60)" in (caught.value.remedy or "")

    bright = np.full((16, 16, 3), 1e6, np.float32)
    monkeypatch.setattr(LightFieldStore, "read_irradiance", lambda self, tiles: bright)
    result = package.run(payload, context)
    (digest,) = (artifact.sha256 for artifact in result.artifacts if artifact.name == "manifest.json")
    manifest = Manifest.model_validate_json(context.blob(digest))
    assert manifest.metrics.light_field is not None and not manifest.metrics.light_field.signal
    assert any("no lobes fit it" in note for note in manifest.notes)


def test_refining_a_block_again_gives_the_same_bytes(baked: Baked) -> None:
    """On another number of threads, and with tiles that do not touch the block."""
    context = MemoryContext(scratch=baked.context.scratch, blobs=dict(baked.context.blobs), threads=1)
    again = refine.run(baked.refine_payloads[1], context)
    assert again.lobes == baked.refines[1].lobes


def test_light_fields_between_are_those_of_a_texel_map_moved_by_half_a_texel(baked: Baked) -> None:
    """What the store holds between two texels lies between them in brightness, and is nothing where no point counts."""
    store = LightFieldStore.open(baked.prepare_payload.store_url)
    texel_map = unpack_texel_map(baked.context.blob(baked.prepared.texel_map))
    moved = [unpack_texel_map(baked.context.blob(digest)) for digest in baked.prepared.between]
    brightness, expected, empty = [], [], 0
    means = np.zeros(texel_map.state.shape)
    for place, images, _ in _valid(baked, Function.LIGHT_FIELD):
        means[place] = images.astype(np.float64).mean(axis=(1, 2, 3))
    for tile in baked.prepared.tiles:
        inside = covered_texels(texel_map, tile)
        rows, columns = map_coordinates(tile, inside)
        sparse = store.read_between(tile, inside).astype(np.float64).mean(axis=(2, 3, 4))
        for kind, (down, right) in enumerate(BETWEEN_STEPS):
            counts = moved[kind].state[rows, columns] == TexelState.VALID
            empty += int(np.count_nonzero(~counts))
            assert not sparse[~counts, kind].any()
            r, c = rows[counts], columns[counts]
            near = moved[kind].position[r, c] - 0.5 * (
                texel_map.position[r, c] + texel_map.position[r + down, c + right]
            )
            # The room is flat; points at the edges of faces are pulled in by a fiftieth of a texel.
            assert np.abs(near).max() < 0.03 * texel_map.texel_size[r, c].max()
            brightness += sparse[counts, kind].tolist()
            expected += (0.5 * (means[r, c] + means[r + down, c + right])).tolist()
    assert empty > 0 and len(brightness) > 100
    assert np.corrcoef(brightness, expected)[0, 1] > 0.9
    assert np.mean(brightness) == pytest.approx(np.mean(expected), rel=0.05)


def test_rendering_a_tile_again_gives_the_same_result(baked: Baked) -> None:
    """Also from a cold start and with another memory bound."""
    store = LightFieldStore.open(baked.prepare_payload.store_url)
    tile = baked.prepared.tiles[0]
    inside = covered_texels(unpack_texel_map(baked.context.blob(baked.prepared.texel_map)), tile)
    before = [store.read_tile(function, tile, inside).tobytes() for function in Function]
    cold = MemoryContext(scratch=baked.context.scratch, blobs=baked.context.blobs, memory_bytes=1 << 22)
    again = render.run(baked.render_payload(0), cold)
    assert again.model_copy(update={"seconds": 0.0}) == baked.renders[0].model_copy(update={"seconds": 0.0})
    assert [store.read_tile(function, tile, inside).tobytes() for function in Function] == before


def test_every_texel_is_in_one_tile(baked: Baked) -> None:
    texel_map = unpack_texel_map(baked.context.blob(baked.prepared.texel_map))
    count = np.zeros(texel_map.state.shape, int)
    for tile in plan_tiles(texel_map, 8):
        inside = covered_texels(texel_map, tile)
        assert len(inside) == tile.texels
        count[map_coordinates(tile, inside)] += 1
    np.testing.assert_array_equal(count, texel_map.state != TexelState.GUTTER)


def test_a_canceled_stage_stops(baked: Baked) -> None:
    context = MemoryContext(scratch=baked.context.scratch, blobs=baked.context.blobs, canceled=True)
    with pytest.raises(Canceled):
        render.run(baked.render_payload(0), context)


def test_a_dark_scene_is_refused(baked: Baked) -> None:
    """No lamp and no environment: there is no light to bake, and the sentence says so."""
    context = MemoryContext(scratch=baked.context.scratch)
    bundle = Bundle(entry="dark.glb", files={"dark.glb": context.put_blob(encode_glb(room(lamp=0.0)))})
    with pytest.raises(InputError, match="light"):
        prepare.run(baked.prepare_payload.model_copy(update={"bundle": bundle}), context)


@pytest.fixture(scope="module")
def downloaded(baked: Baked, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package as a client has it."""
    return baked.download(tmp_path_factory.mktemp("downloaded"))


def test_lobes_are_compressed_where_the_settings_say_so(downloaded: Path) -> None:
    manifest = read_manifest(downloaded)
    for name in ("lightfield.ktx2", "visibility.ktx2"):
        assert manifest.textures[name]["supercompression"] == "zstd"
        scheme = int.from_bytes((downloaded / name).read_bytes()[44:48], "little")
        assert scheme == 2


def test_gates_are_in_the_result_the_manifest_and_the_files(baked: Baked, downloaded: Path) -> None:
    manifest = Manifest.model_validate_json((downloaded / "manifest.json").read_bytes())
    light, visibility, front = baked.packaged.gates
    assert manifest.gates == baked.packaged.gates
    assert manifest.metrics.light_field is not None and manifest.metrics.visibility is not None
    assert (light.name, light.value) == ("log_mse_rel", manifest.metrics.light_field.log_mse_rel)
    assert visibility.value == manifest.metrics.visibility.log_mse_rel
    assert [gate.passed for gate in manifest.gates] == [False, True, True]
    assert front.flip_of_halves is not None and front.noise_floor is not None
    assert 0.0 < front.noise_floor < front.flip_of_halves < 0.3

    suite = ElementTree.parse(downloaded / "gates.xml").getroot()
    assert (suite.get("name"), suite.get("tests"), suite.get("failures")) == ("room", "3", "1")
    assert [case.get("name") for case in suite] == ["log_mse_rel", "visibility_log_mse_rel", "flip.front"]
    assert [case.find("failure") is not None for case in suite] == [True, False, False]
    types = {a.name: a.media_type for a in manifest.files}
    assert types["gates.xml"] == "application/xml"
    assert types["gates/front.png"] == types["gates/front_reference.png"] == "image/png"
    report = (downloaded / "report.html").read_text()
    assert "Quality gates: 1 of 3 missed" in report and "front: the reference, path-traced" in report


def test_flip_is_that_of_the_package_as_downloaded(baked: Baked, downloaded: Path) -> None:
    package = ShadePackage.read(downloaded, torch.device("cpu"))
    picture = shade(package, render_gbuffer(package.scene, FRONT, 480, 270))
    scene = unpack_scene(baked.context.blob(baked.prepared.scene))
    reference = path_trace(scene, FRONT, 480, 270, samples=64, max_depth=12, seed=1)
    stated = baked.packaged.gates[2]
    assert stated.value == pytest.approx(flip(reference.picture, picture), rel=1e-3)
    assert stated.flip_of_halves == pytest.approx(flip(*reference.halves), rel=1e-3)
    # The pictures have one white point, so they look alike where the package is right.
    shown = [
        oiio.ImageBuf(str(downloaded / f"gates/front{end}.png")).get_pixels(oiio.FLOAT) for end in ("", "_reference")
    ]
    assert shown[0].shape == (270, 480, 3) and shown[0].mean() == pytest.approx(shown[1].mean(), rel=0.2)


def payload_of_gates(baked: Baked, **changes: Any) -> PackagePayload:
    """What a package task is given, as far as gates look at it."""
    fields = {
        **{"job_id": "j", "job_name": "room", "renders": (), "fits": (), "store_url": ""},
        **{"bundle": baked.prepare_payload.bundle, "prepare": baked.prepared},
        "settings": baked.prepare_payload.settings,
    }
    return PackagePayload(**fields | changes)


def test_a_package_without_its_irradiance_misses_the_gate(
    baked: Baked, downloaded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gates, "WIDTH", 96)
    monkeypatch.setattr(gates, "HEIGHT", 54)
    shutil.copytree(downloaded, tmp_path / "dark")
    write_rgb(tmp_path / "dark" / "irradiance.exr", np.zeros((16, 16, 3), np.float32))
    payload = payload_of_gates(baked, gates=Gates(flip={"front": 0.3}), cameras={"front": FRONT})
    told: list[str] = []
    scene = unpack_scene(baked.context.blob(baked.prepared.scene))
    judge = gates.GateJudge(payload, scene, {}, told.append, baked.context.blob)
    values = {}
    for folder in (downloaded, tmp_path / "dark"):
        (result,) = judge(folder, read_manifest(folder)).results
        values[folder.name] = result.value
        assert result.flip_of_halves is not None and result.flip_of_halves <= 0.15, "half of the threshold"
    assert values["dark"] > 0.3 > values[downloaded.name]
    assert told[0] == "shading from camera front" and told[1] == "path-tracing from camera front"


def test_without_a_gate_one_picture_is_compared(baked: Baked, downloaded: Path, tmp_path: Path) -> None:
    """From where the viewer looks first; what is wrong in a file is noticed, and who does not want it has none."""
    scene = unpack_scene(baked.context.blob(baked.prepared.scene))

    def judged(folder: Path, *overrides: str, cameras: dict[str, Camera] | None = None) -> Judgement:
        settings = make_settings("draft", [*TINY, "package.pictures=on", *overrides])
        payload = payload_of_gates(baked, settings=settings, cameras=cameras or {})
        judge = gates.GateJudge(payload, scene, {}, lambda message: None, baked.context.blob)
        return judge(folder, read_manifest(folder))

    found = judged(downloaded)
    assert found.results == () and [view.camera for view in found.views] == ["first"]
    seen = found.views[0].seen
    assert (seen.width, seen.height, seen.samples) == (192, 108, 64)
    assert seen.camera == first_camera(scene, 192 / 108)
    package = ShadePackage.read(downloaded, torch.device("cpu"))
    picture = shade(package, render_gbuffer(package.scene, seen.camera, 192, 108))
    reference = path_trace(scene, seen.camera, 192, 108, 64, 12)
    assert seen.flip == pytest.approx(flip(reference.picture, picture), rel=1e-3)
    assert seen.noise_floor is not None and 0.0 < seen.noise_floor < 0.2

    shutil.copytree(downloaded, tmp_path / "dark")
    write_rgb(tmp_path / "dark" / "irradiance.exr", np.zeros((16, 16, 3), np.float32))
    dark = judged(tmp_path / "dark").views[0].seen
    assert dark.flip is not None and seen.flip is not None and dark.flip > seen.flip + 0.1
    assert dark.noise_floor == seen.noise_floor

    named = judged(downloaded, cameras={"front": FRONT}).views
    assert [(view.camera, view.seen.camera) for view in named] == [("front", FRONT)]
    off = judged(downloaded, "package.pictures=off")
    assert off.views == () and off.not_compared == "package.pictures is off"


def test_a_light_map_without_a_valid_texel_is_told_of(baked: Baked, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_stage, "valid_texels", lambda state, tile: np.zeros(0, np.int64))
    monkeypatch.setattr("kiln_workers.fit.source.valid_texels", lambda state, tile: np.zeros(0, np.int64))
    payload = FitPayload(
        function=Function.LIGHT_FIELD,
        texel_map=baked.prepared.texel_map,
        renders=baked.renders,
        settings=baked.prepare_payload.settings,
        store_url=baked.prepare_payload.store_url,
    )
    with pytest.raises(InputError, match="no texel of the light map is valid"):
        fit_stage.run(payload, baked.context)
