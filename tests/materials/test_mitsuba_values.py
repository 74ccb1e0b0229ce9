"""Mitsuba's XML: names of files, colours, BSDFs without an exact counterpart, and what is left out."""

import numpy as np
import pytest
from test_mitsuba_scenes import PLY, write_files

from kiln_schemas.errors import InputError
from kiln_service.cli.bundle import collect
from kiln_workers.render.backend import select_variant
from kiln_workers.scene.load import load_scene

select_variant("cpu")


def scene_of(folder, body, version="3.0.0"):
    (folder / "scene.xml").write_text(f'<scene version="{version}">{body}</scene>')
    return load_scene(folder, "scene.xml")


def sky_of(folder, radiance):
    return scene_of(folder, f'<shape type="cube"/><emitter type="constant">{radiance}</emitter>').environment.pixels[
        0, 0
    ]


def material_of(folder, bsdf):
    scene = scene_of(folder, f'<shape type="cube">{bsdf}</shape>')
    return scene.materials[0], " ".join(scene.notes)


@pytest.mark.parametrize("inner", ["", '<path value="elsewhere"/>', '<path value="."/>', '<path value="../.."/>'])
def test_files_are_looked_for_as_mitsuba_does(tmp_path, inner):
    """In the folders of <path>, beside the entry, beside the file that names them; the bundle has what is read."""
    for name in ("parts/near.ply", "elsewhere/far.ply", "top.ply", "parts/top.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(PLY.replace("-1 0.2", "-3 0.2") if name == "top.ply" else PLY)
    names = ["near.ply", "top.ply", *(["far.ply"] if "elsewhere" in inner else [])]
    shapes = "".join(f'<shape type="ply"><string name="filename" value="{name}"/></shape>' for name in names)
    (tmp_path / "parts" / "part.xml").write_text(f'<scene version="3.0.0">{shapes}</scene>')
    film = '<sensor type="perspective"><film type="hdrfilm"><string name="filename" value="out.exr"/></film></sensor>'
    scene = scene_of(tmp_path, f'{film}{inner}<include filename="parts/part.xml"/>')
    assert len(scene.meshes) == len(names)
    widths = [np.ptp(mesh.positions[:, 0]) for mesh in scene.meshes]
    np.testing.assert_allclose(widths[:2], [2.0, 4.0])
    assert ("leads out" in " ".join(scene.notes)) == (".." in inner)
    far = {"elsewhere/far.ply"} if "elsewhere" in inner else set()
    assert (
        set(collect(tmp_path / "scene.xml").sources)
        == {"scene.xml", "parts/part.xml", "parts/near.ply", "top.ply"} | far
    )


def test_a_file_beyond_a_path_that_leads_out_is_named(tmp_path):
    body = '<path value="../common"/><shape type="ply"><string name="filename" value="a.ply"/></shape>'
    with pytest.raises(InputError, match=r"'a.ply' is missing. <path> '../common' leads out of the scene's folder"):
        scene_of(tmp_path, body)


def test_colours_that_mitsuba_refuses_in_rgb(tmp_path):
    """A black body of 6504 K is nearly white; one twice as bright is twice as bright."""
    white = sky_of(tmp_path, '<spectrum type="d65" name="radiance"><float name="scale" value="3"/></spectrum>')
    np.testing.assert_allclose(white, 3.0)
    day = sky_of(
        tmp_path, '<spectrum type="blackbody" name="radiance"><float name="temperature" value="6504"/></spectrum>'
    )
    assert np.ptp(day / day.mean()) < 0.1
    warm = sky_of(tmp_path, '<blackbody name="radiance" temperature="2700K" scale="2"/>')
    np.testing.assert_allclose(warm, 2 * sky_of(tmp_path, '<blackbody name="radiance" temperature="2700"/>'), rtol=1e-5)
    assert warm[0] > 2 * warm[1] > 4 * warm[2]
    np.testing.assert_allclose(sky_of(tmp_path, '<rgb name="radiance" value="#ff8000"/>'), [1, 0.2158605, 0], atol=1e-6)
    np.testing.assert_allclose(
        sky_of(tmp_path, '<srgb name="radiance" value="1 0.5019608 0"/>')[1], 0.2158605, atol=1e-6
    )
    pairs = sky_of(tmp_path, '<spectrum name="radiance" value="400:1, 500:2, 700:5"/>')
    (tmp_path / "lamp.spd").write_text("# nm, value\n400 1\n500 2\n700 5\n")
    irregular = """<spectrum type="irregular" name="radiance"><string name="wavelengths" value="400 500 700"/>
      <string name="values" value="1 2 5"/></spectrum>"""
    for other in ('<spectrum name="radiance" filename="lamp.spd"/>', irregular):
        np.testing.assert_allclose(sky_of(tmp_path, other), pairs, rtol=1e-6)
    regular = """<spectrum type="regular" name="radiance"><string name="values" value="1 2 5"/>
      <float name="wavelength_min" value="400"/><float name="wavelength_max" value="700"/></spectrum>"""
    even = sky_of(tmp_path, '<spectrum name="radiance" value="400:1, 550:2, 700:5"/>')
    np.testing.assert_allclose(sky_of(tmp_path, regular), even, rtol=1e-6)


def test_other_bsdfs_have_a_counterpart(tmp_path):
    write_files(tmp_path)
    red = '<bsdf type="diffuse"><rgb name="reflectance" value="0.8 0.2 0"/></bsdf>'
    blue = '<bsdf type="diffuse"><rgb name="reflectance" value="0 0.2 0.4"/></bsdf>'
    paint = '<texture type="bitmap" name="{}"><string name="filename" value="paint.exr"/></texture>'
    glass, said = material_of(tmp_path, '<bsdf type="roughdielectric"><string name="int_ior" value="diamond"/></bsdf>')
    assert glass.transmission == 1.0 and "without refraction" in said
    np.testing.assert_allclose(glass.ior, 2.419 / 1.000277, rtol=1e-4)
    thin, _ = material_of(tmp_path, '<bsdf type="thindielectric"/>')
    assert thin.double_sided and thin.transmission == 1.0
    blend, said = material_of(tmp_path, f'<bsdf type="blendbsdf"><float name="weight" value="0.25"/>{red}{blue}</bsdf>')
    np.testing.assert_allclose(blend.base_color[:3], [0.6, 0.2, 0.1])
    assert "blendbsdf" in said
    spots, _ = material_of(tmp_path, f'<bsdf type="blendbsdf">{paint.format("weight")}{red}{blue}</bsdf>')
    assert spots.base_color_texture is not None
    for kind, child in (("bumpmap", paint.format("arbitrary")), ("roughdiffuse", ""), ("coating", red)):
        inner = (
            red
            if kind == "bumpmap"
            else '<rgb name="reflectance" value="0.8 0.2 0"/>'
            if kind == "roughdiffuse"
            else ""
        )
        material, said = material_of(tmp_path, f'<bsdf type="{kind}">{child}{inner}</bsdf>')
        np.testing.assert_allclose(material.base_color[:3], [0.8, 0.2, 0.0], err_msg=kind)
        assert kind in said and material.clearcoat == (kind == "coating")
    bumps, said = material_of(tmp_path, f'<bsdf type="normalmap">{paint.format("normalmap")}{red}</bsdf>')
    assert bumps.normal_texture is not None
    thin, _ = material_of(tmp_path, '<bsdf type="principledthin"/>')
    assert thin.double_sided
    plastic, _ = material_of(tmp_path, '<bsdf type="pplastic"/>')
    assert plastic.metallic == 0.0
    air = scene_of(tmp_path, '<shape type="sphere"><bsdf type="null"/></shape><shape type="cube"/>')
    assert len(air.meshes) == 1 and "'null'" in " ".join(air.notes)
    hole, _ = material_of(tmp_path, f'<bsdf type="mask">{paint.format("opacity")}{red}</bsdf>')
    assert hole.blend and hole.base_color_texture is not None


def test_colours_of_vertices_play_a_part_where_they_are_named(tmp_path):
    """As in Mitsuba; elsewhere a PLY file's colours always do."""
    rows = ["-1 0.2 0", "1 0.2 0", "1 2 0", "-1 2 0"]
    head = "\n".join(f"property float {name}" for name in ("x", "y", "z", "r", "g", "b"))
    text = "\n".join(["ply", "format ascii 1.0", "element vertex 4", head, "element face 2",
                      "property list uchar int vertex_indices", "end_header", *(f"{row} 1 0 0" for row in rows),
                      "3 0 1 2", "3 0 2 3"])  # fmt: skip
    (tmp_path / "a.ply").write_text(text)
    shape = '<shape type="ply"><string name="filename" value="a.ply"/>{}</shape>'
    named = """<bsdf type="diffuse"><texture type="mesh_attribute" name="reflectance">
      <string name="name" value="vertex_color"/></texture></bsdf>"""
    assert scene_of(tmp_path, shape.format("")).meshes[0].colors is None
    painted = scene_of(tmp_path, shape.format(named))
    np.testing.assert_allclose(painted.meshes[0].colors[:, :3], [[1, 0, 0]] * len(painted.meshes[0].colors), atol=1e-6)
    assert painted.materials[0].base_color == (1.0, 1.0, 1.0, 1.0)


def test_what_a_bake_has_no_use_for_is_left_out(tmp_path):
    sensors = '<sensor type="perspective"><film type="hdrfilm"/><sampler type="independent"/></sensor>' * 3
    body = f"""<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>{sensors}
    <medium type="homogeneous" id="fog"><phase type="hg"/><volume type="gridvolume" name="albedo">
    <string name="filename" value="gone.vol"/></volume></medium>
    <shape type="cube"><ref name="interior" id="fog"/><subsurface type="dipole"/></shape>"""
    scene = scene_of(tmp_path, body)
    assert scene.triangles == 12
    notes = " ".join(scene.notes)
    assert "Integrator 'path' ignored" in notes and "Medium 'homogeneous' ignored" in notes and "Subsurface" in notes
    assert set(collect(tmp_path / "scene.xml").sources) == {"scene.xml"}


def test_a_cloud_of_spheres_has_fewer_triangles_each(tmp_path):
    ball = '<shape type="sphere"><float name="radius" value="0.1"/><point name="center" value="{} 0 0"/></shape>'
    few = scene_of(tmp_path, "".join(ball.format(i) for i in range(4)))
    many = scene_of(tmp_path, "".join(ball.format(i) for i in range(1024)))
    assert many.triangles < 20 * few.triangles and "1024 spheres" in " ".join(many.notes)


def test_a_view_is_spelt_as_mitsuba_0_5_does(tmp_path):
    look = '<lookAt origin="1 2 3" target="1 5 3" up="0 0 1"/>'
    body = f'<shape type="rectangle"><transform name="toWorld">{look}</transform></shape>'
    rectangle = scene_of(tmp_path, body, "0.5.0").meshes[0]
    np.testing.assert_allclose(rectangle.normals, np.tile([0.0, 1.0, 0.0], (len(rectangle.normals), 1)), atol=1e-6)
