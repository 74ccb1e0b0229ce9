"""Every error a user can meet, and how it travels: exception, problem+json (RFC 9457), exit code.

    KilnError
    |-- InputError          the scene, a file, a field or a setting is wrong (422, exit 3)
    |   |-- TooLarge        a size or count is over its bound (413, exit 3)
    |   |-- Truncated       an upload ended early (400, exit 3)
    |   `-- DamagedDownload a file arrived with another hash, twice (422, exit 3)
    |-- AuthError           no token, or a wrong one (401, exit 6)
    |-- Forbidden           the token lacks the scope (403, exit 6)
    |-- TooMany             the caller asks too often (429, exit 6)
    |-- NotFound            no such job, task, blob or artifact (404, exit 3)
    |   `-- Damaged         a blob whose bytes are damaged or gone from the storage
    |-- Conflict            the request contradicts the present state (409, exit 4)
    |   |-- StaleAttempt    a worker acts under an attempt that was taken from it
    |   `-- IllegalTransition
    |-- BakeFailed          a task failed for good (exit 4)
    |   `-- FitFailed       the network did not beat P = 0, or has no signal to learn from
    |-- GateFailed          the package is there, but misses a quality gate (422, exit 8)
    |-- Canceled            stopped on request (exit 5)
    |-- Unreachable         the coordinator does not answer (503, exit 6)
    |-- MachineLacks        libLLVM, disk, memory, database: what `lightkiln doctor` tells (507, exit 7)
    |   |-- StoreLost       a light-field store is gone
    |   `-- TilesLost       tiles of a light-field store are gone or damaged
    |-- QuotaExceeded       a token has stored too much that no job uses (507, exit 6)
    `-- InternalError       a defect of ours (500, exit 1)

A message names the place (mesh, file, field), the value and the remedy.
"""

import errno
from typing import ClassVar, Final, Self

from pydantic import Field, ValidationError

from kiln_schemas.base import Contract, Name, Word
from kiln_schemas.text import Place, Told

DISK_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""`OSError.errno` of a disk, a quota or a file at its limit; told as MachineLacks wherever files are written."""


class Problem(Contract):
    """An error as `application/problem+json` and as stored with a failed task."""

    type: Name = "about:blank"
    title: Name
    status: int = Field(ge=100, le=599)
    detail: Told
    code: Word
    """Stable slug for programs: `input`, `fit-failed`, `stale-attempt`, ..."""
    where: Place | None = None
    """The mesh, file or field at fault."""
    remedy: Told | None = None
    """What the user can do about it."""

    def sentence(self) -> str:
        """Place, cause and remedy as one line for people."""
        cause = f"{self.where}: {self.detail}" if self.where else self.detail
        if not self.remedy:
            return cause
        return f"{cause} {self.remedy}" if cause.endswith((".", "!", "?")) else f"{cause}. {self.remedy}"


class KilnError(Exception):
    """Base of all errors raised on purpose."""

    code: ClassVar[str] = "error"
    title: ClassVar[str] = "Error"
    status: ClassVar[int] = 500
    exit_code: ClassVar[int] = 1
    retryable: ClassVar[bool] = False
    """Whether another attempt of the same task may succeed."""

    def __init__(self, detail: str, *, where: str | None = None, remedy: str | None = None) -> None:
        super().__init__(detail)
        self.detail, self.where, self.remedy = detail, where, remedy

    def __str__(self) -> str:
        return self.problem().sentence()

    def problem(self) -> Problem:
        """This error as problem+json."""
        return Problem(
            title=self.title,
            status=self.status,
            detail=self.detail,
            code=self.code,
            where=self.where,
            remedy=self.remedy,
        )

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """The exception that a problem document stands for (the class with its code)."""
        kinds = [cls]
        for kind in kinds:
            kinds.extend(kind.__subclasses__())
        match = next((kind for kind in kinds if kind.code == problem.code), cls)
        return match(problem.detail, where=problem.where, remedy=problem.remedy)


class InputError(KilnError):
    code, title, status, exit_code = "input", "The input is not usable", 422, 3


class TooLarge(InputError):
    code, title, status = "too-large", "A size or count is over its bound", 413


class Truncated(InputError):
    code, title, status = "truncated", "The upload ended early", 400


class DamagedDownload(InputError):
    code, title = "damaged-download", "A file arrived damaged, again and again"


class AuthError(KilnError):
    code, title, status, exit_code = "unauthorized", "A valid token is needed", 401, 6


class Forbidden(KilnError):
    code, title, status, exit_code = "forbidden", "The token lacks the scope", 403, 6


class TooMany(KilnError):
    """`wait_s`: seconds until the next request is taken."""

    code, title, status, exit_code, retryable = "too-many-requests", "The caller asks too often", 429, 6, True

    def __init__(
        self, detail: str, *, where: str | None = None, remedy: str | None = None, wait_s: int | None = None
    ) -> None:
        if wait_s is not None and remedy is None:
            remedy = f"Ask again in {wait_s} s; limits.rates of the coordinator says how often is allowed."
        super().__init__(detail, where=where, remedy=remedy)
        self.wait_s = wait_s


class NotFound(KilnError):
    code, title, status, exit_code = "not-found", "Not found", 404, 3


class Damaged(NotFound):
    code, title, retryable = "damaged", "Stored bytes are damaged or lost", True


class Conflict(KilnError):
    code, title, status, exit_code = "conflict", "The request contradicts the present state", 409, 4


class StaleAttempt(Conflict):
    code, title = "stale-attempt", "The task was given to another attempt"


class Drained(Conflict):
    code, title = "drained", "The worker was told to leave"


class IllegalTransition(Conflict):
    code, title = "illegal-transition", "The state does not allow this"


class BakeFailed(KilnError):
    code, title, status, exit_code = "bake-failed", "The bake failed", 500, 4


class FitFailed(BakeFailed):
    code, title = "fit-failed", "The fit does not represent the data"


class GateFailed(KilnError):
    code, title, status, exit_code = "gate-failed", "The package misses a quality gate", 422, 8


class Canceled(KilnError):
    code, title, status, exit_code = "canceled", "Canceled", 409, 5


class Unreachable(KilnError):
    code, title, status, exit_code, retryable = "unreachable", "The coordinator does not answer", 503, 6, True


class MachineLacks(KilnError):
    code, title, status, exit_code, retryable = "machine-lacks", "This machine lacks something", 507, 7, True


class StoreLost(MachineLacks):
    code, title = "store-lost", "The light-field store is gone"


class TilesLost(MachineLacks):
    """`labels`: the labels of the render tasks whose tiles are lost."""

    code, title = "tiles-lost", "Tiles of the light-field store are gone or damaged"

    def __init__(
        self, detail: str, *, where: str | None = None, remedy: str | None = None, labels: tuple[str, ...] = ()
    ) -> None:
        super().__init__(detail, where=where, remedy=remedy)
        self.labels = labels


class QuotaExceeded(KilnError):
    code, title, status, exit_code, retryable = "quota", "The token has stored too much that no job uses", 507, 6, True


class InternalError(KilnError):
    code, title, status, exit_code, retryable = "internal", "A defect in lightkiln", 500, 1, True


def wait_asked(retry_after: str | None) -> float:
    """Seconds that a Retry-After header asks to wait; 0 where there is none, or it names a time."""
    return float(retry_after) if retry_after is not None and retry_after.strip().isdecimal() else 0.0


def error_of_answer(body: bytes, status: int, request: str, where: str) -> KilnError:
    """The exception that an HTTP answer stands for; Unreachable where it is not one of a coordinator's."""
    try:
        return KilnError.from_problem(Problem.model_validate_json(body))
    except ValidationError:
        return Unreachable(
            f"what answers there is no coordinator: it answered {request} with {status} and no problem document",
            where=where,
            remedy="Check that this URL is a lightkiln coordinator's.",
        )
