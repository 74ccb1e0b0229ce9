"""Emitters that Mitsuba lacks: glTF's spot light, and textured area lights.

A spot light falls off between its cones as KHR_lights_punctual says: with the square of the cosine's share of the way
from the outer cone's to the inner one's. Its `range` is a hint that renderers may cut the light off there; we do not.

An area emitter whose radiance is textured over any UV layout, with holes where an alpha test removes the surface.

Mitsuba's `area` samples textured radiance through the inverse of the UV map, which must then be injective; game
textures repeat and overlap. This one samples the surface uniformly and looks the radiance up at the point.
"""

import math
from functools import lru_cache
from typing import Any

from kiln_workers.render.jit import dr, mi


def register_emitters() -> None:
    """Make `kiln_area` known to the selected Mitsuba variant (once per variant)."""
    _register(mi.variant())


@lru_cache(maxsize=4)
def _register(variant: str) -> None:
    class KilnArea(mi.Emitter):  # type: ignore[misc]
        """One-sided area emitter: `radiance` and, optionally, `opacity` are textures."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.radiance = properties["radiance"]
            self.opacity = properties.get("opacity")
            self.m_flags = int(mi.EmitterFlags.Surface) | int(mi.EmitterFlags.SpatiallyVarying)

        def _radiance(self, si: Any, active: Any) -> Any:
            value = self.radiance.eval(si, active)
            return value if self.opacity is None else value * self.opacity.eval(si, active)

        def eval(self, si: Any, active: Any = True) -> Any:
            return dr.select(mi.Frame3f.cos_theta(si.wi) > 0.0, self._radiance(si, active), 0.0)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            ds = self.get_shape().sample_direction(it, sample, active)
            active &= (dr.dot(ds.d, ds.n) < 0.0) & (ds.pdf > 0.0)
            ds.emitter = mi.EmitterPtr(self)
            radiance = self._at(ds, active)
            return ds, dr.select(active, radiance / ds.pdf, 0.0)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            facing = dr.dot(ds.d, ds.n) < 0.0
            return dr.select(facing, self.get_shape().pdf_direction(it, ds, active), 0.0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return dr.select(dr.dot(ds.d, ds.n) < 0.0, self._at(ds, active), 0.0)

        def _at(self, ds: Any, active: Any) -> Any:
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.uv = ds.uv
            return self._radiance(si, active)

        def bbox(self) -> Any:
            return self.get_shape().bbox()

        def traverse(self, callback: Any) -> None:
            callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "KilnArea[]"

    mi.register_emitter("kiln_area", KilnArea)

    class KilnSpot(mi.Emitter):  # type: ignore[misc]
        """A point that shines into a cone; `red`, `green`, `blue` in W/sr, the cones' half angles in radians."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.intensity = mi.Color3f(*(float(properties[channel]) for channel in ("red", "green", "blue")))
            self.position = mi.Point3f(properties["position"])
            self.axis = dr.normalize(mi.Vector3f(properties["direction"]))
            inner, outer = math.cos(properties["inner_cone"]), math.cos(properties["outer_cone"])
            # KHR_lights_punctual, "Inner and Outer Cone Angles".
            self.angle_scale = 1.0 / max(0.001, inner - outer)
            self.angle_offset = -outer * self.angle_scale
            self.m_flags = int(mi.EmitterFlags.DeltaPosition)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
            ds.p, ds.pdf, ds.delta, ds.time = self.position, 1.0, True, it.time
            ds.emitter = mi.EmitterPtr(self)
            ds.d = ds.p - it.p
            ds.dist = dr.norm(ds.d)
            ds.d /= ds.dist
            return ds, self._arriving(it, ds, active)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0.0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return self._arriving(it, ds, active)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(0.0)

        def _arriving(self, it: Any, ds: Any, active: Any) -> Any:
            """W/m^2 across the ray, if nothing is in its way."""
            share = dr.clip(-dr.dot(ds.d, self.axis) * self.angle_scale + self.angle_offset, 0.0, 1.0)
            return dr.select(active, self.intensity * (dr.square(share) / dr.square(ds.dist)), 0.0)

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def traverse(self, callback: Any) -> None:
            callback.put("intensity", self.intensity, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "KilnSpot[]"

    mi.register_emitter("kiln_spot", KilnSpot)
