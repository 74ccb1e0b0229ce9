"""glTF's metallic-roughness surface as a Mitsuba BSDF: what the tracer, the references and the shaders mean alike.

glTF 2.0, appendix B.2 and B.3: a metal reflects GGX with F0 = base colour, a dielectric GGX with F0 = 0.04 above
Lambert times (1 - F); the two are mixed by metallic. F is Schlick's at the half vector, G Smith's with correlated
heights (Heitz 2014, eq. 99), alpha = roughness^2. Light that meets the microsurface twice is lost, as in the
specification. Towards grazing angles the sum of both lobes exceeds 1 for white dielectrics, as the specification allows
(up to 1.36 at alpha 0.09; its mean over the hemisphere is at most 1.03). `sphere.ggx` has the terms in slow form.
Mitsuba's `principled` is not this: its diffuse lobe is Disney's, brighter by a tenth on plaster.
Letters: i incident (`si.wi`, to the eye), o scattered (`wo`), h half-way; all in the frame of the shading normal.
"""

from functools import lru_cache
from typing import Any, Final

from kiln_workers.render.jit import dr, mi

DIELECTRIC_F0: Final = 0.04
LEAST_CHANCE: Final = 0.1
"""Each of the two lobes that reflects at all is sampled at least this often: bounds the weight of a sample."""


def register_bsdfs() -> None:
    """Make `kiln_gltf` known to the selected Mitsuba variant (once per variant)."""
    _register(mi.variant())


@lru_cache(maxsize=4)
def _register(variant: str) -> None:
    class KilnGltf(mi.BSDF):  # type: ignore[misc]
        """One-sided; `base_color`, `roughness` (perceptual, above 0) and `metallic` are textures."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.base_color = properties["base_color"]
            self.roughness = properties["roughness"]
            self.metallic = properties["metallic"]
            diffuse, glossy = (
                mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide,
                mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide,
            )
            self.m_components = [diffuse, glossy]
            self.m_flags = diffuse | glossy

        def _at(self, si: Any, active: Any) -> tuple[Any, Any, Any, Any]:
            """Lambert's albedo [Color3f], F0 [Color3f], alpha, and the chance of the glossy lobe."""
            base, metallic = self.base_color.eval(si, active), self.metallic.eval_1(si, active)
            alpha = dr.square(self.roughness.eval_1(si, active))
            albedo, f0 = base * (1.0 - metallic), dr.lerp(mi.Color3f(DIELECTRIC_F0), base, metallic)
            cos_i = mi.Frame3f.cos_theta(si.wi)
            glossy, dull = dr.mean(_schlick(f0, cos_i)), dr.mean(albedo)
            chance = dr.clip(glossy / dr.maximum(glossy + dull, 1e-8), LEAST_CHANCE, 1.0 - LEAST_CHANCE)
            return albedo, f0, alpha, dr.select(dull > 0.0, chance, 1.0)

        def sample(self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            albedo, f0, alpha, chance = self._at(si, active)
            cos_i = mi.Frame3f.cos_theta(si.wi)
            active = mi.Bool(active) & (cos_i > 0.0)
            glossy = sample1 < chance
            half, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).sample(si.wi, sample2)
            wo = dr.select(glossy, mi.reflect(si.wi, half), mi.warp.square_to_cosine_hemisphere(sample2))
            value, pdf = _value_and_pdf(si.wi, wo, albedo, f0, alpha, chance)
            active &= pdf > 0.0
            out = dr.zeros(mi.BSDFSample3f)
            out.wo, out.eta = wo, 1.0
            out.pdf = dr.select(active, pdf, 0.0)
            out.sampled_component = dr.select(glossy, mi.UInt32(1), mi.UInt32(0))
            out.sampled_type = dr.select(
                glossy, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            return out, dr.select(active, value / pdf, 0.0)

        def eval(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(context, si, wo, active)[0]

        def pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(context, si, wo, active)[1]

        def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            value, pdf = _value_and_pdf(si.wi, wo, *self._at(si, active))
            return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

        def traverse(self, callback: Any) -> None:
            for name in ("base_color", "roughness", "metallic"):
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "KilnGltf[]"

    mi.register_bsdf("kiln_gltf", KilnGltf)


def _value_and_pdf(wi: Any, wo: Any, albedo: Any, f0: Any, alpha: Any, chance: Any) -> tuple[Any, Any]:
    """BRDF times cosine [Color3f] and the density of `wo` by solid angle; 0 below the surface."""
    cos_i, cos_o = mi.Frame3f.cos_theta(wi), mi.Frame3f.cos_theta(wo)
    above = (cos_i > 0.0) & (cos_o > 0.0)
    half = dr.normalize(wi + wo)
    cos_d = dr.dot(wi, half)
    square = dr.square(alpha)
    # sin^2 + alpha^2 cos^2 of the half vector: 1 - cos^2 would cancel for mirrors.
    spread = dr.fma(half.x, half.x, dr.fma(half.y, half.y, square * dr.square(half.z)))
    d = square * dr.inv_pi / dr.square(spread)
    # cos sqrt(1 + alpha^2 tan^2) of both directions; G2 / (4 cos_i cos_o) = 0.5 / (cos_o a + cos_i b).
    a = dr.sqrt(square + (1.0 - square) * dr.square(cos_i))
    b = dr.sqrt(square + (1.0 - square) * dr.square(cos_o))
    specular = _schlick(f0, cos_d) * (d * 0.5 * cos_o / (cos_o * a + cos_i * b))
    diffuse = albedo * ((1.0 - _schlick(DIELECTRIC_F0, cos_d)) * cos_o * dr.inv_pi)
    # Visible normals have density D G1 (i.h) / cos_i with G1 = 2 cos_i / (cos_i + a); a reflection divides by 4 (i.h).
    glossy_pdf = 0.5 * d / (cos_i + a)
    pdf = dr.lerp(cos_o * dr.inv_pi, glossy_pdf, chance)
    return dr.select(above, specular + diffuse, 0.0), dr.select(above, pdf, 0.0)


def _schlick(f0: Any, cosine: Any) -> Any:
    """F0 + (1 - F0) (1 - cos)^5 (Schlick 1994)."""
    away = dr.clip(1.0 - cosine, 0.0, 1.0)
    return f0 + (1.0 - f0) * (dr.square(dr.square(away)) * away)
