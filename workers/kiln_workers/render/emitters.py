"""An area emitter whose radiance is textured over any UV layout, with holes where an alpha test removes the surface.

Mitsuba's `area` samples textured radiance through the inverse of the UV map, which must then be injective; game
textures repeat and overlap. This one samples the surface uniformly and looks the radiance up at the point.
"""

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
