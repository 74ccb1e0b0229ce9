"""What operators ask of a coordinator and what it tells them: workers, access tokens, the record of who did what."""

from datetime import datetime, time
from enum import StrEnum
from typing import Annotated, Final, Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import AfterValidator, Field, field_validator

from kiln_schemas.base import Contract, Count, Detail, Id, Name, Url, Word
from kiln_schemas.receivers import check_receiver
from kiln_schemas.tasks import Bytes, Tags, TaskKind
from kiln_schemas.text import Told


class Scope(StrEnum):
    """What a token allows; every route names the one it needs."""

    READ = "read"
    """Look at jobs, tasks, events, workers; download artifacts and blobs."""
    SUBMIT = "submit"
    """Upload blobs; submit, change, pause, cancel and retry jobs."""
    WORKER = "worker"
    """Claim tasks, upload and download their blobs, commit them."""
    ADMIN = "admin"
    """All of the above; tokens, orders to workers and the record."""


class WorkerState(StrEnum):
    """What a worker is doing."""

    AWAKE = "awake"
    """It asks for tasks; it has one where `task_id` is set."""
    ASLEEP = "asleep"
    """Told to take no task until it is woken."""
    DRAINING = "draining"
    """Told to leave once its task is done."""
    ERROR = "error"
    """Its last three attempts or more all ended badly; it goes on asking."""
    OFFLINE = "offline"
    """Not heard of for a minute."""


class Order(StrEnum):
    """What a worker may be told."""

    WAKE = "wake"
    """Take tasks again."""
    SLEEP = "sleep"
    """Finish the task at hand and take no other until it is woken."""
    DRAIN = "drain"
    """Finish the task at hand and leave: its process ends."""


DAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")


class SleepSchedule(Contract):
    """Body of `PUT /v1/schedules/{worker}`: when a worker takes no tasks. What it has then it ends."""

    days: tuple[Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"], ...] = Field(min_length=1, max_length=7)
    """Days on which the span begins."""
    begins: time
    ends: time
    """Where this is not after `begins`, the span ends on the next day."""
    timezone: Word = "UTC"
    """IANA name, as in `Europe/Stockholm`."""

    @field_validator("timezone")
    @classmethod
    def _is_known(cls, name: str) -> str:
        try:
            ZoneInfo(name)
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise ValueError(f"no time zone '{name}' is known") from None
        return name

    @field_validator("begins", "ends")
    @classmethod
    def _is_local(cls, value: time) -> time:
        if value.tzinfo is not None:
            raise ValueError("is a time of the day in `timezone`, without a zone of its own")
        return value


class BlockView(Contract):
    """A worker gets no tasks of a kind of a job, since it failed some."""

    job_id: Id
    kind: TaskKind
    until: datetime


class WorkerView(Contract):
    id: Id
    name: Name
    state: WorkerState
    kinds: tuple[TaskKind, ...] = Field(max_length=32)
    memory_bytes: Bytes
    threads: Count
    device: Name
    version: Word
    registered: datetime
    seen: datetime
    task_id: Id | None = None
    job_id: Id | None = None
    task: Name | None = None
    """Kind and label of the task at hand."""
    tags: Tags = ()
    schedule: SleepSchedule | None = None
    """When workers of its name sleep."""
    blocks: tuple[BlockView, ...] = Field(default=(), max_length=1000)
    """Of workers of its name."""


TokenName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", max_length=64)]
Scopes = Annotated[tuple[Scope, ...], Field(min_length=1, max_length=len(Scope))]


class TokenRequest(Contract):
    """Body of `POST /v1/tokens`."""

    name: TokenName
    scopes: Scopes


class TokenView(Contract):
    """A token as the coordinator knows it: never itself."""

    name: Word
    scopes: Scopes
    created: datetime
    created_by: Name
    used: datetime | None = None
    """When it was last used, to the minute."""


class NewToken(TokenView):
    """Answer of `POST /v1/tokens`, the only time that the token is told."""

    token: Name


class JobEvent(StrEnum):
    """What a webhook may be told of."""

    CREATED = "job.created"
    ACTIVE = "job.active"
    PAUSED = "job.paused"
    COMPLETED = "job.completed"
    GATE_FAILED = "job.gate-failed"
    FAILED = "job.failed"
    CANCELED = "job.canceled"


class WebhookRequest(Contract):
    """Body of `POST /v1/webhooks`."""

    url: Annotated[
        str, Field(pattern=r"^https?://[!-.0-?A-~]+(/[!-~]*)?$", max_length=2048), AfterValidator(check_receiver)
    ]
    """Without a user or a password; which hosts are refused: `kiln_schemas.receivers`."""
    events: tuple[JobEvent, ...] = Field(
        default=(JobEvent.COMPLETED, JobEvent.GATE_FAILED, JobEvent.FAILED, JobEvent.CANCELED),
        min_length=1,
        max_length=7,
    )


class WebhookView(Contract):
    id: Id
    url: Url
    events: tuple[JobEvent, ...] = Field(max_length=len(JobEvent))
    created: datetime
    created_by: Name


class NewWebhook(WebhookView):
    """Answer of `POST /v1/webhooks`, the only time that the secret is told."""

    secret: Name


class DeliveryView(Contract):
    """What became of one telling."""

    id: Count
    event: Word
    job_id: Id
    outcome: Word
    """`pending`, `delivered` or `failed` (after twelve attempts)."""
    attempts: Count
    status: Count | None
    """Of the receiver's last answer."""
    error: Told | None
    """Why there was no answer."""
    due: datetime
    ended: datetime | None


class GcRequest(Contract):
    """Body of `POST /v1/gc`."""

    days: float = Field(default=0.0, ge=0, le=36500, description="only jobs that ended so long ago or earlier")
    dry_run: bool = Field(default=False, description="only say what would go")


class Freed(Contract):
    """What one archived job left behind."""

    job_id: Id
    name: Name
    stores: tuple[Url, ...] = Field(max_length=2)
    """Light-field stores that are gone."""
    blob_bytes: Bytes
    """Of blobs that nobody else uses; they go with the next collection."""


class GcReport(Contract):
    """Answer of `POST /v1/gc`."""

    dry_run: bool
    jobs: tuple[Freed, ...] = Field(max_length=1_000_000)


class AuditEntry(Contract):
    """One line of the record."""

    id: Count
    at: datetime
    actor: Name
    action: Word
    """`token.created`, `token.revoked`, `worker.drain`, ..."""
    target: Name
    detail: Detail = Field(default_factory=dict)
