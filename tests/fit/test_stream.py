"""The order of training texels: complete, reproducible from any step, and bounded in memory."""

import itertools

import numpy as np
import pytest

from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.fit.source import ArraySource, Float16, Float32, Index, StoreSource
from kiln_workers.fit.stream import TexelStream, plan_epoch
from kiln_workers.store.light_field import LightFieldStore

COUNTS = (5, 16, 1, 9, 16, 12)


class CountingSource:
    """Texel k is an image of the number k; keeps count of how many were read."""

    image_size = 2
    counts = COUNTS

    def __init__(self) -> None:
        self.read = 0
        self.starts = np.concatenate([[0], np.cumsum(COUNTS)])

    def normals(self, tile: int) -> Float32:
        numbers = self.starts[tile] + np.arange(COUNTS[tile])
        return np.repeat(numbers[:, None], 3, axis=1).astype(np.float32)

    def images(self, tile: int, texels: Index) -> Float16:
        self.read += len(texels)
        return np.broadcast_to((self.starts[tile] + texels)[:, None, None, None], (len(texels), 2, 2, 3)).astype(
            np.float16
        )


def numbers(source: CountingSource, window: int, first: int, steps: int, batch: int = 7) -> list[list[int]]:
    out = []
    for got in itertools.islice(TexelStream(source, 3, batch, window).batches(first), steps):
        texels = got.images[:, 0, 0, 0].astype(int)
        np.testing.assert_array_equal(got.normals[:, 1], texels)
        out.append(texels.tolist())
    return out


@pytest.mark.parametrize("window", [1, 8, 20, 58, 59, 1000])
def test_an_epoch_visits_every_texel_once(window: int) -> None:
    total = sum(COUNTS)
    steps = numbers(CountingSource(), window, 0, 2 * total // 7 + 1)
    flat = list(itertools.chain(*steps))
    assert sorted(flat[:total]) == list(range(total)) == sorted(flat[total : 2 * total])
    assert flat[:total] != flat[total : 2 * total]
    chunks = plan_epoch(3, 0, COUNTS, window)
    assert max(map(len, chunks)) <= (total if total <= window else max(1, window // 2))


@pytest.mark.parametrize("window", [8, 20, 1000])
def test_any_step_can_be_resumed(window: int) -> None:
    whole = numbers(CountingSource(), window, 0, 30)
    for first in (1, 5, 8, 9, 17, 29):
        assert numbers(CountingSource(), window, first, 30 - first) == whole[first:]


def test_no_more_than_the_window_is_read_ahead() -> None:
    source, window, batch = CountingSource(), 20, 5
    for step, _ in enumerate(itertools.islice(TexelStream(source, 0, batch, window).batches(0), 40), start=1):
        assert source.read - step * batch <= window
    everything = CountingSource()
    assert len(numbers(everything, 59, 0, 40)) == 40
    assert everything.read == sum(COUNTS)  # it fits: read once


def test_only_valid_texels_stream_from_a_store(tmp_path: object) -> None:
    size, tile = 16, 4
    store = LightFieldStore.create(
        f"file://{tmp_path}/s",
        shape=(6, 8),
        image_size=size,
        tile=tile,
        functions=[Function.LIGHT_FIELD],
        attributes={},
    )
    state = np.zeros((6, 8), np.uint8)
    state[0, 1] = state[3, 3] = state[5, 6] = state[4, 7] = 1
    state[0, 2] = 2
    normals = np.random.default_rng(0).random((6, 8, 3), np.float32)
    tiles = [Tile(row=0, column=0, size=tile, texels=3), Tile(row=4, column=4, size=tile, texels=2)]
    for place, covered in zip(tiles, ([1, 2, 15], [3, 6]), strict=True):
        values = np.stack([np.full((size, size, 3), 10 * place.row + c, np.float16) for c in covered])
        store.write_tile(place, np.array(covered), values, None, np.zeros((len(covered), 3), np.float32))
    source = StoreSource(store, Function.LIGHT_FIELD, state, normals, tiles)
    assert source.counts == (2, 2)
    assert source.images(0, np.array([1, 0]))[:, 0, 0, 0].tolist() == [15.0, 1.0]
    assert source.images(1, np.array([0, 1]))[:, 5, 5, 2].tolist() == [43.0, 46.0]
    np.testing.assert_array_equal(source.normals(1), normals[[4, 5], [7, 6]])


def test_arrays_are_cut_into_tiles() -> None:
    images = np.arange(5, dtype=np.float16)[:, None, None, None] * np.ones((1, 2, 2, 3), np.float16)
    source = ArraySource(images, np.zeros((5, 3), np.float32), tile=2)
    assert source.counts == (2, 2, 1)
    assert source.images(2, np.array([0]))[0, 0, 0, 0] == 4.0
