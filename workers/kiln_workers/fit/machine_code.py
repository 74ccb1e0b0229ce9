"""Functions of numbers and arrays, compiled by Numba for this machine's CPU where no library has them.

The machine code is kept beside the source file, or in the user's cache directory where that cannot be written to. A
call lets other threads run. Sums may be reordered, so that they become vectors: the same on every machine of a kind.
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, Final, ParamSpec

import numba

ParametersOf = ParamSpec("ParametersOf")

SINGLE: Final = numba.float32
ROWS: Final = numba.float32[:, ::1]
BOXES: Final = numba.float32[:, :, ::1]
INDEX: Final = numba.int64[::1]
INDEX_ROWS: Final = numba.int64[:, ::1]


def compiled(*signature: Any) -> Callable[[Callable[ParametersOf, None]], Callable[ParametersOf, None]]:
    """The decorated function, compiled at its first call for arguments of these types of Numba's."""

    def decorate(function: Callable[ParametersOf, None]) -> Callable[ParametersOf, None]:
        @wraps(function)
        def call(*arguments: ParametersOf.args, **named: ParametersOf.kwargs) -> None:
            _machine_code(function, signature)(*arguments, **named)

        return call

    return decorate


@cache
def _machine_code(function: Callable[..., None], signature: tuple[Any, ...]) -> Callable[..., None]:
    options: dict[str, Any] = {"nogil": True, "fastmath": {"reassoc", "contract", "nsz"}, "error_model": "numpy"}
    try:
        code: Callable[..., None] = numba.njit(signature, cache=True, **options)(function)
    except RuntimeError:  # no folder can be written to: each process compiles
        code = numba.njit(signature, **options)(function)
    return code
