"""A package written some rows at a time: the same bytes as at once, in less memory than its lobes take."""

import dataclasses
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from kiln_schemas.settings import Function
from kiln_workers.package import ktx2
from kiln_workers.package.build import LobeMap, build_package
from kiln_workers.package.dilate import plan_fill
from kiln_workers.package.half import layers_to_lobes
from kiln_workers.package.nearest import Nearest
from kiln_workers.scene import bands as bands_module
from kiln_workers.scene.bands import mapped
from kiln_workers.shade import textures
from kiln_workers.shade.lobe_file import LobeFile


def test_nearest_texels_of_some_rows_are_scipys_of_the_whole_map() -> None:
    random = np.random.default_rng(0)
    for case in range(60):
        height, width = (int(side) for side in random.integers(1, 200, 2))
        known = random.random((height, width)) < (0.0005, 0.01, 0.3, 0.9)[case % 4]
        known[random.integers(height), random.integers(width)] = True
        expected = distance_transform_edt(~known, return_distances=False, return_indices=True)
        first, last = sorted(int(row) for row in random.integers(0, height + 1, 2))
        found = Nearest(known).sources(slice(first, last))
        np.testing.assert_array_equal(np.stack(found), expected[:, first:last], err_msg=f"case {case}")


def test_a_fill_by_rows_is_that_of_the_whole_map() -> None:
    random = np.random.default_rng(1)
    chart = np.repeat(np.repeat(random.integers(-1, 5, (9, 11)), 8, 0), 8, 1).astype(np.int32)
    valid = (chart >= 0) & (random.random(chart.shape) < 0.7)
    valid[chart == 3] = False
    fill, values = plan_fill(valid, chart), random.random((*chart.shape, 3)).astype(np.float32)
    parts = [slice(first, first + 5) for first in range(0, len(chart), 5)]
    for whole in (fill.nearest, fill.smooth):
        np.testing.assert_array_equal(np.concatenate([whole(values, part) for part in parts]), whole(values))
    held = fill.nearest(np.where(valid, chart, -9))
    assert (held == chart)[(chart >= 0) & (chart != 3)].all() and (held >= 0).all()


def test_files_do_not_depend_on_the_bands(make_sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = dataclasses.replace(make_sample().given, supercompress=True)
    whole = build_package(tmp_path / "whole", given)
    monkeypatch.setattr(bands_module, "BAND_TEXELS", 5 * 24 * 8)
    assert build_package(tmp_path / "bands", given) == whole


@pytest.mark.parametrize("supercompress", [False, True])
def test_bands_give_the_bytes_of_a_texture_at_once(
    supercompress: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texels = np.random.default_rng(2).normal(size=(6, 70, 50, 4)).astype(np.float16)
    texture = ktx2.texture_array(texels, {"a": "b"})
    parts = [(first, texels[:, first : first + 16]) for first in range(0, 70, 16)]
    ktx2.write(tmp_path / "whole.ktx2", texture, supercompress=supercompress)
    ktx2.write_bands(tmp_path / "bands.ktx2", texture.shape, parts, supercompress=supercompress)
    assert (tmp_path / "bands.ktx2").read_bytes() == (tmp_path / "whole.ktx2").read_bytes()

    monkeypatch.setattr(ktx2, "ONE_PIECE_BYTES", 0)
    ktx2.write_bands(tmp_path / "stream.ktx2", texture.shape, parts, supercompress=supercompress)
    np.testing.assert_array_equal(ktx2.read(tmp_path / "stream.ktx2").levels[0], texture.levels[0])

    lobes, place = torch.from_numpy(layers_to_lobes(texels)), torch.rand(200, 2)
    layers, shape = ktx2.map_layers(tmp_path / "stream.ktx2", 10**6)
    in_file = LobeFile(layers, shape.height, shape.width, lobes.device)
    torch.testing.assert_close(textures.bilinear(in_file, place), textures.bilinear(lobes, place), rtol=0, atol=0)


def test_memory_for_a_package_is_less_than_its_lobes(
    make_sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bands_module, "BAND_TEXELS", 1 << 13)
    monkeypatch.setattr(ktx2, "ONE_PIECE_BYTES", 0)
    monkeypatch.setattr(ktx2, "STREAM_BYTES", 1 << 16)
    given = make_sample(environment=False).given
    peaks = {}
    for times in (16,):
        side = 24 * times
        large = {
            name: np.kron(getattr(given.texel_map, name), np.ones((times, times), getattr(given.texel_map, name).dtype))
            for name in ("state", "texel_size", "chart")
        }
        texel_map = dataclasses.replace(given.texel_map, **large)
        lobe_map = given.lobes[Function.LIGHT_FIELD]
        lobes = mapped(tmp_path / "lobes", (side, side, 16, 7), np.float16)
        lobes[:] = np.nan_to_num(lobe_map.lobes).repeat(times, 0).repeat(times, 1).repeat(4, 2)
        mask = lobe_map.mask.repeat(times, 0).repeat(times, 1)
        errors = given.preview.functions[Function.LIGHT_FIELD].errors.repeat(times, 0).repeat(times, 1)
        shown = dataclasses.replace(given.preview.functions[Function.LIGHT_FIELD], errors=errors)
        whole = dataclasses.replace(
            given,
            texel_map=texel_map,
            irradiance_map=texel_map,
            irradiance=given.irradiance.repeat(times, 0).repeat(times, 1),
            lobes={Function.LIGHT_FIELD: LobeMap(lobes, mask)},
            preview=dataclasses.replace(given.preview, functions={Function.LIGHT_FIELD: shown}),
            supercompress=True,
        )
        tracemalloc.start()
        build_package(tmp_path / "package", whole)
        peaks[side] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    # A texel's lobes take 448 bytes as float32; a package made at once took 2,800 bytes of the process a texel.
    assert peaks[384] / 384**2 < 250, peaks
