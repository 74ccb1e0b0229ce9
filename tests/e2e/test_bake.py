"""`lightkiln bake` on a real scene: whole packages, errors that other code confirms, interruption and resumption."""

import hashlib
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import recompute
from e2e_farm import digests, lightkiln, settings, wait_until

from kiln_workers.package import ktx2_validate

TEXTURES = ("lightfield.ktx2", "visibility.ktx2", "irradiance.ktx2", "environment_ggx.ktx2", "environment_u.ktx2")


def test_package_is_whole(baked: Path) -> None:
    manifest = json.loads((baked / "manifest.json").read_text())
    listed = {entry["name"]: entry for entry in manifest["files"]}
    assert {*TEXTURES, "irradiance.exr", "environment.exr", "scene.glb", "report.html"} <= listed.keys()
    for name, entry in listed.items():
        data = (baked / name).read_bytes()
        assert (hashlib.sha256(data).hexdigest(), len(data)) == (entry["sha256"], entry["size"]), name
    for name in TEXTURES:
        assert ktx2_validate.validate((baked / name).read_bytes()) == [], name
    assert manifest["overflows"] == 0
    assert set(manifest["stage_seconds"]) == {
        "prepare",
        "render",
        "fit light_field",
        "fit visibility",
        "refine",
        "package",
    }


@pytest.mark.parametrize(("function", "bound"), [("light_field", 0.4), ("visibility", 0.1)])
def test_errors_are_confirmed_by_other_code(baked: Path, function: str, bound: float) -> None:
    """From the KTX2 file and the Zarr store alone, sharing no code with lightkiln."""
    (store,) = (baked / ".lightkiln" / "store").iterdir()
    log_mse, log_mse_zero, log_mse_rel = recompute.recompute(baked, store, function)
    stated = json.loads((baked / "manifest.json").read_text())["metrics"][function]
    assert stated["log_mse"] == pytest.approx(log_mse, rel=1e-3)
    assert stated["log_mse_zero"] == pytest.approx(log_mse_zero, rel=1e-3)
    assert stated["log_mse_rel"] == pytest.approx(log_mse_rel, rel=1e-3)
    assert 0.0 < log_mse_rel < bound


def test_same_call_again_has_nothing_to_do(baked: Path, room_files: tuple[Path, Path]) -> None:
    scene, environment = room_files
    flags = ["--env", environment, "--preset", "draft", *settings(), "--out", baked]
    again = lightkiln("bake", scene, *flags, "--json")
    assert again.returncode == 0 and json.loads(again.stdout)["already_done"] is True
    other = lightkiln("bake", scene, *flags, "--set", "seed=1", "--json")
    assert other.returncode == 4 and json.loads(other.stdout)["code"] == "conflict"


def hear_ctrl_c() -> None:
    """A shell starts what is in the background deaf to SIGINT, and children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_interrupted_bake_resumes_to_the_same_bytes(baked: Path, room_files: tuple[Path, Path], folder: Path) -> None:
    """Ctrl-C while tiles render: exit 130, nothing that looks like a result, then --resume."""
    scene, environment = room_files
    out = folder / "out"
    command = [Path(sys.executable).with_name("lightkiln"), "bake", scene, "--env", environment, "--preset", "draft"]
    running = subprocess.Popen(
        [*command, *settings(), "--out", out], stderr=subprocess.PIPE, text=True, preexec_fn=hear_ctrl_c
    )
    log = out / ".lightkiln" / "logs" / "worker-1.log"
    store = out / ".lightkiln" / "store"
    wait_until("the first tile is written", lambda: any(store.glob("*.zarr/light_field/c/*/*/*")) and log.exists())
    running.send_signal(signal.SIGINT)
    _, messages = running.communicate(timeout=600)
    assert running.returncode == 130, messages
    assert "--resume" in messages and "Traceback" not in messages
    assert not (out / "manifest.json").exists()

    done = lightkiln("bake", "--resume", "--out", out)
    assert done.returncode == 0, done.stderr
    assert digests(out) == digests(baked)
    assert not (out / ".lightkiln").exists()


def test_no_environment_leaves_the_visibility_out(room_files: tuple[Path, Path], folder: Path) -> None:
    # Without the sky only the small lamp is left, which takes more steps to find.
    flags = ["--preset", "draft", *settings("fit.refine_steps=600"), "--out", folder / "out", "--json"]
    done = lightkiln("bake", room_files[0], *flags)
    assert done.returncode == 0, done.stdout + done.stderr
    manifest = json.loads((folder / "out" / "manifest.json").read_text())
    assert manifest["metrics"]["visibility"] is None
    assert "no environment" in manifest["left_out"]["visibility"]
    assert not (folder / "out" / "visibility.ktx2").exists()
    assert manifest["metrics"]["light_field"]["log_mse_rel"] < 0.4
