"""docs/scene-input.md says the truth: each extension does what its line says, and each test that it names is there."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_workers.scene.gltf_extensions import HARMLESS, READ, SHADING_ONLY
from kiln_workers.scene.load import load_scene

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "scene-input.md").read_text()
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("| ")]
EXTENSIONS = {row[0]: row[1] for row in ROWS if re.fullmatch(r"(KHR|EXT)_\w+", row[0])}
FEATURES = [row for row in ROWS if len(row) == 3 and row[2].startswith("`")]
TRIANGLE = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]).tobytes()


def document(**more) -> str:
    uri = "data:application/octet-stream;base64," + base64.b64encode(TRIANGLE).decode()
    whole = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36, "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
    }
    return json.dumps(whole | more)


def test_the_page_lists_what_the_reader_knows():
    known = READ | HARMLESS | SHADING_ONLY
    assert len(EXTENSIONS) > 30 and len(FEATURES) > 15
    assert known - set(EXTENSIONS) == {"KHR_xmp"}  # the ancestor of KHR_xmp_json_ld
    for name, becomes in EXTENSIONS.items():
        verdict = becomes.split()[0].strip(",:;")
        where = {"exact": READ, "approximated": READ, "ignored": HARMLESS | SHADING_ONLY}.get(verdict)
        assert (name in where) if where else (verdict == "refused" and name not in known), (name, becomes)


@pytest.mark.parametrize("name", EXTENSIONS)
def test_an_extension_does_what_its_line_says(tmp_path, name):
    becomes = EXTENSIONS[name]
    (tmp_path / "used.gltf").write_text(document(extensionsUsed=[name]))
    notes = [note for note in load_scene(tmp_path, "used.gltf").notes if name in note]
    told = becomes == "ignored" or becomes.startswith("refused")
    assert bool(notes) == told, (becomes, notes)
    (tmp_path / "required.gltf").write_text(document(extensionsUsed=[name], extensionsRequired=[name]))
    if becomes.startswith("refused"):
        with pytest.raises(InputError, match=name):
            load_scene(tmp_path, "required.gltf")
    else:
        assert load_scene(tmp_path, "required.gltf").triangles == 1


@pytest.mark.parametrize("feature", FEATURES, ids=lambda row: row[0])
def test_the_test_that_holds_a_feature_is_there(feature):
    name = feature[2].strip("`")
    assert any(f"def {name}(" in path.read_text() for path in (ROOT / "tests").rglob("test_*.py")), name


def test_points_and_lines_are_noted(tmp_path):
    two = [{"primitives": [{"attributes": {"POSITION": 0}}, {"attributes": {"POSITION": 0}, "mode": 1}]}]
    (tmp_path / "a.gltf").write_text(document(meshes=two))
    scene = load_scene(tmp_path, "a.gltf")
    assert scene.triangles == 1 and "points or lines (1) ignored" in " ".join(scene.notes)


def test_animations_are_noted(tmp_path):
    (tmp_path / "a.gltf").write_text(document(animations=[{"channels": [], "samplers": []}]))
    assert "animations ignored" in " ".join(load_scene(tmp_path, "a.gltf").notes)


def test_khronos_tangents_change_nothing(tmp_path):
    """Neither tangents nor cameras make a note or another scene."""
    (tmp_path / "a.gltf").write_text(document())
    primitive = {"attributes": {"POSITION": 0, "TANGENT": 0}}
    camera = {"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}
    (tmp_path / "b.gltf").write_text(document(meshes=[{"primitives": [primitive]}], cameras=[camera]))
    plain, other = load_scene(tmp_path, "a.gltf"), load_scene(tmp_path, "b.gltf")
    assert not other.notes
    np.testing.assert_array_equal(plain.meshes[0].positions, other.meshes[0].positions)
