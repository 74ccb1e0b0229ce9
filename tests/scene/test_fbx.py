"""FBX, written by hand: the scene is that of a glTF file; materials, skins, levels of detail, and what is refused."""

import base64
import struct
import zlib

import numpy as np
import pytest

from kiln_schemas.errors import InputError, TooLarge
from kiln_service.cli.bundle import collect
from kiln_workers.scene.fbx_bounds import check_inflation, inflated_bytes
from kiln_workers.scene.file_camera import file_camera
from kiln_workers.scene.geometry import face_areas
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import LightKind

POINTS = np.float64([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0.5]])
NORMALS = np.float64([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [0, 0, 1]])
UV = np.float64([[0, 0], [1, 0], [1, 1], [0.25, 1]])
SECOND_UV = np.float64([[0.1, 0.2], [0.4, 0.2], [0.4, 0.6], [0.1, 0.6]])
COLOURS = np.float64([[1, 0.5, 0.25, 1], [0.75, 1, 0, 1], [0, 0.1, 1, 1], [1, 1, 1, 1]])
GEOMETRY, MATERIAL, TEXTURE, LIGHT = 100, 300, 400, 500
WORLD = {
    # UpAxis, FrontAxis with its sign, centimetres of the unit, and the columns of the way to metres with +Y up.
    "Y up, centimetres": (1, 2, 1, 1.0, 0.01 * np.eye(3)),
    "Z up, metres": (2, 1, -1, 100.0, np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])),
    "Z up, inches": (2, 1, -1, 2.54, 0.0254 * np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])),
}


def listed(name: str, values) -> str:
    flat = np.asarray(values).reshape(-1)
    return f"{name}: *{len(flat)} {{ a: {','.join(f'{value:.9g}' for value in flat)} }}"


def properties(**values) -> str:
    """Properties70; a name's underscores are spaces."""
    rows = []
    for name, value in values.items():
        numbers = value if isinstance(value, (list, tuple)) else [value]
        text = ",".join(f'"{part}"' if isinstance(part, str) else f"{part:.12g}" for part in numbers)
        kind = "KString" if isinstance(value, str) else "double" if len(numbers) == 1 else "Vector3D"
        kind = "ColorRGB" if "Color" in name else kind
        rows.append(f'P: "{name.replace("_", " ")}", "{kind}", "", "A",{text}')
    return "Properties70: {\n" + "\n".join(rows) + "\n}"


def layer(kind: str, data: str, values, number: int = 0, name: str = "") -> str:
    return f"""LayerElement{kind}: {number} {{ Version: 101
      Name: "{name}"
      MappingInformationType: "ByPolygonVertex"
      ReferenceInformationType: "Direct"
      {listed(data, values)} }}"""


def mesh(number: int, points, polygons, layers: str = "") -> str:
    """A geometry; the last corner of a polygon is stored as its complement."""
    corners = [[*polygon[:-1], -polygon[-1] - 1] for polygon in polygons]
    return f"""Geometry: {number}, "Geometry::g{number}", "Mesh" {{
      {listed("Vertices", points)}
      {listed("PolygonVertexIndex", np.concatenate(corners))}
      GeometryVersion: 124
      {layers} }}"""


QUAD = mesh(
    GEOMETRY,
    POINTS,
    [[0, 1, 2, 3]],
    layer("Normal", "Normals", NORMALS)
    + layer("UV", "UV", UV, 0, "first")
    + layer("UV", "UV", SECOND_UV, 1, "second")
    + layer("Color", "Colors", COLOURS),
)


def model(number: int, name: str, kind: str = "Mesh", **values) -> str:
    return f'Model: {number}, "Model::{name}", "{kind}" {{ Version: 232\n{properties(**values)} }}'


def material(shading: str = "lambert", number: int = MATERIAL, **values) -> str:
    return f"""Material: {number}, "Material::paint", "" {{ Version: 102
      ShadingModel: "{shading}"
      {properties(**values)} }}"""


def texture(file: str, number: int = TEXTURE, content: bytes = b"", **values) -> str:
    data = f'Content: , "{base64.b64encode(content).decode()}"' if content else ""
    return f"""Texture: {number}, "Texture::t{number}", "" {{ Type: "TextureVideoClip"
      FileName: "C:\\art\\{file}"
      RelativeFilename: "{file}"
      {properties(**values)} }}
      Video: {number + 50}, "Video::v{number}", "Clip" {{ Type: "Clip"
      FileName: "C:\\art\\{file}"
      RelativeFilename: "{file}"
      {data} }}"""


def light(number: int, name: str, kind: int, **values) -> str:
    own = properties(LightType=kind, **values)
    return f'NodeAttribute: {number}, "NodeAttribute::{name}", "Light" {{ TypeFlags: "Light"\n{own} }}'


def document(objects, links, world: str = "Z up, metres") -> str:
    up, front, sign, unit, _ = WORLD[world]
    settings = properties(
        UpAxis=up, UpAxisSign=1, FrontAxis=front, FrontAxisSign=sign, CoordAxis=0, CoordAxisSign=1, UnitScaleFactor=unit
    ).replace('"double"', '"int"', 6)
    rows = [f'C: "OO",{a},{b}' if not to else f'C: "OP",{a},{b},"{to[0]}"' for a, b, *to in links]
    return f"""; FBX 7.4.0 project file
FBXHeaderExtension: {{ FBXHeaderVersion: 1003
  FBXVersion: 7400
  Creator: "by hand" }}
GlobalSettings: {{ Version: 1000
{settings} }}
Objects: {{
{chr(10).join(objects)}
}}
Connections: {{
{chr(10).join(rows)}
}}
"""


def load(folder, text: str):
    (folder / "a.fbx").write_text(text)
    return load_scene(folder, "a.fbx")


def one_quad(paint: str, *more: str, links=()) -> str:
    """The quad with a material."""
    objects = [QUAD, model(200, "quad"), paint, *more]
    return document(objects, [(200, 0), (GEOMETRY, 200), (MATERIAL, 200), *links])


@pytest.mark.parametrize("world", WORLD)
def test_an_fbx_scene_is_its_gltf_twin(tmp_path, gltf, write_image, surface, world):
    """Nodes, mirrors, instances, two UV sets, colours, a texture and lights, under each up axis and some unit."""
    write_image(tmp_path / "a.png", np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    *_, unit, columns = WORLD[world]
    metres = unit / 100
    objects = [
        QUAD,
        model(201, "parent", "Null", Lcl_Translation=[10, 20, 30], Lcl_Rotation=[0, 0, 90]),
        model(202, "child", Lcl_Translation=[3, 0, 0]),
        model(203, "mirror", Lcl_Scaling=[-1, 1, 1]),
        model(204, "kept", Lcl_Scaling=[1, 2, 1]),
        model(205, "sun", "Light", Lcl_Rotation=[0, 0, 0]),
        model(206, "lamp", "Light", Lcl_Translation=[1, 2, 3]),
        model(207, "torch", "Light", Lcl_Translation=[5, 5, 5], Lcl_Rotation=[-90, 0, 0]),
        material(DiffuseColor=[1, 1, 1], DiffuseFactor=1),
        texture("a.png", UVSet="second", WrapModeV=1),
        light(501, "sun", 1, Color=[1, 0.5, 0.25], Intensity=300, DecayType=0),
        light(502, "lamp", 0, Color=[1, 0.5, 0.25], Intensity=800, DecayType=2),
        light(503, "torch", 2, Color=[1, 1, 0.5], Intensity=100, DecayType=2, InnerAngle=30, OuterAngle=60),
    ]
    links = [(201, 0), (202, 201), (203, 201), (204, 201), (205, 0), (206, 0), (207, 0)]
    links += [(GEOMETRY, number) for number in (202, 203, 204)] + [(MATERIAL, number) for number in (202, 203, 204)]
    links += [(501, 205), (502, 206), (503, 207), (TEXTURE, MATERIAL, "DiffuseColor"), (TEXTURE + 50, TEXTURE)]
    ours = load(tmp_path, document(objects, links, world))

    linear = np.where(COLOURS <= 0.04045, COLOURS / 12.92, ((COLOURS + 0.055) / 1.055) ** 2.4).astype(np.float32)
    flip = np.float32([1, -1]), np.float32([0, 1])
    gltf.mesh(
        POINTS,
        (0, 1, 2, 0, 2, 3),
        0,
        NORMAL=NORMALS.astype(np.float32),
        TEXCOORD_0=UV.astype(np.float32) * flip[0] + flip[1],
        TEXCOORD_1=SECOND_UV.astype(np.float32) * flip[0] + flip[1],
        COLOR_0=linear,
    )
    colours = [1, 0.5, 0.25]
    kinds = [("directional", colours, 3.0), ("point", colours, 8 * metres**2), ("spot", [1, 1, 0.5], metres**2)]
    pbr = {"baseColorTexture": {"index": 0, "texCoord": 1}, "metallicFactor": 0}
    gltf.document |= {
        "images": [{"uri": "a.png"}],
        "samplers": [{"wrapT": 33071}],
        "textures": [{"source": 0, "sampler": 0}],
        "materials": [{"name": "paint", "pbrMetallicRoughness": pbr}],
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensions": {
            "KHR_lights_punctual": {"lights": [{"type": kind, "color": c, "intensity": i} for kind, c, i in kinds]}
        },
    }
    cone = {"innerConeAngle": np.pi / 12, "outerConeAngle": np.pi / 6}
    gltf.document["extensions"]["KHR_lights_punctual"]["lights"][2]["spot"] = cone
    root = np.eye(4)
    root[:3, :3] = columns
    half = np.sqrt(0.5)
    shine = [{"extensions": {"KHR_lights_punctual": {"light": number}}} for number in range(3)]
    tree = [
        {"matrix": root.T.reshape(-1).tolist(), "children": [1, 5, 6, 7]},
        {"translation": [10, 20, 30], "rotation": [0, 0, half, half], "children": [2, 3, 4]},
        {"name": "child", "mesh": 0, "translation": [3, 0, 0]},
        {"name": "mirror", "mesh": 0, "scale": [-1, 1, 1]},
        {"name": "kept", "mesh": 0, "scale": [1, 2, 1]},
        # FBX' lights shine along -Y of their node, glTF's along -Z.
        {"name": "sun", "rotation": [-half, 0, 0, half], **shine[0]},
        {"name": "lamp", "translation": [1, 2, 3], **shine[1]},
        {"name": "torch", "translation": [5, 5, 5], "rotation": [0, 1, 0, 0], **shine[2]},
    ]
    twin = load_scene(tmp_path, gltf.write(tmp_path, nodes=tree))

    one, two = surface(ours), surface(twin)
    assert list(one) == list(two) == ["child", "mirror", "kept"]
    for name in two:
        for part, right in two[name].items():
            np.testing.assert_allclose(one[name][part], right, atol=1e-5, err_msg=f"{name} {part}")
    (paint,), (same,) = ours.materials, twin.materials
    assert (paint.base_color, paint.metallic, paint.roughness) == (same.base_color, 0.0, 1.0)
    assert paint.base_color_texture == same.base_color_texture
    np.testing.assert_array_equal(ours.images[0].pixels, twin.images[0].pixels)
    for found, right in zip(ours.lights, twin.lights, strict=True):
        assert found.kind == right.kind
        np.testing.assert_allclose(found.intensity, right.intensity, rtol=1e-6)
        if right.kind is not LightKind.DIRECTIONAL:
            here, there = np.add(found.position, ours.origin), np.add(right.position, twin.origin)
            np.testing.assert_allclose(here, there, atol=1e-5)
        if right.kind is not LightKind.POINT:
            np.testing.assert_allclose(found.direction, right.direction, atol=1e-6)
        if right.kind is LightKind.SPOT:
            assert (found.inner_cone, found.outer_cone) == pytest.approx((np.pi / 12, np.pi / 6))
    assert ours.notes == ()


def test_concave_polygons_and_several_materials(tmp_path):
    arrow = np.float64([[0, 0, 0], [2, -1, 0], [0, 3, 0], [-2, -1, 0], [0, 0, 1]])
    slots = """LayerElementMaterial: 0 { MappingInformationType: "ByPolygon"
      ReferenceInformationType: "IndexToDirect"
      Materials: *2 { a: 1,0 } }"""
    objects = [
        mesh(GEOMETRY, arrow, [[0, 1, 2, 3], [0, 1, 4]], slots),
        model(200, "arrow"),
        material(number=300, DiffuseColor=[1, 0, 0]),
        material(number=301, DiffuseColor=[0, 1, 0], EmissiveColor=[1, 1, 1], EmissiveFactor=4),
    ]
    scene = load(tmp_path, document(objects, [(200, 0), (GEOMETRY, 200), (300, 200), (301, 200)]))
    assert [each.name for each in scene.meshes] == ["arrow/0", "arrow/1"]
    areas = [face_areas(each.positions, each.faces).sum() for each in scene.meshes]
    assert areas == pytest.approx([np.sqrt(5) / 2, 6.0])
    red, green = (scene.materials[each.material] for each in scene.meshes)
    assert (red.base_color[:2], green.base_color[:2]) == ((1.0, 0.0), (0.0, 1.0))
    assert green.emission == (4.0, 4.0, 4.0) and red.emission == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("shading", "values", "roughness", "opacity"),
    [
        ("lambert", {}, 1.0, 1.0),
        ("phong", {"SpecularColor": [1, 1, 1], "SpecularFactor": 1, "ShininessExponent": 25}, 0.5, 1.0),
        ("phong", {"SpecularColor": [0, 0, 0], "SpecularFactor": 1, "ShininessExponent": 25}, 1.0, 1.0),
        ("lambert", {"TransparentColor": [1, 1, 1], "TransparencyFactor": 0.25}, 1.0, 0.75),
        ("lambert", {"TransparentColor": [0, 0, 0], "TransparencyFactor": 1}, 1.0, 1.0),  # as Maya writes it
        ("lambert", {"TransparentColor": [1, 1, 1], "TransparencyFactor": 0}, 1.0, 1.0),  # as 3ds Max does
        ("lambert", {"TransparentColor": [0, 1, 0], "TransparencyFactor": 1}, 1.0, 1 - 0.71516),
    ],
)
def test_classic_materials(tmp_path, shading, values, roughness, opacity):
    scene = load(tmp_path, one_quad(material(shading, DiffuseColor=[0.4, 0.5, 0.6], DiffuseFactor=0.5, **values)))
    (paint,) = scene.materials
    np.testing.assert_allclose(paint.base_color, [0.2, 0.25, 0.3, opacity], atol=1e-6)
    assert paint.roughness == pytest.approx(roughness) and paint.blend == (opacity < 1.0)


def max_material(**values) -> str:
    """A PBR material of 3ds Max."""
    named = {f"3dsMax|main|{name}": value for name, value in values.items()}
    ids = {"3dsMax|ClassIDa": -804315648, "3dsMax|ClassIDb": -1099438848}
    whole = properties(ShadingModel="unknown", **ids, **named)
    for name in ids:
        whole = whole.replace(f'"{name}", "double"', f'"{name}", "int"')
    return f"""Material: {MATERIAL}, "Material::paint", "" {{ Version: 102
      ShadingModel: "unknown"
      {whole} }}"""


def test_a_physically_based_material_is_metallic_and_rough(tmp_path, write_image):
    rough, metal = np.full((2, 2, 1), 0.4, np.float32), np.full((4, 4, 1), 0.9, np.float32)
    write_image(tmp_path / "r.exr", rough.repeat(3, axis=2))
    write_image(tmp_path / "m.exr", metal.repeat(3, axis=2))
    paint = max_material(baseColor=[0.1, 0.2, 0.3, 1], metalness=0.25, roughness=0.6, useGlossiness=2)
    (plain,) = load(tmp_path, one_quad(paint)).materials
    assert plain.base_color == pytest.approx((0.1, 0.2, 0.3, 1.0), abs=1e-6)
    assert (plain.metallic, plain.roughness) == pytest.approx((0.25, 0.6), abs=1e-6)

    slots = ("3dsMax|main|Roughness_Map", "3dsMax|main|metalness_map")
    links = [(TEXTURE + i, MATERIAL, slot) for i, slot in enumerate(slots)]
    links += [(TEXTURE + 50 + i, TEXTURE + i) for i in range(2)]
    files = (texture("r.exr"), texture("m.exr", TEXTURE + 1))
    scene = load(tmp_path, one_quad(paint, *files, links=links))
    (textured,) = scene.materials
    assert (textured.metallic, textured.roughness) == (1.0, 1.0)
    pixels = scene.images[textured.metallic_roughness_texture.image].pixels
    assert pixels.shape == (4, 4, 3)
    np.testing.assert_allclose(pixels[..., 1], 0.4, atol=1e-3)
    np.testing.assert_allclose(pixels[..., 2], 0.9, atol=1e-3)


def test_a_texture_in_the_file_is_read(tmp_path, write_image):
    """Embedded, though another file of its name lies beside."""
    inner = write_image(tmp_path / "inner.png", np.full((2, 2, 3), 77, np.uint8)).read_bytes()
    write_image(tmp_path / "a.png", np.full((2, 2, 3), 5, np.uint8))
    links = [(TEXTURE, MATERIAL, "DiffuseColor"), (TEXTURE + 50, TEXTURE)]
    scene = load(tmp_path, one_quad(material(), texture("a.png", content=inner), links=links))
    assert scene.images[0].pixels[0, 0, 0] == 77


@pytest.mark.parametrize("path", ["tex\\\\a.png", "..\\\\..\\\\tex\\\\a.png", "D:/x/tex/a.png"])
def test_a_texture_is_found_beside_the_fbx_file(tmp_path, write_image, path):
    (tmp_path / "tex").mkdir()
    write_image(tmp_path / "tex" / "a.png", np.full((1, 1, 3), 9, np.uint8))
    links = [(TEXTURE, MATERIAL, "DiffuseColor"), (TEXTURE + 50, TEXTURE)]
    scene = load(tmp_path, one_quad(material(), texture(path), links=links))
    assert scene.images[0].pixels[0, 0, 0] == 9
    assert set(collect(tmp_path / "a.fbx").bundle.files) == {"a.fbx", "tex/a.png"}
    (tmp_path / "tex" / "a.png").unlink()
    scene = load_scene(tmp_path, "a.fbx")
    assert scene.images == () and "'a.png' is not beside the file" in " ".join(scene.notes)


@pytest.mark.parametrize(("channels", "alpha"), [(4, 0.25), (3, 0.6)])
def test_an_opacity_texture_of_fbx_becomes_alpha(tmp_path, write_image, channels, alpha):
    pixels = np.empty((2, 2, channels), np.float32)
    pixels[:] = [0.6, 0.6, 0.6, 0.25][:channels]
    write_image(tmp_path / "a.exr", pixels)
    links = [(TEXTURE, MATERIAL, "TransparentColor"), (TEXTURE + 50, TEXTURE)]
    scene = load(tmp_path, one_quad(material(DiffuseColor=[1, 1, 1]), texture("a.exr"), links=links))
    (paint,) = scene.materials
    assert paint.blend
    np.testing.assert_allclose(scene.images[paint.base_color_texture.image].pixels[..., 3], alpha, atol=2e-3)


def test_a_normal_map_and_a_height_map(tmp_path, write_image):
    normals = np.full((4, 4, 3), [128, 128, 255], np.uint8)
    write_image(tmp_path / "n.png", normals)
    write_image(tmp_path / "h.png", np.full((4, 4, 3), 90, np.uint8))
    for file, kept in (("n.png", True), ("h.png", False)):
        links = [(TEXTURE, MATERIAL, "Bump"), (TEXTURE + 50, TEXTURE)]
        scene = load(tmp_path, one_quad(material(), texture(file), links=links))
        assert (scene.materials[0].normal_texture is not None) == kept
        assert ("bump ignored" in " ".join(scene.notes)) == (not kept)


def test_skins_of_fbx_are_where_their_joints_put_them(tmp_path):
    """A bar of two joints, the second turned by 90 degrees about its foot at x = 1; Z up, in metres."""
    points = np.float64([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 0, 1], [1, 0, 1], [0, 0, 1]])
    foot, hand = np.eye(4), np.eye(4)
    foot[2, 3] = 5.0
    hand[:3, 3] = [1, 0, 5]

    def cluster(number: int, vertices, weights, bind) -> str:
        # Bound where the bar lay along x, 5 m above the ground.
        return f"""Deformer: {number}, "SubDeformer::c{number}", "Cluster" {{ Version: 100
          {listed("Indexes", vertices)}
          {listed("Weights", weights)}
          {listed("Transform", np.linalg.inv(bind).T)}
          {listed("TransformLink", bind.T)} }}"""

    raised = np.linalg.inv(foot) @ hand
    objects = [
        mesh(GEOMETRY, points, [[0, 1, 4, 5], [1, 2, 3, 4]]),
        model(200, "bar", Lcl_Translation=[9, 9, 9]),
        model(210, "foot", "LimbNode", Lcl_Translation=[0, 0, 5]),
        model(211, "hand", "LimbNode", Lcl_Translation=[1, 0, 0], Lcl_Rotation=[0, -90, 0]),
        'Deformer: 600, "Deformer::skin", "Skin" { Version: 101 }',
        cluster(601, [0, 1, 4, 5], [1, 0.5, 0.5, 1], np.eye(4)),
        cluster(602, [1, 2, 3, 4], [0.5, 1, 1, 0.5], raised),
    ]
    links = [(200, 0), (GEOMETRY, 200), (210, 0), (211, 210), (600, GEOMETRY), (601, 600), (602, 600)]
    scene = load(tmp_path, document(objects, [*links, (210, 601), (211, 602)]))
    (bar,) = scene.meshes
    found = np.unique((bar.positions + scene.origin).round(4), axis=0)
    file = np.array([[0, 0, 5], [1, 0, 5], [1, 0, 6], [0, 0, 6], [0.5, 0, 5.5]])
    right = np.unique(np.stack([file[:, 0], file[:, 2], -file[:, 1]], axis=1).round(4), axis=0)
    np.testing.assert_allclose(found, right, atol=1e-4)


def test_uv_sets_without_names_are_kept_apart(tmp_path):
    layers = layer("UV", "UV", UV, 0) + layer("UV", "UV", SECOND_UV, 1)
    objects = [mesh(GEOMETRY, POINTS, [[0, 1, 2, 3]], layers), model(200, "quad")]
    (quad,) = load(tmp_path, document(objects, [(200, 0), (GEOMETRY, 200)])).meshes
    for found, right in ((quad.uv, UV), (quad.lightmap_uv, SECOND_UV)):
        np.testing.assert_allclose(np.unique(found, axis=0), np.unique(right * [1, -1] + [0, 1], axis=0), atol=1e-6)


def test_hidden_nodes_and_further_levels_of_detail_are_left_out(tmp_path):
    objects = [
        QUAD,
        model(201, "levels", "LodGroup"),
        'NodeAttribute: 501, "NodeAttribute::levels", "LodGroup" { TypeFlags: "LodGroup" }',
        model(202, "fine"),
        model(203, "coarse"),
        model(204, "hidden", Visibility=0),
        model(205, "below"),
    ]
    links = [(201, 0), (501, 201), (202, 201), (203, 201), (204, 0), (205, 204)]
    scene = load(tmp_path, document(objects, [*links, *((GEOMETRY, number) for number in (202, 203, 204, 205))]))
    assert [each.name for each in scene.meshes] == ["fine"]
    assert "further levels of detail left out" in " ".join(scene.notes)


def test_the_camera_of_an_fbx_file(tmp_path):
    """It looks along +X of its node, which is turned by 90 degrees about +Z; the field of view is vertical."""
    own = properties(FieldOfView=40, ApertureMode=2, AspectWidth=3, AspectHeight=2)
    objects = [
        f'NodeAttribute: 501, "NodeAttribute::c", "Camera" {{ TypeFlags: "Camera"\n{own} }}',
        model(201, "c", "Camera", Lcl_Translation=[1, 2, 3], Lcl_Rotation=[0, 0, 90]),
    ]
    for world in ("Z up, metres", "Y up, centimetres"):
        *_, columns = WORLD[world]
        camera = file_camera(document(objects, [(201, 0), (501, 201)], world).encode(), "a.fbx")
        assert camera is not None
        np.testing.assert_allclose(camera.position, columns @ [1, 2, 3], atol=1e-9)
        forward = columns @ [0, 1, 0] / np.linalg.norm(columns @ [0, 1, 0])
        np.testing.assert_allclose(np.subtract(camera.target, camera.position), forward, atol=1e-9)
        np.testing.assert_allclose(camera.up, columns @ [-1, 0, 0] / np.linalg.norm(columns @ [1, 0, 0]), atol=1e-9)
        assert camera.fov_deg == pytest.approx(40)


def test_lights_without_a_counterpart_are_noted(tmp_path):
    objects = [
        QUAD,
        model(200, "quad"),
        model(201, "old", "Light"),
        model(202, "panel", "Light"),
        light(501, "old", 0, Color=[1, 1, 1], Intensity=100, DecayType=0),
        light(502, "panel", 3, Color=[1, 1, 1], Intensity=100),
    ]
    links = [(200, 0), (GEOMETRY, 200), (201, 0), (202, 0), (501, 201), (502, 202)]
    scene = load(tmp_path, document(objects, links))
    said = " ".join(scene.notes)
    assert "'old': its decay has no counterpart" in said and "area and volume lights (1) ignored" in said
    assert [each.intensity for each in scene.lights] == [(1.0, 1.0, 1.0)]


def record(name: bytes, properties: bytes, count: int, inner: bytes, at: int, wide: bool) -> bytes:
    """A record of a binary file that begins at `at`."""
    form = "<QQQB" if wide else "<IIIB"
    size = struct.calcsize(form)
    inner += bytes(size) if inner else b""
    end = at + size + len(name) + len(properties) + len(inner)
    return struct.pack(form, end, count, len(properties), len(name)) + name + properties + inner


@pytest.mark.parametrize("version", [7400, 7500])
def test_what_arrays_become_is_known_before_they_are_inflated(version):
    """Of records in records and beside each other, compressed or not, between properties of every other kind."""
    wide, head = version >= 7500, b"Kaydara FBX Binary  \0\x1a\0" + struct.pack("<I", version)
    packed = zlib.compress(bytes(8 * 1000))
    array = b"d" + struct.pack("<III", 1000, 1, len(packed)) + packed
    plain = b"i" + struct.pack("<III", 3, 0, 12) + bytes(12)
    others = b"Y\0\0" + b"C\1" + b"I" + bytes(4) + b"F" + bytes(4) + b"D" + bytes(8) + b"L" + bytes(8)
    others += b"S" + struct.pack("<I", 5) + b"words" + b"R" + struct.pack("<I", 2) + b"\0\1"
    first = len(head) + struct.calcsize("<QQQB" if wide else "<IIIB") + 5
    body = record(b"Outer", b"", 0, record(b"A", others + array, 9, b"", first, wide), len(head), wide)
    body += record(b"B", plain + array, 2, b"", len(head) + len(body), wide)
    data = head + body + bytes(25 if wide else 13)
    assert inflated_bytes(data) == 2 * 8000 + 12
    check_inflation(data, "a.fbx")
    large = data.replace(struct.pack("<III", 1000, 1, len(packed)), struct.pack("<III", 2**28, 1, len(packed)))
    with pytest.raises(TooLarge, match="when they are inflated"):
        check_inflation(large, "a.fbx")


GOOD = one_quad(material())


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "cannot be read as FBX"),
        (b"solid", "cannot be read as FBX"),
        (b"Kaydara FBX Binary  \x00\x1a\x00" + (7400).to_bytes(4, "little") + b"\xff" * 99, "cannot be read as FBX"),
        (GOOD[: len(GOOD) // 3].encode(), "cannot be read as FBX"),
        (GOOD.replace("0,0,0,2", "0,nan,0,2").encode(), "vertex|FBX"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "cannot be read as FBX|has no faces"),
        (one_quad(material(EmissiveColor=[-1, 0, 0])).encode(), "material 'paint'.*negative"),
    ],
    ids=("nothing", "text", "noise", "a third", "NaN", "an OBJ file", "negative light"),
)
def test_a_faulty_fbx_file_is_refused(tmp_path, data, says):
    (tmp_path / "a.fbx").write_bytes(data)
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path, "a.fbx")
