"""Emitters that Mitsuba lacks: glTF's spot light, and textured area lights.

A spot light falls off between its cones as KHR_lights_punctual says: with the square of the cosine's share of the way
from the outer cone's to the inner one's. Its `range` is a hint that renderers may cut the light off there; we do not.

An area emitter whose radiance is textured over any UV layout, with holes where an alpha test removes the surface.

Mitsuba's `area` samples textured radiance through the inverse of the UV map, which must then be injective; game
textures repeat and overlap. This one samples its triangles uniformly by area and looks the radiance up at the point.
Mitsuba's own sampling of a mesh does not tell which triangle a point lies on, which mesh attributes need.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np

from kiln_workers.render.jit import dr, mi
from kiln_workers.scene.model import Mesh


def register_emitters() -> None:
    """Make `kiln_area` known to the selected Mitsuba variant (once per variant)."""
    _register(mi.variant())


@lru_cache(maxsize=4)
def _register(variant: str) -> None:
    class KilnArea(mi.Emitter):  # type: ignore[misc]
        """One-sided area emitter: `radiance` and, optionally, `opacity` and `tint_alpha` are textures."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.radiance = properties["radiance"]
            covers = (properties.get(name) for name in ("opacity", "tint_alpha"))
            self.covers = [cover for cover in covers if cover is not None]
            self.m_flags = int(mi.EmitterFlags.Surface) | int(mi.EmitterFlags.SpatiallyVarying)

        def set_mesh(self, mesh: Mesh) -> None:
            """The mesh that glows; before anything is sampled."""
            corners = mesh.positions[mesh.faces]  # [F, 3, 3]
            edges = corners[:, 1:].astype(np.float64) - corners[:, :1]
            areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1)
            self.areas = mi.DiscreteDistribution(mi.Float(areas.astype(np.float32)))
            self.density = 1.0 / max(float(areas.sum()), 1e-30)
            self.corners = mi.Float(np.ravel(corners).astype(np.float32))
            uv = np.zeros((len(mesh.positions), 2), np.float32) if mesh.uv is None else mesh.uv
            self.uv = mi.Float(np.ravel(uv[mesh.faces]).astype(np.float32))
            dr.eval(self.corners, self.uv)

        def _radiance(self, si: Any, active: Any) -> Any:
            value = self.radiance.eval(si, active)
            for cover in self.covers:
                value = value * cover.eval_1(si, active)
            return value

        def eval(self, si: Any, active: Any = True) -> Any:
            return dr.select(mi.Frame3f.cos_theta(si.wi) > 0.0, self._radiance(si, active), 0.0)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            triangle, left = self.areas.sample_reuse(sample.y, active)
            b = mi.warp.square_to_uniform_triangle(mi.Point2f(sample.x, left))
            first, second, third = (
                dr.gather(mi.Point3f, self.corners, 3 * triangle + corner, active) for corner in range(3)
            )
            uv = [dr.gather(mi.Point2f, self.uv, 3 * triangle + corner, active) for corner in range(3)]
            normal = dr.cross(second - first, third - first)

            ds = dr.zeros(mi.DirectionSample3f)
            ds.p = first + (second - first) * b.x + (third - first) * b.y
            ds.n = mi.Normal3f(dr.normalize(normal))
            ds.uv = uv[0] + (uv[1] - uv[0]) * b.x + (uv[2] - uv[0]) * b.y
            ds.time, ds.delta, ds.emitter = it.time, False, mi.EmitterPtr(self)
            ds.d = ds.p - it.p
            square = dr.squared_norm(ds.d)
            ds.dist = dr.sqrt(square)
            ds.d /= ds.dist
            facing = -dr.dot(ds.d, ds.n)
            active = mi.Bool(active) & (facing > 0.0) & (dr.squared_norm(normal) > 0.0)
            ds.pdf = dr.select(active, self.density * square / facing, 0.0)

            si = dr.zeros(mi.SurfaceInteraction3f)
            si.p, si.n, si.uv, si.prim_index = ds.p, ds.n, ds.uv, triangle
            si.shape = mi.ShapePtr(self.get_shape())
            return ds, dr.select(active, self._radiance(si, active) / ds.pdf, 0.0)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            facing = dr.dot(ds.d, ds.n) < 0.0
            return dr.select(facing, self.get_shape().pdf_direction(it, ds, active), 0.0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.p, si.n, si.uv = ds.p, ds.n, ds.uv
            return dr.select(dr.dot(ds.d, ds.n) < 0.0, self._radiance(si, active), 0.0)

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
