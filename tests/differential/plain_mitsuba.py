"""The right value: plain Mitsuba on a random scene's own description, nothing of which goes through the product.

A white Lambertian patch at the texel reflects its irradiance over pi, so Mitsuba's own `path` (or, where light goes
through surfaces, `volpath`) gives it as the radiance of a ray that ends on the patch. The scene is built about the
texel and 100 units wide: the distances that Mitsuba keeps from surfaces grow with coordinates. Lambertian flat surfaces
are Mitsuba's `diffuse`; for others `appendix_b` has the formulas of glTF 2.0 in a few lines.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from mitsuba_plugins import register_plugins
from random_scenes import Part, Placed, RandomScene, Surface, Texture

from kiln_workers.render.jit import dr, mi

Floats = npt.NDArray[np.float64]

RADIUS: Final = 100.0
PATCH: Final = 1e-3
"""Half of the patch's side."""
SHEET_GAP: Final = 1e-3
"""Between the two sides of a double-sided emitter."""
SKY_ROWS: Final = 257


class PlainMitsuba:
    """A description as Mitsuba scenes about its texels."""

    def __init__(self, scene: RandomScene, max_depth: int) -> None:
        register_plugins()
        self.scene = scene
        self.triangles = [world_triangles(scene, placed) for placed in scene.placed]
        reach = max(float(np.abs(corners).max()) for corners in self.triangles)
        self.magnification = RADIUS / reach
        veils = any(surface.alpha != "OPAQUE" for surface in scene.surfaces)
        self.integrator = mi.load_dict(
            # The ray to the patch is one segment, and so is the one that leaves it.
            {"type": "volpath" if veils else "path", "max_depth": max_depth + 2, "rr_depth": 1000}
        )
        self.sky = None if scene.sky is None else mi.Bitmap(sky_image(scene))
        self.textures = {
            (number, name): linear(texture, name != "glossy")
            for number, surface in enumerate(scene.surfaces)
            for name, texture in surface.textures.items()
        }

    def irradiance(
        self, position: Floats, normal: Floats, shading_normal: Floats, seed: int, blocks: int, paths: int
    ) -> Floats:
        """`blocks` independent estimates [B, 3] at a point of the description, `paths` each."""
        scene = mi.load_dict(self._dictionary(position, normal, shading_normal))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, blocks * paths)
        # In memory instead of the code, so that all texels share a kernel.
        origin, towards = mi.Point3f(*(PATCH * normal).tolist()), mi.Vector3f(*(-normal).tolist())
        dr.make_opaque(origin, towards)
        ray = mi.Ray3f(dr.repeat(origin, blocks * paths), dr.repeat(towards, blocks * paths))
        radiance = np.array(
            self.integrator.sample(scene, sampler, mi.RayDifferential3f(ray))[0], dtype=np.float64
        )  # [3, N]
        return np.pi * radiance.reshape(3, blocks, paths).mean(axis=2).T

    def _dictionary(self, position: Floats, normal: Floats, shading_normal: Floats) -> dict[str, Any]:
        out: dict[str, Any] = {"type": "scene", "embree_use_robust_intersections": True}
        out["patch"] = patch(normal, shading_normal)
        for number, placed in enumerate(self.scene.placed):
            part = self.scene.parts[placed.part]
            surface = self.scene.surfaces[part.surface]
            corners = (self.triangles[number] - position) * self.magnification  # [F, 3, 3]
            out[f"shape_{number}"] = self._shape(placed, part, corners, False)
            if surface.double_sided and surface.emits:
                out[f"shape_{number}_back"] = self._shape(placed, part, corners, True)
        for number, lamp in enumerate(self.scene.lamps):
            out[f"lamp_{number}"] = self._lamp(lamp, position)
        if self.sky is not None:
            out["sky"] = {"type": "envmap", "bitmap": self.sky}
        return out

    def _shape(self, placed: Placed, part: Part, corners: Floats, back: bool) -> Any:
        """A mesh of loose triangles; the back is turned over and a little behind."""
        surface = self.scene.surfaces[part.surface]
        shape, faces = part.shape, world_faces(part, placed)
        if back:
            across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            across /= np.linalg.norm(across, axis=1, keepdims=True)
            corners, faces = (corners - SHEET_GAP * across[:, None])[:, ::-1], faces[:, ::-1]
        order = faces.ravel()
        streams = {
            name: texture_coordinates(texture, unit(shape.uv_sets[texture.uv_set]))[order]
            for name, texture in surface.textures.items()
        }
        # Mitsuba samples emitters by its own coordinates, so theirs are the emission's.
        main = streams.pop("emission", None)
        properties = mi.Properties()
        properties["bsdf"] = self._bsdf(part)
        if surface.emits:
            properties["emitter"] = self._emitter(part.surface, surface)
        smooth = shape.normals is not None and not surface.emits
        mesh = mi.Mesh(
            "shape",
            len(order),
            len(faces),
            properties,
            has_vertex_normals=smooth,
            has_vertex_texcoords=main is not None,
        )
        arrays = mi.traverse(mesh)
        arrays["vertex_positions"] = mi.Float(corners.astype(np.float32).ravel())
        arrays["faces"] = mi.UInt32(np.arange(len(order), dtype=np.uint32))
        if smooth:
            normals = world_normals(shape.normals, placed.matrix)[order]
            arrays["vertex_normals"] = mi.Float(normals.astype(np.float32).ravel())
        if main is not None:
            arrays["vertex_texcoords"] = mi.Float(main.astype(np.float32).ravel())
        arrays.update()
        for name, uv in streams.items():
            padded = np.concatenate([uv, np.zeros((len(order), 1))], axis=1)
            mesh.add_attribute(f"vertex_{name}", 3, padded.astype(np.float32).ravel())
        if shape.colours is not None:
            colours = rgba(shape.colours)[order]
            mesh.add_attribute("vertex_tint", 3, colours[:, :3].astype(np.float32).ravel())
            mesh.add_attribute("vertex_cover", 1, colours[:, 3].astype(np.float32).ravel())
        return mesh

    def _bsdf(self, part: Part) -> Any:
        surface, tinted = self.scene.surfaces[part.surface], part.shape.colours is not None
        base: dict[str, Any] = {"type": "rgb", "value": list(surface.colour[:3])}
        if surface.texture is not None or tinted:
            base = self._image(part, "base", np.array(surface.colour[:3]), "tint" if tinted else "")
        if surface.lambert and part.shape.normals is None:
            out: dict[str, Any] = {"type": "diffuse", "reflectance": base}
            out = {"type": "twosided", "bsdf": out} if surface.double_sided else out
        else:
            f0 = ((surface.ior - 1.0) / (surface.ior + 1.0)) ** 2 * np.array(surface.specular_colour)
            factors = np.array([1.0, surface.roughness, surface.metallic])
            out = {
                "type": "appendix_b",
                "base": mi.load_dict(base),
                "glossy": mi.load_dict(self._image(part, "glossy", factors, "")),
                "f0": mi.ScalarVector3f(*(surface.specular * np.minimum(f0, 1.0)).tolist()),
                "f90": float(surface.specular),
                "double_sided": surface.double_sided,
            }
        if surface.alpha != "OPAQUE":
            cutoff = surface.cutoff if surface.alpha == "MASK" else -1.0
            cover = "cover" if tinted else ""
            opacity = self._image(part, "base", np.full(1, surface.colour[3]), cover, slice(3, 4), cutoff)
            out = {"type": "mask", "opacity": opacity, "bsdf": out}
        return mi.load_dict(out)

    def _image(
        self, part: Part, name: str, factor: Floats, tint: str, channels: slice = slice(0, 3), cutoff: float = -1.0
    ) -> dict[str, Any]:
        """Some channels of a texture times a factor, or the factor alone, times an attribute of the vertices; with a
        cutoff a test of that, texel by texel."""
        texture = self.scene.surfaces[part.surface].textures.get(name)
        pixels = np.ones((1, 1, 4)) if texture is None else self.textures[part.surface, name]
        wrap = ("clamp", "clamp") if texture is None else texture.wrap
        attribute = "" if texture is None else f"vertex_{name}"
        return image(pixels[..., channels] * factor, wrap, attribute, tint and f"vertex_{tint}", cutoff)

    def _emitter(self, number: int, surface: Surface) -> Any:
        radiance: Any = {"type": "rgb", "value": list(surface.emission)}
        if surface.emission_texture is not None:
            pixels = self.textures[number, "emission"][..., :3] * np.array(surface.emission)
            radiance = image(pixels, surface.emission_texture.wrap)
        return mi.load_dict({"type": "area", "radiance": radiance})

    def _lamp(self, lamp: Any, position: Floats) -> dict[str, Any]:
        place = (lamp.matrix[:3, 3] - position) * self.magnification
        along = lamp.matrix[:3, :3] @ np.array([0.0, 0.0, -1.0])
        power = lamp.intensity * np.array(lamp.colour)
        if lamp.kind == "directional":
            return {"type": "directional", "direction": along.tolist(), "irradiance": rgb(power)}
        power = power * self.magnification**2
        if lamp.kind == "point":
            return {"type": "point", "position": place.tolist(), "intensity": rgb(power)}
        return {
            "type": "khronos_spot",
            "place": mi.ScalarPoint3f(*place.tolist()),
            "along": mi.ScalarVector3f(*along.tolist()),
            "intensity": mi.ScalarVector3f(*power.tolist()),
            "inner": float(lamp.cones[0]),
            "outer": float(lamp.cones[1]),
        }


def rgb(values: Floats) -> dict[str, Any]:
    return {"type": "rgb", "value": np.asarray(values).tolist()}


def patch(normal: Floats, shading_normal: Floats) -> Any:
    """A white quad about the origin."""
    side = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    side *= PATCH / np.linalg.norm(side)
    other = np.cross(normal, side)
    corners = np.array([-side - other, side - other, side + other, -side + other])
    properties = mi.Properties()
    white: dict[str, Any] = {"type": "diffuse", "reflectance": rgb(np.ones(3))}
    if normal @ shading_normal < 1.0 - 1e-6:
        # Light comes from above the geometric surface alone, which matters where that has a hole below the texel.
        base, glossy = (
            mi.load_dict(image(np.array([[c]]), ("clamp", "clamp"))) for c in ([1.0, 1.0, 1.0], [0.0, 1.0, 0.0])
        )
        black = mi.ScalarVector3f(0.0, 0.0, 0.0)
        white = {"type": "appendix_b", "base": base, "glossy": glossy, "f0": black, "f90": 0.0, "double_sided": False}
    properties["bsdf"] = mi.load_dict(white)
    mesh = mi.Mesh("patch", 4, 2, properties, has_vertex_normals=True)
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = mi.Float(corners.astype(np.float32).ravel())
    arrays["vertex_normals"] = mi.Float(np.tile(shading_normal, (4, 1)).astype(np.float32).ravel())
    arrays["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    arrays.update()
    return mesh


def mirrored(matrix: Floats) -> bool:
    return bool(np.linalg.det(matrix[:3, :3]) < 0.0)


def world_faces(part: Part, placed: Placed) -> npt.NDArray[np.int64]:
    """Vertices [F, 3] of each face, counter-clockwise seen from outside (glTF 2.0, 3.7.4)."""
    return part.shape.faces[:, ::-1] if mirrored(placed.matrix) else part.shape.faces


def world_triangles(scene: RandomScene, placed: Placed) -> Floats:
    """Corners [F, 3, 3] in the description's own coordinates."""
    part = scene.parts[placed.part]
    points = part.shape.positions.astype(np.float64) @ placed.matrix[:3, :3].T + placed.matrix[:3, 3]
    return np.asarray(points[world_faces(part, placed)])


def world_normals(normals: Any, matrix: Floats) -> Floats:
    out = np.asarray(normals, np.float64) @ np.linalg.inv(matrix[:3, :3])
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def unit(values: npt.NDArray[Any]) -> Floats:
    """Integers of a file as what they stand for in 0 ... 1; floats as they are."""
    return values.astype(np.float64) / (1.0 if values.dtype == np.float32 else np.iinfo(values.dtype).max)


def rgba(colours: npt.NDArray[Any]) -> Floats:
    """COLOR_0 [V, 4] in 0 ... 1."""
    values = unit(colours)
    return values if values.shape[1] == 4 else np.concatenate([values, np.ones((len(values), 1))], axis=1)


def texture_coordinates(texture: Texture, uv: Any) -> Floats:
    """KHR_texture_transform: translation * rotation * scale, with the rotation matrix that the extension prints."""
    sine, cosine = np.sin(texture.rotation), np.cos(texture.rotation)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    return np.asarray((uv * texture.scale) @ rotation.T + texture.offset)


def linear(texture: Texture, colour: bool) -> Floats:
    """RGBA [H, W, 4] in 0 ... 1, colours linear (IEC 61966-2-1)."""
    values = texture.pixels / 255.0
    if not colour:
        return values
    colours = values[..., :3]
    colours = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return np.concatenate([colours, values[..., 3:]], axis=2)


def image(
    pixels: Floats, wrap: tuple[str, str], attribute: str = "", tint: str = "", cutoff: float = -1.0
) -> dict[str, Any]:
    """A `gltf_image` at the coordinates of an attribute, or at Mitsuba's own."""
    data = mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32))
    names = {"attribute": attribute, "tint": tint, "wrap_s": wrap[0], "wrap_t": wrap[1]}
    return {"type": "gltf_image", "pixels": data, "cutoff": cutoff, **names}


def sky_image(scene: RandomScene) -> Floats:
    """The sky on the nodes of Mitsuba's `envmap`: rows at v = i / (H - 1), columns at u = (j + 1/2) / W."""
    sky = scene.sky
    assert sky is not None
    width = 2 * (SKY_ROWS - 1)
    theta = np.pi * np.arange(SKY_ROWS)[:, None] / (SKY_ROWS - 1)
    phi = 2.0 * np.pi * (np.arange(width)[None, :] + 0.5) / width
    x, z = np.sin(theta) * np.sin(phi), -np.sin(theta) * np.cos(phi)
    return sky_towards(scene, np.stack([x, np.broadcast_to(np.cos(theta), x.shape), z], axis=-1)).astype(np.float32)


def sky_towards(scene: RandomScene, directions: Floats) -> Floats:
    """The scene's sky, scaled and turned: its own +Y axis stays, +X goes to (cos, 0, -sin)."""
    assert scene.sky is not None
    turn = np.radians(scene.sky.rotation_deg)
    x, y, z = np.moveaxis(directions, -1, 0)
    back = np.stack([np.cos(turn) * x - np.sin(turn) * z, y, np.sin(turn) * x + np.cos(turn) * z], axis=-1)
    return scene.sky.scale * scene.sky.radiance(back)
