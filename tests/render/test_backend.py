"""Choosing libLLVM without loading any."""

import json
import os
import struct
from pathlib import Path

import pytest

from kiln_schemas.errors import InputError, MachineLacks
from kiln_workers.render import backend


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-15.so.1", 15),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM.so.19.1", 19),
        ("libLLVM-19.so", 19),
        ("libLLVMCore.a", None),
        ("libLLVM.so", None),
    ],
)
def test_version_from_the_name(tmp_path: Path, name: str, version: int | None) -> None:
    (tmp_path / name).write_bytes(b"")
    assert backend.llvm_version(tmp_path / name) == version


def test_version_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "libLLVM-15.so.1").write_bytes(b"")
    (tmp_path / "libLLVM.so").symlink_to("libLLVM-15.so.1")
    assert backend.llvm_version(tmp_path / "libLLVM.so") == 15


def test_version_from_the_soname(tmp_path: Path) -> None:
    """A library under a name that tells nothing: a minimal ELF file with one PT_LOAD and one PT_DYNAMIC."""
    strings = b"\0libLLVM.so.18.1\0"
    dynamic = struct.pack("<QQQQQQ", 5, 0x1000 + 0x200, 14, 1, 0, 0)
    header = (
        b"\x7fELF\x02\x01\x01" + bytes(9) + struct.pack("<HHIQQQIHHHHHH", 3, 62, 1, 0, 64, 0, 0, 64, 56, 2, 0, 0, 0)
    )
    load = struct.pack("<IIQQQQQQ", 1, 5, 0, 0x1000, 0x1000, 0x400, 0x400, 0x1000)
    table = struct.pack("<IIQQQQQQ", 2, 6, 0x180, 0x1180, 0x1180, len(dynamic), len(dynamic), 8)
    image = (header + load + table).ljust(0x180, b"\0") + dynamic
    (tmp_path / "custom.so").write_bytes(image.ljust(0x200, b"\0") + strings)
    assert backend.llvm_version(tmp_path / "custom.so") == 18
    (tmp_path / "custom.so").write_bytes(image[:0x190])
    assert backend.llvm_version(tmp_path / "custom.so") is None


def test_newest_wins_over_an_old_one_that_was_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("libLLVM-15.so.1", "libLLVM.so.17.0", "libLLVM.so.20.1"):
        (tmp_path / name).write_bytes(b"")
    monkeypatch.setattr(backend, "_candidates", lambda: iter(tmp_path.iterdir()))
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(tmp_path / "libLLVM-15.so.1"))
    assert backend.find_llvm().version == 20
    assert os.environ[backend.LLVM_VARIABLE] == str(tmp_path / "libLLVM.so.20.1")
    monkeypatch.setenv(backend.LLVM_VARIABLE, str(tmp_path / "libLLVM.so.17.0"))
    assert backend.find_llvm().version == 17


def test_only_old_ones_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "libLLVM-15.so.1").write_bytes(b"")
    monkeypatch.setattr(backend, "_candidates", lambda: iter(tmp_path.iterdir()))
    monkeypatch.delenv(backend.LLVM_VARIABLE, raising=False)
    with pytest.raises(MachineLacks, match=r"version 15.*libllvm19"):
        backend.find_llvm()
    summary = backend.device_summary()
    assert "version 15" in summary["problem"] and "apt install" in summary["remedy"]


def test_none_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "_candidates", lambda: iter(()))
    monkeypatch.delenv(backend.LLVM_VARIABLE, raising=False)
    with pytest.raises(MachineLacks, match=r"no libLLVM.*libllvm19"):
        backend.find_llvm()


def test_this_machine_renders() -> None:
    assert backend.select_variant("cpu") == "llvm_ad_rgb"
    summary = json.loads(json.dumps(backend.device_summary()))
    assert summary["problem"] is None and summary["llvm"]["version"] >= backend.OLDEST_LLVM


def test_unknown_device() -> None:
    with pytest.raises(InputError, match="'tpu'"):
        backend.select_variant("tpu")
