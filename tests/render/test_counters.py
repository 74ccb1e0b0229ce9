"""The counters: SplitMix64 as published, uniform, and independent between lanes."""

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from kiln_workers.render import counters

MASK = (1 << 64) - 1
FALSE_ALARMS = 1e-4


def reference_mix(z: int) -> int:
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
    return z ^ (z >> 31)


def test_generator_is_splitmix64() -> None:
    """The first outputs from state 0 as every published implementation gives them."""
    published = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    state, got = 0, []
    for _ in published:
        state = (state + counters.GAMMA) & MASK
        got.append(reference_mix(state))
    assert got == published
    values = [0, 1, 12345678901234567890, MASK]
    assert np.array(counters.mix(mi.UInt64(values))).tolist() == [reference_mix(v) for v in values]


def test_pairs_fill_the_square_evenly() -> None:
    """Chi-squared over 32 x 32 cells of the first pair of 2^20 neighbouring lanes and samples."""
    texel, element = np.divmod(np.arange(1 << 20), 1 << 10)
    lane = counters.lane_state(7, counters.STREAM_LIGHT_FIELD, mi.UInt64(texel), mi.UInt32(element.astype(np.uint32)))
    _, point = counters.pair(counters.sample_state(lane, dr.zeros(mi.UInt32, 1 << 20)))
    x, y = np.array(point.x), np.array(point.y)
    assert x.min() >= 0.0 and max(x.max(), y.max()) < 1.0
    counts = np.bincount((x * 32).astype(int) * 32 + (y * 32).astype(int), minlength=1024)
    assert stats.chisquare(counts).pvalue > FALSE_ALARMS
    lag = np.corrcoef(x[:-1], x[1:])[0, 1]
    assert abs(lag) * np.sqrt(len(x)) < stats.norm.isf(FALSE_ALARMS / 2)


def test_stratified_pairs_are_strata() -> None:
    """64 points of a lane: every one of 4 x 4 cells holds 3 to 5, where random points would not."""
    samples = mi.UInt32(np.tile(np.arange(64, dtype=np.uint32), 50))
    lanes = counters.lane_state(7, 1, mi.UInt64(np.repeat(np.arange(50), 64)), mi.UInt32(0))
    point = np.array(counters.stratified_pair(lanes, samples)).T.reshape(50, 64, 2)
    cells = (point * 4).astype(int) @ [4, 1]
    counts = np.stack([np.bincount(row, minlength=16) for row in cells])
    assert counts.min() >= 2 and counts.max() <= 6
    # The shift makes each point uniform over the lanes.
    lanes = counters.lane_state(7, 1, mi.UInt64(np.arange(1 << 16)), mi.UInt32(0))
    x = np.array(counters.stratified_pair(lanes, dr.full(mi.UInt32, 5, 1 << 16)).x)
    assert stats.kstest(x, "uniform").pvalue > FALSE_ALARMS
