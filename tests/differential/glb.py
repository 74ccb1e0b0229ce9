"""Writes the GLB files of random scenes; independent of the product's writer."""

import json
import struct
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.package import png

COMPONENTS: Final = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125}
WRAP: Final = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
TYPES: Final = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class GlbWriter:
    """Collects the arrays and the JSON of a file."""

    def __init__(self) -> None:
        self.binary = bytearray()
        self.json: dict[str, list[Any]] = {}
        self.nodes: list[dict[str, Any]] = []
        self.lights: list[dict[str, Any]] = []
        self.extensions: set[str] = set()

    def _add(self, table: str, item: dict[str, Any]) -> int:
        rows = self.json.setdefault(table, [])
        rows.append(item)
        return len(rows) - 1

    def _view(self, data: bytes, **more: int) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        place = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.binary += data
        return self._add("bufferViews", place | more)

    def accessor(self, values: npt.NDArray[Any], normalised: bool = False) -> int:
        """Rows [N] or [N, C]; each row begins at a multiple of 4 bytes."""
        rows = values.reshape(len(values), -1)
        width = rows.shape[1] * rows.itemsize
        stride = -(-width // 4) * 4 if values.ndim > 1 else width
        padded = np.zeros((len(rows), stride), np.uint8)
        padded[:, :width] = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), width)
        more = {"byteStride": stride} if values.ndim > 1 else {}
        item: dict[str, Any] = {
            "bufferView": self._view(padded.tobytes(), **more),
            "componentType": COMPONENTS[str(values.dtype)],
            "count": len(rows),
            "type": TYPES[rows.shape[1]],
        }
        if normalised:
            item["normalized"] = True
        if values.dtype == np.float32:
            item |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self._add("accessors", item)

    def add_mesh(self, parts: list[Any]) -> None:
        self._add("meshes", {"primitives": [self._primitive(part) for part in parts]})

    def _primitive(self, part: Any) -> dict[str, Any]:
        shape = part.shape
        attributes = {"POSITION": self.accessor(shape.positions)}
        if shape.normals is not None:
            attributes["NORMAL"] = self.accessor(shape.normals)
        for number, uv in enumerate(shape.uv_sets):
            attributes[f"TEXCOORD_{number}"] = self.accessor(uv, uv.dtype != np.float32)
        if shape.colours is not None:
            attributes["COLOR_0"] = self.accessor(shape.colours, shape.colours.dtype != np.float32)
        primitive: dict[str, Any] = {"attributes": attributes, "material": part.surface}
        if shape.strip:
            primitive["mode"] = 5
        elif not np.array_equal(shape.faces.ravel(), np.arange(len(shape.positions))):
            small = np.uint8 if len(shape.positions) < 200 else np.uint16
            primitive["indices"] = self.accessor(shape.faces.ravel().astype(small))
        return primitive

    def add_material(self, surface: Any) -> None:
        pbr: dict[str, Any] = {
            "baseColorFactor": list(surface.colour),
            "metallicFactor": surface.metallic,
            "roughnessFactor": surface.roughness,
        }
        if surface.texture is not None:
            pbr["baseColorTexture"] = self._texture(surface.texture)
        if surface.glossy_texture is not None:
            pbr["metallicRoughnessTexture"] = self._texture(surface.glossy_texture)
        item: dict[str, Any] = {"pbrMetallicRoughness": pbr, "doubleSided": surface.double_sided, "extensions": {}}
        if (surface.specular, surface.specular_colour) != (1.0, (1.0, 1.0, 1.0)):
            specular = {"specularFactor": surface.specular, "specularColorFactor": list(surface.specular_colour)}
            item["extensions"]["KHR_materials_specular"] = specular
        if surface.ior != 1.5:
            item["extensions"]["KHR_materials_ior"] = {"ior": surface.ior}
        if surface.emits:
            strength = max(surface.emission)
            item["emissiveFactor"] = [channel / strength for channel in surface.emission]
            item["extensions"]["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
        if surface.emission_texture is not None:
            item["emissiveTexture"] = self._texture(surface.emission_texture)
        if surface.alpha != "OPAQUE":
            item["alphaMode"] = surface.alpha
        if surface.alpha == "MASK":
            item["alphaCutoff"] = surface.cutoff
        self.extensions |= set(item["extensions"])
        self._add("materials", item)

    def _texture(self, texture: Any) -> dict[str, Any]:
        image = self._add("images", {"bufferView": self._view(png.encode(texture.pixels)), "mimeType": "image/png"})
        sampler = self._add("samplers", dict(zip(("wrapS", "wrapT"), (WRAP[w] for w in texture.wrap), strict=True)))
        out: dict[str, Any] = {"index": self._add("textures", {"source": image, "sampler": sampler})}
        if texture.uv_set:
            out["texCoord"] = texture.uv_set
        if (texture.offset, texture.rotation, texture.scale) != ((0.0, 0.0), 0.0, (1.0, 1.0)):
            self.extensions.add("KHR_texture_transform")
            transform = {"offset": texture.offset, "rotation": texture.rotation, "scale": texture.scale}
            out["extensions"] = {"KHR_texture_transform": transform}
        return out

    def add_light(self, lamp: Any, intensity: float) -> None:
        self.extensions.add("KHR_lights_punctual")
        item: dict[str, Any] = {"type": lamp.kind, "color": list(lamp.colour), "intensity": intensity}
        if lamp.kind == "spot":
            item["spot"] = dict(zip(("innerConeAngle", "outerConeAngle"), lamp.cones, strict=True))
        self.lights.append(item)

    def add_node(self, node: dict[str, Any]) -> None:
        """A node of `RandomScene.nodes`; the root is node 0, so its children count from 1."""
        item = {key: value for key, value in node.items() if key not in ("root", "light", "instances", "children")}
        if "children" in node:
            item["children"] = [number + 1 for number in node["children"]]
        self.extensions |= set(item.get("extensions", {}))
        if "light" in node:
            item["extensions"] = {"KHR_lights_punctual": {"light": node["light"]}}
        if "instances" in node:
            self.extensions.add("EXT_mesh_gpu_instancing")
            names = ("TRANSLATION", "ROTATION", "SCALE")
            attributes = {name: self.accessor(v) for name, v in zip(names, node["instances"], strict=True)}
            item["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
        self.nodes.append(item)

    def encode(self) -> bytes:
        self.binary += bytes(-len(self.binary) % 4)
        document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": self.nodes,
            "buffers": [{"byteLength": len(self.binary)}],
            "extensionsUsed": sorted(self.extensions),
            **self.json,
        }
        if self.lights:
            document["extensions"] = {"KHR_lights_punctual": {"lights": self.lights}}
        if not self.extensions:
            del document["extensionsUsed"]
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self.binary), 0x004E4942) + bytes(self.binary)
        return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
