"""Collada: the scene is that of a glTF file written by hand; polygons, opacity, skins, and what is refused."""

import numpy as np
import pytest

from kiln_schemas.errors import InputError, TooLarge
from kiln_service.cli.bundle import collect
from kiln_workers.scene.file_camera import file_camera
from kiln_workers.scene.geometry import face_areas, face_normals
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import LightKind

WORLD = {
    # Columns: where x, y and z of the file point in the world, in metres.
    ("Y_UP", 1.0): [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    ("Z_UP", 0.01): [[0.01, 0, 0], [0, 0, -0.01], [0, 0.01, 0]],
    ("X_UP", 0.5): [[0, 0.5, 0], [-0.5, 0, 0], [0, 0, 0.5]],
}
POINTS = np.float32([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0.5]])
NORMALS = np.float32([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [0, 0, 1]])
UV = np.float32([[0, 0], [1, 0], [1, 1], [0.25, 1]])
SECOND_UV = np.float32([[0.1, 0.2], [0.4, 0.2], [0.4, 0.6], [0.1, 0.6]])
COLOURS = np.float32([[1, 0.5, 0.25, 1], [0.75, 1, 0, 1], [0, 0.1, 1, 1], [1, 1, 1, 1]])
FACES = (0, 1, 2, 0, 2, 3)
QUAD_ROWS = " ".join(f"{i} {i} {i} {i} {i}" for i in FACES)


def numbers(values) -> str:
    return " ".join(f"{value:.9g}" for value in np.asarray(values, np.float64).reshape(-1))


def source(name: str, values, parameters: str) -> str:
    rows = np.asarray(values, np.float64)
    named = "".join(f'<param name="{letter}" type="float"/>' for letter in parameters)
    return f"""<source id="{name}"><float_array id="{name}-a" count="{rows.size}">{numbers(rows)}</float_array>
      <technique_common><accessor source="#{name}-a" count="{len(rows)}" stride="{rows.shape[1]}">{named}</accessor>
      </technique_common></source>"""


def geometry(name: str, points, primitives: str, sources: str = "", extra: str = "") -> str:
    return f"""<geometry id="{name}" name="{name}"><mesh>{source(f"{name}-p", points, "XYZ")}{sources}
      <vertices id="{name}-v"><input semantic="POSITION" source="#{name}-p"/></vertices>{primitives}</mesh>{extra}
      </geometry>"""


def vertex(name: str, offset: int = 0) -> str:
    return f'<input semantic="VERTEX" source="#{name}-v" offset="{offset}"/>'


QUAD = geometry(
    "quad",
    POINTS,
    f"""<triangles material="paint" count="2">{vertex("quad")}
      <input semantic="NORMAL" source="#quad-n" offset="1"/>
      <input semantic="TEXCOORD" source="#quad-t" offset="2" set="0"/>
      <input semantic="TEXCOORD" source="#quad-u" offset="3" set="3"/>
      <input semantic="COLOR" source="#quad-c" offset="4"/>
      <p>{QUAD_ROWS}</p></triangles>""",
    source("quad-n", NORMALS, "XYZ")
    + source("quad-t", UV, "ST")
    + source("quad-u", SECOND_UV, "ST")
    + source("quad-c", COLOURS, "RGBA"),
)


def material(name: str, shader: str, parameters: str = "", extra: str = "") -> tuple[str, str]:
    """The `<material>` and its `<effect>`."""
    return (
        f'<material id="{name}" name="{name}"><instance_effect url="#{name}-fx"/></material>',
        f"""<effect id="{name}-fx"><profile_COMMON>{parameters}<technique sid="t">{shader}</technique></profile_COMMON>
        {extra}</effect>""",
    )


SAMPLER = """<newparam sid="surface"><surface type="2D"><init_from>picture</init_from></surface></newparam>
  <newparam sid="sampler"><sampler2D><source>surface</source><wrap_s>MIRROR</wrap_s><wrap_t>CLAMP</wrap_t></sampler2D>
  </newparam>"""
TEXTURE = '<texture texture="sampler" texcoord="second"/>'
BIND = """<bind_material><technique_common><instance_material symbol="paint" target="#paint">
  <bind_vertex_input semantic="second" input_semantic="TEXCOORD" input_set="3"/></instance_material></technique_common>
  </bind_material>"""


def document(nodes, geometries=QUAD, materials=(), unit=1.0, up="Y_UP", image="a.png", more="") -> str:
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
    <asset><unit name="u" meter="{unit}"/><up_axis>{up}</up_axis></asset>
    <library_images><image id="picture"><init_from>{image}</init_from></image></library_images>
    <library_materials>{"".join(one for one, _ in materials)}</library_materials>
    <library_effects>{"".join(two for _, two in materials)}</library_effects>
    <library_geometries>{geometries}</library_geometries>{more}
    <library_visual_scenes><visual_scene id="s">{nodes}</visual_scene></library_visual_scenes>
    <scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def load(folder, text: str):
    (folder / "a.dae").write_text(text)
    return load_scene(folder, "a.dae")


@pytest.mark.parametrize(("up", "unit"), WORLD)
def test_a_collada_scene_is_its_gltf_twin(tmp_path, gltf, write_image, surface, up, unit):
    """Nodes, mirrors, instances, two UV sets, colours, a texture and lights, under each up axis and some unit."""
    write_image(tmp_path / "a.png", np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    one = material("paint", f"<lambert><diffuse>{TEXTURE}</diffuse></lambert>", SAMPLER)
    lights = """<library_lights><light id="sun"><technique_common><directional><color>1 2 3</color></directional>
      </technique_common></light><light id="lamp"><technique_common><point><color>8 4 2</color>
      <constant_attenuation>0</constant_attenuation><quadratic_attenuation>2</quadratic_attenuation></point>
      </technique_common></light><light id="torch"><technique_common><spot><color>1 1 0.5</color>
      <constant_attenuation>0</constant_attenuation><quadratic_attenuation>1</quadratic_attenuation>
      <falloff_angle>60</falloff_angle></spot></technique_common></light></library_lights>
      <library_nodes><node id="kept" name="kept"><scale>1 2 1</scale><instance_geometry url="#quad">"""
    lights += f"{BIND}</instance_geometry></node></library_nodes>"
    nodes = f"""<node name="parent"><translate>10 20 30</translate><rotate>0 0 1 90</rotate>
        <node name="child"><matrix>1 0 0 3  0 1 0 0  0 0 1 0  0 0 0 1</matrix>
          <instance_geometry url="#quad">{BIND}</instance_geometry></node>
        <node name="mirror"><scale>-1 1 1</scale><instance_geometry url="#quad">{BIND}</instance_geometry></node>
        <instance_node url="#kept"/></node>
      <node name="sun"><rotate>1 0 0 -90</rotate><instance_light url="#sun"/></node>
      <node name="lamp"><translate>1 2 3</translate><instance_light url="#lamp"/></node>
      <node name="torch"><lookat>5 5 5  5 5 9  0 1 0</lookat><instance_light url="#torch"/></node>"""
    ours = load(tmp_path, document(nodes, materials=(one,), unit=unit, up=up, more=lights))

    linear = np.where(COLOURS <= 0.04045, COLOURS / 12.92, ((COLOURS + 0.055) / 1.055) ** 2.4).astype(np.float32)
    linear[:, 3] = COLOURS[:, 3]
    down = np.float32([1, -1]), np.float32([0, 1])
    gltf.mesh(
        POINTS,
        FACES,
        0,
        NORMAL=NORMALS,
        TEXCOORD_0=UV * down[0] + down[1],
        TEXCOORD_1=SECOND_UV * down[0] + down[1],
        COLOR_0=linear,
    )
    kinds = [("directional", [1, 2, 3], 1.0), ("point", [8, 4, 2], unit**2 / 2), ("spot", [1, 1, 0.5], unit**2)]
    gltf.document |= {
        "images": [{"uri": "a.png"}],
        "samplers": [{"wrapS": 33648, "wrapT": 33071}],
        "textures": [{"source": 0, "sampler": 0}],
        "materials": [
            {
                "name": "paint",
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}, "metallicFactor": 0},
            }
        ],
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensions": {
            "KHR_lights_punctual": {
                "lights": [{"name": kind, "type": kind, "color": c, "intensity": i} for kind, c, i in kinds]
            }
        },
    }
    cone = {"innerConeAngle": np.pi / 6, "outerConeAngle": np.pi / 6}
    gltf.document["extensions"]["KHR_lights_punctual"]["lights"][2]["spot"] = cone
    root = np.eye(4)
    root[:3, :3] = np.array(WORLD[up, unit]).T
    turn = {"rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]}
    shine = [{"extensions": {"KHR_lights_punctual": {"light": number}}} for number in range(3)]
    back_to_front = [0, 1, 0, 0]  # from -Z to +Z
    tree = [
        {"matrix": root.T.reshape(-1).tolist(), "children": [1, 5, 6, 7]},
        {"translation": [10, 20, 30], "children": [2, 3, 4], **turn},
        {"name": "child", "mesh": 0, "translation": [3, 0, 0]},
        {"name": "mirror", "mesh": 0, "scale": [-1, 1, 1]},
        {"name": "kept", "mesh": 0, "scale": [1, 2, 1]},
        {"name": "sun", "rotation": [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)], **shine[0]},
        {"name": "lamp", "translation": [1, 2, 3], **shine[1]},
        {"name": "torch", "translation": [5, 5, 5], "rotation": back_to_front, **shine[2]},
    ]
    twin = load_scene(tmp_path, gltf.write(tmp_path, nodes=tree))

    one, two = surface(ours), surface(twin)
    assert list(one) == list(two) == ["child", "mirror", "kept"]
    for name in two:
        for part, right in two[name].items():
            np.testing.assert_allclose(
                one[name][part], right, atol=2e-6 * max(1.0, 40 * unit), err_msg=f"{name} {part}"
            )
    (paint,), (same,) = ours.materials, twin.materials
    assert (paint.base_color, paint.metallic, paint.roughness) == (same.base_color, 0.0, 1.0)
    assert paint.base_color_texture == same.base_color_texture and paint.base_color_texture.wrap == ("mirror", "clamp")
    np.testing.assert_array_equal(ours.images[0].pixels, twin.images[0].pixels)
    assert ours.images[0].srgb
    for light, right in zip(ours.lights, twin.lights, strict=True):
        assert light.kind == right.kind
        np.testing.assert_allclose(light.intensity, right.intensity, rtol=1e-6)
        if right.kind is not LightKind.DIRECTIONAL:
            here, there = np.add(light.position, ours.origin), np.add(right.position, twin.origin)
            np.testing.assert_allclose(here, there, atol=1e-5)
        if right.kind is not LightKind.POINT:
            np.testing.assert_allclose(light.direction, right.direction, atol=1e-6)
        assert right.kind is not LightKind.SPOT or (light.inner_cone, light.outer_cone) == pytest.approx(
            (np.pi / 6,) * 2
        )
    assert ours.notes == ()


FRAME = np.float32([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [1, 1, 0], [1, 3, 0], [3, 3, 0], [3, 1, 0]])


@pytest.mark.parametrize(
    ("primitive", "area", "upwards"),
    [
        ("<triangles count='2'>{}<p>0 1 2 0 2 3</p></triangles>", 16, 16),
        ("<polylist count='2'>{}<vcount>4 3</vcount><p>0 1 2 3 4 5 6</p></polylist>", 18, 16),
        # An arrow, whose fan would leave its outline.
        ("<polylist count='1'>{}<vcount>4</vcount><p>0 1 2 7</p></polylist>", 4, 4),
        ("<polygons count='2'>{}<p>0 1 2 3</p><p>4 5 6</p></polygons>", 18, 16),
        ("<polygons count='1'>{}<ph><p>0 1 2 3</p><h>4 5 6 7</h></ph></polygons>", 12, 12),
        ("<polygons count='2'>{}<p>4 5 6</p><ph><p>0 1 2 3</p><h>4 5 6</h></ph></polygons>", 16, 14),
        ("<tristrips count='1'>{}<p>0 1 3 2</p></tristrips>", 16, 16),
        ("<trifans count='2'>{}<p>0 1 2 3</p><p>4 5 6</p></trifans>", 18, 16),
    ],
)
def test_polygons_of_any_shape(tmp_path, primitive, area, upwards):
    shape = geometry("frame", FRAME, primitive.replace("{}", vertex("frame")))
    (mesh,) = load(tmp_path, document('<node><instance_geometry url="#frame"/></node>', shape)).meshes
    areas = face_areas(mesh.positions, mesh.faces)
    normals = face_normals(mesh.positions, mesh.faces)
    assert areas.sum() == pytest.approx(area)
    # The inner ring is wound the other way round, and so is what is made of it alone.
    facing = normals[:, 2] * areas
    assert facing[facing > 0].sum() == pytest.approx(upwards)


@pytest.mark.parametrize(
    ("entry", "opacity"),
    [
        ('<transparent opaque="A_ONE"><color>0 0 0 0.6</color></transparent>', 0.6),
        ("<transparency><float>0.3</float></transparency>", 0.3),
        ("<transparent><color>1 1 1 0.5</color></transparent><transparency><float>0.5</float></transparency>", 0.25),
        ('<transparent opaque="A_ZERO"><color>0 0 0 0.6</color></transparent>', 0.4),
        ('<transparent opaque="RGB_ZERO"><color>0.5 0.5 0.5 1</color></transparent>', 0.5),
        (
            '<transparent opaque="RGB_ZERO"><color>1 0 0 1</color></transparent><transparency><float>0.5</float>'
            "</transparency>",
            1 - 0.212671 / 2,
        ),
        ('<transparent opaque="RGB_ONE"><color>0 1 0 1</color></transparent>', 0.71516),
        ('<transparent opaque="RGB_ZERO"><color>0 0 0 1</color></transparent>', 1.0),
    ],
)
def test_opacity_is_that_of_the_specification(tmp_path, entry, opacity):
    paint = material("paint", f"<lambert><diffuse><color>1 1 1 1</color></diffuse>{entry}</lambert>")
    scene = load(
        tmp_path, document(f'<node><instance_geometry url="#quad">{BIND}</instance_geometry></node>', QUAD, (paint,))
    )
    (found,) = scene.materials
    assert found.base_color[3] == pytest.approx(opacity, abs=1e-6)
    assert found.blend == (opacity < 1.0)


def test_an_invisible_material_is_taken_as_opaque(tmp_path):
    """As 3ds Max and others wrote it: transparency 0 for what is not transparent."""
    entry = "<transparent><color>1 1 1 1</color></transparent><transparency><float>0</float></transparency>"
    paint = material("paint", f"<lambert>{entry}</lambert>")
    scene = load(
        tmp_path, document(f'<node><instance_geometry url="#quad">{BIND}</instance_geometry></node>', QUAD, (paint,))
    )
    assert scene.materials[0].base_color[3] == 1.0 and not scene.materials[0].blend
    assert "would be invisible; taken as opaque" in " ".join(scene.notes)


@pytest.mark.parametrize(("mode", "alpha"), [("A_ONE", 0.25), ("RGB_ZERO", 0.6)])
def test_a_texture_of_opacity_becomes_alpha(tmp_path, write_image, mode, alpha):
    pixels = np.empty((2, 2, 4), np.float32)
    pixels[:] = [0.4, 0.4, 0.4, 0.25]
    write_image(tmp_path / "a.exr", pixels)
    shader = f"""<lambert><diffuse><color>0.5 0.5 0.5 1</color></diffuse><transparent opaque="{mode}">{TEXTURE}
      </transparent></lambert>"""
    nodes = f'<node><instance_geometry url="#quad">{BIND}</instance_geometry></node>'
    scene = load(tmp_path, document(nodes, materials=(material("paint", shader, SAMPLER),), image="a.exr"))
    (paint,) = scene.materials
    assert paint.blend and paint.base_color == (0.5, 0.5, 0.5, 1.0)
    image = scene.images[paint.base_color_texture.image]
    np.testing.assert_allclose(image.pixels[..., :3], 1.0)
    np.testing.assert_allclose(image.pixels[..., 3], alpha, atol=2e-3)


@pytest.mark.parametrize(
    ("shader", "roughness"),
    [
        ("<lambert/>", 1.0),
        ("<phong><shininess><float>30</float></shininess></phong>", 1.0),
        (
            "<phong><specular><color>1 1 1 1</color></specular><shininess><float>30</float></shininess></phong>",
            61**-0.25,
        ),
        ("<blinn><specular><color>1 1 1 1</color></specular><shininess><float>30</float></shininess></blinn>", 0.5),
    ],
)
def test_shininess_is_roughness(tmp_path, shader, roughness):
    """alpha^2 = 2 / (n + 2), and alpha = roughness^2; Phong's n counts four times."""
    nodes = f'<node><instance_geometry url="#quad">{BIND}</instance_geometry></node>'
    scene = load(tmp_path, document(nodes, materials=(material("paint", shader),)))
    assert scene.materials[0].roughness == pytest.approx(roughness)


def test_emission_constant_and_sides(tmp_path):
    glow = material(
        "paint",
        "<constant><emission><color>3 2 1 1</color></emission><diffuse><color>1 1 1 1</color></diffuse></constant>",
        extra='<extra><technique profile="GOOGLEEARTH"><double_sided>1</double_sided></technique></extra>',
    )
    nodes = f'<node><instance_geometry url="#quad">{BIND}</instance_geometry></node>'
    (paint,) = load(tmp_path, document(nodes, materials=(glow,))).materials
    assert paint.emission == (3.0, 2.0, 1.0) and paint.base_color[:3] == (0.0, 0.0, 0.0) and paint.double_sided


def test_what_exporters_add_to_a_texture(tmp_path, write_image):
    """Maya's repetition and offset, v upwards; a bump that is a normal map."""
    write_image(tmp_path / "a.png", np.full((2, 2, 3), [128, 128, 255], np.uint8))
    laid_out = """<texture texture="sampler" texcoord="second"><extra><technique profile="MAYA"><repeatU>2</repeatU>
      <repeatV>3</repeatV><offsetU>0.25</offsetU><offsetV>0.5</offsetV></technique></extra></texture>"""
    bump = f"""<extra><technique profile="FCOLLADA"><bump bumptype="NORMALMAP">{TEXTURE}</bump></technique></extra>"""
    paint = material("paint", f"<lambert><diffuse>{laid_out}</diffuse></lambert>", SAMPLER, bump)
    nodes = f'<node><instance_geometry url="#quad">{BIND}</instance_geometry></node>'
    scene = load(tmp_path, document(nodes, materials=(paint,)))
    (found,) = scene.materials
    base, normal = found.base_color_texture, found.normal_texture
    # At (u, v), upwards, Maya reads (2 u + 0.25, 3 v + 0.5).
    u, v = 0.3, 0.1
    down = base.scale[0] * u + base.offset[0], base.scale[1] * (1 - v) + base.offset[1]
    assert down == pytest.approx((2 * u + 0.25, 1 - (3 * v + 0.5)))
    assert normal is not None and not scene.images[normal.image].srgb and scene.images[base.image].srgb


def test_skins_of_collada_are_where_their_joints_put_them(tmp_path):
    """A bar of two joints, the second turned by 90 degrees about its foot at x = 1; under Z_UP and centimetres."""
    points = np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 0, 1], [1, 0, 1], [0, 0, 1]]) * 100
    bar = geometry(
        "bar", points, f"<polylist count='2'>{vertex('bar')}<vcount>4 4</vcount><p>0 1 4 5 1 2 3 4</p></polylist>"
    )
    inverse = [np.eye(4), np.eye(4)]
    inverse[1][0, 3] = -100.0
    controller = f"""<library_controllers><controller id="c"><skin source="#bar">
      <bind_shape_matrix>{numbers(np.eye(4))}</bind_shape_matrix>
      <source id="j"><Name_array id="j-a" count="2">foot hand</Name_array><technique_common>
        <accessor source="#j-a" count="2"><param name="JOINT" type="name"/></accessor></technique_common></source>
      <source id="b"><float_array id="b-a" count="32">{numbers(inverse)}</float_array><technique_common>
        <accessor source="#b-a" count="2" stride="16"><param name="TRANSFORM" type="float4x4"/></accessor>
        </technique_common></source>{source("w", [[1], [0.5]], "W")}
      <joints><input semantic="JOINT" source="#j"/><input semantic="INV_BIND_MATRIX" source="#b"/></joints>
      <vertex_weights count="6"><input semantic="JOINT" source="#j" offset="0"/>
        <input semantic="WEIGHT" source="#w" offset="1"/><vcount>1 2 1 1 2 1</vcount>
        <v>0 0  0 1 1 1  1 0  1 0  0 1 1 1  0 0</v></vertex_weights></skin></controller></library_controllers>"""
    nodes = """<node id="foot-id" sid="foot" type="JOINT"><translate>0 0 500</translate><node sid="hand" type="JOINT">
      <translate>100 0 0</translate><rotate>0 1 0 -90</rotate></node></node>
      <node name="skinned"><translate>9 9 9</translate><instance_controller url="#c"><skeleton>#foot-id</skeleton>
      </instance_controller></node>"""
    scene = load(tmp_path, document(nodes, bar, unit=0.01, up="Z_UP", more=controller))
    (mesh,) = scene.meshes
    found = np.unique((mesh.positions + scene.origin).round(4), axis=0)
    # In the file: the foot's end at z = 5, the hand's end upright over x = 1 (and x = 0 for its upper side).
    file = np.array([[0, 0, 5], [1, 0, 5], [1, 0, 6], [0, 0, 6], [0.5, 0, 5.5]])
    right = np.unique(np.stack([file[:, 0], file[:, 2], -file[:, 1]], axis=1).round(4), axis=0)
    np.testing.assert_allclose(found, right, atol=1e-4)


@pytest.mark.parametrize(
    "path", ["a.png", "./tex/a.png", "file:///C:/art/tex/a.png", "..\\..\\tex\\a.png", "/home/me/a%2epng", "tex\\a.png"]
)
def test_a_texture_is_found_by_the_end_of_its_path(tmp_path, write_image, path):
    (tmp_path / "tex").mkdir()
    write_image(tmp_path / "tex" / "a.png", np.full((1, 1, 3), 9, np.uint8))
    write_image(tmp_path / "a.png", np.full((1, 1, 3), 5, np.uint8))
    paint = material("paint", f"<lambert><diffuse>{TEXTURE}</diffuse></lambert>", SAMPLER)
    nodes = f'<node><instance_geometry url="#quad">{BIND}</instance_geometry></node>'
    scene = load(tmp_path, document(nodes, materials=(paint,), image=path))
    assert scene.images[0].pixels[0, 0, 0] == (9 if "tex" in path else 5)
    name = "tex/a.png" if "tex" in path else "a.png"
    assert set(collect(tmp_path / "a.dae").bundle.files) == {"a.dae", name}


def test_a_texture_elsewhere_is_left_out_with_a_note(tmp_path, write_image):
    (tmp_path / "scene").mkdir()
    write_image(tmp_path / "b.png", np.full((1, 1, 3), 9, np.uint8))
    (tmp_path / "scene" / "link.png").symlink_to(tmp_path / "b.png")
    paint = material("paint", f"<lambert><diffuse>{TEXTURE}</diffuse></lambert>", SAMPLER)
    nodes = f'<node><instance_geometry url="#quad">{BIND}</instance_geometry></node>'
    scene = load(tmp_path / "scene", document(nodes, materials=(paint,), image="../b.png"))
    assert scene.images == () and "texture 'b.png' is not beside the file" in " ".join(scene.notes)
    assert set(collect(tmp_path / "scene" / "a.dae").bundle.files) == {"a.dae"}
    with pytest.raises(InputError, match="a link that leaves"):
        load(tmp_path / "scene", document(nodes, materials=(paint,), image="link.png"))


def test_what_has_no_counterpart_is_noted(tmp_path):
    lines = f"<lines count='1'>{vertex('quad')}<p>0 1</p></lines></mesh>"
    lights = """<library_lights><light id="l"><technique_common><ambient><color>1 1 1</color></ambient>
      </technique_common></light><light id="k" name="old"><technique_common><point/></technique_common></light>
      </library_lights><library_animations><animation/></library_animations>"""
    nodes = f"""<node><instance_geometry url="#quad">{BIND}</instance_geometry><instance_light url="#l"/>
      <instance_light url="#k"/><instance_geometry url="#spline"/><instance_node url="other.dae#n"/></node>"""
    shapes = QUAD.replace("</mesh>", lines) + '<geometry id="spline"><spline/></geometry>'
    bumpy = material("paint", "<lambert/>", extra=f"<extra><technique><bump>{TEXTURE}</bump></technique></extra>")
    scene = load(tmp_path, document(nodes, shapes, (bumpy,), more=lights))
    said = " ".join(scene.notes)
    for part in (
        *("primitives of lines (1)", "ambient or other lights without a place (1)", "animations ignored"),
        *("Light 'old': its attenuation has no counterpart", "geometries of spline (1)", "bump ignored"),
        "references to other files (1)",
    ):
        assert part in said, part
    assert scene.lights[0].intensity == (1.0, 1.0, 1.0)


def test_the_camera_of_a_collada_file(tmp_path):
    cameras = """<library_cameras><camera id="c"><optics><technique_common><perspective><xfov>60</xfov>
      <aspect_ratio>1.5</aspect_ratio></perspective></technique_common></optics></camera></library_cameras>"""
    nodes = '<node><translate>1 2 3</translate><rotate>1 0 0 90</rotate><instance_camera url="#c"/></node>'
    data = document(nodes, up="Z_UP", unit=0.1, more=cameras).encode()
    camera = file_camera(data, "a.dae")
    assert camera is not None
    np.testing.assert_allclose(camera.position, [0.1, 0.3, -0.2], atol=1e-9)
    np.testing.assert_allclose(camera.target, [0.1, 0.3, -1.2], atol=1e-9)
    assert camera.fov_deg == pytest.approx(2 * np.degrees(np.arctan(np.tan(np.radians(30)) / 1.5)))
    assert file_camera(document("<node/>").encode(), "a.dae") is None


PLAIN = '<node><instance_geometry url="#quad"/></node>'
COPIES = "".join(
    f'<node id="n{i}"><instance_node url="#n{i + 1}"/><instance_node url="#n{i + 1}"/></node>' for i in range(40)
)
ENTITIES = '<!DOCTYPE COLLADA [<!ENTITY a "{}">]>'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<scene/>", "not with <COLLADA>"),
        ("<COLLADA", "not well-formed XML"),
        (ENTITIES + document(PLAIN).partition("?>")[2], "document type"),
        (ENTITIES.replace('"{}"', 'SYSTEM "file:///etc/passwd"') + document(PLAIN).partition("?>")[2], "document type"),
        (document(PLAIN, unit=0), "its unit is '0' metres"),
        (document(PLAIN, up="UP"), "its up axis is 'UP'"),
        (document('<node><instance_geometry url="#none"/></node>'), "names no <geometry>"),
        (document(PLAIN, QUAD.replace("2 2 2 2 2", "2 2 9 2 2")), "names TEXCOORD 9 of 4"),
        (document(PLAIN, QUAD.replace("2 2 2 2 2", "2 2 -1 2 2")), "names TEXCOORD -1 of 4"),
        (document(PLAIN, QUAD.replace("2 2 2 2 2", "2 2 x 2 2")), "holds what is no number"),
        (document(PLAIN, QUAD.replace("2 2 2 2 2", "2 2 2")), "list of 26 indices, 5 to a corner"),
        (document(PLAIN, QUAD.replace('stride="3"', 'stride="3000"')), "reads 0 [+] 4 x 3000 of 12"),
        (document(PLAIN, QUAD.replace('count="4" stride="3"', 'count="4000000000" stride="3"')), "rows of data"),
        (document(f"<node><scale>1e308 1 1</scale><node><scale>1e308 1 1</scale>{PLAIN}</node></node>"), "not finite"),
        (document("<node><rotate>1 2</rotate></node>"), "holds 2 numbers, not 4"),
        (document('<node id="n"><instance_node url="#n"/></node>'), "hold themselves"),
        (document(COPIES), "nodes with all its instances"),
        (document("<node>" * 300 + "</node>" * 300), "nests too deeply"),
    ],
    ids=lambda value: value[-30:] if len(value) < 60 else "",
)
def test_a_faulty_collada_file_is_refused(tmp_path, text, says):
    with pytest.raises((InputError, TooLarge), match=says):
        load(tmp_path, text)
