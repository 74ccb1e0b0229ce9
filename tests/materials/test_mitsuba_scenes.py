"""Mitsuba's XML against Mitsuba: the same file, traced by plain Mitsuba and as the scene that we read from it.

The radiance along rays into a scene is the mean of many paths. Both sides have to agree within four standard deviations
and the share that `docs/scene-input.md` calls approximated.
"""

import struct
import zlib

import numpy as np
import OpenEXR
import pytest

from kiln_workers.render.backend import select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.render.mitsuba_scene import to_mitsuba
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.sheets import part_sheets

PATHS = 1024
WALL = '<bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf>'
FLOOR = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform>
  <ref id="floor"/></shape><bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.5 0.6 0.7"/></bsdf>"""
LAMP = """<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="9 8 7"/></emitter>
  <transform name="to_world"><rotate x="1" angle="90"/><translate x="1" y="4" z="0.5"/></transform></shape>"""
SKY = '<emitter type="constant"><rgb name="radiance" value="0.3 0.4 0.5"/></emitter>'
OBJ = "\n".join(
    [
        *(
            f"v {x} {y} {z}"
            for x, y, z in ((-1, 0.2, -1), (1, 0.2, -1), (1, 1.5, -0.5), (-1, 1.5, -0.5), (0, 2.2, 0.4))
        ),
        *("vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "f 1/1 2/2 3/3 4/4", "f 4/4 3/3 5/2"),
    ]
)
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float s
property float t
element face 2
property list uchar int vertex_indices
end_header
-1 0.2 0 0 0
1 0.2 0 1 0
1 2 0.3 1 1
-1 2 0.3 0 1
3 0 1 2
3 0 2 3
"""
TEXTURED = """<bsdf type="twosided"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
  <string name="filename" value="paint.exr"/>{}</texture></bsdf></bsdf>"""

SCENES = {
    "references before definitions, two-sided, spectra": FLOOR
    + """<shape type="cube"><ref id="late"/><transform name="to_world"><scale x="0.5" y="1" z="0.7"/>
      <rotate y="1" angle="30"/><translate y="1"/></transform></shape>
    <bsdf type="twosided" id="late"><bsdf type="diffuse">
      <spectrum name="reflectance" value="400:0.1, 500:0.2, 600:0.7, 700:0.8"/></bsdf></bsdf>
    <shape type="rectangle"><emitter type="area">
      <spectrum name="radiance" value="400:3, 500:5, 600:7, 700:9"/></emitter>
      <transform name="to_world"><rotate x="1" angle="90"/><translate y="4"/></transform></shape>"""
    + '<emitter type="constant"><spectrum name="radiance" value="0.2"/></emitter>',
    "curved shapes": FLOOR
    + LAMP
    + SKY
    + f"""<shape type="sphere"><point name="center" x="-1.5" y="0.8" z="0"/><float name="radius" value="0.7"/>{WALL}
    </shape><shape type="cylinder"><point name="p0" value="1 0 0"/><point name="p1" value="1.5 1.5 0.5"/>
      <float name="radius" value="0.4"/><bsdf type="twosided">{WALL}</bsdf></shape>
    <shape type="disk"><transform name="to_world"><scale value="0.8"/><lookat origin="0 1 -1.5" target="0 1 3"
      up="0 1 0"/></transform><bsdf type="twosided">{WALL}</bsdf></shape>""",
    "instances": FLOOR
    + LAMP
    + SKY
    + f"""<shape type="instance"><ref id="group"/><transform name="to_world"><translate x="1.5"/></transform></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world"><scale x="-1" y="0.6" z="1"/>
      <rotate y="1" angle="40"/><translate x="-1.5"/></transform></shape>
    <shape type="shapegroup" id="group"><shape type="cube">{WALL}<transform name="to_world">
      <scale x="0.4" y="0.8" z="0.6"/><translate y="0.8"/></transform></shape></shape>""",
    "an environment turned about a slanted axis": FLOOR
    + f"""<shape type="cube"><transform name="to_world"><scale value="0.6"/><translate y="1"/></transform>{WALL}</shape>
    <emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="1.5"/>
      <transform name="to_world"><rotate y="1" angle="-50"/><rotate x="0.8" z="0.6" angle="90"/></transform>
    </emitter>""",
    "an environment turned about +Y": FLOOR
    + f"""<shape type="cube"><transform name="to_world"><scale value="0.6"/><translate y="1"/></transform>{WALL}</shape>
    <emitter type="envmap"><string name="filename" value="sky.exr"/>
      <transform name="to_world"><rotate y="1" angle="130"/></transform></emitter>""",
    "lamps": FLOOR
    + f"""<shape type="cube"><transform name="to_world"><scale value="0.6"/><translate y="1"/></transform>{WALL}</shape>
    <emitter type="point"><point name="position" value="2 3 1"/><rgb name="intensity" value="9 7 5"/></emitter>
    <emitter type="directional"><vector name="direction" value="0.5 -2 0.3"/><rgb name="irradiance" value="1 2 3"/>
    </emitter><emitter type="spot"><transform name="to_world"><lookat origin="-2 4 2" target="0 0 0" up="0 1 0"/>
      </transform><float name="cutoff_angle" value="30"/><float name="beam_width" value="29.99"/>
      <spectrum name="intensity" value="20"/></emitter>""",
    "a checkerboard": LAMP
    + SKY
    + """<shape type="rectangle"><bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
      <rgb name="color0" value="0.9 0.1 0.1"/><rgb name="color1" value="0.1 0.1 0.9"/>
      <transform name="to_uv"><scale x="3" y="2"/></transform></texture></bsdf>
      <transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform></shape>""",
    "a lamp on a two-sided surface": FLOOR
    + SKY
    + """<shape type="rectangle"><bsdf type="twosided"><bsdf type="diffuse"/></bsdf>
      <emitter type="area"><rgb name="radiance" value="5"/></emitter>
      <transform name="to_world"><rotate x="1" angle="70"/><translate y="2"/></transform></shape>""",
    "a mask": FLOOR
    + LAMP
    + SKY
    + """<shape type="rectangle"><bsdf type="mask"><float name="opacity" value="0.3"/><bsdf type="twosided">
      <bsdf type="diffuse"><rgb name="reflectance" value="0.9 0.2 0.2"/></bsdf></bsdf></bsdf>
      <transform name="to_world"><rotate x="1" angle="30"/><translate y="2"/></transform></shape>""",
    "defaults and aliases": """<default name="size" value="0.5"/><default name="big" value="$size"/>
    <bsdf type="diffuse" id="one"><rgb name="reflectance" value="0.5"/></bsdf><alias id="one" as="two"/>"""
    + FLOOR
    + LAMP
    + """<shape type="cube"><ref id="two"/><transform name="to_world"><scale value="$big"/>
      <translate value="0 0.8 0"/></transform></shape>
    <emitter type="constant"/>""",
    "meshes without normals": FLOOR
    + LAMP
    + SKY
    + "".join(
        f"""<shape type="{kind}"><string name="filename" value="a.{kind}"/><boolean name="face_normals" value="{flat}"/>
      <bsdf type="twosided">{WALL}</bsdf><transform name="to_world"><translate x="{x}"/></transform></shape>"""
        for kind, flat, x in (("obj", "false", -2), ("obj", "true", 0), ("ply", "false", 2), ("serialized", "false", 1))
    ),
} | {
    f"a texture on {shape}, {number}": FLOOR
    + LAMP
    + SKY
    + f'<shape type="{shape}">{more}{TEXTURED.format(step)}<transform name="to_world"><scale value="0.9"/>'
    '<rotate y="1" angle="-25"/><translate y="1.2"/></transform></shape>'
    for shape, more in (
        ("rectangle", ""),
        ("cube", ""),
        ("sphere", ""),
        ("cylinder", '<boolean name="flip_normals" value="false"/>'),
        ("disk", ""),
        ("obj", '<string name="filename" value="a.obj"/>'),
        ("ply", '<string name="filename" value="a.ply"/>'),
        ("serialized", '<string name="filename" value="a.serialized"/>'),
    )
    for number, step in enumerate(
        (
            '<string name="wrap_mode" value="clamp"/>',
            '<transform name="to_uv"><scale x="1.5" y="0.7"/><rotate z="1" angle="35"/><translate x="0.2" y="0.4"/>'
            '</transform><string name="wrap_mode" value="mirror"/>',
        )
    )
    if number or shape == "rectangle"
}
OLD = """<scene version="0.6.0"><shape type="obj"><string name="filename" value="a.obj"/>
  <boolean name="faceNormals" value="true"/><transform name="toWorld"><translate x="0.5"/></transform>
  <bsdf type="twosided"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
    <string name="filename" value="paint.exr"/><float name="uscale" value="2"/><float name="voffset" value="0.25"/>
  </texture></bsdf></bsdf></shape>
  <shape type="rectangle"><transform name="toWorld"><rotate x="1" angle="-90"/><scale value="4"/></transform></shape>
  <shape type="rectangle"><emitter type="area"><rgb name="radiance" value="9 8 7"/></emitter>
    <transform name="toWorld"><rotate x="1" angle="90"/><translate y="4"/></transform></shape></scene>"""


@pytest.fixture(autouse=True)
def variant():
    select_variant("cpu")


def write_files(folder):
    """Meshes and images that the scenes name."""
    (folder / "a.obj").write_text(OBJ)
    (folder / "a.ply").write_text(PLY.strip())
    (folder / "a.serialized").write_bytes(serialized())
    rng = np.random.default_rng(5)
    paint = rng.uniform(0.1, 0.9, (8, 8, 3)).repeat(4, axis=0).repeat(4, axis=1)
    v, u = np.meshgrid((np.arange(128) + 0.5) / 128, (np.arange(256) + 0.5) / 256, indexing="ij")
    sky = 1.0 + np.sin(np.pi * v)[..., None] * np.cos(
        2 * np.pi * (u[..., None] * [1, 2, 3] + v[..., None] + [0.1, 0.4, 0])
    )
    for name, pixels in (("paint.exr", paint), ("sky.exr", sky), ("tilt.exr", np.tile([0.55, 0.8, 0.9], (4, 4, 1)))):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels, np.float32)}) as file:
            file.write(str(folder / name))


def serialized() -> bytes:
    """Two meshes of version 4: a triangle, and a square with texture coordinates."""
    square = np.float32([[-1, 0.2, 0], [1, 0.2, 0], [1, 2, 0.3], [-1, 2, 0.3]])
    uv, faces = np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]), np.uint32([[0, 1, 2], [0, 2, 3]])
    parts = [
        struct.pack("<I", 0x1002) + b"square\0" + struct.pack("<QQ", 4, 2) + square.tobytes() + uv.tobytes()
        + faces.tobytes(),
        struct.pack("<I", 0x1000) + b"\0" + struct.pack("<QQ", 3, 1) + square[:3].tobytes() + faces[:1].tobytes(),
    ]  # fmt: skip
    out, starts = b"", []
    for part in parts:
        starts.append(len(out))
        out += struct.pack("<HH", 0x041C, 4) + zlib.compress(part)
    return out + struct.pack("<QQI", *starts, 2)


def incoming(scene, origins, directions, seed):
    """Radiance along rays: mean and its standard deviation [N, 3]."""
    count = len(origins)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count * PATHS)
    index = dr.arange(mi.UInt32, count * PATHS) // PATHS
    rows = [[dr.gather(mi.Float, mi.Float(a[:, axis].astype(np.float32)), index) for axis in range(3)]
            for a in (origins, directions)]  # fmt: skip
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*rows[0]), mi.Vector3f(*rows[1])))
    integrator = mi.load_dict({"type": "path", "max_depth": 6, "rr_depth": 99})
    found = np.array(integrator.sample(scene, sampler, ray)[0]).T.reshape(count, PATHS, 3).astype(np.float64)
    return found.mean(axis=1), found.std(axis=1) / np.sqrt(PATHS)


def agree(folder, name, approximated=0.015, over_all=0.01, edges=4):
    """Compare the radiance along 160 rays from the front and 40 from above."""
    scene = part_sheets(load_scene(folder, name))
    plain, ours = mi.load_file(str(folder / name)), to_mitsuba(scene)
    rng = np.random.default_rng(3)
    eye = np.array([0.5, 2.5, 6.0]) + rng.normal(0.0, 0.5, (160, 3))
    view = rng.uniform([-2, 0, -1], [2, 2.2, 1], (160, 3)) - eye
    directions = view / np.linalg.norm(view, axis=1, keepdims=True)
    down = np.tile([0.0, -1.0, 0.0], (40, 1))
    origins = np.concatenate([eye, rng.uniform([-2, 3.5, -2], [2, 3.5, 2], (40, 3))])
    directions = np.concatenate([directions, down])
    one, other = (
        incoming(plain, origins, directions, 1),
        incoming(ours, origins - np.array(scene.origin), directions, 2),
    )
    noise = np.sqrt(one[1] ** 2 + other[1] ** 2)
    assert one[0].max() > 0.1
    off = np.abs(one[0] - other[0]) - approximated * np.maximum(one[0], 0.05)
    # Rays that meet an edge may see one side of it here and the other there.
    assert (off > 4.0 * noise).any(axis=1).sum() <= edges
    whole = other[0].mean(axis=0) / one[0].mean(axis=0)
    assert np.abs(whole - 1.0).max() < over_all + 4.0 * (noise.mean() / one[0].mean() / np.sqrt(len(noise))), whole


@pytest.mark.parametrize("name", SCENES)
def test_a_mitsuba_scene_is_lit_as_mitsuba_lights_it(tmp_path, name):
    write_files(tmp_path)
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{SCENES[name]}</scene>')
    agree(tmp_path, "scene.xml")


def test_a_scene_of_mitsuba_0_6_is_lit_as_mitsuba_lights_it(tmp_path):
    write_files(tmp_path)
    (tmp_path / "scene.xml").write_text(OLD)
    agree(tmp_path, "scene.xml")


GLOSSY = {
    "gold": """<bsdf type="roughconductor"><string name="material" value="Au"/><float name="alpha" value="0.3"/>
      <string name="distribution" value="ggx"/></bsdf>""",
    "a metal of spectra": """<bsdf type="roughconductor"><spectrum name="eta" value="400:1.6, 550:0.9, 700:0.2"/>
      <spectrum name="k" value="400:1.9, 550:2.3, 700:4"/><float name="alpha" value="0.4"/>
      <string name="distribution" value="ggx"/></bsdf>""",
    "plastic": """<bsdf type="roughplastic"><float name="alpha" value="0.3"/><float name="int_ior" value="1.7"/>
      <string name="distribution" value="ggx"/><rgb name="diffuse_reflectance" value="0.6 0.3 0.1"/></bsdf>""",
    "nonlinear plastic": """<bsdf type="roughplastic"><float name="alpha" value="0.3"/><boolean name="nonlinear"
      value="true"/><string name="distribution" value="ggx"/><rgb name="diffuse_reflectance" value="0.8 0.5 0.2"/>
      </bsdf>""",
    "principled": """<bsdf type="principled"><rgb name="base_color" value="0.6 0.4 0.2"/><float name="roughness"
      value="0.6"/><float name="metallic" value="0.5"/></bsdf>""",
    "a normal map": """<bsdf type="normalmap"><texture type="bitmap" name="normalmap"><boolean name="raw" value="true"/>
      <string name="filename" value="tilt.exr"/></texture><bsdf type="diffuse"/></bsdf>""",
    "a metal of textured roughness": """<bsdf type="roughconductor"><texture type="bitmap" name="alpha">
      <string name="filename" value="paint.exr"/><boolean name="raw" value="true"/></texture>
      <string name="distribution" value="ggx"/></bsdf>""",
}


@pytest.mark.parametrize("name", GLOSSY)
def test_glossy_surfaces_are_near_to_mitsuba(tmp_path, name):
    """Schlick's Fresnel, and Lambert below a dielectric, are not Mitsuba's: 12 % along a ray, 4 % over all."""
    write_files(tmp_path)
    plate = '<transform name="to_world"><rotate x="1" angle="-60"/><translate y="1"/></transform></shape>'
    body = f'<shape type="rectangle">{GLOSSY[name]}{plate}{FLOOR}{LAMP}{SKY}'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{body}</scene>')
    agree(tmp_path, "scene.xml", 0.12, 0.04, 8)
