"""What the coherent descent starts from: which texels, whose lobes each texel takes, small images, the file."""

import numpy as np
import pytest
import torch

from kiln_schemas.errors import InputError
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.network import Shape, initial_parameters
from kiln_workers.fit.pooling import PooledSource, pooled, pooled_size
from kiln_workers.fit.predict import Weights, predict
from kiln_workers.fit.solution import Lobes
from kiln_workers.fit.solvers.coherent import MOST_TEXELS, Start, chosen_texels, find_start, stride
from kiln_workers.fit.solvers.evaluate import errors_at_texels
from kiln_workers.fit.solvers.joint import CoherentOptions, descend
from kiln_workers.fit.solvers.starts import shared_start
from kiln_workers.fit.source import ArraySource

RNG = np.random.default_rng(4)


def start_on(place: np.ndarray, chart: np.ndarray, *, signal: bool = True) -> Start:
    """Lobes that are told apart by their numbers."""
    lobes = np.broadcast_to(np.arange(len(place), dtype=np.float32)[:, None, None], (len(place), 2, 7)).copy()
    return Start(place, chart, lobes, 0.5, signal)


def test_one_texel_in_two_each_way_and_one_of_each_chart() -> None:
    """A square of 9 x 9 texels, and two charts that no texel of the grid lies in."""
    square = np.argwhere(np.ones((9, 9), bool))
    place = np.concatenate([square, [[1, 21], [1, 23], [41, 40]]])
    chart = np.array([5] * 81 + [2, 2, 9])
    chosen = place[chosen_texels(place, chart)].tolist()
    assert chosen == [[r, c] for r in range(0, 9, 2) for c in range(0, 9, 2)] + [[1, 21], [41, 40]]


@pytest.mark.parametrize("side", [100, 500, 2000])
def test_the_start_of_a_large_light_map_is_bounded(side: int) -> None:
    step = stride(side * side)
    assert step >= 2 and (side // step) ** 2 <= MOST_TEXELS


def test_each_texel_takes_the_lobes_of_the_nearest_in_its_chart() -> None:
    """Against a search through all pairs; distances differ, so the nearest one is known."""
    place, chart = RNG.integers(0, 8192, (60, 2)), np.arange(60) % 5
    start = start_on(place, chart)
    texels, charts = RNG.integers(0, 8192, (200, 2)), RNG.integers(0, 5, 200)
    distance = ((texels[:, None] - place[None]) ** 2).sum(axis=2).astype(np.float64)
    distance[charts[:, None] != chart[None]] = np.inf
    assert start.at(texels, charts)[:, 0, 0].tolist() == distance.argmin(axis=1).tolist()
    assert start.at(np.empty((0, 2), np.int64), np.empty(0, np.int64)).shape == (0, 2, 7)


def test_the_file_holds_all_of_it_and_names_what_it_is_not() -> None:
    start = start_on(RNG.integers(0, 64, (7, 2)), np.arange(7))
    read = Start.from_bytes(start.to_bytes())
    for name in ("place", "chart", "lobes"):
        np.testing.assert_array_equal(getattr(read, name), getattr(start, name))
    assert (read.exposure, read.signal) == (0.5, True)
    shape = Shape(16, 2)
    with pytest.raises(InputError, match="fit-weights"):
        Start.from_bytes(Weights(shape, 1.0, True, initial_parameters(shape, 0).numpy()).to_bytes())


def test_scene_units_undo_the_exposure_and_keep_within_fp16() -> None:
    lobes = np.float32([[[0.0, 1.0, 0.0, 9.0, 1.0, 2.0, 60_000.0]]])
    place, chart = np.zeros((1, 2), np.int64), np.zeros(1, np.int64)
    assert start_on(place, chart).in_scene_units(lobes).ravel().tolist() == [0, 1, 0, 9, 2, 4, 65504]
    dark = start_on(place, chart, signal=False).in_scene_units(lobes)
    assert dark.ravel().tolist() == [0, 1, 0, 9, 0, 0, 0]


def test_a_start_is_a_descent_on_the_chosen_texels(lobe_field: TexelField) -> None:
    """Neighbours of the start lie `step` texels apart; without a signal nothing is sought."""
    options = CoherentOptions(steps=200)
    far = TexelField(lobe_field.images, lobe_field.normals, 3 * lobe_field.place, lobe_field.chart, lobe_field.exposure)
    start = find_start(far, 3, 4, options, 0)
    base = constrain(shared_start(lobe_field, 4), torch.from_numpy(lobe_field.normals))
    torch.testing.assert_close(torch.from_numpy(start.lobes), descend(lobe_field, base, options, 0))
    np.testing.assert_array_equal(start.place, far.place)
    assert errors_at_texels(Lobes(torch.from_numpy(start.lobes)), lobe_field).log_mse_rel < 0.1
    dark = find_start(far, 3, 4, options, 0, signal=False)
    np.testing.assert_array_equal(dark.lobes, base.numpy())
    assert not dark.signal and not dark.in_scene_units(dark.lobes)[..., 4:].any()


def test_texels_off_the_grid_are_nobodys_neighbours(lobe_field: TexelField) -> None:
    """Moved off the grid, every texel is descended for by itself: as texels of charts of their own are."""
    count = len(lobe_field)
    images, normals, exposure = lobe_field.images, lobe_field.normals, lobe_field.exposure
    off = TexelField(images, normals, 3 * lobe_field.place + 1, lobe_field.chart, exposure)
    alone = TexelField(images, normals, lobe_field.place, np.arange(count), exposure)
    options = CoherentOptions(steps=20)
    base = constrain(shared_start(alone, 4), torch.from_numpy(normals))
    found = torch.from_numpy(find_start(off, 3, 4, options, 0).lobes)
    torch.testing.assert_close(found, descend(alone, base, options, 0))


def test_the_loss_that_a_step_tells_is_the_error_and_its_continuation_below_the_horizon(lobe_field: TexelField) -> None:
    losses: list[float] = []
    start = constrain(shared_start(lobe_field, 4), torch.from_numpy(lobe_field.normals))
    found = descend(
        lobe_field, start, CoherentOptions(steps=300), 0, on_step=lambda step, raw, loss: losses.append(loss)
    )
    assert len(losses) == 300 and losses[-1] < 0.1 * losses[0]
    # Images of 16 x 16 pixels are seen whole in each step. The continuation has a tenth of the weight.
    first, last = (errors_at_texels(Lobes(lobes), lobe_field).log_mse for lobes in (start, found))
    assert first < losses[0] < 1.1 * first
    assert last < losses[-1]


@pytest.mark.parametrize(("size", "small"), [(16, 16), (32, 32), (48, 48), (64, 32), (96, 48), (128, 32), (256, 32)])
def test_images_are_halved_to_a_size_that_the_network_takes(size: int, small: int) -> None:
    assert pooled_size(size) == small and small % 16 == 0


def test_pooled_images_are_the_means_of_their_squares() -> None:
    images = RNG.uniform(0.0, 4.0, (3, 64, 64, 3)).astype(np.float16)
    small = pooled(images, 32)
    expected = np.zeros((3, 32, 32, 3))
    for row in range(2):
        for column in range(2):
            expected += images[:, row::2, column::2].astype(np.float64) / 4.0
    np.testing.assert_allclose(small.astype(np.float64), expected, rtol=2.0**-10)
    np.testing.assert_array_equal(pooled(images, 64), images)
    source = PooledSource(ArraySource(images, np.zeros((3, 3), np.float32)))
    np.testing.assert_array_equal(source.images(0, np.array([2, 0])), small[[2, 0]])
    assert (source.image_size, list(source.counts)) == (32, [3])


def test_a_network_of_small_images_sees_large_ones_pooled() -> None:
    images = RNG.uniform(0.0, 4.0, (2, 64, 64, 3)).astype(np.float16)
    normals = np.float32([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    shape = Shape(32, 3)
    weights = Weights(shape, 0.5, True, initial_parameters(shape, 0).numpy())
    np.testing.assert_array_equal(predict(weights, images, normals), predict(weights, pooled(images, 32), normals))
