"""OBJ, MTL and PLY: polygons of any shape, opacity, laid-out maps, colours, and files from every kind of writer."""

import codecs

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_workers.scene.geometry import face_areas, face_normals
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.polygons import triangulated

NOTCH = [(-2, -2), (-0.5, -2), (-0.5, 1), (0.5, 1), (0.5, -2), (2, -2), (2, 2), (-2, 2)]
STAR = [(np.cos(a) * r, np.sin(a) * r) for a, r in zip(np.arange(10) * np.pi / 5, [2, 0.7] * 5, strict=True)]
ARROW = [(0, 0), (2, -1), (0, 3), (-2, -1)]
# A square with a square hole, joined by a bridge that is walked there and back.
HOLED = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
TILTS = [np.eye(3), np.eye(3)[[2, 0, 1]], np.linalg.qr(np.array([[1.0, 2, 0], [0, 1, 3], [1, 0, 1]]))[0]]
SHAPES = {"notch": NOTCH, "star": STAR, "arrow": ARROW, "hole": HOLED, "square": [(0, 0), (1, 0), (1, 1), (0, 1)]}


def shoelace(points) -> float:
    x, y = np.array(points, float).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def inside(points, at) -> np.ndarray:
    """Even-odd rule for points [P, 2]."""
    x, y = np.array(points, float).T
    x2, y2 = np.roll(x, -1), np.roll(y, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = (y > at[:, 1:]) != (y2 > at[:, 1:])
        left = at[:, :1] < (x2 - x) * (at[:, 1:] - y) / (y2 - y) + x
    return (cross & left).sum(axis=1) % 2 == 1


@pytest.mark.parametrize(
    "tilt",
    [
        np.eye(3),
        np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        np.linalg.qr(np.array([[1.0, 2, 0], [0, 1, 3], [1, 0, 1]]))[0],
    ],
)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("reverse", [False, True])
def test_polygons_cover_what_they_enclose(shape, tilt, reverse):
    points = np.array(SHAPES[shape][::-1] if reverse else SHAPES[shape], float)
    placed = np.column_stack([points, np.zeros(len(points))]) @ tilt.T + 5.0
    faces = triangulated(placed, np.array([len(points)]))
    assert face_areas(placed, faces).sum() == pytest.approx(abs(shoelace(points)))
    sound = face_areas(placed, faces) > 1e-9
    normal = tilt @ [0, 0, np.sign(shoelace(points))]
    np.testing.assert_allclose(face_normals(placed, faces)[sound], np.tile(normal, (sound.sum(), 1)), atol=1e-6)
    centres = points[faces[sound]].mean(axis=1)
    assert inside(points, centres).all()


@pytest.mark.parametrize("name", ["poly.obj", "quads.obj"])
def test_a_ceiling_with_a_notch_lets_light_through_the_notch(irradiance_in, name):
    """As one polygon and as three quads; 3.898, 4.113, 1.521 by the same bake of the quads, at more samples."""
    found = irradiance_in(name, [[0, 0, -1], [0, 0, 0], [1.5, 0, -1]])[:, 0]
    np.testing.assert_allclose(found, [3.898, 4.113, 1.521], rtol=0.04)


def test_one_polygon_is_the_same_as_its_quads(irradiance_in):
    points = [[0, 0, -1], [0, 0, 0], [1.5, 0, -1]]
    np.testing.assert_allclose(irradiance_in("poly.obj", points), irradiance_in("quads.obj", points), rtol=1e-3)


@pytest.mark.parametrize("name", ["d.obj", "map_d.obj"])
def test_a_pane_of_no_opacity_holds_back_no_light(irradiance_in, name):
    np.testing.assert_allclose(irradiance_in(name, [[0, 0, 0]]), 2.308, rtol=0.01)


@pytest.mark.parametrize(
    "key,value,right", [("d", 0.2, 1.846), ("d", 0.6, 0.923), ("Tr", 0.8, 1.846), ("d -halo", 1, 0)]
)
def test_opacity_is_a_fraction(irradiance, data, tmp_path, key, value, right):
    """(1 - alpha) x 2.308, whichever statement says it."""
    for name in ("d.obj", "d.mtl"):
        (tmp_path / name).write_text((data / name).read_text().replace("\nd 0.0", f"\n{key} {value}"))
    np.testing.assert_allclose(irradiance(load_scene(tmp_path, "d.obj"), [[0, 0, 0]]), right, rtol=0.015, atol=1e-3)


def test_a_map_is_laid_out_as_its_options_say(irradiance_in):
    """`map_Ke -s 8 8 1`: 3.720 and 3.319 by quadrature over the small squares."""
    found = irradiance_in("tiled.obj", [[-0.5, 0, 0.5], [0.5, 0, -0.5]])[:, 0]
    np.testing.assert_allclose(found, [3.720, 3.319], rtol=0.015)


TEXTURED = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"


@pytest.mark.parametrize(
    "line,offset,scale,wrap",
    [
        ("a.png", (0, 0), (1, 1), "repeat"),
        ("-s 2 3 1 a.png", (0, -2), (2, 3), "repeat"),
        ("-o 0.25 0.5 a.png", (0.25, -0.5), (1, 1), "repeat"),
        ("-clamp on -s 2 a.png", (0, 0), (2, 1), "clamp"),
        ("-mm 0 1 -blendu off -texres 64 -bm 0.5 -o 0.25 a.png", (0.25, 0), (1, 1), "repeat"),
        ("-s 2 2 2 two words.png", (0, -1), (2, 2), "repeat"),
    ],
)
def test_options_of_map_statements(tmp_path, write_png, line, offset, scale, wrap):
    """At (u, v), v upwards, the image is read at (u, v) s + o."""
    for name in ("a.png", "two words.png"):
        write_png(tmp_path / name, np.full((2, 2, 3), 9, np.uint8))
    (tmp_path / "a.obj").write_text(TEXTURED)
    (tmp_path / "a.mtl").write_text(f"newmtl m\nmap_Kd {line}\n")
    scene = load_scene(tmp_path, "a.obj")
    reference = scene.materials[0].base_color_texture
    assert (reference.offset, reference.scale, reference.wrap) == (offset, scale, (wrap, wrap))


def test_what_a_library_says_and_nobody_reads_is_named(tmp_path):
    (tmp_path / "a.obj").write_text(TEXTURED)
    (tmp_path / "a.mtl").write_text("newmtl m\nillum 2\nKa 1 1 1\nmap_Bump a.png\nrefl x.png\n")
    (note,) = load_scene(tmp_path, "a.obj").notes
    assert note == "Material 'm': map_bump, refl ignored."


def test_map_d_is_the_alpha_of_the_colour(tmp_path, write_png):
    write_png(tmp_path / "c.png", np.full((2, 2, 3), 255, np.uint8))
    cover = np.array([[[0], [51]], [[102], [255]]], np.uint8)
    write_png(tmp_path / "d.png", np.repeat(np.repeat(cover, 2, 0), 2, 1))
    (tmp_path / "a.obj").write_text(TEXTURED)
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd c.png\nmap_d d.png\n")
    scene = load_scene(tmp_path, "a.obj")
    material = scene.materials[0]
    pixels = scene.images[material.base_color_texture.image].pixels
    assert material.blend
    np.testing.assert_allclose(pixels[::2, ::2, 3], cover[..., 0] / 255, atol=1e-6)
    np.testing.assert_allclose(pixels[..., :3], 1.0)


def test_colours_of_obj_vertices_tint(tmp_path):
    """sRGB 0.5 is 0.214 linear; vertices without a colour are white."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0 1 0.5 0\nv 0 1 0\nf 1 2 3\n")
    scene = load_scene(tmp_path, "a.obj")
    mesh = scene.meshes[0]
    red = mesh.colors[mesh.positions[:, 0] == 1.0]
    np.testing.assert_allclose(red, [[1.0, 0.21404, 0.0, 1.0]], atol=1e-4)
    np.testing.assert_allclose(mesh.colors[mesh.positions[:, 0] == 0.0], 1.0)
    assert scene.materials[0].base_color == (1.0, 1.0, 1.0, 1.0)


@pytest.mark.parametrize("mark,encoding", [(codecs.BOM_UTF8, "utf-8"), (b"", "utf-16")])
def test_byte_order_marks_and_tabs(tmp_path, mark, encoding):
    text = "v\t0 0 0\nv 1 0 0\nv 0 1 0\nf\t1 2 3\n"
    (tmp_path / "a.obj").write_bytes(mark + text.encode(encoding))
    assert load_scene(tmp_path, "a.obj").triangles == 1


HEAD = "ply\nformat {form} 1.0\ncomment made by hand\nelement vertex 5\n"
HEAD += "property double x\nproperty float y\nproperty float z\n"
HEAD += "property uchar red\nproperty uchar green\nproperty uchar blue\n"
HEAD += "element face 3\nproperty list uchar int vertex_indices\nproperty uchar flags\nend_header\n"
PLY_POINTS = [(0, 0, 0), (2, -1, 0), (0, 3, 0), (-2, -1, 0), (0, 9, 0)]
PLY_FACES = [(0, 1, 2, 3), (0, 1, 2), (1, 4)]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_with_faces_of_every_size_and_colours(tmp_path, form):
    """A concave quad, a triangle and an edge in one file, which general readers refuse in binary."""
    order = ">" if "big" in form else "<"
    data = HEAD.format(form=form).encode()
    for point in PLY_POINTS:
        if form == "ascii":
            data += " ".join(map(str, (*point, 255, 188, 0))).encode() + b"\n"
        else:
            data += (
                np.array(point[0], order + "f8").tobytes() + np.array(point[1:], order + "f4").tobytes() + b"\xff\xbc\0"
            )
    for face in PLY_FACES:
        row = (len(face), *face, 7)
        if form == "ascii":
            data += " ".join(map(str, row)).encode() + b"\n"
        else:
            data += bytes([len(face)]) + np.array(face, order + "i4").tobytes() + b"\7"
    (tmp_path / "a.ply").write_bytes(codecs.BOM_UTF8 + data if form == "ascii" else data)
    scene = load_scene(tmp_path, "a.ply")
    mesh = scene.meshes[0]
    assert face_areas(mesh.positions, mesh.faces).sum() == pytest.approx(shoelace(ARROW) + 3.0)
    np.testing.assert_allclose(mesh.colors, np.tile([1.0, 0.5029, 0.0, 1.0], (len(mesh.colors), 1)), atol=1e-4)


@pytest.mark.parametrize(
    "change,says",
    [
        (("element face 3", "element face 900000000"), "900000000 rows of face"),
        (("uchar flags", "quad flags"), "a line of its header is not understood"),
        (("format ascii", "comment ascii"), "names no format"),
        (("element vertex", "element point"), "no vertices with x, y and z"),
        (("\n3 0 1 2 7", "\n3 0 1 8 7"), "names vertex 8 of 5"),
        (("\n3 0 1 2 7", "\n99 0 1 2 7"), "a row is cut off"),
    ],
)
def test_broken_ply_is_refused_by_name(tmp_path, change, says):
    body = "".join(f"{x} {y} {z} 1 2 3\n" for x, y, z in PLY_POINTS) + "4 0 1 2 3 7\n3 0 1 2 7\n2 1 4 7\n"
    text = HEAD.format(form="ascii") + body
    (tmp_path / "a.ply").write_text(text.replace(*change))
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path, "a.ply")
