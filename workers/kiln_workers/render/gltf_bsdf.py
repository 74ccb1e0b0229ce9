"""glTF's metallic-roughness surface as a Mitsuba BSDF: what the tracer, the references and the shaders mean alike.

glTF 2.0, appendix B.2 and B.3: a metal reflects GGX with F0 = base colour, a dielectric GGX with its own F0 and F90
(0.04 and 1, or as KHR_materials_ior, _specular and _clearcoat say) above Lambert times (1 - F); the two are mixed by
metallic. F is Schlick's at the half vector, G Smith's with correlated heights (Heitz 2014, eq. 99), alpha =
roughness^2. Light that meets the microsurface twice is lost, as in the specification. Towards grazing angles the sum of
both lobes exceeds 1 for white dielectrics, as the specification allows (up to 1.36 at alpha 0.09; its mean over the
hemisphere is at most 1.03). `sphere.ggx` has the terms in slow form. Mitsuba's `principled` is not this: its diffuse
lobe is Disney's, brighter by a tenth on plaster.

Light goes straight through as far as the surface is no surface (1 - opacity: an alpha test or a blended alpha), and
where KHR_materials_transmission replaces Lambert: tinted by the base colour, less Fresnel's share, from either side.
What passes is Mitsuba's `Null` component: `eval_null_transmission` has it, `sample` draws it unless its context leaves
it out, and all other values are already times the opacity.
A normal map turns the frame that all of this is meant in (`scene.normal_maps`), bent towards i where it would face
away; light that would leave on the other side of the unmapped surface is lost. What passes straight through does not
depend on the map.
An emitter's mesh is flat to Mitsuba (`mitsuba_scene`): its interpolated normals are an attribute of its vertices and
turn the frame in the same way.
Letters: i incident (`si.wi`, to the eye), o scattered (`wo`), h half-way; all in the frame of the shading normal.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from kiln_workers.render.jit import dr, mean, mi
from kiln_workers.scene.normal_maps import LEAST_FACING, LEAST_HEIGHT

LEAST_CHANCE: Final = 0.1
"""Each of the two lobes that reflects at all is sampled at least this often: bounds the weight of a sample."""


DIFFUSE_ALBEDO: Final = "diffuse_albedo"
"""Name of the attribute that holds the diffuse lobe's albedo."""

MEAN_SCHLICK: Final = 0.028
"""The mean of (1 - i.h)^5 over cosine-distributed o is this times (1 - cos_i)^2.5, within 0.001."""


def reflections_only(*, diffuse: bool = True, glossy: bool = True) -> Any:
    """A context in which nothing passes straight through: the caller has already seen to it.

    Without `diffuse` or `glossy` that lobe is left out.
    """
    context = mi.BSDFContext()
    left_out = int(mi.BSDFFlags.Null)
    if not diffuse:
        left_out |= int(mi.BSDFFlags.DiffuseReflection)
    if not glossy:
        left_out |= int(mi.BSDFFlags.GlossyReflection)
    context.type_mask = int(mi.BSDFFlags.All) & ~left_out
    return context


def register_bsdfs() -> None:
    """Make `kiln_gltf` known to the selected Mitsuba variant (once per variant)."""
    _register(mi.variant())


@dataclass
class _Point:
    """The surface's parameters where a ray meets it."""

    albedo: Any  # Color3f of Lambert's lobe
    f0: Any  # Color3f
    f90: Any  # Float
    dielectric: tuple[Any, Any]  # F0 (the largest channel) and F90: Lambert's lobe gets the rest
    alpha: Any  # Float: GGX
    chance: Any  # Float: of the glossy lobe
    opacity: Any  # Float: 1 where the surface is whole
    frame: Any  # Frame3f of the normal map or an emitter's normal in the shading frame, on the side of i; None without
    side: Any  # Float: -1 where the back of a double-sided surface is meant


@lru_cache(maxsize=4)
def _register(variant: str) -> None:
    class KilnGltf(mi.BSDF):  # type: ignore[misc]
        """One-sided unless `double_sided`.

        `base_color`, `roughness` (perceptual, above 0), `metallic`, and where given `opacity` and `transmission` are
        textures; `tint` (the vertices' colour) multiplies the base colour, `tint_alpha` the opacity. A `normal_map`
        needs the mesh's attributes `vertex_tangent` and `vertex_hand`, `rounded` needs `vertex_rounded`.
        """

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            for name in ("base_color", "roughness", "metallic"):
                setattr(self, name, properties[name])
            for name in ("opacity", "tint", "tint_alpha", "transmission", "normal_map"):
                setattr(self, name, properties.get(name))
            self.f0 = mi.Color3f(*(float(properties.get(f"f0_{channel}", 0.04)) for channel in "rgb"))
            self.normal_scale = float(properties.get("normal_scale", 1.0))
            self.f90 = float(properties.get("f90", 1.0))
            self.double_sided = bool(properties.get("double_sided", False))
            self.rounded = bool(properties.get("rounded", False))
            sides = mi.BSDFFlags.FrontSide
            if self.double_sided:
                sides = sides | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.DiffuseReflection | sides, mi.BSDFFlags.GlossyReflection | sides]
            self.passes = self.opacity is not None or self.tint_alpha is not None or self.transmission is not None
            if self.passes:
                both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
                self.m_components = [*self.m_components, mi.BSDFFlags.Null | both]
            flags = self.m_components[0]
            for component in self.m_components[1:]:
                flags = flags | component
            self.m_flags = flags

        def _at(self, context: Any, si: Any, active: Any) -> _Point:
            base, metallic = self._base(si, active), self.metallic.eval_1(si, active)
            alpha = dr.square(self.roughness.eval_1(si, active))
            kept = 1.0 - metallic
            if self.transmission is not None:
                kept *= 1.0 - self.transmission.eval_1(si, active)
            albedo, f0 = base * kept, dr.lerp(self.f0, base, metallic)
            f90 = dr.lerp(mi.Float(self.f90), 1.0, metallic)
            if not context.is_enabled(mi.BSDFFlags.DiffuseReflection, 0):
                albedo = mi.Color3f(0.0)
            if not context.is_enabled(mi.BSDFFlags.GlossyReflection, 1):
                f0, f90 = mi.Color3f(0.0), mi.Float(0.0)
            glossy = mean(_schlick(f0, f90, dr.abs(mi.Frame3f.cos_theta(si.wi))))
            dull = mean(albedo)
            chance = dr.clip(glossy / dr.maximum(glossy + dull, 1e-8), LEAST_CHANCE, 1.0 - LEAST_CHANCE)
            chance = dr.select(dull > 0.0, chance, 1.0)
            frame, side = self._frame(si, active)
            opacity = self._opacity(si, active)
            return _Point(albedo, f0, f90, (dr.max(self.f0), self.f90), alpha, chance, opacity, frame, side)

        def _frame(self, si: Any, active: Any) -> tuple[Any, Any]:
            """The frame of map and rounding on the side of `si.wi`, None without both; and the sign of that side."""
            side = mi.Float(1.0)
            if self.double_sided:
                side = dr.select(si.wi.z < 0.0, mi.Float(-1.0), mi.Float(1.0))
            if self.normal_map is None and not self.rounded:
                return None, side
            n = self._normal(si, active)
            mapped = side * (n if self.normal_map is None else self._mapped(si, n, active))
            missing = dr.maximum(LEAST_FACING - dr.dot(mapped, si.wi), 0.0)
            return mi.Frame3f(dr.normalize(mapped + missing * si.wi)), side

        def _normal(self, si: Any, active: Any) -> Any:
            """The interpolated normal in the shading frame, on the front."""
            if not self.rounded:
                return mi.Vector3f(0.0, 0.0, 1.0)
            return dr.normalize(si.to_local(mi.Vector3f(si.shape.eval_attribute_3("vertex_rounded", si, active))))

        def _mapped(self, si: Any, n: Any, active: Any) -> Any:
            """The normal map's normal about the interpolated one, `n`."""
            texel = self.normal_map.eval_3(si, active)
            m = 2.0 * mi.Vector3f(texel.x, texel.y, texel.z) - 1.0
            along = si.to_local(mi.Vector3f(si.shape.eval_attribute_3("vertex_tangent", si, active)))
            along -= dr.dot(along, n) * n
            along *= dr.rsqrt(dr.maximum(dr.squared_norm(along), 1e-12))
            up = si.shape.eval_attribute_1("vertex_hand", si, active) * dr.cross(n, along)
            scaled = self.normal_scale * (m.x * along + m.y * up)
            return dr.normalize(scaled + dr.maximum(m.z, LEAST_HEIGHT) * n)

        def _base(self, si: Any, active: Any) -> Any:
            base = self.base_color.eval(si, active)
            return base if self.tint is None else base * self.tint.eval(si, active)

        def _opacity(self, si: Any, active: Any) -> Any:
            out = mi.Float(1.0)
            for part in (self.opacity, self.tint_alpha):
                if part is not None:
                    out *= part.eval_1(si, active)
            return out

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            """The base colour: what guides a denoiser, which knows no metals."""
            return dr.select(active, self._base(si, active), 0.0)

        def eval_attribute_3(self, name: str, si: Any, active: Any = True) -> Any:
            """`DIFFUSE_ALBEDO`: what the diffuse lobe sends back of light that comes evenly from everywhere."""
            if name != DIFFUSE_ALBEDO:
                raise ValueError(f"kiln_gltf has no attribute '{name}'")
            at = self._at(reflections_only(), si, active)
            cosine = self._inward(si.wi, at).z
            f0, f90 = at.dielectric
            away = dr.clip(1.0 - cosine, 0.0, 1.0)
            reflected = f0 + (f90 - f0) * (MEAN_SCHLICK * dr.square(away) * dr.sqrt(away))
            return dr.select(active & (cosine > 0.0), at.albedo * (at.opacity * (1.0 - reflected)), 0.0)

        def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
            if not self.passes:
                return mi.Color3f(0.0)
            opacity = self._opacity(si, active)
            through = mi.Color3f(1.0 - opacity)
            if self.transmission is not None:
                kept = (1.0 - self.metallic.eval_1(si, active)) * self.transmission.eval_1(si, active)
                cosine = dr.dot(self._normal(si, active), si.wi) if self.rounded else mi.Frame3f.cos_theta(si.wi)
                reflected = _schlick(dr.max(self.f0), self.f90, dr.abs(cosine))
                through += self._base(si, active) * (opacity * kept * (1.0 - reflected))
            return dr.select(active, through, 0.0)

        def sample(self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            out = dr.zeros(mi.BSDFSample3f)
            out.eta = 1.0
            straight, through = self._chance_of_passing(context, si, active)
            passes = mi.Bool(active) & (sample1 < straight)
            rest = 1.0 - straight
            choice = dr.select(rest > 0.0, (sample1 - straight) / rest, 0.0)

            at = self._at(context, si, active)
            wi = self._inward(si.wi, at)
            glossy = choice < at.chance
            half, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, at.alpha, True).sample(wi, sample2)
            wo = dr.select(glossy, mi.reflect(wi, half), mi.warp.square_to_cosine_hemisphere(sample2))
            value, pdf = _value_and_pdf(wi, wo, at)
            pdf *= rest
            onwards = self._outward(wo, at)
            reflects = mi.Bool(active) & ~passes & self._above(si, onwards, at) & (wi.z > 0.0) & (pdf > 0.0)
            out.wo = dr.select(passes, -si.wi, onwards)
            out.pdf = dr.select(passes, straight, dr.select(reflects, pdf, 0.0))
            component = dr.select(glossy, mi.UInt32(1), mi.UInt32(0))
            out.sampled_component = dr.select(passes, mi.UInt32(2), component)
            kind = dr.select(
                glossy, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            out.sampled_type = dr.select(passes, mi.UInt32(+mi.BSDFFlags.Null), kind)
            weight = dr.select(reflects, value / pdf, 0.0)
            return out, dr.select(passes, through / straight, weight)

        def eval(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(context, si, wo, active)[0]

        def pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(context, si, wo, active)[1]

        def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            at = self._at(context, si, active)
            value, pdf = _value_and_pdf(self._inward(si.wi, at), self._inward(wo, at), at)
            straight, _ = self._chance_of_passing(context, si, active)
            active = mi.Bool(active) & self._above(si, wo, at)
            return dr.select(active, value, 0.0), dr.select(active, pdf * (1.0 - straight), 0.0)

        def _inward(self, w: Any, at: _Point) -> Any:
            """A direction of the shading frame in the frame that the surface is meant in."""
            return mi.Vector3f(w.x, w.y, w.z * at.side) if at.frame is None else at.frame.to_local(w)

        def _outward(self, w: Any, at: _Point) -> Any:
            """The reverse of `_inward`."""
            return mi.Vector3f(w.x, w.y, w.z * at.side) if at.frame is None else at.frame.to_world(w)

        def _above(self, si: Any, wo: Any, at: _Point) -> Any:
            """Whether light from `si.wi` may leave by `wo`: both have to be on one side of the unmapped surface."""
            if at.frame is None:
                return mi.Bool(True)
            real = dr.dot(si.n, si.to_world(si.wi)) * dr.dot(si.n, si.to_world(wo)) > 0.0
            return real & (si.wi.z * at.side > 0.0) & (wo.z * at.side > 0.0)

        def _chance_of_passing(self, context: Any, si: Any, active: Any) -> tuple[Any, Any]:
            """Probability by which `sample` goes straight on, and what passes [Color3f]."""
            if not self.passes or not context.is_enabled(mi.BSDFFlags.Null, 2):
                return mi.Float(0.0), mi.Color3f(0.0)
            through = self.eval_null_transmission(si, active)
            return mean(through), through

        def traverse(self, callback: Any) -> None:
            for name in ("base_color", "roughness", "metallic"):
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "KilnGltf[]"

    mi.register_bsdf("kiln_gltf", KilnGltf)


def _value_and_pdf(wi: Any, wo: Any, at: _Point) -> tuple[Any, Any]:
    """BRDF times cosine [Color3f] and the density of `wo` by solid angle; 0 below the surface."""
    cos_i, cos_o = mi.Frame3f.cos_theta(wi), mi.Frame3f.cos_theta(wo)
    above = (cos_i > 0.0) & (cos_o > 0.0)
    half = dr.normalize(wi + wo)
    cos_d = dr.dot(wi, half)
    square = dr.square(at.alpha)
    # sin^2 + alpha^2 cos^2 of the half vector: 1 - cos^2 would cancel for mirrors.
    spread = dr.fma(half.x, half.x, dr.fma(half.y, half.y, square * dr.square(half.z)))
    d = square * dr.inv_pi / dr.square(spread)
    # cos sqrt(1 + alpha^2 tan^2) of both directions; G2 / (4 cos_i cos_o) = 0.5 / (cos_o a + cos_i b).
    a = dr.sqrt(square + (1.0 - square) * dr.square(cos_i))
    b = dr.sqrt(square + (1.0 - square) * dr.square(cos_o))
    specular = _schlick(at.f0, at.f90, cos_d) * (d * 0.5 * cos_o / (cos_o * a + cos_i * b))
    diffuse = at.albedo * ((1.0 - _schlick(*at.dielectric, cos_d)) * cos_o * dr.inv_pi)
    # Visible normals have density D G1 (i.h) / cos_i with G1 = 2 cos_i / (cos_i + a); a reflection divides by 4 (i.h).
    glossy_pdf = 0.5 * d / (cos_i + a)
    pdf = dr.lerp(cos_o * dr.inv_pi, glossy_pdf, at.chance)
    return dr.select(above, (specular + diffuse) * at.opacity, 0.0), dr.select(above, pdf, 0.0)


def _schlick(f0: Any, f90: Any, cosine: Any) -> Any:
    """F0 + (F90 - F0) (1 - cos)^5 (Schlick 1994)."""
    away = dr.clip(1.0 - cosine, 0.0, 1.0)
    return f0 + (f90 - f0) * (dr.square(dr.square(away)) * away)
