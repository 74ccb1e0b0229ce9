"""Read what is in the database already: an older version may have written what a contract does not allow today.

A request over a bound is refused; a row is not, since every view that shows it would fail with it. What is over a bound
is cut to it, and fields that are not known are left out. A row for which that is not enough is left out of lists, and
the log names it.
"""

import logging
import math
from collections.abc import Iterable
from typing import Any, Final, TypeVar

from psycopg.rows import DictRow
from pydantic import ValidationError

from kiln_schemas.base import Contract
from kiln_schemas.errors import InternalError, Problem
from kiln_schemas.tasks import Progress
from kiln_schemas.text import told

log = logging.getLogger(__name__)

C = TypeVar("C", bound=Contract)
ROUNDS: Final = 4
"""A value that is mended may be over another bound: an infinity becomes a number first, and that is cut then."""


def readable(contract: type[C], tree: Any) -> C:
    """The contract of a stored document, whose faults are mended; ValidationError where that cannot be."""
    for number in range(ROUNDS):
        try:
            return contract.model_validate(tree)
        except ValidationError as error:
            tree = _mutable(tree)
            mended = [_mend(tree, fault) for fault in error.errors()]
            if number + 1 == ROUNDS or not all(mended):
                raise
    raise AssertionError("the last round returns or raises")


def readable_or(contract: type[C], tree: Any, otherwise: C | None) -> C | None:
    """The same, or something else where there is none or it cannot be read."""
    if tree is None:
        return otherwise
    try:
        return readable(contract, tree)
    except ValidationError:
        return otherwise


def readable_rows(contract: type[C], rows: Iterable[DictRow]) -> list[C]:
    """A contract of each row; one that cannot be read is left out."""
    found = []
    for row in rows:
        try:
            found.append(readable(contract, row))
        except ValidationError as error:
            note_unreadable(contract.__name__, row, error)
    return found


def readable_problem(tree: Any) -> Problem | None:
    """A stored error; where it cannot be read, one that says so."""
    lost = InternalError(told(f"the error that is stored cannot be read: {tree!r}", 1000)).problem()
    return None if tree is None else readable_or(Problem, tree, lost)


def readable_outcome(row: DictRow) -> DictRow:
    """Progress and error of a row of `tasks`; None or a stand-in where they cannot be read."""
    progress, error = readable_or(Progress, row["progress"], None), readable_problem(row["error"])
    return {"progress": progress, "error": error}


def note_unreadable(what: str, row: DictRow, error: Exception) -> None:
    """Say in the log which row was left out."""
    name = told(str(row.get("id") or row.get("name")), 80)
    log.error("%s %s cannot be read and is left out: %s", what, name, told(str(error), 500))


def _mutable(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _mutable(value) for key, value in tree.items()}
    return [_mutable(value) for value in tree] if isinstance(tree, list | tuple) else tree


def _mend(tree: Any, fault: Any) -> bool:
    """Bring the value at fault within its bound; False where that is not its fault, or it is not found."""
    *path, last = fault["loc"] or [None]
    try:
        for part in path:
            if last == "[key]" and part == path[-1]:
                del tree[part]
                return True
            tree = tree[part]
        if fault["type"] == "extra_forbidden":
            del tree[last]
        else:
            tree[last] = _within(tree[last], fault["type"], fault.get("ctx", {}))
    except (KeyError, IndexError, TypeError):
        return False
    return True


def _within(value: Any, kind: str, bounds: Any) -> Any:
    """The nearest value that is allowed; TypeError where it is unknown."""
    match kind:
        case "string_too_long":
            return value[: bounds["max_length"]]
        case "too_long" if isinstance(value, dict):
            return dict(list(value.items())[: bounds["max_length"]])
        case "too_long":
            return value[: bounds["max_length"]]
        case "less_than_equal":
            return bounds["le"]
        case "greater_than_equal":
            return bounds["ge"]
        case "less_than":
            return bounds["lt"] - 1 if isinstance(bounds["lt"], int) else math.nextafter(bounds["lt"], -math.inf)
        case "greater_than":
            return bounds["gt"] + 1 if isinstance(bounds["gt"], int) else math.nextafter(bounds["gt"], math.inf)
        case "finite_number":
            number = float(value)
            return 0.0 if math.isnan(number) else math.copysign(1e308, number)
        case "float_type" if isinstance(value, int):  # one that no float holds
            return math.copysign(1e308, value > 0 or -1)
        case "value_error" if isinstance(value, dict):
            return {}
    raise TypeError(kind)
