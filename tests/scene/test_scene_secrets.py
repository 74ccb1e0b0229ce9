"""A file that is no scene, or a damaged one, is refused without being quoted: errors travel to jobs, logs and mails."""

from pathlib import Path

import pytest

from kiln_schemas.errors import InputError
from kiln_schemas.text import QUOTE_LENGTH
from kiln_workers.scene.load import load_scene

SECRET = "hunter2-correct-horse-battery"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.obj", f"v 0 0 {SECRET}\n"),
        ("a.obj", f"f {SECRET}\n"),
        ("a.obj", f"v 0 0 0\nf 1/{SECRET} 2 3\n"),
        ("a.ply", f"{SECRET}\n"),
        ("a.ply", f"ply\nformat ascii 1.0\nelement vertex {SECRET}\nend_header\n"),
        ("a.ply", f"ply\nformat ascii 1.0\nelement vertex 1\nproperty {SECRET} x\nend_header\n1\n"),
        ("a.ply", f"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n{SECRET}\n"),
        ("a.gltf", SECRET),
        ("a.gltf", f'{{"asset": "{SECRET}"}}'),
        ("a.glb", f"glTF{SECRET}"),
        ("a.xml", SECRET),
    ],
)
def test_a_file_that_is_none_of_its_format_is_not_quoted(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        load_scene(tmp_path, name)
    assert SECRET not in str(caught.value) and caught.value.where == name


def test_a_material_library_is_not_quoted(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "a.mtl").write_text(f"newmtl m\nKd {SECRET}\n")
    with pytest.raises(InputError, match="'Kd' is not one or three numbers") as caught:
        load_scene(tmp_path, "a.obj")
    assert SECRET not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.xml", "<scene><{0}/></scene>"),
        ("a.xml", "<{0}/>"),
        ("a.xml", '<scene><shape type="{0}"/></scene>'),
        ("a.xml", '<scene><shape type="sphere"><float name="radius" value="{0}"/></shape></scene>'),
        ("a.xml", '<scene><shape type="sphere"><ref id="{0}"/></shape></scene>'),
        ("a.xml", '<?xml version="1.0" encoding="{0}"?><scene/>'),
        ("a.gltf", '{{"asset": {{"version": "{0}"}}}}'),
    ],
)
def test_a_value_is_quoted_in_short(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text.format("x" * 3000))
    with pytest.raises(InputError) as caught:
        load_scene(tmp_path, name)
    assert "x" * (2 * QUOTE_LENGTH + 1) not in str(caught.value)


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.gltf", "a.glb", "a.xml"])
def test_a_reader_follows_no_link_out_of_the_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret").write_text(SECRET)
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / name).symlink_to("../secret")
    with pytest.raises(InputError, match="link that leaves the bundle"):
        load_scene(folder, name)
