"""What this machine can do as a worker, as a list of checks with remedies; the worker's half of `lightkiln doctor`.

Everything that may abort runs in a subprocess (`probe`), so the answer is a sentence whatever happens.
"""

import json
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from typing import Any, Final, Literal

from kiln_schemas.base import Contract
from kiln_schemas.errors import MachineLacks
from kiln_workers.render.backend import LLVM_REMEDY, OLDEST_LLVM, find_llvm
from kiln_workers.runner.machine import cores, memory_bytes

PROBE_TIMEOUT_S: Final = 180
GIB: Final = 1 << 30
MEMORY_WANTED: Final = 2 * GIB
DISK_WANTED: Final = 2 * GIB
PYTHON_WANTED: Final = (3, 11)


class Check(Contract):
    """One finding."""

    name: str
    status: Literal["ok", "warn", "fail"]
    detail: str
    remedy: str | None = None


def examine() -> list[Check]:
    """All checks of the worker's side, the cheap ones first."""
    renderer = _probe("renderer")
    return [_python(), _cores(), _memory(), _disk(), _llvm(), _renderer(renderer), _network(), _cuda(renderer)]


def _python() -> Check:
    version = platform.python_version()
    if sys.version_info[:2] < PYTHON_WANTED:
        return Check(name="python", status="fail", detail=version, remedy="Install Python 3.11 or newer.")
    return Check(name="python", status="ok", detail=f"{version}, {sys.executable}")


def _cores() -> Check:
    return Check(name="cores", status="ok", detail=f"{cores()} usable, {platform.machine()}")


def _memory() -> Check:
    have = memory_bytes()
    detail = f"{have / GIB:.1f} GiB"
    if have < MEMORY_WANTED:
        return Check(
            name="memory", status="warn", detail=detail, remedy="Bake with small settings, or use a machine with 2 GiB."
        )
    return Check(name="memory", status="ok", detail=detail)


def _disk() -> Check:
    folder = tempfile.gettempdir()
    free = shutil.disk_usage(folder).free
    detail = f"{free / GIB:.1f} GiB free in {folder}"
    if free < DISK_WANTED:
        return Check(
            name="scratch", status="warn", detail=detail, remedy="Free space there, or start workers with --scratch."
        )
    return Check(name="scratch", status="ok", detail=detail)


def _llvm() -> Check:
    try:
        llvm = find_llvm()
    except MachineLacks as lack:
        return Check(name="libLLVM", status="fail", detail=str(lack.detail), remedy=lack.remedy)
    return Check(name="libLLVM", status="ok", detail=f"version {llvm.version}, {llvm.path}")


def _renderer(found: dict[str, Any]) -> Check:
    if found["works"]:
        detail = f"mitsuba {found['mitsuba']}, drjit {found['drjit']}, {found['variant']}"
        return Check(name="renderer", status="ok", detail=detail)
    return _failed("renderer", found, f"libLLVM {OLDEST_LLVM} or newer is needed. {LLVM_REMEDY}")


def _network() -> Check:
    found = _probe("network")
    if found["works"]:
        where = "CUDA" if found["cuda"] else "CPU"
        return Check(name="torch", status="ok", detail=f"{found['torch']}, {where}")
    return _failed("torch", found, "Install it again: pip install 'lightkiln[worker]'.")


def _cuda(found: dict[str, Any]) -> Check:
    if str(found.get("variant")).startswith("cuda"):
        return Check(name="CUDA", status="ok", detail="a device answers")
    return Check(
        name="CUDA",
        status="warn",
        detail="no device: rendering and fitting run on the CPU",
        remedy="For speed, use a machine with an NVIDIA GPU and driver.",
    )


def _failed(name: str, found: dict[str, Any], remedy: str) -> Check:
    detail = found.get("detail") or "the computation gave a wrong result"
    return Check(name=name, status="fail", detail=detail, remedy=found.get("remedy") or remedy)


def _probe(what: str) -> dict[str, Any]:
    """Run one probe; an abort, a crash or a hang becomes a finding."""
    command = [sys.executable, "-m", "kiln_workers.runner.probe", what]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return {"works": False, "detail": f"no answer within {PROBE_TIMEOUT_S} s"}
    if done.returncode < 0:
        return {"works": False, "detail": f"the process was ended by {signal.Signals(-done.returncode).name}"}
    try:
        found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    except (IndexError, ValueError):
        words = done.stderr.strip().splitlines()
        return {"works": False, "detail": words[-1] if words else f"exit status {done.returncode}"}
    return found
