"""Logs of coordinators and workers: lines for people, or one JSON object a line for collectors.

    {"time": "2026-03-01T12:00:00.123Z", "level": "info", "logger": "kiln_service.reaper", "message": "no heartbeat",
     "job_id": "...", "task_id": "...", "worker_id": "...", "request_id": "..."}

Ids come from `bound`, which holds for everything logged within its block, and from a record's own `extra`.
"""

import json
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Final

_OF_EVERY_RECORD: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}

_bound: ContextVar[dict[str, Any] | None] = ContextVar("lightkiln_log_fields", default=None)


class LogFormat(StrEnum):
    """How a log is written."""

    TEXT = "text"
    JSON = "json"


@contextmanager
def bound(**fields: Any) -> Iterator[None]:
    """Put fields (`job_id`, `task_id`, `worker_id`, `request_id`) on every line that is logged within the block."""
    token = _bound.set((_bound.get() or {}) | fields)
    try:
        yield
    finally:
        _bound.reset(token)


def set_up(form: LogFormat, level: str = "info") -> None:
    """Log to standard error from now on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if form is LogFormat.JSON else TextFormatter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


def fields_of(record: logging.LogRecord) -> dict[str, Any]:
    """What was bound when the record was made, and its own `extra`."""
    own = {name: value for name, value in vars(record).items() if name not in _OF_EVERY_RECORD}
    return (_bound.get() or {}) | own


class Seldom(logging.Filter):
    """Lets `most` lines of a kind through each minute, so that nobody fills the disk with them from outside.

    `kind` tells a record's kind, None where it always passes. The next line that passes says how many were left out.
    """

    def __init__(
        self,
        kind: Callable[[logging.LogRecord], str | None],
        most: int = 20,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self._kind, self._most, self._clock = kind, most, clock
        self._seen: dict[str, tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the line is written."""
        kind = self._kind(record)
        if kind is None:
            return True
        began, count = self._seen.get(kind, (-math.inf, 0))
        if self._clock() - began < 60:
            self._seen[kind] = began, count + 1
            return count < self._most
        if count > self._most:
            record.msg = f"{record.getMessage()} ({count - self._most} more like this before)"
            record.args = ()
        self._seen[kind] = self._clock(), 1
        return True


class JsonFormatter(logging.Formatter):
    """One JSON object a record."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one line."""
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        line = {"time": at, "level": record.levelname.lower(), "logger": record.name, "message": record.getMessage()}
        line |= {name: value for name, value in fields_of(record).items() if name not in line}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class TextFormatter(logging.Formatter):
    """Time, level, logger and message, then the fields."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line before a traceback."""
        fields = " ".join(f"{name}={value}" for name, value in fields_of(record).items())
        return f"{super().formatMessage(record)} {fields}" if fields else super().formatMessage(record)
