"""glTF's surface in the renderer against `sphere.ggx` and quadrature: values, density, samples, energy."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from kiln_workers.render.gltf_bsdf import register_bsdfs
from kiln_workers.sphere import ggx
from kiln_workers.sphere.quadrature import fibonacci_sphere

SURFACES = [(0.05, 1.0), (0.3, 1.0), (0.3, 0.0), (0.7, 0.4), (1.0, 0.0)]
BASE = np.array([0.9, 0.6, 0.2])


def surface(roughness: float, metallic: float, base: np.ndarray = BASE):
    register_bsdfs()
    textures = {"base_color": {"type": "rgb", "value": base.tolist()}}
    textures |= {
        name: {"type": "uniform", "value": v} for name, v in (("roughness", roughness), ("metallic", metallic))
    }
    return mi.load_dict({"type": "kiln_gltf", **{name: mi.load_dict(value) for name, value in textures.items()}})


def seen_from(wi: np.ndarray):
    """Surface interactions seen from local directions [K, 3], or from one."""
    si = dr.zeros(mi.SurfaceInteraction3f, max(1, wi.size // 3))
    si.wi = mi.Vector3f(np.ascontiguousarray(np.atleast_2d(wi).T.astype(np.float32)))
    return si


def evaluated(bsdf, wi: np.ndarray, wo: np.ndarray, context=None) -> tuple[np.ndarray, np.ndarray]:
    """BRDF times cosine [K, 3] and density [K]."""
    out = mi.Vector3f(np.ascontiguousarray(wo.T.astype(np.float32)))
    value, pdf = bsdf.eval_pdf(context or mi.BSDFContext(), seen_from(wi), out, True)
    return np.array(value).T.astype(np.float64), np.array(pdf).astype(np.float64)


def direction(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.array([0.6 * np.sin(angle), 0.8 * np.sin(angle), np.cos(angle)])


def upper(count: int) -> np.ndarray:
    points = fibonacci_sphere(count)
    return points[points[:, 2] > 0.0]


def slow_value(wi: np.ndarray, wo: np.ndarray, roughness: float, metallic: float) -> np.ndarray:
    """glTF 2.0, appendix B.2: mix(dielectric, metal, metallic), times the cosine; [K, 3]."""
    half = wi + wo
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    cos_d = (wo * half).sum(-1)[:, None]
    shape = ggx.distribution(half[:, 2], roughness**2)
    shape = shape * ggx.masking_shadowing(wo[:, 2], wi[:, 2], roughness**2) / (4.0 * wo[:, 2] * wi[:, 2])
    fresnel = ggx.fresnel_schlick(cos_d, 0.04)
    dielectric = fresnel * shape[:, None] + (1.0 - fresnel) * BASE / np.pi
    metal = ggx.fresnel_schlick(cos_d, BASE) * shape[:, None]
    return (dielectric + metallic * (metal - dielectric)) * wo[:, 2:]


@pytest.mark.parametrize(("roughness", "metallic"), SURFACES)
def test_values_are_those_of_the_specification(roughness: float, metallic: float) -> None:
    """At random, and in the mirror direction, where sharp lobes have all of their light."""
    random = np.random.default_rng(1)
    wi, wo = np.abs(random.normal(size=(2, 400, 3))) + np.array([0.0, 0.0, 0.05])
    wo[:200] = wi[:200] * [-1.0, -1.0, 1.0]
    wi, wo = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (wi, wo))
    found, _ = evaluated(surface(roughness, metallic), wi, wo)
    np.testing.assert_allclose(found, slow_value(wi, wo, roughness, metallic), rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize(("roughness", "metallic"), SURFACES)
def test_reciprocity(roughness: float, metallic: float) -> None:
    bsdf, wo = surface(roughness, metallic), upper(2000)
    wi = np.roll(wo, 333, axis=0)
    there, back = (evaluated(bsdf, a, b)[0] / b[:, 2:] for a, b in ((wi, wo), (wo, wi)))
    assert there.min() > 0.0
    np.testing.assert_allclose(there, back, rtol=5e-3, atol=1e-6)


def test_nothing_below_the_surface() -> None:
    bsdf, below = surface(0.5, 0.3), direction(30.0) * [1.0, 1.0, -1.0]
    for wi, wo in ((direction(20.0), below), (below, direction(20.0))):
        value, pdf = evaluated(bsdf, wi, wo[None])
        assert not value.any() and not pdf.any()
    assert evaluated(bsdf, direction(20.0), direction(30.0)[None])[0].min() > 0.01


@pytest.mark.parametrize(("roughness", "metallic"), SURFACES[1:])
@pytest.mark.parametrize("degrees", [10.0, 75.0])
def test_samples_follow_the_density_and_are_weighted_right(roughness: float, metallic: float, degrees: float) -> None:
    """Chi-squared over 12 x 24 cells of equal solid angle, false alarms at 1e-5; the mean weight is the albedo."""
    bsdf, wi, count = surface(roughness, metallic), direction(degrees), 1 << 17
    random = np.random.default_rng(7)
    numbers = [mi.Float(random.random(count).astype(np.float32)) for _ in range(3)]
    si = seen_from(np.tile(wi, (count, 1)))
    sampled, weight = bsdf.sample(mi.BSDFContext(), si, numbers[0], mi.Point2f(numbers[1], numbers[2]), True)
    wo, weight = np.array(sampled.wo).T.astype(np.float64), np.array(weight).T.astype(np.float64)
    kept = np.array(sampled.pdf) > 0.0
    points = upper(1_000_000)
    value, pdf = evaluated(bsdf, wi, points)
    solid_angle = 4.0 * np.pi / 1_000_000
    expected = np.bincount(cells(points), pdf * solid_angle * count, 288)
    found = np.bincount(cells(wo[kept]), minlength=288)
    assert found.sum() > 0.5 * count
    # What went below the surface is a cell of its own; small cells are joined.
    expected, found = np.append(expected, count - expected.sum()), np.append(found, count - found.sum())
    order = np.argsort(expected)
    few = expected[order].cumsum() < 20.0
    expected, found = (np.append(x[order][~few], x[order][few].sum()) for x in (expected, found))
    use = expected > 1.0
    statistic = (np.square(found - expected)[use] / expected[use]).sum()
    assert stats.chi2.sf(statistic, use.sum() - 1) > 1e-5
    error = weight.std(axis=0) / np.sqrt(count)
    assert (np.abs(weight.mean(axis=0) - value.sum(axis=0) * solid_angle) < 5.0 * error + 1e-4).all()
    assert weight.max() < 12.0


def cells(directions: np.ndarray) -> np.ndarray:
    """Cell [K] of each direction: 12 bands of equal height, 24 sectors."""
    band = np.clip((directions[:, 2] * 12).astype(int), 0, 11)
    sector = np.clip((np.arctan2(directions[:, 1], directions[:, 0]) / (2.0 * np.pi) + 0.5) * 24, 0, 23).astype(int)
    return band * 24 + sector


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0])
def test_a_white_metal_in_a_furnace_reflects_the_single_scattering_albedo(roughness: float, degrees: float) -> None:
    value, _ = evaluated(surface(roughness, 1.0, np.ones(3)), direction(degrees), upper(1_000_000))
    exact = ggx.single_scattering_albedo(np.cos(np.radians(degrees)), roughness**2)
    np.testing.assert_allclose(value.mean(axis=0) * 2.0 * np.pi, exact, rtol=4e-3)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_white_plaster_gains_three_per_cent_at_most(roughness: float) -> None:
    """Mean over the hemisphere of the albedo; towards grazing angles glTF's formula exceeds 1."""
    bsdf, points = surface(roughness, 0.0, np.ones(3)), upper(100_000)
    cosines = (np.arange(16) + 0.5) / 16
    angles = np.degrees(np.arccos(cosines))
    albedo = [evaluated(bsdf, direction(angle), points)[0][:, 0].mean() * 2.0 * np.pi for angle in angles]
    assert 0.95 < 2.0 * np.mean(albedo * cosines) < 1.03
