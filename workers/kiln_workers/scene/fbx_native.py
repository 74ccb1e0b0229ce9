"""An FBX file as plain arrays and numbers, by ufbx in a process of its own.

ufbx itself is a sound reader of binary and ASCII FBX of all versions, but its Python bindings (0.0.5) are young: an
attribute that is asked for twice is freed too early, and the process dies. So every object is held here for ever
(`_held`), nothing is torn down, the memory of the process is bounded, and if it dies all the same the file is refused.
Only this module loads ufbx. World space is right-handed with +Y up, in metres; animations are left out.
"""

import ctypes
import gc
import math
import os
import resource
import sys
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from kiln_workers.scene.container import Array, chunks
from kiln_workers.scene.limits import MAX_ENTRIES, MAX_MESHES, MAX_READ_BYTES, MAX_TRIANGLES, MAX_UV_SETS

KIND: Final = "fbx"
REFUSED: Final = 3
"""Status of the process where the file is at fault; the reason is on standard error."""
DEPTH: Final = 256
"""Nodes in nodes."""
BLENDER: Final = (2, 3)
"""ufbx' numbers of Blender's exporters."""
LOD_GROUP: Final = 16
"""ufbx' number of this kind of node."""
HOLD: Final = ctypes.pythonapi.Py_IncRef
HOLD.argtypes = [ctypes.py_object]
PBR_MAPS: Final = (
    *("base_factor", "base_color", "roughness", "metalness", "specular_factor", "specular_color", "specular_ior"),
    *("emission_factor", "emission_color", "opacity", "transmission_factor", "coat_factor", "glossiness", "normal_map"),
)
FBX_MAPS: Final = ("transparency_factor", "transparency_color", "bump", "normal_map")


class Refused(Exception):
    """What is wrong with the file."""


def read_arrays(data: bytes) -> tuple[dict[str, Any], dict[str, Array]]:
    """What the file holds; Refused where it cannot be read, or holds too much."""
    import ufbx  # here, so that the parent never loads it

    axes = ufbx.CoordinateAxes(
        ufbx.CoordinateAxis.POSITIVE_X, ufbx.CoordinateAxis.POSITIVE_Y, ufbx.CoordinateAxis.POSITIVE_Z
    )
    try:
        scene = _held(
            ufbx.load_memory(
                data,
                file_format=ufbx.FileFormat.FBX,
                target_axes=axes,
                target_unit_meters=1.0,
                ignore_animation=True,
                load_external_files=False,
                use_blender_pbr_material=True,
                node_depth_limit=DEPTH,
            )
        )
    except (ufbx.UfbxError, MemoryError) as error:
        raise Refused(f"cannot be read as FBX: {error}") from None
    return _Extraction(scene).result()


class _Extraction:
    def __init__(self, scene: Any) -> None:
        self.scene = scene
        self.arrays: dict[str, Array] = {}

    def result(self) -> tuple[dict[str, Any], dict[str, Array]]:
        scene = self.scene
        for what, most in (("nodes", MAX_MESHES), ("materials", MAX_ENTRIES), ("textures", MAX_ENTRIES)):
            if len(_get(scene, what)) > most:
                raise Refused(f"has {len(_get(scene, what))} {what}, at most {most} are read")
        meshes = list(_items(scene, "meshes"))
        triangles = sum(int(_get(mesh, "num_triangles")) for mesh in meshes)
        if triangles > MAX_TRIANGLES:
            raise Refused(f"has {triangles} triangles, at most {MAX_TRIANGLES} are read")
        body = {
            "unit": _number(_get(scene, "settings", "original_unit_meters")),
            "blender": int(_get(scene, "metadata", "exporter")) in BLENDER,
            "animated": len(_get(scene, "anim_curves")) > 0,
            "curves": len(_get(scene, "line_curves")) + len(_get(scene, "nurbs_curves")),
            "nurbs": len(_get(scene, "nurbs_surfaces")),
            "nodes": [self._node(node) for node in _items(scene, "nodes")],
            "meshes": [self._mesh(mesh, f"m{number}") for number, mesh in enumerate(meshes)],
            "materials": [self._material(material) for material in _items(scene, "materials")],
            "textures": [self._texture(part, f"t{number}") for number, part in enumerate(_items(scene, "textures"))],
            "lights": [self._light(light) for light in _items(scene, "lights")],
            "cameras": [self._camera(camera) for camera in _items(scene, "cameras")],
        }
        return body, self.arrays

    def _node(self, node: Any) -> dict[str, Any]:
        parent, mesh = _get(node, "parent"), _get(node, "mesh")
        light, camera = _get(node, "light"), _get(node, "camera")
        return {
            "name": _get(node, "name"),
            "parent": -1 if parent is None else int(_get(parent, "typed_id")),
            "visible": bool(_get(node, "visible")),
            "lod_group": int(_get(node, "attrib_type")) == LOD_GROUP,
            "mesh": -1 if mesh is None else int(_get(mesh, "typed_id")),
            "light": -1 if light is None else int(_get(light, "typed_id")),
            "camera": -1 if camera is None else int(_get(camera, "typed_id")),
            "geometry_to_world": _matrix(_get(node, "geometry_to_world")),
            "node_to_world": _matrix(_get(node, "node_to_world")),
            "materials": [int(_get(part, "typed_id")) for part in _items(node, "materials")],
        }

    def _mesh(self, mesh: Any, key: str) -> dict[str, Any]:
        add, corners = self.arrays, int(_get(mesh, "num_indices"))
        add[f"{key} faces"] = np.array(_get(mesh, "faces"), dtype=np.int64).reshape(-1, 2)
        add[f"{key} material"] = _whole(_get(mesh, "face_material"))
        self._attribute(mesh, "vertex_position", f"{key} position", corners)
        out = {
            "name": _get(mesh, "name"),
            "normal": self._attribute(mesh, "vertex_normal", f"{key} normal", corners),
            "color": self._attribute(mesh, "vertex_color", f"{key} color", corners),
            "uv": [],
            "skinned": False,
            "morphed": len(_get(mesh, "blend_deformers")) > 0,
            "subdivided": int(_get(mesh, "subdivision_display_mode")) > 1,
        }
        for number, part in enumerate(_items(mesh, "uv_sets")):
            if number < MAX_UV_SETS and self._attribute(part, "vertex_uv", f"{key} uv{number}", corners):
                out["uv"].append(_get(part, "name"))
        for skin in list(_items(mesh, "skin_deformers"))[:1]:
            out["skinned"] = self._skin(skin, key)
        return out

    def _attribute(self, owner: Any, name: str, key: str, corners: int) -> bool:
        """Values [N, C] and which of them each corner has [corners]; whether there are any."""
        attribute = _get(owner, name)
        values, indices = _get(attribute, "values"), _get(attribute, "indices")
        if not len(values) or len(indices) != corners:
            return False
        self.arrays[f"{key} values"] = np.array(values, dtype=np.float64)
        self.arrays[f"{key} index"] = _whole(indices)
        return True

    def _skin(self, skin: Any, key: str) -> bool:
        """Matrices [J, 4, 4], and of each influence its joint, vertex and weight [I]."""
        matrices, joints, vertices, weights = [], [], [], []
        for number, cluster in enumerate(_items(skin, "clusters")):
            matrices.append(_matrix(_get(cluster, "geometry_to_world")))
            vertex = _whole(_get(cluster, "vertices"))
            vertices.append(vertex)
            weights.append(np.array(_get(cluster, "weights"), dtype=np.float64).reshape(-1))
            joints.append(np.full(len(vertex), number))
        if not matrices:
            return False
        self.arrays |= {
            f"{key} joints": np.array(matrices, dtype=np.float64).reshape(-1, 4, 4),
            f"{key} joint": np.concatenate(joints).astype(np.int64),
            f"{key} vertex": np.concatenate(vertices),
            f"{key} weight": np.concatenate(weights),
        }
        return True

    def _material(self, material: Any) -> dict[str, Any]:
        features = _get(material, "features")
        return {
            "name": _get(material, "name"),
            "shader": int(_get(material, "shader_type")),
            "double_sided": bool(_get(features, "double_sided", "enabled")),
            "glossy": bool(_get(features, "roughness_as_glossiness", "enabled")),
            "pbr": {name: _map(_get(material, "pbr", name)) for name in PBR_MAPS},
            "fbx": {name: _map(_get(material, "fbx", name)) for name in FBX_MAPS},
        }

    def _texture(self, texture: Any, key: str) -> dict[str, Any]:
        files = list(_items(texture, "file_textures"))
        first = files[0] if files else texture
        content = _get(first, "content")
        if len(content):
            self.arrays[f"{key} content"] = np.frombuffer(content, np.uint8)
        return {
            "file": _get(first, "relative_filename") or _get(first, "filename"),
            "layers": len(files),
            "uv_set": _get(first, "uv_set"),
            "clamp": [int(_get(first, "wrap_u")) == 1, int(_get(first, "wrap_v")) == 1],
            "transform": _matrix(_get(first, "uv_to_texture")) if _get(first, "has_uv_transform") else None,
        }

    def _light(self, light: Any) -> dict[str, Any]:
        return {
            "name": _get(light, "name"),
            "kind": int(_get(light, "type")),
            "decay": int(_get(light, "decay")),
            "color": [_number(value) for value in _get(light, "color")],
            "intensity": _number(_get(light, "intensity")),
            "direction": [_number(value) for value in _get(light, "local_direction")],
            "inner": _number(_get(light, "inner_angle")),
            "outer": _number(_get(light, "outer_angle")),
            "on": bool(_get(light, "cast_light")),
        }

    def _camera(self, camera: Any) -> dict[str, Any]:
        return {
            "perspective": int(_get(camera, "projection_mode")) == 0,
            "fov": _number(_get(camera, "field_of_view_deg")[1]),
        }


def _held(thing: Any) -> Any:
    """The object, never freed: ufbx' getters return references that they do not own."""
    HOLD(thing)
    HOLD(thing)
    return thing


def _get(thing: Any, *names: str) -> Any:
    """An attribute of an attribute, held."""
    for name in names:
        thing = _held(getattr(thing, name))
    return thing


def _items(owner: Any, name: str) -> Iterator[Any]:
    """The elements of a list, held."""
    for element in _get(owner, name):
        yield _held(element)


def _whole(values: Any) -> Array:
    return np.fromiter(values, np.int64, len(values))


def _number(value: float) -> float:
    """JSON has no infinities: what is not finite is refused with its material or light later."""
    return float(value) if math.isfinite(value) else -1.0


def _matrix(matrix: Any) -> list[float]:
    """The 16 numbers of a 4 x 4 matrix, row by row."""
    flat = np.concatenate([np.array(matrix, dtype=np.float64).T, [[0.0, 0.0, 0.0, 1.0]]])
    if not np.isfinite(flat).all():
        raise Refused("has a transform that is not finite")
    return [float(value) for value in flat.reshape(-1)]


def _map(entry: Any) -> dict[str, Any]:
    texture = _get(entry, "texture")
    return {
        "has": bool(_get(entry, "has_value")),
        "value": [_number(value) for value in _get(entry, "value_vec4")],
        "texture": -1 if texture is None or not _get(entry, "texture_enabled") else int(_get(texture, "typed_id")),
    }


def main() -> None:
    """Read the file from standard input, write its arrays to standard output."""
    gc.disable()
    resource.setrlimit(resource.RLIMIT_AS, (MAX_READ_BYTES, MAX_READ_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    status = 0
    try:
        body, arrays = read_arrays(sys.stdin.buffer.read())
        for piece in chunks(KIND, body, arrays):
            sys.stdout.buffer.write(piece)
        sys.stdout.buffer.flush()
    except (Refused, MemoryError) as error:
        sys.stderr.write(str(error) or "needs too much memory")
        sys.stderr.flush()
        status = REFUSED
    os._exit(status)


if __name__ == "__main__":
    main()
