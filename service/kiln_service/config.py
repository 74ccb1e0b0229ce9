"""Everything that can be configured about a coordinator, as one frozen model.

`python -m kiln_service --config FILE` reads it from JSON; flags override single fields. Secrets are
not in it: access tokens appear as hashes only (`auth.py`).
"""

import ipaddress
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, Field, ValidationError, field_validator

from kiln_schemas.base import Contract, Name, Url
from kiln_schemas.errors import InputError
from kiln_schemas.job import Labels
from kiln_schemas.operators import Scopes
from kiln_schemas.tasks import MOST_TILES, Sha256
from kiln_schemas.text import Line

OWN_TOKEN: Final = "owner"
"""Name of the token in the data folder."""
LONGEST_PATH: Final = 4096

Interval = Annotated[float, Field(gt=0, le=1e9)]
"""Seconds."""
Bound = Annotated[int, Field(gt=0, lt=2**63)]
StorageUrl = Annotated[str, Field(max_length=1024)]
"""Leaves room for the names below it in a contract's `Url`."""
Days = Annotated[float, Field(ge=0, le=36500)]


def _short_path(value: object) -> object:
    if len(str(value)) > LONGEST_PATH:
        raise ValueError(f"is longer than {LONGEST_PATH} characters")
    return value


Folder = Annotated[Path, Field(json_schema_extra={"maxLength": LONGEST_PATH}), BeforeValidator(_short_path)]


class TokenEntry(Contract):
    """An access token as the coordinator knows it: its hash, never itself."""

    name: Line = Field(min_length=1, max_length=64)
    sha256: Sha256
    scopes: Scopes


class Rate(Contract):
    """A token bucket (`kiln_service.rates`)."""

    per_s: float = Field(gt=0, le=1e9)
    """Requests a second in the long run."""
    burst: int = Field(ge=1, lt=2**31)
    """Requests at once."""


class Rates(Contract):
    """How often one caller may ask."""

    clients: Rate = Rate(per_s=200, burst=2000)
    """A token, on all routes but those of workers."""
    workers: Rate = Rate(per_s=5000, burst=20000)
    """A token on the routes of workers, tasks and blobs: a whole farm may share it."""
    failures: Rate = Rate(per_s=5, burst=1000)
    """An address (of IPv6 a /64 network) that fails to sign in; whoever has a valid token is not concerned."""


class ConnectionLimits(Contract):
    """How many connections there may be, and how slow each (`kiln_service.connections`)."""

    all: int = Field(default=16384, ge=1, lt=2**20)
    """At once; fewer where the process may not open as many descriptors (256 are kept for other uses)."""
    of_address: int = Field(default=4096, ge=1, lt=2**20)
    """Of one address at once: the workers of a farm may share one."""
    head_s: float = Field(default=10.0, gt=0, le=86400)
    """A new connection, or one that is kept open, has to send the whole head of a request within so long."""
    stall_s: float = Field(default=30.0, gt=0, le=86400)
    """A body has to come, and an answer to be read, at `bytes_per_s` over each span of so long."""
    bytes_per_s: float = Field(default=512.0, ge=0, le=1e9)


class LogLimits(Contract):
    """How much of what tasks print is kept (`kiln_service.task_logs`); the oldest goes first."""

    attempt_bytes: Bound = 4 * 2**20
    """Of one attempt,"""
    job_bytes: Bound = 64 * 2**20
    """of all attempts of a job,"""
    all_bytes: Bound = 2**30
    """and of all jobs."""
    answer_bytes: Bound = 2**20
    """That one request reads, about."""


class Limits(Contract):
    """Bounds that keep one client from exhausting the coordinator."""

    blob_bytes: Bound = 8 * 2**30
    """Largest blob."""
    body_bytes: Bound = 16 * 2**20
    """Largest body of any request but a blob upload."""
    reserve_bytes: int = Field(default=256 * 2**20, ge=0, lt=2**63)
    """While the disk has less free space than this, nothing is taken that grows (`kiln_service.disk`)."""
    unused_bytes: Bound = 64 * 2**30
    """Most bytes of blobs that one token has uploaded and no job uses."""
    unused_blobs: Bound = 20_000
    """Most such blobs."""
    page: Bound = 200
    """Most jobs on a page."""
    tiles: int = Field(default=MOST_TILES, gt=0, le=MOST_TILES)
    """Most render tiles of a job, and most blocks to refine."""
    workers: Bound = 4096
    """Most registered workers of a token; one that is gone makes room for another."""
    rates: Rates = Rates()
    """How often one caller may ask."""
    connections: ConnectionLimits = ConnectionLimits()
    logs: LogLimits = LogLimits()
    streams: int = Field(default=128, ge=1, lt=2**31)
    """Event streams and followed logs that one token may have open."""


class Timing(Contract):
    """Intervals in seconds."""

    heartbeat_s: Interval = 3.0
    """Told to workers: beat this often while a task runs. A canceled task has stopped after this and two seconds."""
    stale_s: Interval = 30.0
    """A running task without a heartbeat for this long has lost its worker."""
    poll_s: Interval = 1.0
    """Longest sleep of a waiting claim or event stream (a retried job sends no NOTIFY)."""
    database_s: Interval = 15.0
    """A request waits so long for a database connection before it is answered 503."""
    statement_s: Interval = 60.0
    """A statement that takes longer is ended by the database."""
    lock_s: Interval = 30.0
    """A statement that waits longer for rows that another transaction has locked is ended by the database."""
    idle_s: Interval = 60.0
    """A transaction that pauses for longer between two statements is ended by the database."""
    transaction_s: Interval = 120.0
    """A transaction that takes longer in all is ended by the coordinator, and the request answered 503."""
    ready_s: Interval = 5.0
    """`/readyz` waits so long for a database connection."""
    maintenance_s: Interval = 5.0
    """Between two passes of the reaper."""
    block_s: Interval = 3600.0
    """A worker that fails tasks of a kind of a job gets no more of them for so long (`blocks`)."""
    blob_grace_s: Interval = 3600.0
    """A blob that nothing uses is kept this long after it was last uploaded or asked for."""


class FailedTasks(Contract):
    """A task that fails leaves the others to go on; a job of which so many failed fails at once."""

    least: int = Field(default=10, ge=1, lt=2**31)
    """At least so many tasks of a kind,"""
    of_all: float = Field(default=0.1, ge=0, le=1)
    """and more than this share of all tasks of the kind."""


class Retention(Contract):
    """How long jobs that are over keep what they have; nothing goes where no days are given."""

    archive_days: Days | None = None
    """A job is archived so many days after its end."""
    free_days: Days | None = None
    """An archived job gives up its light fields so many days after its end; its package stays."""
    log_days: Days | None = None
    """What a job's tasks logged goes so many days after the job's end; its events stay."""
    keep: Labels = Field(default={"keep": "true"})
    """Jobs with one of these labels are left alone."""
    check_s: Interval = 3600.0
    """Seconds between two rounds."""


class ServiceConfig(Contract):
    """A coordinator. Without `database` an embedded PostgreSQL is run in `<data>/postgres`."""

    data: Folder
    """Folder for the token, temporary files and, by default, everything else."""
    host: Name = "127.0.0.1"
    port: int = Field(default=8321, ge=0, le=65535)
    database: Url | None = None
    """libpq connection string."""
    storage_url: StorageUrl | None = None
    """Where light-field stores and blobs go, `file://` or `s3://`, reachable from every worker; `data` by default."""
    store_url: StorageUrl | None = None
    """Where light-field stores go instead; `<storage>/store` by default."""
    blob_url: StorageUrl | None = None
    """Where blobs (uploads, what tasks make, artifacts) go instead; `<storage>/blobs` by default."""
    trusted_proxies: tuple[Name, ...] = Field(default=(), max_length=1000)
    """Addresses and networks of proxies whose `X-Forwarded-For` and `X-Forwarded-Proto` are believed."""
    tokens: tuple[TokenEntry, ...] = Field(default=(), max_length=1000)
    """Tokens besides the one in `<data>/token`."""
    max_attempts: int = Field(default=4, ge=1, lt=2**31)
    """A task fails for good after this many attempts in a row that ended without a new checkpoint."""
    failed_tasks: FailedTasks = FailedTasks()
    pool_size: int = Field(default=10, ge=2, le=1000)
    """Database connections."""
    limits: Limits = Limits()
    timing: Timing = Timing()
    retention: Retention = Retention()

    @field_validator("storage_url", "store_url", "blob_url")
    @classmethod
    def _is_file_or_bucket(cls, url: str | None) -> str | None:
        if url is not None and not url.startswith(("file:///", "s3://")):
            raise ValueError("must begin with file:/// or s3://")
        return url

    @field_validator("trusted_proxies")
    @classmethod
    def _are_addresses(cls, proxies: tuple[str, ...]) -> tuple[str, ...]:
        for proxy in proxies:
            ipaddress.ip_network(proxy)
        return proxies

    @property
    def store_base(self) -> str:
        """The folder URL under which every job has its light-field store."""
        return (self.store_url or f"{self._storage}/store").rstrip("/")

    @property
    def blob_base(self) -> str:
        """The folder URL of the blobs."""
        return (self.blob_url or f"{self._storage}/blobs").rstrip("/")

    @property
    def _storage(self) -> str:
        return (self.storage_url or self.data.absolute().as_uri()).rstrip("/")

    @property
    def incoming(self) -> Path:
        """Where uploads grow until their hash is known; on the blobs' file system when those are local."""
        return self.data / "incoming"


def make_config(tree: dict[str, Any]) -> ServiceConfig:
    """Validate a configuration; InputError names the first field at fault."""
    try:
        return ServiceConfig.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "configuration"
        value = first.get("input")
        # A wrong value may be a password in the wrong place: numbers alone are quoted.
        what = f"{value} is refused" if isinstance(value, int | float) else "the value is refused"
        raise InputError(f"{what}: {first['msg']}", where=where) from None
