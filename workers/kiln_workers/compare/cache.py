"""Results that took time, kept in the output folder under a hash of everything they depend on.

So a comparison that was interrupted goes on, and one with more solvers repeats nothing. A changed scene or setting, and
a change to a solver's own source file, gives another name, so no old result is taken for a new one. Files are written
atomically; a damaged one counts as absent.
"""

import functools
import hashlib
import importlib
import inspect
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_workers.package.files import write_bytes
from kiln_workers.scene.container import pack, unpack

Arrays = Mapping[str, npt.NDArray[Any]]

FOLDER: Final = "cache"
SHARED: Final = tuple(f"kiln_workers.fit.{name}" for name in ("field", "lobes", "loss", "solution"))


@dataclass(frozen=True)
class Cache:
    """The cache of one output folder."""

    out: Path

    def path(self, kind: str, key: Mapping[str, Any]) -> Path:
        """The file of a result of `kind` that depends on `key` (JSON)."""
        text = json.dumps(key, sort_keys=True, allow_nan=False)
        return self.out / FOLDER / f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:32]}.bin"

    def load(self, kind: str, key: Mapping[str, Any]) -> tuple[dict[str, Any], Arrays] | None:
        """What `save` kept, or None."""
        try:
            return unpack(kind, self.path(kind, key).read_bytes())
        except (OSError, InputError):
            return None

    def save(self, kind: str, key: Mapping[str, Any], body: Mapping[str, Any], arrays: Arrays) -> None:
        """Keep a result; MachineLacks where the disk refuses."""
        write_bytes(self.path(kind, key), pack(kind, body, {n: np.ascontiguousarray(a) for n, a in arrays.items()}))


def source_digest(function: Callable[..., Any]) -> str:
    """sha256 over the module that defines a solver and those that all solvers share."""
    out = hashlib.sha256()
    while isinstance(function, functools.partial):
        out.update(repr(sorted(function.keywords.items())).encode())
        function = function.func
    for module in dict.fromkeys([*SHARED, function.__module__]):
        path = inspect.getsourcefile(importlib.import_module(module))
        out.update(b"" if path is None else Path(path).read_bytes())
    return out.hexdigest()
