"""Between points lie half-way between texels on the surface, and their light is traced independently of the texels'."""

from pathlib import Path

import numpy as np
import pytest

from kiln_workers.compare.noise import image_errors
from kiln_workers.compare.subject import Subject, open_subject
from kiln_workers.compare.targets import retraced_difference
from kiln_workers.compare.texels import choose_texels
from kiln_workers.render.between import place_between, trace_halves


@pytest.fixture(scope="module")
def subject(kept_bake: Path) -> Subject:
    return open_subject(str(kept_bake), None, None, None)


def test_places_are_the_means_of_the_corners(subject: Subject) -> None:
    """On parallelograms, whose positions are linear in the light-map UV; but points keep off their chart's edge."""
    chosen = choose_texels(subject, None)
    placed = place_between(subject.scene, chosen.texel_map, chosen.field, 1000, 7)
    positions = subject.store.read_texel_map()["position"][tuple(chosen.field.place.T)]
    assert len(placed.points) == len(chosen.field.between) > 300
    means = positions[placed.points.corners].mean(axis=1)
    apart = np.linalg.norm(placed.batch.position - means, axis=1) / placed.batch.texel_size
    assert np.median(apart) < 1e-4 and apart.max() < 0.03
    np.testing.assert_array_equal(placed.batch.normal, chosen.field.normals[placed.points.first])
    again = place_between(subject.scene, chosen.texel_map, chosen.field, 30, 7)
    assert len(again.points) == 90
    other = place_between(subject.scene, chosen.texel_map, chosen.field, 30, 8)
    assert not np.array_equal(other.points.first, again.points.first)


def test_random_numbers_are_nobody_elses(subject: Subject) -> None:
    chosen = choose_texels(subject, None)
    placed = place_between(subject.scene, chosen.texel_map, chosen.field, 10, 7)
    texels = chosen.texel_map.state.size
    assert placed.batch.index.min() >= texels and len(np.unique(placed.batch.index)) == 30
    settings = subject.settings.render
    traced = trace_halves(subject.scene, subject.manifest.scene_hash, settings, placed, texels, 1 << 24)
    normals = placed.batch.normal
    apart = image_errors(*traced.halves, normals, chosen.field.exposure)
    assert traced.samples == settings.samples and not traced.enclosed.any()
    assert 0.001 < apart.log_mse_rel < 0.5
    assert (apart.weight > 5.0).all()  # steradians above the horizon; 2 pi but for pixels that straddle it


def test_the_same_renderer_traces_the_same(subject: Subject) -> None:
    chosen = choose_texels(subject, None)
    assert retraced_difference(subject, chosen, 1 << 24) == 0.0
