"""What plain Mitsuba lacks for glTF, each from its specification in a few lines, independent of the product."""

import math
from functools import lru_cache
from typing import Any, Final

from kiln_workers.render.jit import dr, mi

WRAPS: Final = ("repeat", "clamp", "mirror")


def register_plugins() -> None:
    """Make the plugins known to the selected variant."""
    _register(mi.variant())


@lru_cache(maxsize=2)
def _register(variant: str) -> None:
    class GltfImage(mi.Texture):
        """Bilinear look-up with a wrap mode for each axis, the first row at v = 0, times an attribute of the vertices.

        With a cutoff from 0 on, whether the nearest texel times the attribute reaches it: 1 or 0.
        """

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            pixels = mi.TensorXf(properties["pixels"])
            # Numbers in memory instead of the code, so that all images share a kernel.
            self.size = [mi.Int32(pixels.shape[1]), mi.Int32(pixels.shape[0])]
            self.mode = [mi.Int32(WRAPS.index(properties[name])) for name in ("wrap_s", "wrap_t")]
            self.channels = pixels.shape[2]
            self.pixels = mi.Float(pixels.array)
            self.attribute, self.tint = properties["attribute"], properties["tint"]
            self.test, self.cutoff = properties["cutoff"] >= 0.0, mi.Float(properties["cutoff"])
            dr.make_opaque(self.pixels, self.size, self.mode, self.cutoff)

        def _texel(self, column: Any, row: Any, active: Any) -> Any:
            x, y = (_wrapped(*axis) for axis in zip((column, row), self.size, self.mode, strict=True))
            first = mi.UInt32(y * self.size[0] + x) * self.channels
            return [dr.gather(mi.Float, self.pixels, first + min(c, self.channels - 1), active) for c in range(3)]

        def _look_up(self, si: Any, active: Any) -> Any:
            uv = si.uv
            if self.attribute:
                stream = si.shape.eval_attribute_3(self.attribute, si, active)
                uv = mi.Point2f(stream.x, stream.y)
            x, y = uv.x * self.size[0], uv.y * self.size[1]
            if self.test:
                return mi.Color3f(*self._texel(mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y)), active))
            x, y = x - 0.5, y - 0.5
            left, top = mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y))
            right, down = x - mi.Float(left), y - mi.Float(top)
            out = mi.Color3f(0.0)
            for dx, wx in ((0, 1.0 - right), (1, right)):
                for dy, wy in ((0, 1.0 - down), (1, down)):
                    out += wx * wy * mi.Color3f(*self._texel(left + dx, top + dy, active))
            return out

        def eval(self, si: Any, active: Any = True) -> Any:
            out = self._look_up(si, active)
            if self.tint == "vertex_tint":
                tint = si.shape.eval_attribute_3(self.tint, si, active)
                out *= mi.Color3f(tint.x, tint.y, tint.z)
            elif self.tint:
                out *= si.shape.eval_attribute_1(self.tint, si, active)
            return dr.select(out >= self.cutoff, mi.Color3f(1.0), mi.Color3f(0.0)) if self.test else out

        def eval_3(self, si: Any, active: Any = True) -> Any:
            return self.eval(si, active)

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return self.eval(si, active).x

        def is_spatially_varying(self) -> bool:
            """False, so that `area` samples its shape by area, which is right for any coordinates."""
            return False

        def to_string(self) -> str:
            return "GltfImage[]"

    class AppendixB(mi.BSDF):
        """glTF 2.0, appendix B.2 and B.3, with KHR_materials_specular's F0 and F90.

        `glossy` has the roughness in G, the metal in B. Where the interpolated normal faces away from the viewer the
        geometric one takes its place; light does not come from behind the geometric surface. Sampled by the cosine and
        by GGX's normals, half each.
        """

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.base, self.glossy = properties["base"], properties["glossy"]
            self.f0, self.f90 = mi.Color3f(mi.Vector3f(properties["f0"])), mi.Float(properties["f90"])
            dr.make_opaque(self.f0, self.f90)
            self.double_sided = properties["double_sided"]
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.GlossyReflection | sides]
            self.m_flags = mi.BSDFFlags.GlossyReflection | sides

        def _frame(self, si: Any) -> tuple[Any, Any, Any]:
            """The frame, the geometric normal, both on the viewer's side if double-sided, and the way to the viewer."""
            v, flat, smooth = si.to_world(si.wi), mi.Normal3f(si.n), mi.Normal3f(si.sh_frame.n)
            if self.double_sided:
                away = dr.dot(v, flat) < 0.0
                flat, smooth = dr.select(away, -flat, flat), dr.select(away, -smooth, smooth)
            n = dr.select(dr.dot(smooth, v) > 0.0, smooth, flat)
            return mi.Frame3f(n), flat, v

        def _gloss(self, si: Any, active: Any) -> tuple[Any, Any]:
            """GGX alpha, and how much of the surface is metal."""
            found = self.glossy.eval(si, active)
            return dr.square(found.y), found.z

        def _value(self, si: Any, v: Any, light: Any, alpha: Any, metallic: Any, active: Any) -> Any:
            """The specification's f(l, v) times n . l, for l and v in the frame."""
            c = self.base.eval(si, active)
            h = dr.normalize(light + v)
            nl, nv, nh, vh = light.z, v.z, h.z, dr.dot(v, h)
            a2 = dr.square(alpha)
            d = a2 / (dr.pi * dr.square(nh * nh * (a2 - 1.0) + 1.0))
            left, right = nl * dr.sqrt(nv * nv * (1 - a2) + a2), nv * dr.sqrt(nl * nl * (1 - a2) + a2)
            brdf = 0.5 / (left + right) * d
            grazing = (1.0 - dr.clip(vh, 0.0, 1.0)) ** 5
            fresnel = self.f0 + (self.f90 - self.f0) * grazing
            dielectric = (1.0 - dr.max(fresnel)) * c * dr.inv_pi + fresnel * brdf
            metal = (c + (1.0 - c) * grazing) * brdf
            return (dielectric * (1.0 - metallic) + metal * metallic) * nl

        def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            frame, flat, to_viewer = self._frame(si)
            to_light = si.to_world(wo)
            v, light = frame.to_local(to_viewer), frame.to_local(to_light)
            lit = (v.z > 0) & (light.z > 0) & (dr.dot(flat, to_viewer) > 0) & (dr.dot(flat, to_light) > 0)
            h = dr.normalize(light + v)
            alpha, metallic = self._gloss(si, active)
            a2 = dr.square(alpha)
            d = a2 / (dr.pi * dr.square(h.z * h.z * (a2 - 1.0) + 1.0))
            pdf = 0.5 * light.z * dr.inv_pi + 0.5 * d * h.z / (4.0 * dr.dot(v, h))
            active = mi.Bool(active) & lit
            value = self._value(si, v, light, alpha, metallic, active)
            return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

        def eval(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(context, si, wo, active)[0]

        def pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(context, si, wo, active)[1]

        def sample(self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            frame, _, to_viewer = self._frame(si)
            v = frame.to_local(to_viewer)
            # D cos is the density of tan^2 = alpha^2 u / (1 - u).
            tangent, angle = (
                self._gloss(si, active)[0] * dr.sqrt(sample2.x / dr.maximum(1.0 - sample2.x, 1e-9)),
                2 * dr.pi * sample2.y,
            )
            h = dr.normalize(mi.Vector3f(tangent * dr.cos(angle), tangent * dr.sin(angle), 1.0))
            glossy = 2.0 * dr.dot(v, h) * h - v
            light = dr.select(sample1 < 0.5, mi.warp.square_to_cosine_hemisphere(sample2), glossy)
            out = dr.zeros(mi.BSDFSample3f)
            out.wo, out.eta = si.to_local(frame.to_world(light)), 1.0
            value, out.pdf = self.eval_pdf(context, si, out.wo, active)
            out.sampled_type, out.sampled_component = mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(0)
            return out, dr.select(out.pdf > 0.0, value / out.pdf, 0.0)

        def to_string(self) -> str:
            return "AppendixB[]"

    class KhronosSpot(mi.Emitter):
        """KHR_lights_punctual's spot: intensity times the square of saturate(cos * scale + offset), over distance^2."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.place, self.along = mi.Point3f(properties["place"]), dr.normalize(mi.Vector3f(properties["along"]))
            self.intensity = mi.Color3f(mi.Vector3f(properties["intensity"]))
            inner, outer = math.cos(properties["inner"]), math.cos(properties["outer"])
            self.slope = mi.Float(1.0 / max(0.001, inner - outer))
            self.offset = -outer * self.slope
            self.m_flags = mi.EmitterFlags.DeltaPosition
            dr.make_opaque(self.place, self.along, self.intensity, self.slope, self.offset)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
            ds.p, ds.pdf, ds.delta, ds.emitter = self.place, 1.0, True, mi.EmitterPtr(self)
            ds.d = self.place - it.p
            ds.dist = dr.norm(ds.d)
            ds.d = ds.d / ds.dist
            share = dr.clip(dr.dot(-ds.d, self.along) * self.slope + self.offset, 0.0, 1.0)
            return ds, dr.select(active, self.intensity * dr.square(share / ds.dist), 0.0)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0.0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(0.0)

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return "KhronosSpot[]"

    mi.register_texture("gltf_image", GltfImage)
    mi.register_bsdf("appendix_b", AppendixB)
    mi.register_emitter("khronos_spot", KhronosSpot)


def _wrapped(k: Any, count: Any, mode: Any) -> Any:
    """A pixel's number in 0 ... count - 1 for any k; `mode` is a place in WRAPS."""
    period = dr.select(mode == 2, 2 * count, count)
    turned = k - period * mi.Int32(dr.floor(mi.Float(k) / mi.Float(period)))
    turned = dr.clip(turned, 0, period - 1)
    turned = dr.select(turned < count, turned, 2 * count - 1 - turned)
    return dr.select(mode == 1, dr.clip(k, 0, count - 1), turned)
