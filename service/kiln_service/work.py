"""What workers ask: register, claim, heartbeat, commit, fail, checkpoint.

The fence: a claim increments the task's attempt and hands out a lease, a secret of which the database has the hash.
Every later call carries both, and one whose attempt is not the task's running one, or whose lease is not that of the
claim, is refused with StaleAttempt: nothing that a zombie or a stranger says counts.
Everything that a commit causes (the result, the next stage's release, the job's end) happens in its
transaction under the job's lock, so the last tile's fan-in happens once.
"""

import asyncio
import hmac
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Final

from psycopg.types.json import Jsonb

from kiln_schemas import __version__
from kiln_schemas.errors import Conflict, Drained, InputError, KilnError, NotFound, Problem, StaleAttempt, TooMany
from kiln_schemas.states import LIVE_JOB_STATES, JobState, TaskState
from kiln_schemas.tasks import (
    Checkpoint,
    Claim,
    ClaimRequest,
    Commit,
    Failure,
    FitResult,
    Heartbeat,
    HeartbeatReply,
    PackageResult,
    PrepareResult,
    RefineResult,
    RenderResult,
    Result,
    TaskKind,
    WorkerRegistration,
)
from kiln_service import lost_renders, queue, transitions
from kiln_service.auth import digest_of
from kiln_service.batches import Batches
from kiln_service.blobs import drop_blobs, hold_blobs, use_blobs
from kiln_service.blocks import note_failure
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, JobRow, TaskRow, Tx, WorkerRow, fetched, readable
from kiln_service.disk import Disk
from kiln_service.events import QUEUED_CHANNEL, Signals, add_event, wait
from kiln_service.ids import new_id
from kiln_service.jobs import settle_cancel
from kiln_service.operators import OFFLINE_S
from kiln_service.payloads import Handed, build_payload
from kiln_service.planner import METHODS, plan_after_prepare
from kiln_service.reuse import check_sources, renders_to_reuse
from kiln_service.task_logs import LogBounds

RELEASED_CODE: Final = "canceled"
"""A worker that leaves in good order gives its task back with this code; that is no strike against the task."""


class Work:
    """The workers' side of one coordinator."""

    def __init__(self, database: Database, config: ServiceConfig, signals: Signals) -> None:
        self._database, self._config, self._signals = database, config, signals
        self._disk = Disk(config)
        self._logs = LogBounds(database, config.limits.logs)
        self._claims = Batches(database, self._claim_all)
        self._renders = Batches(database, self._commit_renders)

    async def register(self, registration: WorkerRegistration, owner: str) -> str:
        """The id of a new worker of the token `owner`.

        Conflict where it is of another version than this coordinator, TooMany where the token has too many already.
        """
        if registration.version != __version__:
            about = {"owner": owner, "name": registration.name, "version": registration.version}
            async with self._database.transaction() as tx:
                await tx.run("note_refused_worker", **about, most=self._config.limits.workers)
            raise Conflict(
                f"the worker is lightkiln {registration.version}, the coordinator {__version__}",
                where="version",
                remedy="Install the same version on both: what they tell each other changes between versions.",
            )
        worker_id = new_id()
        async with self._database.turn(f"workers of {owner}"), self._database.transaction() as tx:
            await self._make_room(tx, owner)
            await tx.run(
                "insert_worker",
                id=worker_id,
                owner=owner,
                **registration.model_dump(exclude={"kinds", "tags"}),
                kinds=[kind.value for kind in registration.kinds],
                tags=list(registration.tags),
            )
        return worker_id

    async def _make_room(self, tx: Tx, owner: str) -> None:
        """TooMany unless the token may register another worker, for which one that is gone makes room."""
        most = self._config.limits.workers
        await tx.run("lock_registrations", owner=owner)
        over = (await tx.one("count_workers", owner=owner))["workers"] + 1 - most
        if over > 0 and await tx.count("replace_workers", owner=owner, offline_s=OFFLINE_S, count=over) < over:
            raise TooMany(
                f"the token '{owner}' has {most} workers registered",
                where="limits.workers",
                remedy=f"One that was not heard of for {OFFLINE_S:.0f} s makes room; or raise limits.workers.",
                wait_s=round(OFFLINE_S),
            )

    async def claim(
        self, worker_id: str, request: ClaimRequest, owner: str, is_gone: Callable[[], Awaitable[bool]]
    ) -> Handed | None:
        """The next task of these kinds, waiting for one as long as the worker allows; None where there is none.

        `is_gone` tells whether the worker hung up: a task given to nobody would wait for the reaper.
        """
        deadline = time.monotonic() + request.wait_s
        with self._signals.watch(QUEUED_CHANNEL, [*request.kinds, worker_id]) as woken:
            while True:
                woken.clear()
                if await is_gone():
                    self._signals.wake(QUEUED_CHANNEL, 1, request.kinds)
                    return None
                found = await self._claim_once(worker_id, request.kinds, owner)
                if isinstance(found, Handed):
                    # There may be more: the next one that waits looks.
                    self._signals.wake(QUEUED_CHANNEL, 1, [found.claim.payload.kind])
                    return found
                left = deadline - time.monotonic()
                if left <= 0 or self._signals.stopping:
                    return None
                if found is _NOTHING:
                    await wait(woken, min(left, self._signals.claim_poll_s(self._config.timing.poll_s)))

    async def _claim_once(self, worker_id: str, kinds: Sequence[TaskKind], owner: str) -> "Handed | _Outcome":
        stale_s = self._config.timing.stale_s
        # What one worker asks at once would otherwise wait for the worker's row with all connections in hand.
        async with self._database.turn(worker_id), self._database.transaction() as tx:
            worker = await _find_worker(tx, worker_id, owner)
            if worker.orders == "drain":
                raise Drained("an operator told the worker to leave", where=worker.name)
            rests = worker.orders == "sleep" or worker.asleep or self._disk.shortage() is not None
            job_id = None if rests else await queue.look(tx, worker, kinds, stale_s)
            if job_id is None:
                await tx.run("see_worker_lightly", id=worker_id)
                return _NOTHING
        return await self._claims.ask(job_id, (worker, kinds)) or _GONE

    async def _claim_all(
        self, tx: Tx, job_id: str, askers: Sequence[tuple[WorkerRow, Sequence[TaskKind]]]
    ) -> list[Handed | Exception | None]:
        """A task of the job for each worker; None where others have claimed what it saw."""
        leases = [secrets.token_urlsafe(32) for _ in askers]
        hashes = [digest_of(lease) for lease in leases]
        job, tasks = await transitions.claim_next(tx, job_id, askers, hashes, self._config.timing.stale_s)
        claims: list[Handed | Exception | None] = []
        for (worker, _), task, lease in zip(askers, tasks, leases, strict=True):
            if task is None:
                claims.append(None)
                continue
            await tx.run("see_worker", id=worker.id)
            built = await build_payload(tx, job, task)
            claim = Claim(
                task_id=task.id,
                job_id=job.id,
                attempt=task.attempt,
                lease=lease,
                payload=built.payload,
                checkpoint=task.checkpoint,
            )
            claims.append(Handed(claim, built.lists))
        return claims

    async def heartbeat(self, worker_id: str, beat: Heartbeat, owner: str) -> HeartbeatReply:
        """Keep the attempt alive, or tell the worker to stop."""
        progress = beat.progress
        async with self._database.turn(worker_id):
            row = await self._database.first(
                "beat",
                worker_id=worker_id,
                owner=owner,
                task_id=beat.task_id,
                attempt=beat.attempt,
                lease_sha256=digest_of(beat.lease),
                lines=beat.log if self._disk.shortage() is None else "",
                progress=Jsonb(progress.model_dump(mode="json")) if progress else None,
                step=progress.done if progress else None,
                loss=progress.loss if progress else None,
            )
        if row is None or not row["known"]:
            raise _no_worker(worker_id)
        self._logs.taken(beat.log)
        if row["job_state"] is None:
            return HeartbeatReply(stop=True, reason="the task was given to another attempt or is over")
        state = JobState(row["job_state"])
        if state in LIVE_JOB_STATES:
            return HeartbeatReply(stop=False)
        await self._stop_attempt(beat.task_id, beat.attempt, f"the job is {state}")
        return HeartbeatReply(stop=True, reason=f"the job is {state}")

    async def _stop_attempt(self, task_id: str, attempt: int, reason: str) -> None:
        """The worker is being told to stop: the task is canceled, and any later word of the attempt refused."""
        async with locked_task(self._database, task_id) as (tx, job, task):
            if task.state is TaskState.ACTIVE and task.attempt == attempt:
                await transitions.cancel_task(tx, task, transitions.COORDINATOR, reason)
                await settle_cancel(tx, job)

    async def checkpoint(self, task_id: str, checkpoint: Checkpoint) -> None:
        """Publish a checkpoint for later attempts; the one before is no longer used."""
        async with locked_task(self._database, task_id) as (tx, _, task):
            _check_fence(task, checkpoint)
            await _require(tx, [checkpoint.sha256])
            await drop_blobs(tx, f"checkpoint:{task.id}")
            await use_blobs(tx, f"checkpoint:{task.id}", [checkpoint.sha256])
            await tx.run("set_checkpoint", id=task.id, sha256=checkpoint.sha256)
            await tx.run("forget_task_failures", ids=[task.id])

    async def commit(self, task_id: str, commit: Commit) -> None:
        """Take an attempt's result. The same commit again (its answer was lost) is no error."""
        if isinstance(commit.result, RenderResult):
            job_id = await job_of(self._database, task_id)
            if await self._renders.ask(job_id, (task_id, commit)):
                return
        sources: Sequence[str] = ()
        if isinstance(commit.result, PrepareResult):
            sources = await check_sources(self._database, self._config, task_id, commit.result)
        stopped: StaleAttempt | None = None
        async with locked_task(self._database, task_id) as (tx, job, task):
            if _is_repeated(task, commit):
                return
            _check_fence(task, commit)
            _check_result(job, task, commit.result)
            if job.state not in LIVE_JOB_STATES:
                stopped = StaleAttempt(f"the job is {job.state}; the result is not wanted", where=task.label)
                await transitions.cancel_task(tx, task, transitions.COORDINATOR, stopped.detail)
                await settle_cancel(tx, job)
            else:
                await self._accept(tx, job, task, commit.result, sources)
        if stopped:
            raise stopped

    async def _commit_renders(
        self, tx: Tx, job_id: str, commits: Sequence[tuple[str, Commit]]
    ) -> list[bool | Exception]:
        """Tiles of a job that goes on, which are most of its commits; False for all where it does not."""
        locked = await tx.ask("lock_job", id=job_id)
        tasks = [await tx.ask("lock_task", id=task_id) for task_id, _ in commits]
        job = JobRow.of(await fetched(locked))
        if job.state not in LIVE_JOB_STATES:
            return [False] * len(commits)
        answers: list[bool | Exception] = []
        rendered: tuple[TaskRow, Result] | None = None
        for cursor, (_, commit) in zip(tasks, commits, strict=True):
            task = TaskRow.of(await fetched(cursor))
            try:
                if not _is_repeated(task, commit):
                    _check_fence(task, commit)
                    _check_result(job, task, commit.result)
                    await transitions.complete_task(tx, task, commit.result)
                    await tx.run("clear_strikes", id=task.worker_id)
                    rendered = task, commit.result
                answers.append(True)
            except KilnError as error:
                answers.append(error)
        if rendered is not None:
            await _fan_in(tx, job, *rendered)
        return answers

    async def _accept(self, tx: Tx, job: JobRow, task: TaskRow, result: Result, sources: Sequence[str]) -> None:
        """Complete the task, publish what it made, and go on with the job; `sources` may be reused."""
        if made := _blobs_of(result):
            sizes = await _require(tx, made)
            if isinstance(result, PackageResult):
                _check_sizes(result, sizes)
            await use_blobs(tx, f"result:{task.id}", made)
        await transitions.complete_task(tx, task, result)
        if isinstance(result, PrepareResult) and job.prepared is not None:
            _check_same(job, result)
        elif isinstance(result, PrepareResult):
            await tx.run("add_notes", id=job.id, notes=Jsonb(list(result.notes)))
            prepared = result.model_dump(mode="json", exclude={"tiles", "placements"})
            await tx.run("set_prepared", id=job.id, prepared=Jsonb(prepared))
            try:
                most = self._config.limits.tiles
                planned = await asyncio.to_thread(plan_after_prepare, result, job.settings, job.gates, most)
            except InputError as error:
                await transitions.fail_job(tx, job, error.problem(), transitions.COORDINATOR)
                return
            source = await renders_to_reuse(tx, job, result, sources)
            if source is None:
                await transitions.add_tasks(tx, job, planned)
            else:
                await transitions.add_tasks(tx, job, [replace(task, ready=False) for task in planned])
                await transitions.reuse_renders(tx, job, source.job_id, source.store_url)
        if isinstance(result, FitResult):
            await tx.run("drop_losses", task_id=task.id)  # the whole curve is in the result
        if isinstance(result, PackageResult):
            for artifact in result.artifacts:
                await tx.run("add_artifact", job_id=job.id, **artifact.model_dump())
        await tx.run("clear_strikes", id=task.worker_id)
        await _fan_in(tx, job, task, result)

    async def fail(self, task_id: str, failure: Failure) -> None:
        """An attempt ended without a result: another may try, or the task fails."""
        lost = await lost_renders.believed(self._database, self._config, task_id, failure)
        async with locked_task(self._database, task_id) as (tx, job, task):
            _check_fence(task, failure)
            lines = failure.log if self._disk.shortage() is None else ""
            await _add_log(tx, task.id, failure.attempt, lines)
            self._logs.taken(lines)
            if lost is not None and job.state in LIVE_JOB_STATES and task.strikes + 1 < self._config.max_attempts:
                actor, reason = f"worker:{task.worker_id}", failure.problem.sentence()
                await transitions.requeue_task(tx, task, "task.retried", actor, strike=True, reason=reason)
                await lost_renders.redo(tx, self._config, job, lost)
                return
            await self.end_attempt(
                tx,
                job,
                task,
                failure.problem,
                kind="task.retried",
                actor=f"worker:{task.worker_id}",
                retryable=failure.retryable,
            )

    async def end_attempt(
        self, tx: Tx, job: JobRow, task: TaskRow, problem: Problem, *, kind: str, actor: str, retryable: bool
    ) -> None:
        """What follows when the running attempt of a locked task is over without a result.

        Another attempt follows, unless it was the last. A task that fails leaves its job to the tasks that go
        without it; an input error is final for both, whatever the worker says.
        """
        if job.state not in LIVE_JOB_STATES:
            await transitions.cancel_task(tx, task, actor, f"the job is {job.state}")
            await settle_cancel(tx, job)
            return
        final = isinstance(KilnError.from_problem(problem), InputError)
        strike = problem.code != RELEASED_CODE
        if retryable and not final:
            if strike and await note_failure(tx, job, task, self._config):
                task, strike = await _lock(tx, task.id), False
            if not strike or task.strikes + 1 < self._config.max_attempts:
                reason = problem.sentence()
                await transitions.requeue_task(tx, task, kind, actor, strike=strike, reason=reason)
                return
        await transitions.fail_task(tx, task, problem, actor)
        if final or await self._fails_with(tx, job, task):
            await transitions.fail_job(tx, job, problem, actor)

    async def _fails_with(self, tx: Tx, job: JobRow, task: TaskRow) -> bool:
        """Whether the job fails with this task: nothing is left to do for it, or the rest would fail as well.

        That is to be expected where many have failed, or the first of all on the only worker there is.
        """
        stale_s, share = self._config.timing.stale_s, self._config.failed_tasks
        row = await tx.one("failed_share", job_id=job.id, kind=task.kind, worker_id=task.worker_id, stale_s=stale_s)
        many = row["failed"] >= share.least and row["failed"] > share.of_all * row["total"]
        return not row["open"] or many or not (row["completed"] or row["others"])


class _Outcome:
    """Why a claim got no task."""


_NOTHING: Final = _Outcome()
_GONE: Final = _Outcome()
"""Somebody else was quicker; look again at once."""


@asynccontextmanager
async def locked_task(database: Database, task_id: str) -> AsyncIterator[tuple[Tx, JobRow, TaskRow]]:
    """A transaction with a task and its job, both locked, the job first."""
    job_id = await job_of(database, task_id)
    async with database.turn(job_id), database.transaction() as tx:
        locked = await tx.ask("lock_job", id=job_id)
        task = await _lock(tx, task_id)
        yield tx, JobRow.of(await fetched(locked)), task


async def job_of(database: Database, task_id: str) -> str:
    """The id of a task's job."""
    row = await database.first("job_of_task", id=task_id)
    if row is None:
        raise NotFound(f"no task '{task_id}'", where="task")
    return str(row["job_id"])


async def _lock(tx: Tx, task_id: str) -> TaskRow:
    return TaskRow.of(await tx.one("lock_task", id=task_id))


async def _find_worker(tx: Tx, worker_id: str, owner: str) -> WorkerRow:
    """The worker, if this token registered it."""
    row = await tx.maybe("find_worker", id=worker_id)
    if row is None or row["owner"] != owner:
        raise _no_worker(worker_id)
    return WorkerRow.of(row)


def _no_worker(worker_id: str) -> NotFound:
    return NotFound(f"no worker '{worker_id}'", where="worker", remedy="Register it with POST /v1/workers.")


async def _fan_in(tx: Tx, job: JobRow, task: TaskRow, result: Result) -> None:
    """After a completed task: release the next stage, or finish the job, if it was its stage's last.

    Where only failed tasks are left of the stage, the job fails with the first of them.
    """
    left = await tx.one("stage_left", job_id=job.id, kind=task.kind)
    if left["unfinished"]:
        if left["stuck"]:
            await transitions.fail_job(tx, job, readable(Problem, left["stuck"]), transitions.COORDINATOR)
        return
    stage = METHODS[job.method].stage_after(task.kind)
    while stage is not None and not (await tx.one("stage_left", job_id=job.id, kind=stage))["unfinished"]:
        stage = METHODS[job.method].stage_after(stage)
    if stage is None:
        await transitions.finish_job(tx, job, result.gates if isinstance(result, PackageResult) else ())
        return
    await add_event(tx, job.id, "stage.completed", transitions.COORDINATOR, detail={"kind": task.kind.value})
    await transitions.release_tasks(tx, job, stage)


def _check_fence(task: TaskRow, said: Commit | Failure | Checkpoint) -> None:
    """StaleAttempt unless this is said by who holds the running attempt. It names nobody, and nothing of the task."""
    if task.state is not TaskState.ACTIVE or not _holds(task, said):
        raise StaleAttempt(
            f"attempt {said.attempt} of the task is over, or the lease is not the one that its claim was given",
            where="lease",
            remedy="Drop the work and claim again.",
        )


def _holds(task: TaskRow, said: Commit | Failure | Checkpoint) -> bool:
    """Whether this is said under the task's last attempt, with its lease."""
    right = task.lease_sha256 is not None and hmac.compare_digest(task.lease_sha256, digest_of(said.lease))
    return right and task.attempt == said.attempt


def _is_repeated(task: TaskRow, commit: Commit) -> bool:
    return (
        task.state is TaskState.COMPLETED
        and _holds(task, commit)
        and task.result == commit.result.model_dump(mode="json")
    )


def _check_result(job: JobRow, task: TaskRow, result: Result) -> None:
    """InputError where the result is not one of this task."""
    if result.kind is not task.kind:
        raise InputError(f"a result of kind '{result.kind}' for a task of kind '{task.kind}'", where="result.kind")
    given: object = None
    if isinstance(result, RenderResult):
        given = {"tile": result.tile.model_dump(mode="json")}
    elif isinstance(result, FitResult):
        given = {"function": result.function.value}
    elif isinstance(result, RefineResult):
        given = {"block": result.block.model_dump(mode="json")}
    if given is not None and given != task.spec:
        raise InputError(f"the result is of {given}, the task is {task.spec}", where="result")
    if isinstance(result, PackageResult):
        names = [artifact.name for artifact in result.artifacts]
        if len(set(names)) < len(names):
            raise InputError("two artifacts have the same name", where="result.artifacts")
        asked = job.gates.thresholds()
        if len(result.gates) != len(asked) or {gate.name: gate.threshold for gate in result.gates} != asked:
            raise InputError("the gates measured are not those that the job states", where="result.gates")


def _blobs_of(result: Result) -> list[str]:
    """Hashes that the result names."""
    match result:
        case PrepareResult():
            optional = [digest for digest in (result.fine, result.cache) if digest]
            return [result.scene, result.texel_map, *result.between, *optional]
        case FitResult():
            return [result.weights]
        case RefineResult():
            return [result.lobes]
        case PackageResult():
            return [artifact.sha256 for artifact in result.artifacts]
        case RenderResult():
            return []


async def _require(tx: Tx, hashes: Sequence[str]) -> dict[str, int]:
    """Sizes of blobs, which are kept until the transaction ends; Conflict where one is not here."""
    sizes = await hold_blobs(tx, hashes)
    if absent := sorted(set(hashes) - sizes.keys()):
        raise Conflict(
            f"blobs were not uploaded: {', '.join(absent)}",
            where="blobs",
            remedy="PUT them to /v1/blobs/{sha256} and repeat the call.",
        )
    return sizes


def _check_sizes(result: PackageResult, sizes: dict[str, int]) -> None:
    """InputError where an artifact has another size than its blob: it could never be downloaded."""
    for artifact in result.artifacts:
        if artifact.size != sizes[artifact.sha256]:
            raise InputError(
                f"it is said to have {artifact.size} bytes, its blob has {sizes[artifact.sha256]}",
                where=f"result.artifacts: {artifact.name}",
            )


def _check_same(job: JobRow, result: PrepareResult) -> None:
    """InputError where a scene that was prepared again came out as another one: its tiles would not fit together."""
    again = result.model_dump(mode="json")
    changed = [name for name in ("scene_hash", "texel_map") if (job.prepared or {}).get(name) != again[name]]
    if changed:
        raise InputError(
            f"the scene was prepared again and its {' and '.join(changed)} changed",
            where="prepare",
            remedy="Submit the job anew: its worker's libraries are of other versions than those that began it.",
        )


async def _add_log(tx: Tx, task_id: str, attempt: int, lines: str) -> None:
    if lines:
        await tx.run("add_log", task_id=task_id, attempt=attempt, lines=lines)
