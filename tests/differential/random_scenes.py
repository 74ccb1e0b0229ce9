"""Random glTF scenes, each from its seed, with a description of their own from which the right light is computed.

The description is in the scene's own units: about ten across and about the origin. The file has it under a root node
that scales it and moves it away; all else is nodes, accessors and textures as the seed has it. What the file rounds
(float32 positions, 8-bit colours) is rounded in the description too.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapes
from glb import GlbWriter

Floats = npt.NDArray[np.float64]
FARTHEST: Final = 5e6
"""Metres; the product refuses coordinates beyond twice as many."""
WRAPS: Final = ("repeat", "clamp", "mirror")


@dataclass(frozen=True)
class Texture:
    """An image and how it is looked up: (u, v) goes through scale, rotation and offset (KHR_texture_transform)."""

    pixels: npt.NDArray[np.uint8]  # [H, W, 4]
    wrap: tuple[str, str]
    uv_set: int
    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True)
class Surface:
    """A material; with `specular` (KHR_materials_specular.specularFactor) 0 and no metal it is Lambert's."""

    colour: tuple[float, float, float, float]
    texture: Texture | None = None
    specular: float = 0.0
    specular_colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ior: float = 1.5
    metallic: float = 0.0
    roughness: float = 1.0
    glossy_texture: Texture | None = None
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: Texture | None = None
    double_sided: bool = False
    alpha: str = "OPAQUE"
    cutoff: float = 0.5

    @property
    def emits(self) -> bool:
        return max(self.emission) > 0.0

    @property
    def lambert(self) -> bool:
        return self.specular == 0.0 and self.metallic == 0.0

    @property
    def textures(self) -> dict[str, Texture]:
        """By what they are for."""
        every = {"base": self.texture, "glossy": self.glossy_texture, "emission": self.emission_texture}
        return {name: texture for name, texture in every.items() if texture is not None}


@dataclass(frozen=True)
class Part:
    """A primitive of the file."""

    shape: shapes.Shape
    surface: int


@dataclass(frozen=True)
class Placed:
    """A part under the transform of its node, without the root's."""

    part: int
    matrix: Floats  # [4, 4]


@dataclass(frozen=True)
class Lamp:
    """KHR_lights_punctual; it shines along -Z of its node. W/sr in the scene's own units, W/m^2 if directional."""

    kind: str
    colour: tuple[float, float, float]
    intensity: float
    matrix: Floats
    cones: tuple[float, float] = (0.0, np.pi / 4)


@dataclass(frozen=True)
class Sky:
    """Radiance base + sum of peak exp(sharpness (d . axis - 1)), before it is scaled and turned about +Y."""

    base: Floats  # [3]
    lobes: tuple[tuple[Floats, float, Floats], ...]  # axis, sharpness, peak
    scale: float
    rotation_deg: float

    def radiance(self, directions: Floats) -> Floats:
        """Unscaled and not turned, of unit directions [..., 3]."""
        out = np.broadcast_to(self.base, directions.shape).copy()
        for axis, sharpness, peak in self.lobes:
            out += np.exp(sharpness * (directions @ axis - 1.0))[..., None] * peak
        return out


@dataclass
class RandomScene:
    """A description; `features` names what it has, for the report."""

    seed: int
    unit: float  # metres to one of the scene's own units
    offset: Floats  # [3] metres
    surfaces: list[Surface] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    meshes: list[list[int]] = field(default_factory=list)
    """Parts of each mesh of the file."""
    placed: list[Placed] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    sky: Sky | None = None
    nodes: list[dict[str, Any]] = field(default_factory=list)
    features: set[str] = field(default_factory=set)


class Maker:
    """Draws the scene of a seed."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        unit = float(10.0 ** self.random.uniform(-3.0, 4.0)) if self.chance(0.5) else 1.0
        offset = np.zeros(3)
        if self.chance(0.35):
            offset = self.random.uniform(-1.0, 1.0, 3) * min(unit * 10.0 ** self.random.uniform(1.0, 5.0), FARTHEST)
        self.scene = RandomScene(seed, unit, offset)
        self.note("far from the origin", bool(offset.any()))
        self.note("scaled", unit != 1.0)
        self.own_lightmap_uv = self.chance(0.4)
        self.note("TEXCOORD_1 for the light map", self.own_lightmap_uv)
        self.veils = self.chance(0.25)

    def make(self) -> RandomScene:
        kind = self.pick("ground", "room", "room", "walls", "thick room")
        self.note(kind)
        size = self.random.uniform([2.0, 1.2, 2.0], [3.2, 2.0, 3.2])
        self._shell(kind, size)
        for _ in range(int(self.random.integers(1, 5))):
            self._object(size)
        self._light(kind, size)
        return self.scene

    def chance(self, probability: float) -> bool:
        return bool(self.random.random() < probability)

    def pick(self, *choices: Any) -> Any:
        return choices[int(self.random.integers(len(choices)))]

    def note(self, feature: str, there: bool = True) -> None:
        if there:
            self.scene.features.add(feature)

    def _shell(self, kind: str, size: Floats) -> None:
        """What stands around: a ground, a room of single sheets or of solid walls, or three walls."""
        surface = self._surface(veiled=False)
        if kind == "ground":
            shape = shapes.ground(size)
        elif kind == "walls":
            shape = shapes.room(size, walls=(0, 2, 4))
        else:
            shape = shapes.room(size)
            if kind == "thick room":
                shape = shapes.joined(shape, shapes.box(size + 0.2))
        self._place(self._mesh(self._part(shape, surface)), np.eye(4), {})

    def _object(self, size: Floats) -> None:
        """A part under a group's and its own transform, once or several times."""
        parts = [self._part(self._shape(), self._surface()) for _ in range(self.pick(1, 1, 1, 2))]
        self.note("several primitives", len(parts) > 1)
        mesh = self._mesh(*parts)
        group, group_matrix = self._transform(size, spread=0.6)
        count = self.pick(1, 1, 2, 3)
        self.note("instances", count > 1)
        children = []
        for _ in range(count):
            node, matrix = self._transform(0.3 * size, spread=1.0, small=True)
            children.append((node, group_matrix @ matrix))
        if self.chance(0.15):
            self.note("EXT_mesh_gpu_instancing")
            self._gpu_instances(mesh, group, group_matrix, size)
            return
        index = len(self.scene.nodes)
        self.scene.nodes.append(group | {"children": list(range(index + 1, index + 1 + count))})
        for node, matrix in children:
            self._place(mesh, matrix, node, root=False)
        if self.chance(0.1):
            self.note("hidden node")
            hidden = {"KHR_node_visibility": {"visible": False}}
            self.scene.nodes.append({"mesh": mesh, "extensions": hidden, "root": True})

    def _gpu_instances(self, mesh: int, group: dict[str, Any], group_matrix: Floats, size: Floats) -> None:
        count = int(self.random.integers(2, 4))
        translation = (0.3 * size * self.random.uniform(-1.0, 1.0, (count, 3))).astype(np.float32)
        rotation = np.array([shapes.quaternion(self.random) for _ in range(count)]).astype(np.float32)
        scale = self.random.uniform(0.4, 1.0, (count, 3)).astype(np.float32)
        self.scene.nodes.append(group | {"mesh": mesh, "instances": (translation, rotation, scale), "root": True})
        for k in range(count):
            local = shapes.trs(*(np.float64(values[k]) for values in (translation, rotation, scale)))
            self.scene.placed += [Placed(part, group_matrix @ local) for part in self.scene.meshes[mesh]]

    def _transform(self, size: Floats, spread: float, small: bool = False) -> tuple[dict[str, Any], Floats]:
        """A node's JSON and its matrix: moved, turned, and sometimes mirrored, stretched or sheared."""
        translation = spread * size * self.random.uniform(-1.0, 1.0, 3)
        rotation = shapes.quaternion(self.random) if self.chance(0.7) else np.array([0.0, 0.0, 0.0, 1.0])
        scale = np.full(3, float(self.random.uniform(0.5, 1.1)))
        if self.chance(0.4):
            scale = self.random.uniform(0.35, 1.2, 3)
            self.note("non-uniform scale")
        if self.chance(0.35):
            scale[int(self.random.integers(3))] *= -1.0
            self.note("mirrored")
        matrix = shapes.trs(translation, rotation, scale)
        if small and self.chance(0.25):
            shear = np.eye(4)
            shear[0, 1] = self.random.uniform(-0.5, 0.5)
            matrix = matrix @ shear
            self.note("matrix with shear")
            return {"matrix": matrix.T.ravel().tolist()}, matrix
        node = {"translation": translation.tolist(), "rotation": rotation.tolist(), "scale": scale.tolist()}
        return node, matrix

    def _mesh(self, *parts: int) -> int:
        self.scene.meshes.append(list(parts))
        return len(self.scene.meshes) - 1

    def _place(self, mesh: int, matrix: Floats, node: dict[str, Any], root: bool = True) -> None:
        self.scene.placed += [Placed(part, matrix) for part in self.scene.meshes[mesh]]
        self.scene.nodes.append(node | {"mesh": mesh, "root": root})

    def _part(self, shape: shapes.Shape, surface: int) -> int:
        look = self.scene.surfaces[surface]
        sets = 1 + max((texture.uv_set for texture in look.textures.values()), default=-1)
        sets = max(sets, 2) if self.own_lightmap_uv else sets
        uv = [self._coordinates(shape.uv) for _ in range(sets)]
        if self.own_lightmap_uv:
            uv[1] = self._stored(shapes.unique_uv(shape))
        colours = None
        if self.chance(0.3) and not look.emits:
            colours = self._colours(len(shape.positions), look)
        self.scene.parts.append(Part(replace(shape, uv_sets=tuple(uv), colours=colours), surface))
        return len(self.scene.parts) - 1

    def _coordinates(self, uv: Floats) -> npt.NDArray[Any]:
        """A TEXCOORD set: turned, magnified and moved, or within 0 ... 1."""
        if self.chance(0.25):
            return self._stored(uv)
        turn, grow = self.random.uniform(0.0, 6.28), self.random.uniform(0.6, 2.5)
        matrix = grow * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        return np.asarray((uv @ matrix + self.random.uniform(-1.0, 1.0, 2)).astype(np.float32))

    def _stored(self, values: Floats) -> npt.NDArray[Any]:
        """Values in 0 ... 1 as the file has them: floats, or integers."""
        kind = self.pick(np.float32, np.float32, np.uint16)
        self.note("normalised TEXCOORD", kind is np.uint16)
        return values.astype(np.float32) if kind is np.float32 else np.round(values * 65535).astype(np.uint16)

    def _colours(self, count: int, look: Surface) -> npt.NDArray[Any]:
        """COLOR_0 [V, 3 or 4] as the file has it: floats, or integers that stand for 0 ... 1."""
        self.note("vertex colours")
        values = self.random.uniform(0.2, 1.0, (count, self.pick(3, 4)))
        if look.alpha == "MASK":
            # All of the surface or nothing, so that no edge depends on how a test is interpolated.
            values[:, 3:] = self.pick(0.2, 1.0)
            self.note("vertex alpha under a test", values.shape[1] == 4)
        kind = self.pick(np.float32, np.uint8, np.uint16)
        return values.astype(np.float32) if kind is np.float32 else np.round(values * np.iinfo(kind).max).astype(kind)

    def _shape(self) -> shapes.Shape:
        make: Callable[[np.random.Generator], shapes.Shape] = self.pick(*shapes.OBJECTS)
        shape = make(self.random)
        self.note(f"shape: {make.__name__}")
        self.note("smooth normals", shape.smooth)
        return shape

    def _surface(self, veiled: bool = True) -> int:
        grey = self.chance(0.3)
        colour = np.full(3, self.random.uniform(0.2, 0.8)) if grey else self.random.uniform(0.1, 0.85, 3)
        look = Surface((*colour.tolist(), 1.0), double_sided=self.chance(0.3))
        self.note("double-sided", look.double_sided)
        if self.chance(0.45):
            look = replace(look, texture=self._texture())
        if self.chance(0.35):
            look = self._glossy(look)
        if veiled and self.veils and self.chance(0.6):
            look = self._veiled(look)
        self.scene.surfaces.append(look)
        return len(self.scene.surfaces) - 1

    def _glossy(self, look: Surface) -> Surface:
        self.note("glossy")
        look = replace(
            look,
            specular=1.0,
            metallic=self.pick(0.0, 1.0, float(self.random.uniform())),
            roughness=float(self.random.uniform(0.35, 1.0)),
        )
        if self.chance(0.3):
            self.note("KHR_materials_specular and _ior")
            colour = tuple(self.random.uniform(0.2, 1.5, 3).tolist())
            factor, ior = float(self.random.uniform(0.1, 1.0)), float(self.random.uniform(1.1, 2.5))
            look = replace(look, specular=factor, specular_colour=colour, ior=ior)
        if self.chance(0.3):
            self.note("metallic-roughness texture")
            look = replace(look, glossy_texture=self._texture(least=100))
        return look

    def _veiled(self, look: Surface) -> Surface:
        """A cut-out along borders of texels, or a fractional opacity."""
        alpha = self.pick("MASK", "BLEND")
        self.note(f"alpha: {alpha}")
        opacity = float(self.random.uniform(0.6, 1.0)) if alpha == "BLEND" or self.chance(0.3) else 1.0
        look = replace(look, alpha=alpha, colour=(*look.colour[:3], opacity))
        if alpha == "MASK":
            # Where the factor is 1 the border of a hole is that of the texels.
            return replace(look, texture=self._holes(look.texture or self._texture()) if opacity == 1.0 else None)
        return look

    def _holes(self, texture: Texture) -> Texture:
        """The texture with a chequered alpha of 0 and 1 in squares of two texels."""
        height, width = (2 * int(n) for n in self.random.integers(1, 4, 2))
        pixels = self.random.integers(40, 256, (2 * height, 2 * width, 4), dtype=np.uint8)
        rows, columns = np.indices(pixels.shape[:2])
        pixels[..., 3] = 255 * ((rows // 2 + columns // 2) % 2)
        return replace(texture, pixels=pixels)

    def _texture(self, least: int = 40) -> Texture:
        self.note("texture")
        height, width = (int(n) for n in self.random.integers(2, 9, 2))
        pixels = self.random.integers(least, 256, (height, width, 4), dtype=np.uint8)
        wrap = (self.pick(*WRAPS), self.pick(*WRAPS))
        self.note("two wrap modes", wrap[0] != wrap[1])
        number = self.pick(0, 0, 1, 2)
        self.note("TEXCOORD_1 or _2", number > 0)
        out = Texture(pixels, wrap, number)
        if self.chance(0.4):
            self.note("KHR_texture_transform")
            offset, scale = self.random.uniform(-1.0, 1.0, 2), self.random.uniform(0.5, 2.0, 2)
            out = replace(
                out,
                offset=tuple(offset.tolist()),
                scale=tuple(scale.tolist()),
                rotation=float(self.random.uniform(-3.0, 3.0)),
            )
        return out

    def _light(self, kind: str, size: Floats) -> None:
        """A sky, lamps, a glowing part: at least one of them that is inside of a closed room."""
        closed = "room" in kind
        if self.chance(0.5 if closed else 0.8):
            self._sky()
        inside = int(self.random.integers(1, 3)) if closed else int(self.random.integers(0, 2))
        if self.scene.sky is None:
            inside = max(inside, 1)
        for _ in range(inside):
            if self.chance(0.5):
                self._glow(size)
            else:
                self._lamp(size, closed)

    def _sky(self) -> None:
        self.note("sky")
        lobes = []
        for _ in range(int(self.random.integers(1, 4))):
            axis = self.random.normal(size=3)
            peak = self.random.uniform(0.2, 1.0, 3) * 10.0 ** self.random.uniform(0.0, 1.3)
            lobes.append((axis / np.linalg.norm(axis), float(self.random.uniform(2.0, 60.0)), peak))
        rotation = float(self.random.uniform(-360.0, 360.0)) if self.chance(0.7) else 0.0
        self.note("sky turned", rotation != 0.0)
        self.scene.sky = Sky(
            self.random.uniform(0.05, 0.5, 3), tuple(lobes), float(10.0 ** self.random.uniform(-1, 1)), rotation
        )

    def _glow(self, size: Floats) -> None:
        """A panel or a solid that shines."""
        self.note("emissive mesh")
        colour = self.random.uniform(0.3, 1.0, 3) * 10.0 ** self.random.uniform(0.0, 1.5)
        look = Surface((0.3, 0.3, 0.3, 1.0), emission=tuple(colour.tolist()), double_sided=self.chance(0.4))
        if self.chance(0.4):
            self.note("emissive texture")
            look = replace(look, emission_texture=self._texture())
        if self.chance(0.4):
            look = replace(look, texture=self._texture())
        self.note("double-sided emissive mesh", look.double_sided)
        self.scene.surfaces.append(look)
        shape = self.pick(shapes.panel, shapes.crate)(self.random)
        mesh = self._mesh(self._part(shape, len(self.scene.surfaces) - 1))
        node, matrix = self._transform(0.5 * size, spread=1.0)
        self._place(mesh, matrix, node)

    def _lamp(self, size: Floats, closed: bool) -> None:
        kind = self.pick("point", "spot", "spot") if closed else self.pick("point", "spot", "directional")
        self.note(f"lamp: {kind}")
        translation = 0.6 * size * self.random.uniform(-1.0, 1.0, 3)
        rotation, scale = shapes.quaternion(self.random), self.random.uniform(0.3, 3.0, 3)
        if self.chance(0.3):
            scale[int(self.random.integers(3))] *= -1.0
        outer = float(self.random.uniform(0.3, 1.3))
        colour = tuple(self.random.uniform(0.2, 1.0, 3).tolist())
        matrix = shapes.trs(translation, rotation, scale)
        intensity = float(10.0 ** self.random.uniform(0.0, 1.5))
        lamp = Lamp(kind, colour, intensity, matrix, (float(outer * self.random.uniform(0.0, 0.95)), outer))
        node = {"translation": translation.tolist(), "rotation": rotation.tolist(), "scale": scale.tolist()}
        self.scene.nodes.append(node | {"light": len(self.scene.lamps), "root": True})
        self.scene.lamps.append(lamp)


def make_scene(seed: int) -> RandomScene:
    """The random scene of a seed."""
    return Maker(seed).make()


def write_scene(scene: RandomScene, folder: Path) -> str:
    """Write `scene.glb`, and `sky.exr` where there is one; the entry's name."""
    writer = GlbWriter()
    for surface in scene.surfaces:
        writer.add_material(surface)
    for parts in scene.meshes:
        writer.add_mesh([scene.parts[number] for number in parts])
    # Metres: a lamp's irradiance is intensity over distance squared.
    for lamp in scene.lamps:
        intensity = lamp.intensity * (1.0 if lamp.kind == "directional" else scene.unit**2)
        writer.add_light(lamp, intensity)
    roots = [number + 1 for number, node in enumerate(scene.nodes) if node.get("root") or "children" in node]
    root = {"translation": scene.offset.tolist(), "scale": [scene.unit] * 3, "children": roots}
    writer.nodes.append(root)
    for node in scene.nodes:
        writer.add_node(node)
    (folder / "scene.glb").write_bytes(writer.encode())
    return "scene.glb"
