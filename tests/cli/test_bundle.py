"""Collecting a scene's files: everything that is referenced, nothing else, nothing from outside."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from watched_folder import watched

from kiln_schemas.errors import InputError
from kiln_schemas.files import open_inside
from kiln_service.cli.bundle import collect


def files(path: Path, **options) -> dict[str, str]:
    return collect(path, **options).bundle.files


def test_a_gltf_brings_its_buffers_and_images_and_nothing_else(scene: Path) -> None:
    local = collect(scene)
    assert set(local.bundle.files) == {"triangle.gltf", "triangle.bin", "my textures/red.png"}
    assert local.bundle.entry == "triangle.gltf" and local.bundle.environment is None
    for name, sha256 in local.bundle.files.items():
        assert hashlib.sha256((scene.parent / name).read_bytes()).hexdigest() == sha256
        assert local.by_hash()[sha256].read_bytes() == (scene.parent / name).read_bytes()


def test_the_working_folder_does_not_matter(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    absolute = collect(scene).bundle
    monkeypatch.chdir(scene.parent)
    assert collect(Path(scene.name)).bundle == absolute


def test_a_glb_alone(lit_glb: Path) -> None:
    assert set(files(lit_glb)) == {"lit.glb"}


def test_an_obj_brings_its_material_libraries_and_their_maps(tmp_path: Path) -> None:
    (tmp_path / "mats").mkdir()
    (tmp_path / "tex").mkdir()
    (tmp_path / "a.obj").write_text("mtllib mats/first.mtl mats/second.mtl\nmtllib third one.mtl\nv 0 0 0\n")
    (tmp_path / "mats/first.mtl").write_text("newmtl a\nmap_Kd -s 1 1 1 -bm 0.5 ../tex/wood floor.png\n")
    (tmp_path / "mats/second.mtl").write_text("newmtl b\nnorm -clamp on ../tex/n.png\n# map_Kd ../tex/unused.png\n")
    (tmp_path / "third one.mtl").write_text("newmtl c\nKd 1 1 1\n")
    for name in ("wood floor.png", "n.png"):
        (tmp_path / "tex" / name).write_bytes(name.encode())
    assert set(files(tmp_path / "a.obj")) == {
        "a.obj",
        "mats/first.mtl",
        "mats/second.mtl",
        "third one.mtl",
        "tex/wood floor.png",
        "tex/n.png",
    }


def test_a_mitsuba_scene_brings_its_file_names_with_variables_filled_in(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/cup.ply").write_bytes(b"ply")
    (tmp_path / "sky.exr").write_bytes(b"exr")
    (tmp_path / "a.xml").write_text(
        '<scene version="3.0.0"><default name="folder" value="meshes"/>'
        '<shape type="ply"><string name="filename" value="$folder/cup.ply"/></shape>'
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
        '<bsdf type="diffuse"><string name="id" value="not-a-file"/></bsdf></scene>'
    )
    assert set(files(tmp_path / "a.xml")) == {"a.xml", "meshes/cup.ply", "sky.exr"}


@pytest.mark.parametrize("declaration", ["<!DOCTYPE scene [<!ENTITY a 'b'>]>", "<!DOCTYPE scene SYSTEM 'x.dtd'>"])
def test_xml_with_entities_is_refused(tmp_path: Path, declaration: str) -> None:
    (tmp_path / "a.xml").write_text(f"<?xml version='1.0'?>{declaration}<scene/>")
    with pytest.raises(InputError, match="entities are refused"):
        collect(tmp_path / "a.xml")


def test_an_environment_from_elsewhere_gets_a_place_of_its_own(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "sky.exr").write_bytes(b"sky")
    bundle = collect(scene, tmp_path / "sky.exr", scale=2.0, rotation_deg=90.0).bundle
    assert bundle.environment is not None
    assert bundle.environment.file == "environment/sky.exr"
    assert (bundle.environment.scale, bundle.environment.rotation_deg) == (2.0, 90.0)
    assert bundle.files["environment/sky.exr"] == hashlib.sha256(b"sky").hexdigest()


def test_an_environment_in_the_scene_s_folder_keeps_its_name(scene: Path) -> None:
    (scene.parent / "sky.hdr").write_bytes(b"sky")
    bundle = collect(scene, scene.parent / "sky.hdr").bundle
    assert bundle.environment is not None and bundle.environment.file == "sky.hdr"


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "a/../../secret.bin", "/etc/hostname", "%2e%2e/secret.bin", "..\\secret.bin", "C:/x.bin"]
)
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, uri: str) -> None:
    (tmp_path / "secret.bin").write_bytes(b"secret")
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "a.gltf").write_text(json.dumps({"buffers": [{"uri": uri}]}))
    with pytest.raises(InputError, match="leaves the scene's folder") as caught:
        collect(folder / "a.gltf")
    assert caught.value.where == "a.gltf"


def test_a_link_that_leaves_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(b"secret")
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "inside.bin").symlink_to(tmp_path / "secret.bin")
    (folder / "a.gltf").write_text(json.dumps({"buffers": [{"uri": "inside.bin"}]}))
    with pytest.raises(InputError, match="link that leaves"):
        collect(folder / "a.gltf")


def test_a_missing_file_is_named_with_the_file_that_wants_it(scene: Path) -> None:
    (scene.parent / "my textures" / "red.png").unlink()
    with pytest.raises(InputError, match=r"triangle\.gltf: the file 'my textures/red\.png' is missing"):
        collect(scene)


def test_a_map_missing_from_a_material_library_names_the_library(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n")
    (tmp_path / "a.mtl").write_text("map_Kd gone.png\n")
    with pytest.raises(InputError, match=r"a\.mtl: the file 'gone\.png' is missing"):
        collect(tmp_path / "a.obj")


def test_a_missing_material_library_is_left_to_the_reader_who_uses_defaults(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib gone.mtl here.mtl\n")
    (tmp_path / "here.mtl").write_text("newmtl red\n")
    assert set(files(tmp_path / "a.obj")) == {"a.obj", "here.mtl"}


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.gltf", b"{"), ("a.gltf", b"\xff\xfe"), ("a.glb", b"glTF"), ("a.glb", b"x" * 64), ("a.xml", b"<scene>")],
)
def test_broken_files_are_named(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        collect(tmp_path / name)
    assert caught.value.where == name


@pytest.mark.parametrize("document", ["[]", '{"buffers": 3}', '{"images": [7, {"uri": 7}]}'])
def test_odd_gltf_is_left_to_the_worker(tmp_path: Path, document: str) -> None:
    (tmp_path / "a.gltf").write_text(document)
    assert set(files(tmp_path / "a.gltf")) == {"a.gltf"}


def test_other_formats_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.max").write_bytes(b"")
    with pytest.raises(InputError, match=r"'\.max' is not a scene format.*glTF"):
        collect(tmp_path / "a.max")
    (tmp_path / "a.odd").write_bytes(b"")
    with pytest.raises(InputError, match=r"'\.odd' is not a scene format.*\.glb"):
        collect(tmp_path / "a.odd")


SECRET = b"root:x:0:0:the secret of somebody else\n"


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    """A scene's folder beside a file that is none of its author's."""
    (tmp_path / "secret").write_bytes(SECRET)
    (tmp_path / "secrets").mkdir()
    (tmp_path / "secrets" / "a.mtl").write_bytes(b"newmtl a\nmap_Kd wood.png\n")
    folder = tmp_path / "scene"
    (folder / "inner").mkdir(parents=True)
    return folder


@pytest.mark.parametrize("name", ["room.ply", "room.obj", "room.gltf", "room.glb", "room.xml"])
@pytest.mark.parametrize("absolute", [False, True])
def test_an_entry_that_is_a_link_out_of_its_folder_is_refused(shared: Path, name: str, absolute: bool) -> None:
    (shared / name).symlink_to(shared.parent / "secret" if absolute else "../secret")
    with watched(shared.parent) as watch:
        with pytest.raises(InputError, match="link that leaves the scene's folder") as caught:
            collect(shared / name)
        assert not [act for act in watch.acts() if "secret" in act]
    assert "root:x" not in str(caught.value)


def test_an_entry_may_be_a_link_within_its_folder(shared: Path) -> None:
    (shared / "versions").mkdir()
    (shared / "versions" / "3.obj").write_text("v 0 0 0\n")
    (shared / "room.obj").symlink_to("inner/../versions/3.obj")
    assert files(shared / "room.obj") == {"room.obj": hashlib.sha256(b"v 0 0 0\n").hexdigest()}


@pytest.mark.parametrize(
    ("entry", "text", "link", "target"),
    [
        ("a.gltf", '{"images": [{"uri": "i.png"}]}', "i.png", "../secret"),
        ("a.gltf", '{"buffers": [{"uri": "sub/b.bin"}]}', "sub", "../secrets"),
        ("a.gltf", '{"buffers": [{"uri": "b.bin"}]}', "b.bin", "inner/../../secret"),
        ("a.obj", "mtllib a.mtl\n", "a.mtl", "../secrets/a.mtl"),
        ("a.obj", "mtllib sub/a.mtl\n", "sub", "../secrets"),
        ("a.xml", '<scene><include filename="b.xml"/></scene>', "b.xml", "../secret"),
        ("a.xml", '<scene><string name="filename" value="m.ply"/></scene>', "m.ply", "../secret"),
    ],
)
def test_no_reference_follows_a_link_out_of_the_folder(
    shared: Path, entry: str, text: str, link: str, target: str
) -> None:
    (shared / entry).write_text(text)
    (shared / link).symlink_to(target)
    (shared.parent / "secrets" / "b.bin").write_bytes(SECRET)
    with pytest.raises(InputError, match="link that leaves") as caught:
        collect(shared / entry)
    assert "root:x" not in str(caught.value)


@pytest.mark.parametrize("inside", [True, False])
def test_an_environment_that_is_a_link_out_of_its_folder_is_refused(shared: Path, inside: bool) -> None:
    (shared / "a.obj").write_text("v 0 0 0\n")
    folder = shared if inside else shared.parent / "skies"
    folder.mkdir(exist_ok=True)
    (folder / "sky.exr").symlink_to("../secret")
    with pytest.raises(InputError, match="link that leaves"):
        collect(shared / "a.obj", folder / "sky.exr")


@pytest.mark.parametrize(
    ("entry", "text", "pipe"),
    [
        ("a.obj", "", "a.obj"),
        ("a.gltf", '{"images": [{"uri": "i.png"}]}', "i.png"),
        ("a.xml", '<scene><include filename="b.xml"/></scene>', "b.xml"),
    ],
)
def test_a_pipe_is_refused_and_not_waited_for(shared: Path, entry: str, text: str, pipe: str) -> None:
    (shared / entry).write_text(text)
    (shared / pipe).unlink(missing_ok=True)
    os.mkfifo(shared / pipe)
    with pytest.raises(InputError, match="not a regular file"):
        collect(shared / entry)


def test_a_mitsuba_scene_brings_what_it_includes(shared: Path) -> None:
    (shared / "a.xml").write_text(
        '<scene><default name="part" value="inner"/>'
        '<include filename="$part/b.xml"/><include filename="a.xml"/></scene>'
    )
    (shared / "inner" / "b.xml").write_text('<scene><string name="filename" value="m.ply"/></scene>')
    (shared / "inner" / "m.ply").write_bytes(b"ply")
    assert set(files(shared / "a.xml")) == {"a.xml", "inner/b.xml", "inner/m.ply"}


def test_a_file_that_becomes_a_link_after_it_was_collected_is_not_uploaded(shared: Path) -> None:
    (shared / "a.obj").write_text("v 0 0 0\n")
    local = collect(shared / "a.obj")
    (shared / "a.obj").unlink()
    (shared / "a.obj").symlink_to("../secret")
    with pytest.raises(InputError, match="link that leaves"):
        local.open(local.bundle.files["a.obj"])


def test_a_race_for_a_component_never_opens_what_lies_outside(shared: Path) -> None:
    """Another process exchanges a folder for a link, again and again; what is opened is the folder's or an error."""
    (shared / "inner" / "secret").write_bytes(b"inside")
    (shared / "link").symlink_to("..")
    program = (
        "import ctypes, os, sys\n"
        "swap = ctypes.CDLL(None).renameat2\n"
        "while True:\n"
        "    swap(-100, b'inner', -100, b'link', 2)\n"  # RENAME_EXCHANGE
    )
    opened = refused = 0
    with subprocess.Popen([sys.executable, "-c", program], cwd=shared) as racer:
        try:
            while opened < 500 or refused < 500:
                try:
                    with open_inside(shared, "inner/secret") as file:
                        assert file.read() == b"inside"
                    opened += 1
                except OSError:
                    refused += 1
        finally:
            racer.kill()
