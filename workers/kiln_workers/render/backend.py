"""Choose the machine that renders: a CUDA GPU, or the CPU through a libLLVM that Dr.Jit can use.

Dr.Jit loads libLLVM at run time and takes the first that it finds; with one older than 16 the process aborts on
machines with AVX-512, where no Python code can catch it. So the version is read from file names and ELF headers, never
by loading the library, and the newest is named to Dr.Jit in DRJIT_LIBLLVM_PATH before any LLVM variant is selected.
What lacks is a `MachineLacks` with the package that mends it.
"""

import ctypes.util
import os
import platform
import re
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final, Literal

from kiln_schemas.errors import InputError, MachineLacks

Device = Literal["auto", "cpu", "cuda"]

LLVM_VARIABLE: Final = "DRJIT_LIBLLVM_PATH"
OLDEST_LLVM: Final = 16
LLVM_REMEDY: Final = "Install one: `sudo apt install libllvm19` (Debian, Ubuntu), or name one in DRJIT_LIBLLVM_PATH."

_LIBRARY_FOLDERS: Final = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib")
_NAMES: Final = (
    re.compile(r"^libLLVM-(\d+)(?:\.\d+)*\.so(?:\.\d+)*$"),
    re.compile(r"^libLLVM\.so\.(\d+)(?:\.\d+)*$"),
    re.compile(r"^libLLVM[.-](\d+)(?:\.\d+)*\.dylib$"),
)
_DT_STRTAB, _DT_SONAME, _PT_LOAD, _PT_DYNAMIC = 5, 14, 1, 2


@dataclass(frozen=True, order=True)
class Llvm:
    """A libLLVM on this machine; ordered by version."""

    version: int
    path: Path


def llvm_version(path: Path) -> int | None:
    """Major version of a libLLVM file from its resolved name, else from its ELF soname; None where neither tells."""
    real = path.resolve()
    return _version_in_name(real.name) or _version_in_name(_elf_soname(real) or "")


def installed_llvms() -> list[Llvm]:
    """Every libLLVM that the dynamic linker's cache or the usual folders hold, newest first."""
    found = {}
    for path in _candidates():
        version = llvm_version(path)
        if version is not None:
            found[path.resolve()] = Llvm(version, path.resolve())
    return sorted(found.values(), reverse=True)


def find_llvm() -> Llvm:
    """The libLLVM to use: the one that DRJIT_LIBLLVM_PATH names if it is recent enough, else the newest installed.

    Sets DRJIT_LIBLLVM_PATH for this process and its children. Raises MachineLacks where all are older than 16.
    """
    named = os.environ.get(LLVM_VARIABLE)
    if named and Path(named).is_file():
        version = llvm_version(Path(named))
        if version is not None and version >= OLDEST_LLVM:
            return Llvm(version, Path(named))
    llvms = installed_llvms()
    if not llvms:
        raise MachineLacks("no libLLVM is installed, which the renderer needs on a CPU", remedy=LLVM_REMEDY)
    if llvms[0].version < OLDEST_LLVM:
        raise MachineLacks(
            f"the newest libLLVM is version {llvms[0].version}; the renderer needs {OLDEST_LLVM} or newer",
            where=str(llvms[0].path),
            remedy=LLVM_REMEDY,
        )
    os.environ[LLVM_VARIABLE] = str(llvms[0].path)
    return llvms[0]


def select_variant(device: Device | str = "auto", threads: int | None = None) -> str:
    """Select Mitsuba's variant for `device` and return its name, `cuda_ad_rgb` or `llvm_ad_rgb`.

    `auto` takes the GPU where one works. `threads` bounds Dr.Jit's CPU threads (all cores otherwise). Idempotent.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"'{device}' is not a device", where="device", remedy="Choose auto, cpu or cuda.")
    if device == "cuda" and not has_cuda():
        raise MachineLacks(
            "no CUDA device answers",
            where="device",
            remedy="Install NVIDIA's driver, or choose the device `cpu`.",
        )
    variant = "cuda_ad_rgb" if device == "cuda" or (device == "auto" and has_cuda()) else "llvm_ad_rgb"
    if variant == "llvm_ad_rgb":
        find_llvm()

    import drjit as dr
    import mitsuba as mi

    if threads is not None:
        dr.set_thread_count(threads)
    if mi.variant() != variant:
        mi.set_variant(variant)
    return variant


def watertight() -> dict[str, bool]:
    """What a Mitsuba scene's dictionary has to hold so that no ray slips through between two triangles.

    OptiX intersects watertight by itself; Embree does so only when asked.
    """
    import mitsuba as mi

    return {"embree_use_robust_intersections": True} if str(mi.variant()).startswith("llvm") else {}


@lru_cache(maxsize=1)
def has_cuda() -> bool:
    """Whether NVIDIA's driver is installed and Dr.Jit can use a device with it."""
    if ctypes.util.find_library("cuda") is None:
        return False

    import drjit as dr

    return bool(dr.has_backend(dr.JitBackend.CUDA))


def device_summary() -> dict[str, Any]:
    """What this machine renders with, for `lightkiln doctor`: JSON-able, never raises for a lacking part."""
    cuda = has_cuda()
    summary: dict[str, Any] = {
        "cuda": cuda,
        "llvm": None,
        "variant": "cuda_ad_rgb" if cuda else None,
        "device": f"CPU, {os.cpu_count()} cores, {platform.machine()}",
        "mitsuba": metadata.version("mitsuba"),
        "drjit": metadata.version("drjit"),
        "problem": None,
        "remedy": None,
    }
    try:
        llvm = find_llvm()
    except MachineLacks as lack:
        summary |= {"problem": lack.detail, "remedy": lack.remedy}
    else:
        summary |= {"llvm": {"version": llvm.version, "path": str(llvm.path)}}
        summary["variant"] = summary["variant"] or "llvm_ad_rgb"
    if cuda:
        summary["device"] = "CUDA device"
    return summary


def _version_in_name(name: str) -> int | None:
    match = next((m for m in (pattern.match(name) for pattern in _NAMES) if m), None)
    return int(match.group(1)) if match else None


def _candidates() -> Iterator[Path]:
    yield from _linker_cache()
    for folder in map(Path, _LIBRARY_FOLDERS):
        for pattern in ("libLLVM*", "*-linux-gnu/libLLVM*", "llvm*/lib/libLLVM*", "llvm*/lib64/libLLVM*"):
            # Static archives (libLLVMCore.a) fall out by their names.
            yield from (p for p in folder.glob(pattern) if ".so" in p.name or p.name.endswith(".dylib"))


def _linker_cache() -> Iterator[Path]:
    for tool in ("ldconfig", "/sbin/ldconfig"):
        try:
            listing = subprocess.run([tool, "-p"], capture_output=True, text=True, check=True).stdout
        except (OSError, subprocess.CalledProcessError):
            continue
        yield from (Path(line.split("=> ")[1].strip()) for line in listing.splitlines() if "libLLVM" in line)
        return


def _elf_soname(path: Path) -> str | None:
    """DT_SONAME of a little-endian 64-bit ELF file; None for anything else."""
    try:
        with path.open("rb") as file:
            header = file.read(64)
            if header[:6] != b"\x7fELF\x02\x01":
                return None
            table, count = struct.unpack_from("<Q", header, 32)[0], struct.unpack_from("<H", header, 56)[0]
            file.seek(table)
            raw = file.read(56 * count)
            segments = [struct.unpack_from("<IIQQQQ", raw, 56 * k) for k in range(len(raw) // 56)]
            dynamic = next((s for s in segments if s[0] == _PT_DYNAMIC), None)
            if dynamic is None:
                return None
            file.seek(dynamic[2])
            entries = dict(struct.iter_unpack("<QQ", file.read(dynamic[5] // 16 * 16)))
            strings, name = entries.get(_DT_STRTAB), entries.get(_DT_SONAME)
            # The string table's address is virtual: find the segment that maps it.
            load = next((s for s in segments if s[0] == _PT_LOAD and strings and s[3] <= strings < s[3] + s[5]), None)
            if load is None or strings is None or name is None:
                return None
            file.seek(strings - load[3] + load[2] + name)
            return file.read(256).split(b"\0")[0].decode("ascii", "replace")
    except (OSError, struct.error):
        return None
