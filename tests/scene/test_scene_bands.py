"""The texel map made some rows at a time: the same as all at once, and in memory that does not grow with the map."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiln_schemas.settings import LightmapSettings
from kiln_workers.render.between import between_bands, between_maps
from kiln_workers.scene import bands as bands_module
from kiln_workers.scene import raster, texel_surface
from kiln_workers.scene.atlas import assign_lightmap_uv
from kiln_workers.scene.bands import bands, mapped, release
from kiln_workers.scene.examples import write_examples
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import Image, Material, Scene, TextureRef
from kiln_workers.scene.raster import touched_squares
from kiln_workers.scene.tangents import with_tangents
from kiln_workers.scene.texel_map import open_texel_map, pack_texel_map, speck_share, write_texel_map
from kiln_workers.scene.texels import TexelMaker, build_texel_map
from kiln_workers.store.layout import BETWEEN_STEPS

SIDE = 96


@pytest.fixture(scope="module")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("examples")
    write_examples(folder)
    return assign_lightmap_uv(load_scene(folder, "gallery.glb", None), LightmapSettings(resolution=SIDE))


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bands of 16 rows."""
    monkeypatch.setattr(bands_module, "BAND_TEXELS", 16 * 64)


def test_bands_cover_every_row_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for texels, shape in ((1, (40, 8)), (1 << 17, (8192, 8192)), (1 << 17, (1000, 1000, 3)), (1 << 17, (8, 8))):
        monkeypatch.setattr(bands_module, "BAND_TEXELS", texels)
        rows = [row for band in bands(shape) for row in range(band.start, band.stop)]
        assert rows == list(range(shape[0]))


def test_released_pages_keep_their_values(tmp_path: Path) -> None:
    array = mapped(tmp_path / "array", (300, 5), np.float32)
    array[7:9] = 3.0
    release(array[2:])
    assert array.sum() == 30.0
    release(np.ones(4))


def test_squares_of_some_rows_are_those_of_all_rows() -> None:
    corners = np.random.default_rng(2).random((50, 3, 2)) * 60.0 - 10.0
    whole = touched_squares(corners, 40, 40)
    parts = [touched_squares(corners, 40, 40, rows=slice(first, min(first + 7, 40))) for first in range(0, 40, 7)]
    for name in ("square", "face", "barycentric", "distance"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))


def test_a_map_made_in_bands_has_the_bytes_of_one_made_at_once(
    gallery: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = build_texel_map(gallery, SIDE)
    between = between_maps(gallery, whole)
    assert len(list(bands(whole.state.shape))) == 1 and 0.3 < whole.covered / SIDE**2 < 1.0

    monkeypatch.setattr(bands_module, "BAND_TEXELS", 16 * SIDE)
    maker = TexelMaker(gallery, SIDE)
    rows = list(bands(maker.shape))
    assert len(rows) == 6
    write_texel_map(tmp_path / "map", maker.shape, (maker.pushed(part) for part in rows))
    assert (tmp_path / "map").read_bytes() == pack_texel_map(whole)

    stored = open_texel_map(tmp_path / "map")
    assert speck_share(stored.chart) == speck_share(whole.chart)
    for step, expected in zip(BETWEEN_STEPS, between, strict=True):
        write_texel_map(tmp_path / "between", maker.shape, between_bands(gallery, stored, step))
        assert (tmp_path / "between").read_bytes() == pack_texel_map(expected)
        assert expected.covered > 1000


def test_mapped_normals_do_not_depend_on_the_bands(
    two_quads: Scene, narrow: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two maps, no room to keep the copies of both, and one row of bands or all."""
    random = np.random.default_rng(3)
    pixels = [random.integers(90, 256, (64, 64, 3), dtype=np.uint8) for _ in range(2)]
    materials = [Material(f"m{k}", normal_texture=TextureRef(k, scale=(9, 9))) for k in range(2)]
    meshes = [replace(mesh, material=k, uv=mesh.lightmap_uv, more_uv=()) for k, mesh in enumerate(two_quads.meshes)]
    images = tuple(Image(f"n{k}", image, False) for k, image in enumerate(pixels))
    scene = with_tangents(Scene(tuple(meshes), tuple(materials), images))
    monkeypatch.setattr(texel_surface, "MOST_COPIES_BYTES", 0)
    banded = build_texel_map(scene, 64, "cpu")
    monkeypatch.undo()
    whole = build_texel_map(scene, 64, "cpu")
    assert pack_texel_map(banded) == pack_texel_map(whole)
    covered = whole.state == 1
    assert np.abs(whole.shading_normal - whole.normal)[covered].max() > 0.05


def test_missing_rows_are_a_fault(two_quads: Scene, tmp_path: Path) -> None:
    maker = TexelMaker(two_quads, 64, "cpu")
    with pytest.raises(ValueError, match="the bands have 32 rows, the map 64"):
        write_texel_map(tmp_path / "map", maker.shape, [maker.pushed(slice(0, 32))])


def test_memory_for_a_texel_map_does_not_grow_with_it(
    gallery: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bands_module, "BAND_TEXELS", 1 << 14)
    monkeypatch.setattr(raster, "BATCH_SQUARES", 1 << 15)
    peaks = {}
    for side in (256, 512):
        tracemalloc.start()
        maker = TexelMaker(gallery, side)
        write_texel_map(tmp_path / "map", maker.shape, (maker.pushed(rows) for rows in bands(maker.shape)))
        stored = open_texel_map(tmp_path / "map")
        for _ in between_bands(gallery, stored, BETWEEN_STEPS[0]):
            pass
        peaks[side] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert stored.covered > 0.3 * side**2
    # All at once it was 1,270 bytes a texel.
    assert peaks[512] / 512**2 < 200, peaks
    assert peaks[512] < 1.3 * peaks[256], peaks
