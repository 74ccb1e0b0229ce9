"""The part of glTF 2.0's JSON that is read, as frozen models: field types, ranges and defaults of the specification.

A scene file is a stranger's: validating the document once means that the reader may trust its types, and that every
malformed field is refused with its path. Unknown fields are ignored, as the specification asks.
"""

import codecs
import json
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.limits import MAX_ENTRIES, MAX_JSON_BYTES, MAX_JSON_ITEMS, NAME_LENGTH, check_count

Index = Annotated[int, Field(ge=0, le=2**31 - 1)]
Count = Annotated[int, Field(ge=1, le=2**31 - 1)]
Bytes = Annotated[int, Field(ge=0, le=2**40)]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(ge=0.0)]
Extensions = dict[str, dict[str, Any]]
T = TypeVar("T")
Name = Annotated[str, AfterValidator(lambda name: told(name, NAME_LENGTH))]
Table = Annotated[list[T], Field(max_length=MAX_ENTRIES)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False, alias_generator=to_camel)


P = TypeVar("P", bound=_Part)


class Buffer(_Part):
    byte_length: Bytes
    uri: str | None = None


class BufferView(_Part):
    buffer: Index
    byte_offset: Bytes = 0
    byte_length: Bytes
    byte_stride: Annotated[int, Field(ge=4, le=252)] | None = None
    extensions: Extensions = {}


class Meshopt(_Part):
    """EXT_meshopt_compression of a buffer view."""

    buffer: Index
    byte_offset: Bytes = 0
    byte_length: Bytes
    byte_stride: Annotated[int, Field(ge=2, le=256)]
    count: Count
    mode: Literal["ATTRIBUTES", "TRIANGLES", "INDICES"]
    filter: Literal["NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR"] = "NONE"


class Draco(_Part):
    """KHR_draco_mesh_compression of a primitive."""

    buffer_view: Index
    attributes: dict[str, Index]


class SparseIndices(_Part):
    buffer_view: Index
    byte_offset: Bytes = 0
    component_type: Literal[5121, 5123, 5125]


class SparseValues(_Part):
    buffer_view: Index
    byte_offset: Bytes = 0


class Sparse(_Part):
    count: Count
    indices: SparseIndices
    values: SparseValues


class Accessor(_Part):
    buffer_view: Index | None = None
    byte_offset: Bytes = 0
    component_type: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    normalized: bool = False
    count: Count
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    sparse: Sparse | None = None


class Primitive(_Part):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = 4
    targets: Table[dict[str, Index]] = []
    extensions: Extensions = {}


class MeshPart(_Part):
    name: Name = ""
    primitives: Table[Primitive] = []
    weights: Table[float] = []


class Skin(_Part):
    joints: Table[Index]
    inverse_bind_matrices: Index | None = None


class Visibility(_Part):
    """KHR_node_visibility."""

    visible: bool = True


class Node(_Part):
    name: Name = ""
    children: Table[Index] = []
    mesh: Index | None = None
    camera: Any = None
    skin: Index | None = None
    weights: Table[float] = []
    matrix: Annotated[list[float], Field(min_length=16, max_length=16)] | None = None
    translation: Vector3 = (0.0, 0.0, 0.0)
    rotation: Vector4 = (0.0, 0.0, 0.0, 1.0)
    scale: Vector3 = (1.0, 1.0, 1.0)
    extensions: Extensions = {}


class ScenePart(_Part):
    nodes: Table[Index] = []


class TextureInfo(_Part):
    index: Index
    tex_coord: Index = 0
    extensions: Extensions = {}


class NormalInfo(TextureInfo):
    scale: float = 1.0


class OcclusionInfo(TextureInfo):
    strength: Unit = 1.0


class MetallicRoughness(_Part):
    base_color_factor: tuple[Unit, Unit, Unit, Unit] = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: TextureInfo | None = None
    metallic_factor: Unit = 1.0
    roughness_factor: Unit = 1.0
    metallic_roughness_texture: TextureInfo | None = None


class MaterialPart(_Part):
    name: Name = ""
    pbr_metallic_roughness: MetallicRoughness = MetallicRoughness()
    normal_texture: NormalInfo | None = None
    occlusion_texture: OcclusionInfo | None = None
    emissive_factor: tuple[Unit, Unit, Unit] = (0.0, 0.0, 0.0)
    emissive_texture: TextureInfo | None = None
    alpha_mode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alpha_cutoff: Annotated[float, Field(ge=0.0)] = 0.5
    double_sided: bool = False
    extensions: Extensions = {}


class TexturePart(_Part):
    sampler: Index | None = None
    source: Index | None = None
    extensions: Extensions = {}


class Sampler(_Part):
    wrap_s: Literal[33071, 33648, 10497] = 10497
    wrap_t: Literal[33071, 33648, 10497] = 10497


class ImagePart(_Part):
    name: Name = ""
    uri: str | None = None
    buffer_view: Index | None = None


class Asset(_Part):
    version: str


class EmissiveStrength(_Part):
    emissive_strength: Annotated[float, Field(ge=0.0)] = 1.0


class Ior(_Part):
    ior: Annotated[float, Field(ge=0.0)] = 1.5


class Specular(_Part):
    specular_factor: Unit = 1.0
    specular_texture: TextureInfo | None = None
    specular_color_factor: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    specular_color_texture: TextureInfo | None = None


class Clearcoat(_Part):
    clearcoat_factor: Unit = 0.0
    clearcoat_texture: TextureInfo | None = None


class Transmission(_Part):
    transmission_factor: Unit = 0.0
    transmission_texture: TextureInfo | None = None


class SpecularGlossiness(_Part):
    """KHR_materials_pbrSpecularGlossiness (archived)."""

    diffuse_factor: tuple[Unit, Unit, Unit, Unit] = (1.0, 1.0, 1.0, 1.0)
    diffuse_texture: TextureInfo | None = None
    specular_factor: tuple[Unit, Unit, Unit] = (1.0, 1.0, 1.0)
    glossiness_factor: Unit = 1.0
    specular_glossiness_texture: TextureInfo | None = None


class TextureSource(_Part):
    """EXT_texture_webp and KHR_texture_basisu."""

    source: Index


class TextureTransform(_Part):
    offset: Vector2 = (0.0, 0.0)
    scale: Vector2 = (1.0, 1.0)
    rotation: float = 0.0
    tex_coord: Index | None = None


class Instancing(_Part):
    attributes: dict[str, Index]


class Spot(_Part):
    inner_cone_angle: Annotated[float, Field(ge=0.0)] = 0.0
    outer_cone_angle: Annotated[float, Field(gt=0.0, le=1.5707964)] = 0.7853981633974483


class Light(_Part):
    name: Name = ""
    type: Literal["point", "spot", "directional"]
    color: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    intensity: Annotated[float, Field(ge=0.0)] = 1.0
    spot: Spot = Spot()


class Lights(_Part):
    lights: Table[Light] = []


class LightIndex(_Part):
    light: Index


class Document(_Part):
    """A glTF 2.0 document, as far as it is read."""

    asset: Asset
    scene: Index | None = None
    scenes: Table[ScenePart] = []
    nodes: Table[Node] = []
    meshes: Table[MeshPart] = []
    materials: Table[MaterialPart] = []
    accessors: Table[Accessor] = []
    buffer_views: Table[BufferView] = []
    buffers: Table[Buffer] = []
    images: Table[ImagePart] = []
    textures: Table[TexturePart] = []
    samplers: Table[Sampler] = []
    skins: Table[Skin] = []
    animations: Table[Any] = []
    cameras: Table[Any] = []
    extensions_used: Table[str] = []
    extensions_required: Table[str] = []
    extensions: Extensions = {}


def parse_document(text: bytes, where: str) -> Document:
    """The document of a file's JSON; InputError names the first field at fault."""
    check_count(len(text), MAX_JSON_BYTES, "bytes of JSON", where, "Save it as GLB.")
    check_count(text.count(b","), MAX_JSON_ITEMS, "commas in its JSON", where)
    text = text.removeprefix(codecs.BOM_UTF8)
    try:
        document = Document.model_validate_json(text)
    except ValidationError as error:
        _check_version(_told_version(text), where)
        raise _refusal(error, where) from None
    _check_version(document.asset.version, where)
    return document


def parse_extension(model: type[P], content: dict[str, Any], where: str) -> P:
    """An extension's object as `model`."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise _refusal(error, where) from None


def pick(items: list[T], index: int, what: str, where: str) -> T:
    """`items[index]`; InputError where the document names what it does not hold."""
    if index >= len(items):
        raise InputError(f"{what} {index} is named but there are {len(items)}", where=where, remedy="Export it again.")
    return items[index]


def _check_version(version: str, where: str) -> None:
    if not version.startswith("2."):
        raise InputError(
            f"is glTF {told(version, 20)}",
            where=where,
            remedy="Export it as glTF 2.0, or convert it with gltf-pipeline.",
        )


def _told_version(text: bytes) -> str:
    """What a document that is not valid glTF 2.0 says of its version; 2.0 where it says nothing."""
    try:
        return str(json.loads(text)["asset"]["version"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return "2.0"


def _refusal(error: ValidationError, where: str) -> InputError:
    first = error.errors()[0]
    field = told(".".join(str(part) for part in first["loc"]), NAME_LENGTH) or "the document"
    return InputError(f"is not valid glTF 2.0: {field}: {first['msg']}", where=where, remedy="Export it again.")
