"""Gates and cameras as words of a command line, and what is written of them as JUnit XML."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from kiln_schemas.camera import Camera
from kiln_schemas.errors import GateFailed, InputError, KilnError
from kiln_schemas.gates import GateResult, Gates, gate_problem, read_cameras, read_gates
from kiln_schemas.junit import junit

FRONT = Camera(position=(0, 1, 3), target=(0, 1, 0), fov_deg=42)


def test_words_are_read(tmp_path: Path) -> None:
    words = ["log_mse_rel=0.2", "flip.front=0.5", "visibility_log_mse_rel=5e-2", "flip.a.b=1", "flip.front=0.08"]
    gates = read_gates(words)
    assert gates == Gates(log_mse_rel=0.2, visibility_log_mse_rel=0.05, flip={"front": 0.08, "a.b": 1.0})
    assert list(gates.thresholds()) == ["log_mse_rel", "visibility_log_mse_rel", "flip.front", "flip.a.b"]
    assert read_gates(()).thresholds() == {}
    (tmp_path / "b=c.json").write_text(FRONT.model_dump_json())
    assert read_cameras(["front=0,1,3:0,1,0:42", f"file={tmp_path}/b=c.json"]) == {"front": FRONT, "file": FRONT}


@pytest.mark.parametrize(
    ("word", "why"),
    [
        ("log_mse=1", "'log_mse' is not a gate"),
        ("flip=0.1", "'flip' is not a gate"),
        ("=0.1", "'' is not a gate"),
        ("log_mse_rel", "'' is not a number"),
        ("log_mse_rel=low", "'low' is not a number"),
        ("log_mse_rel=0", "greater than 0"),
        ("log_mse_rel=nan", "finite"),
        ("flip.a=2", "less than or equal to 1"),
        ("flip.=0.1", "pattern"),
        ("flip.a/b=0.1", "pattern"),
    ],
)
def test_gates_that_are_refused(word: str, why: str) -> None:
    with pytest.raises(InputError) as caught:
        read_gates(["log_mse_rel=0.2", word])
    assert why in caught.value.detail and caught.value.where == f"--gate {word}" and "flip.CAMERA" in str(caught.value)


@pytest.mark.parametrize(
    ("word", "why"),
    [
        ("0,0,0:1,1,1:40", "has no name"),
        ("a=", "cannot be read"),
        ("a=0,0,0:0,0,0:40", "coincide"),
        ("a=0,0,0:0,5,0:40", "along"),
        ("a=0,0,0:2e7,0,0:40", "target.0"),
        ("a=0,0,0:1,1,1:180", "fov_deg"),
        ("a=0,0:1,1,1:40", "position"),
        ("a=0,0,inf:1,1,1:40", "position"),
        ("a b=0,0,0:1,1,1:40", "pattern"),
    ],
)
def test_cameras_that_are_refused(word: str, why: str) -> None:
    with pytest.raises(InputError) as caught:
        read_cameras([word])
    assert why in str(caught.value) and str(caught.value.where).startswith("--camera")


def test_a_missed_gate_is_an_error_of_its_own() -> None:
    met, missed = GateResult.of("log_mse_rel", 0.2, 0.2), GateResult.of("flip.front", 0.2, 0.1, noise_floor=0.03)
    assert gate_problem([met]) is None
    problem = gate_problem([met, missed])
    assert problem is not None and problem.code == "gate-failed"
    assert problem.detail == "flip.front is 0.2, more than the threshold 0.1 (noise of the reference: 0.03)"
    error = KilnError.from_problem(problem)
    assert isinstance(error, GateFailed) and error.exit_code == 8


def test_any_name_is_written_as_xml() -> None:
    """Also one with characters that XML has no way to write."""
    suite = ElementTree.fromstring(
        junit('<a> & "b" \x00\x1f\uffff \U0001f9ea', [GateResult.of("log_mse_rel", 0.1, 0.2)])
    )
    assert suite.get("name") == '<a> & "b" ??? \U0001f9ea'
    assert suite[0].get("classname") == f"lightkiln.{suite.get('name')}"
