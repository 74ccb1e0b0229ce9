"""Random scenes against plain Mitsuba: a few of them, those that once failed, and faults that the comparison must find.

`make differential` tries 200 scenes.
"""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiln_workers.render.backend import select_variant
from kiln_workers.scene.model import Scene

select_variant("cpu")

from comparison import Comparison, compare, compared, prepared  # noqa: E402
from random_scenes import RandomScene, make_scene  # noqa: E402

ONCE_FAILED = {
    7: "a hole below a texel with a smooth normal let light into the right value from below the horizon",
    82: "a texture of two wrap modes was not interpolated across its border",
}
"""Seeds of `random_scenes` and the kind of fault that they found; they stay."""

PLANTED_IN = 39
PATHS = (512, 2048)


@pytest.mark.parametrize("seed", [1000, 1001, 1002])
def test_a_random_scene_is_lit_as_plain_mitsuba_lights_it(seed: int) -> None:
    outcome = compare(make_scene(seed), 3)
    assert len(outcome.texels) == 3 and not outcome.faults


@pytest.mark.parametrize("seed", ONCE_FAILED)
def test_seeds_that_once_failed(seed: int) -> None:
    outcome = compare(make_scene(seed), 4)
    assert len(outcome.texels) == 4 and not outcome.faults


@pytest.fixture(scope="module")
def sound() -> tuple[Comparison, list[tuple[int, int]], list[np.ndarray]]:
    """A scene, the texels of it that have light, and Mitsuba's values there."""
    with tempfile.TemporaryDirectory() as folder:
        scene, texel_map = prepared(make_scene(PLANTED_IN), Path(folder))
    comparison = Comparison(make_scene(PLANTED_IN), scene, texel_map)
    valid = np.argwhere(texel_map.state == 1)
    places = [(int(row), int(column)) for row, column in valid[len(valid) // 20 :: len(valid) // 10][:10]]
    return comparison, places, [comparison.right(place, PATHS[1], k) for k, place in enumerate(places)]


def deviations(comparison: Comparison, places: list, right: list) -> float:
    """The largest |z|."""
    found = comparison.product(places, PATHS[0], 0)
    return max(np.abs(compared(*row).z).max() for row in zip(places, found, right, strict=True))


def brighter(scene: Scene) -> Scene:
    return replace(scene, environment=replace(scene.environment, scale=1.1 * scene.environment.scale))


def turned(scene: Scene) -> Scene:
    return replace(scene, environment=replace(scene.environment, rotation_deg=scene.environment.rotation_deg + 20.0))


def wrongly_textured(scene: Scene) -> Scene:
    """Each look-up moved by half an image."""
    materials = [
        replace(material, base_color_texture=replace(texture, offset=(texture.offset[0] + 0.5, texture.offset[1])))
        if (texture := material.base_color_texture) is not None
        else material
        for material in scene.materials
    ]
    return replace(scene, materials=tuple(materials))


def test_without_a_planted_fault_nothing_is_found(sound: tuple) -> None:
    assert deviations(*sound) < 4.5
    assert not any(sound[0].misplacement(place) for place in sound[1])


@pytest.mark.parametrize("plant", [brighter, turned, wrongly_textured])
def test_planted_faults_are_found(plant: Callable[[Scene], Scene], sound: tuple) -> None:
    comparison, places, right = sound
    faulty = Comparison(comparison.description, plant(comparison.scene), comparison.map)
    assert deviations(faulty, places, right) > 6.0


def test_a_point_on_no_surface_is_found(sound: tuple) -> None:
    comparison, places, _ = sound
    turned_over = replace(comparison.map, normal=-comparison.map.normal)
    assert Comparison(comparison.description, comparison.scene, turned_over).misplacement(places[0])
    moved = replace(comparison.map, position=comparison.map.position + 3.0 * comparison.map.texel_size[..., None])
    assert Comparison(comparison.description, comparison.scene, moved).misplacement(places[0])


def test_scenes_differ_and_a_seed_gives_the_same_scene() -> None:
    first: list[RandomScene] = [make_scene(seed) for seed in (5, 5, 6)]
    assert first[0].nodes[-1].keys() == first[1].nodes[-1].keys() and first[0].features == first[1].features
    np.testing.assert_array_equal(first[0].parts[0].shape.positions, first[1].parts[0].shape.positions)
    assert not np.array_equal(first[0].parts[0].shape.positions, first[2].parts[0].shape.positions)
