"""The same texels give the same bytes, however the work is cut."""

from collections.abc import Callable
from dataclasses import fields

import drjit as dr
import numpy as np
import pytest

from kiln_schemas.errors import MachineLacks
from kiln_workers.render.tile import BYTES_PER_LANE, SMALLEST_WAVEFRONT, TexelBatch, TileImages, TileRenderer
from kiln_workers.scene.model import Environment, Scene

ARRAYS = ("light_field", "visibility", "irradiance", "enclosed")


def subset(texels: TexelBatch, order: np.ndarray) -> TexelBatch:
    return TexelBatch(**{f.name: getattr(texels, f.name)[order] for f in fields(texels)})


def same_bytes(a: TileImages, b: TileImages, order: np.ndarray) -> None:
    for name in ARRAYS:
        assert getattr(a, name)[order].tobytes() == getattr(b, name).tobytes(), name


@pytest.fixture
def spots(texels: Callable[..., TexelBatch]) -> TexelBatch:
    random = np.random.default_rng(3)
    batch = texels(np.stack([random.random(37), np.zeros(37), random.random(37)], axis=-1).tolist())
    tilted = random.normal(size=(37, 3)) * 0.4 + [0.0, 1.0, 0.0]
    tilted = (tilted / np.linalg.norm(tilted, axis=-1, keepdims=True)).astype(np.float32)
    alpha = random.choice([0.05, 0.2, 0.5], 37).astype(np.float32)
    return TexelBatch(batch.index, batch.position, tilted, tilted, alpha, batch.texel_size)


def test_memory_order_and_composition_change_nothing(
    cornell: Callable[..., Scene], spots: TexelBatch, renderer: Callable[..., TileRenderer], sky: Environment
) -> None:
    scene = cornell(sky)
    settings = {"image_size": 64, "samples": 2, "irradiance_samples": 40}
    whole = renderer(scene, **settings).render(spots)
    small = renderer(scene, memory=BYTES_PER_LANE * SMALLEST_WAVEFRONT, **settings)
    assert small.wavefront == SMALLEST_WAVEFRONT
    same_bytes(whole, small.render(spots), np.arange(37))
    order = np.random.default_rng(4).permutation(37)[:11]
    same_bytes(whole, small.render(subset(spots, order)), order)


def test_threads_change_nothing(
    cornell: Callable[..., Scene], spots: TexelBatch, renderer: Callable[..., TileRenderer], sky: Environment
) -> None:
    tile = renderer(cornell(sky), samples=4, irradiance_samples=40)
    whole = tile.render(spots)
    threads = dr.thread_count()
    try:
        dr.set_thread_count(1)
        same_bytes(whole, tile.render(spots), np.arange(37))
    finally:
        dr.set_thread_count(threads)


def test_another_scene_hash_gives_other_noise(
    cornell: Callable[..., Scene], spots: TexelBatch, renderer: Callable[..., TileRenderer]
) -> None:
    scene = cornell()
    a, b = (renderer(scene, key=key, samples=1).render(spots).light_field for key in (1, 2))
    assert (a != b).mean() > 0.2


def test_progress_ends_at_one_and_may_stop(
    cornell: Callable[..., Scene], spots: TexelBatch, renderer: Callable[..., TileRenderer], sky: Environment
) -> None:
    tile = renderer(cornell(sky), samples=1)
    seen: list[float] = []
    tile.render(spots, seen.append)
    assert seen == sorted(seen) and seen[-1] == pytest.approx(1.0)

    def stop(fraction: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tile.render(spots, stop)


def test_too_little_memory_is_refused(cornell: Callable[..., Scene], renderer: Callable[..., TileRenderer]) -> None:
    with pytest.raises(MachineLacks, match="Allow at least"):
        renderer(cornell(), memory=1000)
