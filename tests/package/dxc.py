"""Microsoft's HLSL compiler, called by its COM interfaces (dxcapi.h); the library comes with PyPI's compushady-lrtu.

Objects are never released: there are few, and the process that calls this is short-lived.
"""

import ctypes
import functools
import importlib.util
import uuid
from ctypes import POINTER, byref, c_char_p, c_int32, c_size_t, c_uint32, c_void_p, c_wchar_p
from pathlib import Path
from typing import Any

SPIRV = ("-spirv", "-fvk-use-dx-layout")
"""For Vulkan, constant buffers laid out as in Direct3D."""

_COMPILER = uuid.UUID("73e22d93-e6ce-47f3-b5bf-f0664f39c1b0")  # CLSID_DxcCompiler
_COMPILER_3 = uuid.UUID("228b4687-5a6a-4730-900c-9702b2203f54")  # IDxcCompiler3
_RESULT = uuid.UUID("58346cda-dde7-4497-9461-6f87af5e0659")  # IDxcResult
_UTF_8 = 65001

# Slots of the interfaces' tables; the first three are IUnknown's.
_COMPILE = 3
_STATUS, _OUTPUT, _ERRORS = 3, 4, 5
_POINTER, _SIZE = 3, 4


class _Buffer(ctypes.Structure):
    _fields_ = (("pointer", c_char_p), ("size", c_size_t), ("encoding", c_uint32))


def compile_hlsl(source: str, entry: str, target: str, *options: str) -> bytes:
    """One stage for Direct3D 12 (DXIL), or as `options` say; ValueError with the messages of errors and warnings."""
    compiler, result, status = c_void_p(), c_void_p(), c_int32()
    _library().DxcCreateInstance(_guid(_COMPILER), _guid(_COMPILER_3), byref(compiler))
    arguments = ["-E", entry, "-T", target, "-WX", *options]
    text = source.encode()
    buffer = _Buffer(text, len(text), _UTF_8)
    listed = (c_wchar_p * len(arguments))(*arguments)
    _call(compiler, _COMPILE, byref(buffer), listed, c_uint32(len(arguments)), None, _guid(_RESULT), byref(result))
    _call(result, _STATUS, byref(status))
    if status.value != 0:
        raise ValueError(_blob(result, _ERRORS).decode())
    return _blob(result, _OUTPUT)


@functools.cache
def _library() -> ctypes.CDLL:
    found = importlib.util.find_spec("compushady.backends")
    assert found is not None and found.submodule_search_locations is not None
    (path,) = Path(found.submodule_search_locations[0]).glob("libdxcompiler_*.so")
    return ctypes.CDLL(str(path))


def _call(pointer: c_void_p, slot: int, *arguments: Any, returns: Any = c_int32) -> Any:
    """Call a method of a COM object; HRESULTs below 0 are faults."""
    table = ctypes.cast(pointer, POINTER(POINTER(c_void_p)))[0]
    kinds = [c_uint32 if isinstance(argument, c_uint32) else c_void_p for argument in arguments]
    method = ctypes.CFUNCTYPE(returns, c_void_p, *kinds)(table[slot])
    value = method(pointer, *(ctypes.cast(a, c_void_p) if isinstance(a, ctypes.Array) else a for a in arguments))
    assert returns is not c_int32 or value >= 0, hex(value & 0xFFFFFFFF)
    return value


def _blob(result: c_void_p, slot: int) -> bytes:
    blob = c_void_p()
    _call(result, slot, byref(blob))
    return ctypes.string_at(_call(blob, _POINTER, returns=c_void_p), _call(blob, _SIZE, returns=c_size_t))


def _guid(name: uuid.UUID) -> ctypes.Array:
    return (ctypes.c_ubyte * 16).from_buffer_copy(name.bytes_le)
