"""The light-field store against stock zarr-python, a rival, a full disk, killed writers and a real S3 server."""

import json
import resource
import shutil
import signal
import subprocess
import sys
import time
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import zarr

from kiln_schemas.errors import Conflict, InputError, InternalError, MachineLacks, NotFound, StoreLost, TilesLost
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.store import location
from kiln_workers.store.light_field import LightFieldStore

R, TILE, SHAPE = 16, 8, (20, 24)
PLACE = Tile(row=8, column=16, size=TILE, texels=4)
COVERED = np.array([0, 3, 17, 63])
SCALE = 3
FINE = np.array([0, 3 * SCALE * TILE + 5, (SCALE * TILE) ** 2 - 1])
"""Row-major in the tile of the finer map."""


def make(url: str, **changes: object) -> LightFieldStore:
    settings: dict[str, object] = {
        "shape": SHAPE,
        "image_size": R,
        "tile": TILE,
        "functions": tuple(Function),
        "attributes": {"scene_hash": "ab" * 32, "settings": {"preset": "draft"}},
    }
    return LightFieldStore.create(url, **(settings | changes))  # type: ignore[arg-type]


def images(count: int, seed: int = 0) -> np.ndarray:
    values = np.random.default_rng(seed).random((count, R, R, 3)).astype(np.float16)
    values[1:2] = 0.0  # a covered texel may be black
    return values


def fill(store: LightFieldStore, seed: int = 0) -> None:
    irradiance = np.arange(12, dtype=np.float32).reshape(4, 3)
    store.write_tile(PLACE, COVERED, images(4, seed), images(4, seed + 1), irradiance)
    if store.irradiance_scale > 1:
        store.write_fine_irradiance(PLACE, FINE, np.arange(12, 21, dtype=np.float32).reshape(3, 3))


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"file://{tmp_path}/a store"


def folder(url: str) -> Path:
    return Path(url.removeprefix("file://"))


def objects(url: str) -> dict[str, bytes]:
    root = folder(url)
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def test_reads_back_what_was_written(url: str) -> None:
    fill(make(url))
    store = LightFieldStore.open(url)
    for seed, function in enumerate(Function):
        np.testing.assert_array_equal(store.read_tile(function, PLACE, COVERED), images(4, seed))
        np.testing.assert_array_equal(store.read_tile(function, PLACE, COVERED[[2, 0]]), images(4, seed)[[2, 0]])
    assert store.read_irradiance([PLACE])[8 + 2, 16 + 1].tolist() == [6.0, 7.0, 8.0]  # 17 = row 2, column 1
    assert store.read_irradiance([PLACE]).sum() == np.arange(12).sum()


def test_the_finer_irradiance_has_its_own_grid(url: str) -> None:
    fill(make(url, irradiance_scale=SCALE))
    found = LightFieldStore.open(url).read_fine_irradiance([PLACE])
    assert found.shape == (SCALE * SHAPE[0], SCALE * SHAPE[1], 3)
    top, left = SCALE * PLACE.row, SCALE * PLACE.column
    assert found[top, left].tolist() == [12.0, 13.0, 14.0]
    assert found[top + 3, left + 5].tolist() == [15.0, 16.0, 17.0]
    assert found[top + SCALE * TILE - 1, left + SCALE * TILE - 1].tolist() == [18.0, 19.0, 20.0]
    assert found.sum() == np.arange(12, 21).sum()
    assert np.asarray(zarr.open_group(folder(url), mode="r")["fine_irradiance"]).sum() == found.sum()  # type: ignore[arg-type]


def test_stock_zarr_python_reads_the_same_and_sees_absent_chunks(url: str) -> None:
    fill(make(url))
    group = zarr.open_group(str(folder(url)), mode="r")
    rows, columns = 8 + COVERED // TILE, 16 + COVERED % TILE
    for seed, name in enumerate(("light_field", "visibility")):
        array = group[name]
        assert isinstance(array, zarr.Array)
        assert array.shards == (TILE, TILE, R, R, 3) and array.chunks == (1, 1, R, R, 3)
        block = np.asarray(array[8:16, 16:24])
        np.testing.assert_array_equal(block[COVERED // TILE, COVERED % TILE], images(4, seed))
        assert np.count_nonzero(block.any(axis=(2, 3, 4))) == 3
    # The shard's index (offset, length of each chunk, then its crc32c) lists the covered texels and no others.
    data = (folder(url) / "light_field" / "c" / "1" / "2" / "0" / "0" / "0").read_bytes()
    index = np.frombuffer(data[-(TILE * TILE * 16 + 4) : -4], "<u8").reshape(-1, 2)
    assert np.flatnonzero(index[:, 0] != 2**64 - 1).tolist() == COVERED.tolist()
    assert len(data) == 4 * (R * R * 6 + 4) + TILE * TILE * 16 + 4
    irradiance = group["irradiance"]
    assert isinstance(irradiance, zarr.Array)
    assert np.asarray(irradiance[rows[3], columns[3]]).tolist() == [9.0, 10.0, 11.0]


def test_attributes_and_texel_map_explain_the_store(url: str) -> None:
    store = make(url)
    rng = np.random.default_rng(1)
    arrays = {
        "position": rng.random((*SHAPE, 3), np.float32),
        "normal": rng.random((*SHAPE, 3), np.float32),
        "alpha": rng.random(SHAPE, np.float32),
        "state": rng.integers(0, 3, SHAPE).astype(np.uint8),
    }
    store.write_texel_map(arrays)
    group = zarr.open_group(str(folder(url)), mode="r")
    assert group.attrs["scene_hash"] == "ab" * 32 and group.attrs["format_version"] == 1
    conventions = group.attrs["conventions"]
    assert isinstance(conventions, dict)
    assert {"octahedral_map", "horizon", "exposure", "units"} <= set(conventions)
    for name, values in arrays.items():
        np.testing.assert_array_equal(np.asarray(group[name]), values)
        np.testing.assert_array_equal(LightFieldStore.open(url).read_texel_map()[name], values)


def test_create_again_is_a_no_op_and_a_different_one_is_refused(url: str) -> None:
    fill(make(url))
    before = objects(url)
    make(url)
    assert objects(url) == before
    with pytest.raises(Conflict, match="image_size"):
        make(url, image_size=32)
    with pytest.raises(Conflict, match="scene_hash"):
        make(url, attributes={"scene_hash": "cd" * 32, "settings": {"preset": "draft"}})
    assert objects(url) == before


def test_a_rewritten_tile_is_the_same_bytes(url: str, tmp_path: Path) -> None:
    fill(make(url))
    once = objects(url)
    fill(make(url))
    assert objects(url) == once
    other = f"file://{tmp_path}/other"
    fill(make(other), seed=7)
    fill(make(other))
    assert objects(other) == once


def test_missing_tile_store_and_function_are_errors(url: str) -> None:
    with pytest.raises(StoreLost, match="not there"):
        LightFieldStore.open(url)
    store = make(url, functions=(Function.LIGHT_FIELD,))
    with pytest.raises(TilesLost, match="tile 8,16 are gone"):
        store.read_tile(Function.LIGHT_FIELD, PLACE, COVERED)
    with pytest.raises(NotFound, match="no visibility"):
        store.read_tile(Function.VISIBILITY, PLACE, COVERED)


SHARDS = {
    "light_field": "light_field/c/1/2/0/0/0",
    "visibility": "visibility/c/1/2/0/0/0",
    "between": "between/c/1/2/0/0/0/0",
    "irradiance": "irradiance/c/1/2/0",
    "fine_irradiance": "fine_irradiance/c/1/2/0",
}
WITHOUT_IMAGES = ("irradiance", "fine_irradiance")


def read(store: LightFieldStore, array: str) -> npt.NDArray[Any]:
    """What a tile has in one of the arrays."""
    if array == "irradiance":
        return store.read_irradiance([PLACE])
    if array == "fine_irradiance":
        return store.read_fine_irradiance([PLACE])
    return (
        store.read_between(PLACE, COVERED) if array == "between" else store.read_tile(Function(array), PLACE, COVERED)
    )


@pytest.mark.parametrize("array", SHARDS)
def test_one_wrong_byte_anywhere_is_found_and_so_is_a_cut_or_lost_object(url: str, array: str) -> None:
    store = make(url, between=True, irradiance_scale=SCALE)
    fill(store)
    store.write_between(PLACE, COVERED, np.ones((4, 3, R // 2, R // 2, 3), np.float16))
    good = read(store, array)
    shard = folder(url) / SHARDS[array]
    data = shard.read_bytes()
    stored = (
        [range(0, len(data), 1 + len(data) // 500)]
        if array in WITHOUT_IMAGES
        else [range(40), range(len(data) // 2, len(data), 7)]
    )
    for place in chain(*stored):
        shard.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        with pytest.raises(TilesLost, match=f"{array} of tile 8,16") as caught:
            read(LightFieldStore.open(url), array)
        assert caught.value.labels == ("tile 8,16",) and caught.value.where == url
    for length in (0, 3, len(data) // 2, len(data) - 1):
        shard.write_bytes(data[:length])
        with pytest.raises(TilesLost, match="damaged"):
            read(LightFieldStore.open(url), array)
    shard.unlink()
    with pytest.raises(TilesLost, match=f"{array} of tile 8,16 are gone"):
        read(LightFieldStore.open(url), array)
    shard.write_bytes(data)
    np.testing.assert_array_equal(read(LightFieldStore.open(url), array), good)


@pytest.mark.parametrize("array", SHARDS)
def test_a_damaged_tile_is_replaced_when_it_is_written_again(url: str, array: str) -> None:
    store = make(url, between=True, irradiance_scale=SCALE)
    between = np.ones((4, 3, R // 2, R // 2, 3), np.float16)
    fill(store)
    store.write_between(PLACE, COVERED, between)
    before = objects(url)
    data = before[SHARDS[array]]
    for bad in (data[:100] + b"x" + data[101:], data[:-2] + b"x" + data[-1:], data[: len(data) // 2], b""):
        (folder(url) / SHARDS[array]).write_bytes(bad)
        again = LightFieldStore.open(url)
        fill(again)
        again.write_between(PLACE, COVERED, between)
        assert objects(url) == before


def test_black_texels_are_stored_and_single_ones_that_are_not_are_an_error(url: str) -> None:
    store = make(url, functions=(Function.LIGHT_FIELD,))
    black = images(4)
    black[1] = 0.0
    store.write_tile(PLACE, COVERED, black, None, np.zeros((4, 3), np.float32))
    np.testing.assert_array_equal(store.read_tile(Function.LIGHT_FIELD, PLACE, COVERED), black)
    assert not store.read_irradiance([PLACE]).any()
    with pytest.raises(TilesLost, match="are gone"):
        store.read_tile(Function.LIGHT_FIELD, PLACE, np.array([*COVERED, 5]))


def test_all_lost_tiles_are_named_at_once(url: str) -> None:
    store = make(url)
    fill(store)
    other, third = (Tile(row=0, column=column, size=TILE, texels=4) for column in (0, 8))
    tiles = {PLACE: COVERED, other: COVERED, third: COVERED}
    with pytest.raises(TilesLost) as caught, store.all_lost(["light_field"], tiles):
        store.read_tile(Function.LIGHT_FIELD, other, COVERED)
    assert caught.value.labels == ("tile 0,0", "tile 0,8")
    with pytest.raises(TilesLost) as caught:
        store.read_irradiance(tiles)
    assert caught.value.labels == ("tile 0,0", "tile 0,8")


@pytest.mark.parametrize("damage", [None, b"{", b'{"zarr_format": 3}'])
@pytest.mark.parametrize("name", ["zarr.json", "visibility/zarr.json"])
def test_a_store_whose_documents_are_damaged_is_made_anew_by_create(url: str, name: str, damage: bytes | None) -> None:
    fill(make(url))
    before = objects(url)
    document = folder(url) / name
    document.unlink() if damage is None else document.write_bytes(damage)
    with pytest.raises(StoreLost):
        LightFieldStore.open(url).read_tile(Function.VISIBILITY, PLACE, COVERED)
    fill(make(url))
    assert objects(url) == before


def test_a_store_that_was_deleted_takes_no_more_tiles(url: str) -> None:
    store = make(url)
    store.check()
    shutil.rmtree(folder(url))
    with pytest.raises(StoreLost, match="not there any more"):
        store.check()


def test_a_texel_map_with_a_lost_part_is_an_error(url: str) -> None:
    store = make(url)
    with pytest.raises(StoreLost, match="are gone"):
        store.read_texel_map()


def test_values_that_are_not_finite_are_refused(url: str) -> None:
    store = make(url, functions=(Function.LIGHT_FIELD,))
    for bad in (np.inf, np.nan):
        values = images(4)
        values[2, 3, 4, 1] = bad
        with pytest.raises(InternalError, match="1 values of light_field are not finite"):
            store.write_tile(PLACE, COVERED, values, None, np.zeros((4, 3), np.float32))
    assert not (folder(url) / "light_field" / "c").exists()


@pytest.mark.parametrize("bad", ["/tmp/x", "http://host/x", "s3://", "file://host/x", "file://"])
def test_places_that_are_none_are_refused(bad: str) -> None:
    with pytest.raises(InputError, match="not a place for a store"):
        LightFieldStore.open(bad)


def test_full_disk_names_the_store_and_leaves_the_old_shard(url: str) -> None:
    store = make(url)
    fill(store)
    before = objects(url)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, hard))
    try:
        with pytest.raises(MachineLacks, match="cannot take more data") as caught:
            fill(store, seed=9)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.where == url and "Free space" in (caught.value.remedy or "")
    assert objects(url) == before


_WRITER = """
import sys, numpy as np
from kiln_schemas.tasks import Tile
from kiln_workers.store import location
from kiln_workers.store.light_field import LightFieldStore
store = LightFieldStore.open(sys.argv[1])
tile = Tile(row=0, column=0, size=store.tile_size, texels=64)
covered = np.arange(64)
print("ready", flush=True)
value = 0
while True:
    value += 1
    images = np.full((64, store.image_size, store.image_size, 3), value, np.float16)
    store.write_tile(tile, covered, images, None, np.full((64, 3), value, np.float32))
"""


def test_killed_writers_leave_no_torn_shard(url: str) -> None:
    make(url, image_size=64, functions=(Function.LIGHT_FIELD,))
    tile = Tile(row=0, column=0, size=TILE, texels=64)
    seen: set[float] = set()
    for trial in range(60):
        with subprocess.Popen([sys.executable, "-c", _WRITER, url], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None and writer.stdout.readline() == b"ready\n"
            time.sleep(0.03 + 0.017 * (trial % 30))
            writer.send_signal(signal.SIGKILL)
        shard = folder(url) / "light_field" / "c" / "0" / "0" / "0" / "0" / "0"
        if shard.exists():
            values = LightFieldStore.open(url).read_tile(Function.LIGHT_FIELD, tile, np.arange(64))
            assert values.min() == values.max() > 0  # one writer's whole tile, checksums right
            seen.add(float(values.max()))
        if trial >= 5 and len(seen) > 1:
            return
    raise AssertionError("sixty writers were killed and no two different tiles seen")


def test_a_real_s3_server(s3_server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in s3_server.environment().items():
        monkeypatch.setenv(name, value)
    url = f"s3://{s3_server.bucket}/bakes/one"
    with pytest.raises(StoreLost, match="not there"):
        LightFieldStore.open(url)
    fill(make(url))
    fill(make(url))
    store = LightFieldStore.open(url)
    np.testing.assert_array_equal(store.read_tile(Function.VISIBILITY, PLACE, COVERED), images(4, 1))
    with pytest.raises(TilesLost, match="tile 0,0 are gone"):
        store.read_tile(Function.VISIBILITY, Tile(row=0, column=0, size=TILE, texels=4), COVERED)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(MachineLacks, match="refuses access"):
        LightFieldStore.open(url)


def test_the_group_document_is_json_with_sorted_keys(url: str) -> None:
    make(url)
    text = (folder(url) / "zarr.json").read_text()
    assert json.dumps(json.loads(text), indent=1, sort_keys=True) == text
    assert not list(folder(url).rglob("*__lock"))


def test_a_disk_that_is_full_for_a_while_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(location, "PAUSE_S", (0.0, 0.0))
    said = ["No space left on device", "Disk quota exceeded", ""]

    def write() -> None:
        if words := said.pop(0):
            raise ValueError(f"RESOURCE_EXHAUSTED: {words}")

    location.write_patiently("file:///store", write)
    assert said == []
    for given_up in ("File too large", "Permission denied"):
        said[:] = [given_up]
        with pytest.raises(MachineLacks):
            location.write_patiently("file:///store", write)
    monkeypatch.setattr(location, "FULL_PATIENCE_S", -1.0)
    said[:] = ["No space left on device"]
    with pytest.raises(MachineLacks, match="cannot take more data"):
        location.write_patiently("file:///store", write)
