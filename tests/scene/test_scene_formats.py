"""OBJ, PLY and Mitsuba XML become the same model; attacks by name, entity and reference are refused."""

import numpy as np
import pytest

from kiln_schemas.errors import InputError, TooLarge
from kiln_workers.scene.geometry import face_areas, face_normals
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import LightKind

OBJ = """mtllib set.mtl
o plate
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl shiny
f 1/1 2/2 3/3 4/4
o flag
usemtl lamp
f -4 -3 -2
f 1 1 2
"""
MTL = """newmtl shiny
Kd 0.2 0.4 0.6
Ks 1 1 1
Ns 198
newmtl lamp
Ke 5 4 3
"""


def refused(folder, name) -> str:
    with pytest.raises(InputError) as caught:
        load_scene(folder, name)
    return str(caught.value)


def test_obj_with_its_library(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "set.mtl").write_text(MTL)
    scene = load_scene(tmp_path, "a.obj")
    plate, flag = scene.meshes
    assert (plate.name, flag.name, scene.triangles) == ("plate", "flag", 3)
    np.testing.assert_allclose(face_normals(plate.positions, plate.faces), [[0, 0, 1]] * 2)
    top_left = np.flatnonzero((plate.positions == [0, 1, 0]).all(axis=1))[0]
    np.testing.assert_allclose(plate.uv[top_left], [0, 0])  # v is turned downwards
    shiny, lamp = (scene.materials[mesh.material] for mesh in scene.meshes)
    assert shiny.base_color == (0.2, 0.4, 0.6, 1.0)
    np.testing.assert_allclose(shiny.roughness**4, 0.01)  # alpha^2 = 2 / (198 + 2)
    assert lamp.emission == (5.0, 4.0, 3.0) and lamp.roughness == 1.0
    assert scene.notes == ("Mesh 'flag': 1 degenerate face dropped.",)


def test_obj_faults(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    assert any("set.mtl' is missing" in note for note in load_scene(tmp_path, "a.obj").notes)
    (tmp_path / "set.mtl").write_text(MTL.replace("Ns 198", "map_Kd wood.png"))
    assert "the texture 'wood.png' is missing" in refused(tmp_path, "a.obj")
    (tmp_path / "set.mtl").write_text("newmtl shiny\nmap_Kd ../../secret.png\n")
    assert "leaves the bundle" in refused(tmp_path, "a.obj")
    for text, says in {
        "v 0 0 0\nf 1 2 3\n": "line 2",
        "v 0 0 x\n": "line 1",
        "v 0 0\nv 1 0 0\nv 1 1 1\nf 1 2 3": "line 1",
        "v 0 0 nan\nv 1 0 0\nv 1 1 1\nf 1 2 3": "vertex 0",
        "v 0 0 0\nv 1 0 0\nv 1 1 1\nf 1 2": "line 4",
        "v 0 0 0\n": "has no faces",
        "mtllib ../x.mtl\nv 0 0 0": "leaves the bundle",
    }.items():
        (tmp_path / "b.obj").write_text(text)
        assert says in refused(tmp_path, "b.obj"), text


def test_obj_with_several_libraries_and_names_with_spaces(tmp_path, write_image):
    text = OBJ.replace("mtllib set.mtl", "mtllib gone.mtl first.mtl\nmtllib my second.mtl")
    (tmp_path / "a.obj").write_text(text)
    shiny, lamp = MTL.split("newmtl lamp")
    (tmp_path / "first.mtl").write_text(shiny + "map_Kd -s 2 2 2 -clamp on red wood.png\n")
    (tmp_path / "my second.mtl").write_text("newmtl lamp" + lamp)
    write_image(tmp_path / "red wood.png", np.full((2, 2, 3), 255, np.uint8))
    scene = load_scene(tmp_path, "a.obj")
    plate, flag = (scene.materials[mesh.material] for mesh in scene.meshes)
    assert scene.images[plate.base_color_texture.image].name == "red wood.png"
    assert flag.emission == (5.0, 4.0, 3.0)
    assert sum("is missing" in note for note in scene.notes) == 1


PLY_HEAD = """ply
format {kind} 1.0
element vertex 4
property float x
property float y
property float z
property float s
property float t
element face 1
property list uchar int vertex_indices
end_header
"""
PLY_ROWS = np.array([[0, 0, 0, 0, 0], [1, 0, 0, 1, 0], [1, 1, 0, 1, 1], [0, 1, 0, 0, 1]], dtype=np.float32)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_in_every_encoding(tmp_path, kind):
    order = ">" if "big" in kind else "<"
    data = PLY_HEAD.format(kind=kind).encode()
    if kind == "ascii":
        data += "".join(" ".join(str(x) for x in row) + "\n" for row in PLY_ROWS).encode() + b"4 0 1 2 3\n"
    else:
        data += PLY_ROWS.astype(order + "f4").tobytes() + b"\x04" + np.arange(4, dtype=order + "i4").tobytes()
    (tmp_path / "quad.ply").write_bytes(data)
    mesh = load_scene(tmp_path, "quad.ply").meshes[0]
    np.testing.assert_allclose(face_areas(mesh.positions, mesh.faces), [0.5, 0.5])
    np.testing.assert_allclose(face_normals(mesh.positions, mesh.faces), [[0, 0, 1]] * 2)
    np.testing.assert_allclose(mesh.uv, np.stack([mesh.positions[:, 0], 1 - mesh.positions[:, 1]], axis=1))


def test_broken_ply_is_refused(tmp_path):
    for data in (b"", b"not ply", PLY_HEAD.format(kind="ascii").encode(), PLY_HEAD.format(kind="odd").encode()):
        (tmp_path / "bad.ply").write_bytes(data)
        assert "bad.ply" in refused(tmp_path, "bad.ply")


def xml(tmp_path, body: str, head: str = "") -> str:
    (tmp_path / "scene.xml").write_text(f'{head}<scene version="3.0.0">{body}</scene>')
    return "scene.xml"


LIT = '<emitter type="constant"><rgb name="radiance" value="1, 2, 3"/></emitter>'


def test_mitsuba_shapes_are_closed_and_face_outwards(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    body = f"""{LIT}
    <shape type="cube"><transform name="to_world"><scale value="2"/><translate x="5"/></transform></shape>
    <shape type="sphere"><point name="center" x="1" y="2" z="3"/><float name="radius" value="0.5"/></shape>
    <shape type="rectangle"><boolean name="flip_normals" value="true"/></shape>
    <shape type="disk"/>
    <shape type="obj"><string name="filename" value="a.obj"/></shape>"""
    scene = load_scene(tmp_path, xml(tmp_path, body))
    cube, ball, rectangle, disk, plate, _ = scene.meshes
    areas = [face_areas(mesh.positions, mesh.faces).sum() for mesh in (cube, ball, rectangle, disk, plate)]
    np.testing.assert_allclose(areas, [96.0, np.pi, 4.0, np.pi, 1.0], rtol=4e-3)
    for mesh, centre in ((cube, [5, 0, 0]), (ball, [1, 2, 3])):
        middle = mesh.positions[mesh.faces].mean(axis=1) - centre
        assert (np.einsum("fd,fd->f", middle, face_normals(mesh.positions, mesh.faces)) > 0).all()
    np.testing.assert_allclose(face_normals(rectangle.positions, rectangle.faces), [[0, 0, -1]] * 2)
    np.testing.assert_allclose(face_normals(disk.positions, disk.faces)[:, 2], 1.0)
    np.testing.assert_allclose(scene.environment.pixels[3, 5], [1, 2, 3])


def test_mitsuba_materials(tmp_path):
    body = f"""{LIT}<default name="rough" value="0.09"/>
    <bsdf type="twosided" id="gold"><bsdf type="roughconductor"><string name="material" value="Au"/>
      <string name="distribution" value="ggx"/><float name="alpha" value="$rough"/></bsdf></bsdf>
    <shape type="cube"><ref id="gold"/></shape>
    <shape type="rectangle"><bsdf type="diffuse"><rgb name="reflectance" value="#ff8000"/></bsdf>
      <emitter type="area"><rgb name="radiance" value="7 8 9"/></emitter></shape>
    <shape type="disk"><bsdf type="principled"><float name="roughness" value="0.7"/></bsdf></shape>
    <shape type="disk"><bsdf type="conductor"><rgb name="eta" value="1"/><rgb name="k" value="2"/></bsdf></shape>
    <shape type="disk"><bsdf type="roughplastic"><float name="alpha" value="0.25"/></bsdf></shape>"""
    scene = load_scene(tmp_path, xml(tmp_path, body))
    gold, lamp, principled, metal, plastic = (scene.materials[mesh.material] for mesh in scene.meshes)
    np.testing.assert_allclose(gold.roughness, 0.3)  # the root of Mitsuba's alpha
    assert gold.double_sided and gold.metallic == 1.0 and gold.base_color[0] > gold.base_color[2]
    np.testing.assert_allclose(lamp.base_color, [1.0, 0.2158605, 0.0, 1.0], atol=1e-6)
    assert lamp.emission == (7.0, 8.0, 9.0) and not lamp.double_sided
    np.testing.assert_allclose(principled.roughness, 0.7)
    np.testing.assert_allclose(metal.base_color[:3], 0.5)  # k^2 / (4 + k^2)
    np.testing.assert_allclose(plastic.roughness, 0.5)
    assert any("Beckmann" in note for note in scene.notes)


def test_mitsuba_lights_and_environment(tmp_path, write_image):
    write_image(tmp_path / "sky.exr", np.ones((4, 8, 3), np.float32))
    body = """<shape type="cube"/>
    <emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="2"/>
      <transform name="to_world"><rotate y="1" angle="35"/></transform></emitter>
    <emitter type="point"><point name="position" value="1 2 3"/><rgb name="intensity" value="4"/></emitter>
    <emitter type="spot"><transform name="to_world"><lookat origin="0 5 0" target="0 0 0" up="0 0 1"/></transform>
      <float name="cutoff_angle" value="30"/></emitter>
    <emitter type="directional"><vector name="direction" x="0" y="-2" z="0"/></emitter>"""
    scene = load_scene(tmp_path, xml(tmp_path, body))
    assert scene.environment.scale == 2.0
    np.testing.assert_allclose(scene.environment.rotation_deg, 35.0 - 90.0)
    point, spot, sun = scene.lights
    assert [light.kind for light in scene.lights] == [LightKind.POINT, LightKind.SPOT, LightKind.DIRECTIONAL]
    assert point.position == (1.0, 2.0, 3.0) and point.intensity == (4.0, 4.0, 4.0)
    np.testing.assert_allclose(spot.position, [0, 5, 0])
    np.testing.assert_allclose([spot.direction, sun.direction], [[0, -1, 0]] * 2, atol=1e-12)
    np.testing.assert_allclose(np.rad2deg([spot.inner_cone, spot.outer_cone]), [22.5, 30.0])


@pytest.mark.parametrize(
    "head",
    [
        '<!DOCTYPE scene [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE scene [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>',
        '<!DOCTYPE scene SYSTEM "http://example.com/scene.dtd">',
    ],
)
def test_entities_and_document_types_are_refused(tmp_path, head):
    assert "document type or entities" in refused(tmp_path, xml(tmp_path, '<shape type="cube"/>', head))


@pytest.mark.parametrize("name", ["../secret.obj", "/etc/passwd", "sub/../../secret.obj", "..\\secret.obj"])
@pytest.mark.parametrize(
    "form", ['<shape type="obj"><string name="filename" value="{}"/></shape>', '<include filename="{}"/>']
)
def test_names_that_leave_the_bundle_are_refused(tmp_path, name, form):
    folder = tmp_path / "bundle"
    folder.mkdir()
    (tmp_path / "secret.obj").write_text(OBJ)
    assert "leaves the bundle" in refused(folder, xml(folder, form.format(name)))


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ('<shape type="serialized"/>', "shape 'serialized'"),
        ('<shape type="cube"><bsdf type="hair"/></shape>', "bsdf 'hair'"),
        (
            '<shape type="cube"><bsdf type="diffuse"><texture type="bitmap" name="reflectance"/></bsdf></shape>',
            "texture 'bitmap': it has no filename",
        ),
        ('<shape type="cube"><bsdf type="twosided" id="a"><ref id="a"/></bsdf></shape>', "within itself"),
        ('<shape type="cube"><bsdf type="conductor"><string name="material" value="../x"/></bsdf></shape>', "'../x'"),
        ('<shape type="cube"><bsdf type="conductor"><string name="material" value="Xx"/></bsdf></shape>', "no 'Xx'"),
        ('<shape type="cube"><bsdf type="plastic"><float name="int_ior" value="nan"/></bsdf></shape>', "not finite"),
        ('<alias id="none" as="b"/>', "not found"),
        ('<shape type="cube"><ref id="none"/></shape>', "names nothing"),
        ('<shape type="cube"><float name="x" value="$undefined"/></shape>', "without a default"),
        ('<emitter type="sunsky"/>', "emitter 'sunsky'"),
        (
            "<path value='/etc'/><shape type='ply'><string name='filename' value='a'/></shape>",
            "<path> '/etc' leads out",
        ),
        ('<shape type="ply"><string name="filename" value="gone.ply"/></shape>', "'gone.ply' is missing"),
        ('<shape type="sphere"><float name="radius" value="nan"/></shape>', "not finite"),
        (
            '<shape type="cube"><transform name="to_world"><matrix value="1 2"/></transform></shape>',
            "matrix must have 9 or 16 values",
        ),
        ('<include filename="scene.xml"/>', "included files"),
        ("<shape", "not well-formed"),
        ('<sensor type="perspective"/>', "has no faces"),
    ],
)
def test_what_is_not_read_is_refused_by_name(tmp_path, body, says):
    assert says in refused(tmp_path, xml(tmp_path, body))


def test_deep_nesting_is_refused(tmp_path):
    with pytest.raises(TooLarge):
        load_scene(tmp_path, xml(tmp_path, "<shape>" * 1000))
