"""The path tracer: incident radiance of pixels of local light fields, and irradiance, in wavefronts of lanes.

A lane computes one pixel of one texel's image (or one block of a texel's irradiance samples): it takes its samples one
after another, a new path starting as soon as the last has ended, and adds them in order to its own registers. So no
atomics are needed and a result depends on nothing but its own random numbers. Paths use next-event estimation and BSDF
sampling weighted by the power heuristic (Veach 1997, section 9.2.4) and Russian roulette from the fourth scattering on.
Deviations from Mitsuba's `path` integrator: directions on the wrong side of the geometric surface carry nothing, where
the interpolated normal faces away from the ray the geometric one is used, and what lets light pass (cut-outs, blended
and transmitting surfaces) dims shadow rays by what it holds back; paths meet it by chance.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from kiln_workers.render import counters
from kiln_workers.render.gltf_bsdf import DIFFUSE_ALBEDO, reflections_only
from kiln_workers.render.jit import dr, mean, mi
from kiln_workers.render.materials import LIGHTMAP
from kiln_workers.render.mitsuba_scene import mesh_number, to_mitsuba
from kiln_workers.scene.model import Scene
from kiln_workers.scene.precision import face_clearance, face_pull

ROULETTE_FROM: Final = 3
"""Scattering events that a path makes before roulette may end it."""

MAX_LAYERS: Final = 64
"""Cut-out surfaces that one ray passes, at most."""

TEXEL_OFFSET: Final = 2e-4
"""Rays leave a texel this fraction of its size above its point."""

SHADOW_SLACK: Final = 1e-5
"""Shadow rays end this fraction of their length before the light."""

EDGE_CLEARANCES: Final = 4.0
"""Clearances that a path's vertices keep from the edges of their faces."""

LEAST_COSINE: Final = 0.01
"""At a grazing hit a ray steps back no further than at this cosine."""

OPACITY_THRESHOLD: Final = 0.5
"""Where a cut-out's opacity is below it, `closest` sees nothing; alpha tests have 0 and 1 (`textures.thresholded`)."""


@dataclass
class Start:
    """The first ray of a path."""

    origin: Any  # Point3f
    direction: Any  # Vector3f
    weight: Any  # Float: factor on the path's radiance
    pdf: Any  # Float: density of `direction` for the weight against next-event estimation at the texel; 0: no such
    used: Any  # Bool: False for directions below the horizon, which carry nothing and are not traced


@dataclass
class LaneSums:
    """What a lane has added up over its samples."""

    radiance: Any  # Color3f: sum of weight times radiance
    weight: Any  # Float: sum of the weights of samples in use
    square: Any  # Float: sum of the squares of weight times the radiance's mean over channels
    paths: Any  # UInt32: samples in use
    dropped: Any  # UInt32: paths that were not finite


class PathTracer:
    """A scene ready to be traced: Mitsuba's scene, offsets against self-intersection, and which surfaces are thin."""

    cache: Any = None
    """Texture2f of what surfaces receive (`with_cache`)."""
    knows_backs: bool = False
    """Whether the cache has the backs of surfaces too."""

    def __init__(self, scene: Scene, max_depth: int) -> None:
        self.scene = to_mitsuba(scene)
        self.max_depth = max_depth
        used = [scene.materials[mesh.material] for mesh in scene.meshes]
        self.has_cutouts = any(material.lets_light_pass for material in used)
        self.has_veils = any(material.is_veil for material in used)
        self.has_backs = any(material.double_sided for material in used)
        self._tabulate(scene)

    def with_cache(self, cache: npt.NDArray[np.floating[Any]]) -> Self:
        """The same scene, traced with a radiance cache: paths end where they would leave by a diffuse lobe.

        `cache`: irradiance [H, W, 3] of the light map's fronts, or [H, W, 6] of fronts and backs, without what comes
        straight from punctual lights (`stages.radiance_cache`); negative where paths have to go on.
        """
        out = copy(self)
        # Not by a GPU's texture units, which interpolate with 8 bits.
        out.cache = mi.Texture2f(mi.TensorXf(np.ascontiguousarray(cache, np.float32)), use_accel=False)
        out.knows_backs = cache.shape[2] == 6
        return out

    def _tabulate(self, scene: Scene) -> None:
        """By Dr.Jit's identifier of the shape: is it double-sided, its first face; by face: clearance and pull."""
        shapes = self.scene.shapes()
        identifiers = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
        double_sided, first = (np.zeros(max(identifiers, default=0) + 1, np.uint32) for _ in range(2))
        clearances, pulls, count = [np.zeros(1)], [np.zeros((1, 4))], 1
        self.emitter_clearance = 0.0
        for shape, identifier in zip(shapes, identifiers, strict=True):
            mesh = scene.meshes[mesh_number(shape)]
            double_sided[identifier] = scene.materials[mesh.material].double_sided
            first[identifier] = count
            clearances.append(face_clearance(mesh.positions, mesh.faces))
            pulls.append(face_pull(mesh.positions, mesh.faces, EDGE_CLEARANCES * clearances[-1]))
            count += len(mesh.faces)
            if shape.is_emitter():
                self.emitter_clearance = max(self.emitter_clearance, float(clearances[-1].max()))
        self.double_sided, self.first_face = mi.UInt32(double_sided), mi.UInt32(first)
        self.face_clearance = mi.Float(np.concatenate(clearances).astype(np.float32))
        self.face_pull = mi.Float(np.concatenate(pulls).astype(np.float32).ravel())

    def _face(self, si: Any) -> Any:
        """Number [UInt32] of the face that was hit, in the tables by face; 0 where none was."""
        first = dr.gather(mi.UInt32, self.first_face, dr.reinterpret_array(mi.UInt32, si.shape), si.is_valid())
        return dr.select(si.is_valid(), first + si.prim_index, 0)

    def vertex(self, si: Any, direction: Any) -> Any:
        """Where rays start [Point3f] that leave a hit on the side from which `direction` came.

        The point lies on the way that the ray has just come, so that it is not behind another surface: a clearance
        above its own face, off the edges of which it is moved too, because another wall may stand there.
        """
        face = self._face(si)
        pull = dr.gather(mi.Vector4f, self.face_pull, face)
        inside = si.p + pull.w * (mi.Point3f(pull.x, pull.y, pull.z) - si.p)
        back = inside - dr.minimum(self._step(si, face, direction), 0.5 * si.t) * direction
        # A ray that grazes the face does not get a clearance off it on its way back.
        side = dr.dot(si.n, direction)
        missing = dr.maximum(1.0 - dr.abs(side) / LEAST_COSINE, 0.0) * dr.gather(mi.Float, self.face_clearance, face)
        return mi.Point3f(back - dr.mulsign(missing, side) * si.n)

    def beyond(self, si: Any, direction: Any) -> Any:
        """The point [Point3f] on a ray in which it goes on behind a hit."""
        return mi.Point3f(si.p + self._step(si, self._face(si), direction) * direction)

    def behind(self, position: Any, normal: Any, reach: Any) -> Any:
        """The points [Point3f] behind the surface above which points lie no higher than `reach` [Float] metres."""
        ray = mi.Ray3f(position, -normal)
        ray.maxt = reach
        si = self.scene.ray_intersect(ray)
        return dr.select(si.is_valid(), self.beyond(si, ray.d), position)

    def _step(self, si: Any, face: Any, direction: Any) -> Any:
        """Metres [Float] along `direction` that lead a clearance off the face."""
        cosine = dr.abs(dr.dot(si.n, direction))
        return dr.gather(mi.Float, self.face_clearance, face) / dr.maximum(cosine, LEAST_COSINE)

    @dr.syntax  # type: ignore[untyped-decorator, unused-ignore]
    def closest(self, ray: Any, active: Any) -> Any:
        """The first opaque hit: Mitsuba's SurfaceInteraction3f, invalid where the ray leaves the scene."""
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        if dr.hint(self.has_cutouts, mode="scalar"):
            layers = mi.UInt32(0)
            through = active & si.is_valid() & (self._opacity(si, active) < OPACITY_THRESHOLD)
            while through:
                onwards = mi.Ray3f(self.beyond(si, ray.d), ray.d, ray.maxt, ray.time, ray.wavelengths)
                onwards.maxt = ray.maxt - dr.norm(onwards.o - ray.o)
                behind = self.scene.ray_intersect(onwards, mi.RayFlags.All, False, through)
                si = dr.select(through, behind, si)
                layers += 1
                through &= si.is_valid() & (self._opacity(si, through) < OPACITY_THRESHOLD) & (layers < MAX_LAYERS)
        return si

    @dr.syntax  # type: ignore[untyped-decorator, unused-ignore]
    def scattering(self, ray: Any, chance: Any, active: Any) -> tuple[Any, Any]:
        """A hit drawn from all that let a part of the light pass, and the factor [Color3f] on what comes from there.

        `chance`: a uniform number [Float]; after each surface it is stretched and used again. A surface of
        transmittance T is passed with probability p = mean T and factor T / p, else hit with factor 1 / (1 - p), so
        that the mean is T times what lies behind plus what the surface itself sends.
        """
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        factor = mi.Color3f(1.0)
        layers, searching = mi.UInt32(0), active & si.is_valid()
        while searching:
            through = si.bsdf().eval_null_transmission(si, searching)
            share = dr.select(layers < MAX_LAYERS, mean(through), 0.0)
            passes = searching & (chance < share)
            hit = searching & ~passes
            factor = dr.select(passes, factor * through / share, dr.select(hit, factor / (1.0 - share), factor))
            chance = dr.select(passes, chance / share, chance)
            onwards = mi.Ray3f(self.beyond(si, ray.d), ray.d)
            behind = self.scene.ray_intersect(onwards, mi.RayFlags.All, False, passes)
            si = dr.select(passes, behind, si)
            layers += 1
            searching = passes & si.is_valid()
        return si, factor

    @dr.syntax  # type: ignore[untyped-decorator, unused-ignore]
    def passing(self, ray: Any, active: Any) -> Any:
        """The part [Color3f] of the light that passes all surfaces before the ray's `maxt`."""
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        passed = mi.Color3f(1.0)
        layers, searching = mi.UInt32(0), active & si.is_valid()
        while searching:
            through = si.bsdf().eval_null_transmission(si, searching)
            passed = dr.select(searching, passed * dr.select(layers < MAX_LAYERS, through, 0.0), passed)
            searching &= dr.max(passed) > 0.0
            onwards = mi.Ray3f(self.beyond(si, ray.d), ray.d)
            onwards.maxt = ray.maxt - dr.norm(onwards.o - ray.o)
            si = dr.select(searching, self.scene.ray_intersect(onwards, mi.RayFlags.All, False, searching), si)
            layers += 1
            searching &= si.is_valid()
        return passed

    def _opacity(self, si: Any, active: Any) -> Any:
        return 1.0 - mean(si.bsdf().eval_null_transmission(si, active))

    def unoccluded(self, origin: Any, target: Any, active: Any) -> Any:
        """The part [Color3f] of the light that gets from one point to another."""
        segment = target - origin
        distance = dr.norm(segment)
        ray = mi.Ray3f(origin, segment / distance)
        ray.maxt = dr.maximum(distance * (1.0 - SHADOW_SLACK) - self.emitter_clearance, 0.0)
        if self.has_veils:
            return self.passing(ray, active)
        return dr.select(self.blocked(ray, active), mi.Color3f(0.0), mi.Color3f(1.0))

    def blocked(self, ray: Any, active: Any) -> Any:
        """Whether the ray meets an opaque surface before its `maxt`."""
        if not self.has_cutouts:
            return self.scene.ray_test(ray, active)
        return self.closest(ray, active).is_valid()

    def light_at(self, si: Any, sample: Any, active: Any) -> tuple[Any, Any]:
        """Next-event estimation at a point off a surface: direction sample, and what arrives of radiance / pdf."""
        ds, weight = self.scene.sample_emitter_direction(si, sample, False, active)
        active = active & (ds.pdf != 0.0) & (dr.max(weight) > 0.0)
        weight *= self.unoccluded(si.p, ds.p, active)
        return ds, dr.select(active, weight, 0.0)

    @dr.syntax  # type: ignore[untyped-decorator, unused-ignore]
    def trace(
        self,
        lanes: Any,
        samples: Any,
        start: Callable[[Any, Any], Start],
        sees_environment: bool,
        done: Any | None = None,
    ) -> LaneSums:
        """Sums over `samples` [UInt32 a lane] paths a lane that begin as `start(sample state, sample)` says.

        `lanes`: UInt64 states. The environment counts at the first ray only with `sees_environment`. With a cache the
        diffuse lobe of a front is not followed: the cache says what it receives, but for punctual lights. `done`
        [UInt32 a lane]: how many samples earlier calls have taken, which are not taken again.
        """
        width = dr.width(lanes)
        zeros = dr.zeros(mi.UInt32, width)
        radiance, weight_sum = dr.zeros(mi.Color3f, width), dr.zeros(mi.Float, width)
        square = dr.zeros(mi.Float, width)
        paths, dropped = mi.UInt32(zeros), mi.UInt32(zeros)
        sample, depth = mi.UInt32(zeros if done is None else done), mi.UInt32(zeros)
        last = sample + samples
        state = mi.UInt64(lanes)
        origin, direction = dr.zeros(mi.Point3f, width), dr.zeros(mi.Vector3f, width)
        before, before_pdf = dr.zeros(mi.Point3f, width), dr.zeros(mi.Float, width)
        path_weight = dr.zeros(mi.Float, width)
        throughput, path_radiance = dr.zeros(mi.Color3f, width), dr.zeros(mi.Color3f, width)
        on_path = dr.zeros(mi.Bool, width)
        running = sample < last

        while running:
            # Begin the next path in every lane that is between paths.
            fresh = ~on_path
            state = dr.select(fresh, counters.sample_state(lanes, sample), state)
            first = start(lanes, sample)
            on_path |= first.used
            origin, direction = dr.select(fresh, first.origin, origin), dr.select(fresh, first.direction, direction)
            before, before_pdf = dr.select(fresh, first.origin, before), dr.select(fresh, first.pdf, before_pdf)
            path_weight = dr.select(fresh, first.weight, path_weight)
            throughput, path_radiance = dr.select(fresh, 1.0, throughput), dr.select(fresh, 0.0, path_radiance)
            depth = dr.select(fresh, 0, depth)

            ray = mi.Ray3f(origin, direction)
            if dr.hint(self.has_veils, mode="scalar"):
                state, chance = counters.pair(state)
                si, factor = self.scattering(ray, chance.x, on_path)
                throughput *= factor
            else:
                si = self.closest(ray, on_path)
            self._orient(si, ray)
            thin = dr.gather(mi.UInt32, self.double_sided, dr.reinterpret_array(mi.UInt32, si.shape), si.is_valid())
            behind = si.is_valid() & (dr.dot(si.n, direction) > 0.0) & (thin == 0)

            emits = on_path & (si.is_valid() | (depth > 0) | sees_environment)
            path_radiance += throughput * self._emitted(si, before, before_pdf, emits)
            scatters = on_path & si.is_valid() & (depth < self.max_depth) & ~behind
            si.p = self.vertex(si, direction)
            known = mi.Bool(False)
            if dr.hint(self.cache is not None, mode="scalar"):
                received, known = self._received(si, direction, scatters)
                path_radiance += throughput * received
            state, u = counters.pair(state)
            path_radiance += throughput * self._direct(si, direction, u, scatters, known)

            # Continue in a direction drawn from the BSDF.
            state, u = counters.pair(state)
            state, choice = counters.pair(state)
            scattered, factor = self._sample(si, choice.x, u, scatters, known)
            onwards = si.to_world(scattered.wo)
            scatters &= dr.dot(si.n, onwards) * dr.dot(si.n, direction) < 0.0
            throughput *= factor
            largest = dr.max(throughput)
            survival = dr.select(depth >= ROULETTE_FROM, dr.minimum(largest, 0.95), 1.0)
            survives = scatters & (largest > 0.0) & (choice.y < survival)
            throughput = dr.select(survives, throughput / survival, throughput)

            # Finish the path, or move on to its next vertex.
            ends = ~survives
            finite = dr.all(dr.isfinite(path_radiance))
            counted = on_path & ends
            radiance += dr.select(counted & finite, path_weight * path_radiance, 0.0)
            square += dr.select(counted & finite, dr.square(path_weight * mean(path_radiance)), 0.0)
            weight_sum += dr.select(counted & finite, path_weight, 0.0)
            dropped += dr.select(counted & ~finite, 1, 0)
            paths += dr.select(counted, 1, 0)
            sample += dr.select(ends, 1, 0)
            on_path = survives & running
            before, before_pdf = mi.Point3f(si.p), mi.Float(scattered.pdf)
            origin, direction = mi.Point3f(si.p), mi.Vector3f(onwards)
            depth += 1
            running = on_path | (sample < last)

        return LaneSums(radiance, weight_sum, square, paths, dropped)

    @dr.syntax  # type: ignore[untyped-decorator, unused-ignore]
    def direct(
        self, lanes: Any, samples: Any, position: Any, normal: Any, shading_normal: Any, punctual: bool = True
    ) -> Any:
        """Sum [Color3f] over `samples` next-event estimates of the irradiance at points of a surface.

        Weighted against cosine-distributed paths that see the environment, which `trace` takes. Not `punctual`: without
        what comes from lights that are points or directions.
        """
        total = dr.zeros(mi.Color3f, dr.width(lanes))
        sample = dr.zeros(mi.UInt32, dr.width(lanes))
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.p, at.n = position, mi.Normal3f(normal)
        at.sh_frame = mi.Frame3f(at.n)
        while sample < samples:
            active = sample < samples
            ds, arriving = self.light_at(at, counters.stratified_pair(lanes, sample), active)
            cosine = dr.dot(shading_normal, ds.d)
            above = (cosine > 0.0) & (dr.dot(normal, ds.d) > 0.0)
            alone = mi.Float(1.0 if punctual else 0.0)
            share = dr.select(ds.delta, alone, _power_heuristic(ds.pdf, cosine * dr.inv_pi))
            arriving = arriving * cosine * share
            total += dr.select(above & dr.all(dr.isfinite(arriving)), arriving, 0.0)
            sample += 1
        return total

    def _emitted(self, si: Any, before: Any, before_pdf: Any, active: Any) -> Any:
        """Radiance [Color3f] that the hit, or the environment, emits towards `before`.

        Weighted against next-event estimation at `before`, unless `before_pdf` is 0 because there was none.
        """
        reference = dr.zeros(mi.Interaction3f)
        reference.p = before
        seen = mi.DirectionSample3f(self.scene, si, reference)
        sampled = active & (before_pdf > 0.0)
        light_pdf = dr.select(sampled, self.scene.pdf_emitter_direction(reference, seen, sampled), 0.0)
        return dr.select(active, seen.emitter.eval(si, active), 0.0) * _power_heuristic(before_pdf, light_pdf)

    def _direct(self, si: Any, direction: Any, sample: Any, active: Any, known: Any) -> Any:
        """Light [Color3f] that reaches the hit straight from an emitter and is scattered back along the ray.

        Weighted against BSDF sampling. Where `known`, the cache has what comes from emitters that are not punctual and
        leaves by the diffuse lobe.
        """
        ds, arriving = self.light_at(si, sample, active)
        value, pdf = self._eval(si, si.to_local(ds.d), active, known, ds.delta)
        same_side = dr.dot(si.n, ds.d) * dr.dot(si.n, direction) < 0.0
        share = dr.select(ds.delta, 1.0, _power_heuristic(ds.pdf, pdf))
        return dr.select(active & same_side, value * arriving * share, 0.0)

    def _eval(self, si: Any, wo: Any, active: Any, known: Any, punctual: Any) -> tuple[Any, Any]:
        """BRDF times cosine [Color3f] and density, of the glossy lobe alone where `known` and not `punctual`."""
        bsdf = si.bsdf()
        if self.cache is None:
            return tuple(bsdf.eval_pdf(reflections_only(), si, wo, active))
        value, pdf = bsdf.eval_pdf(reflections_only(diffuse=False), si, wo, active)
        whole, whole_pdf = bsdf.eval_pdf(reflections_only(), si, wo, active & (~known | punctual))
        return dr.select(known & ~punctual, value, whole), dr.select(known, pdf, whole_pdf)

    def _sample(self, si: Any, choice: Any, sample: Any, active: Any, known: Any) -> tuple[Any, Any]:
        """A direction drawn from the BSDF, from its glossy lobe alone where `known`; and the factor on its radiance."""
        bsdf = si.bsdf()
        if self.cache is None:
            return tuple(bsdf.sample(reflections_only(), si, choice, sample, active))
        scattered, factor = bsdf.sample(reflections_only(diffuse=False), si, choice, sample, active & known)
        whole, whole_factor = bsdf.sample(reflections_only(), si, choice, sample, active & ~known)
        return dr.select(known, scattered, whole), dr.select(known, factor, whole_factor)

    def _received(self, si: Any, direction: Any, active: Any) -> tuple[Any, Any]:
        """What the diffuse lobe [Color3f] sends back of the light that the cache knows, and whether it knows any."""
        at = si.shape.eval_attribute_3(LIGHTMAP, si, active)
        held = self.cache.eval(mi.Point2f(at.x, at.y), active)
        irradiance = mi.Color3f(held[:3])
        front = (dr.dot(si.n, direction) < 0.0) ^ (at.z < 0.0)
        if self.knows_backs:
            irradiance = dr.select(front, irradiance, mi.Color3f(held[3:]))
        known = active & (front | self.knows_backs) & (irradiance.x >= 0.0)
        albedo = si.bsdf().eval_attribute_3(DIFFUSE_ALBEDO, si, known)
        return dr.select(known, irradiance * dr.inv_pi * albedo, 0.0), known

    def _orient(self, si: Any, ray: Any) -> None:
        """Replace an interpolated normal that faces away from the ray while the surface faces it, or vice versa."""
        turned = dr.dot(si.sh_frame.n, ray.d) * dr.dot(si.n, ray.d) <= 0.0
        si.sh_frame = dr.select(turned, mi.Frame3f(si.n), si.sh_frame)
        si.wi = dr.select(turned & si.is_valid(), si.to_local(-ray.d), si.wi)


def off_surface(position: Any, normal: Any, direction: Any, clearance: Any) -> Any:
    """The point [Point3f] `clearance` metres off a surface, on the side that `direction` leads to."""
    return mi.Point3f(position + dr.mulsign(clearance, dr.dot(normal, direction)) * normal)


def _power_heuristic(own: Any, other: Any) -> Any:
    """Weight of a sample drawn with density `own` where another technique has density `other`; 1 for other = 0."""
    square = own * own
    return dr.select(other > 0.0, square / dr.fma(other, other, square), 1.0)
