"""What workers ask: register, claim, heartbeat, commit, fail, checkpoint.

The fence: a claim increments the task's attempt, every later call carries it, and a call whose attempt is not the
task's running one is refused with StaleAttempt, for procrastinate itself would take a zombie's finish.
Everything that a commit causes (the result, the next stage's release, the job's end) happens in its
transaction under the job's lock, so the last tile's fan-in happens once.
"""

import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from typing import Final

from psycopg.types.json import Jsonb

from kiln_schemas import __version__
from kiln_schemas.errors import Conflict, Drained, InputError, KilnError, NotFound, Problem, StaleAttempt
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
from kiln_service import queue, transitions
from kiln_service.blobs import drop_blobs, require_blobs, use_blobs
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, JobRow, TaskRow, Tx, WorkerRow
from kiln_service.events import QUEUED_CHANNEL, Signals, add_event, wait
from kiln_service.ids import new_id
from kiln_service.jobs import lock_job, settle_cancel, withdraw
from kiln_service.payloads import build_payload
from kiln_service.planner import METHODS, plan_after_prepare
from kiln_service.reuse import renders_to_reuse

RELEASED_CODE: Final = "canceled"
"""A worker that leaves in good order gives its task back with this code; that is no strike against the task."""


class Work:
    """The workers' side of one coordinator."""

    def __init__(self, database: Database, config: ServiceConfig, signals: Signals) -> None:
        self._database, self._config, self._signals = database, config, signals

    async def register(self, registration: WorkerRegistration) -> str:
        """A new worker's id; Conflict where it is of another version than this coordinator."""
        if registration.version != __version__:
            raise Conflict(
                f"the worker is lightkiln {registration.version}, the coordinator {__version__}",
                where="version",
                remedy="Install the same version on both: what they tell each other changes between versions.",
            )
        worker_id = new_id()
        async with self._database.transaction() as tx:
            await tx.run(
                "insert_worker",
                id=worker_id,
                **registration.model_dump(exclude={"kinds"}),
                kinds=[kind.value for kind in registration.kinds],
                queue_worker=await queue.register_worker(tx),
            )
        return worker_id

    async def claim(
        self, worker_id: str, request: ClaimRequest, is_gone: Callable[[], Awaitable[bool]]
    ) -> Claim | None:
        """The next task of these kinds, waiting for one as long as the worker allows; None where there is none.

        `is_gone` tells whether the worker hung up: a task given to nobody would wait for the reaper.
        """
        deadline = time.monotonic() + request.wait_s
        with self._signals.watch(QUEUED_CHANNEL) as woken:
            while True:
                woken.clear()
                if await is_gone():
                    return None
                found = await self._claim_once(worker_id, request.kinds)
                if isinstance(found, Claim):
                    return found
                left = deadline - time.monotonic()
                if left <= 0 or self._signals.stopping:
                    return None
                if found is _NOTHING:
                    await wait(woken, min(left, self._config.timing.poll_s))

    async def _claim_once(self, worker_id: str, kinds: Sequence[TaskKind]) -> "Claim | _Outcome":
        async with self._database.transaction() as tx:
            worker = await _seen(tx, worker_id)
            if worker.orders == "drain":
                raise Drained("an operator told the worker to leave", where=worker.name)
            if worker.orders == "sleep":
                return _NOTHING
            fetched = await queue.fetch(tx, kinds, worker.queue_worker)
            if fetched is None:
                return _NOTHING
            queue_job, task_id = fetched
            job, task = await lock_task(tx, task_id)
            paused = job.state is JobState.PAUSED
            if paused or task.state is not TaskState.QUEUED or task.queue_job != queue_job:
                await queue.finish(tx, queue_job)
                return _DROPPED
            task = await transitions.claim_task(tx, job, task, worker)
            payload = await build_payload(tx, job, task)
        return Claim(task_id=task.id, job_id=job.id, attempt=task.attempt, payload=payload, checkpoint=task.checkpoint)

    async def heartbeat(self, worker_id: str, beat: Heartbeat) -> HeartbeatReply:
        """Keep the attempt alive, or tell the worker to stop."""
        async with self._database.transaction() as tx:
            await _seen(tx, worker_id)
            await _add_log(tx, beat.task_id, beat.attempt, beat.log)
            row = await tx.maybe(
                "beat_task",
                id=beat.task_id,
                attempt=beat.attempt,
                progress=Jsonb(beat.progress.model_dump(mode="json")) if beat.progress else None,
            )
            if row is not None and beat.progress is not None and beat.progress.loss is not None:
                await tx.run("add_loss", task_id=beat.task_id, step=beat.progress.done, loss=beat.progress.loss)
        if row is None:
            return HeartbeatReply(stop=True, reason="the task was given to another attempt or is over")
        state = JobState(row["job_state"])
        if state in LIVE_JOB_STATES:
            return HeartbeatReply(stop=False)
        await self._stop_attempt(beat.task_id, beat.attempt, f"the job is {state}")
        return HeartbeatReply(stop=True, reason=f"the job is {state}")

    async def _stop_attempt(self, task_id: str, attempt: int, reason: str) -> None:
        """The worker is being told to stop: the task is canceled, and any later word of the attempt refused."""
        async with self._database.transaction() as tx:
            job, task = await lock_task(tx, task_id)
            if task.state is TaskState.ACTIVE and task.attempt == attempt:
                await transitions.cancel_task(tx, task, transitions.COORDINATOR, reason)
                await settle_cancel(tx, job)

    async def checkpoint(self, task_id: str, checkpoint: Checkpoint) -> None:
        """Publish a checkpoint for later attempts; the one before is no longer used."""
        async with self._database.transaction() as tx:
            _, task = await lock_task(tx, task_id)
            _check_fence(task, checkpoint.attempt)
            await _require(tx, [checkpoint.sha256])
            await drop_blobs(tx, f"checkpoint:{task.id}")
            await use_blobs(tx, f"checkpoint:{task.id}", [checkpoint.sha256])
            await tx.run("set_checkpoint", id=task.id, sha256=checkpoint.sha256)

    async def commit(self, task_id: str, commit: Commit) -> None:
        """Take an attempt's result. The same commit again (its answer was lost) is no error."""
        idle: list[int] = []
        stopped: StaleAttempt | None = None
        async with self._database.transaction() as tx:
            job, task = await lock_task(tx, task_id)
            if _is_repeated(task, commit):
                return
            _check_fence(task, commit.attempt)
            _check_result(job, task, commit.result)
            if job.state not in LIVE_JOB_STATES:
                stopped = StaleAttempt(f"the job is {job.state}; the result is not wanted", where=task.label)
                await transitions.cancel_task(tx, task, transitions.COORDINATOR, stopped.detail)
                await settle_cancel(tx, job)
            else:
                idle = await self._accept(tx, job, task, commit.result)
        await withdraw(self._database, idle)
        if stopped:
            raise stopped

    async def _accept(self, tx: Tx, job: JobRow, task: TaskRow, result: Result) -> list[int]:
        """Complete the task, publish what it made, and go on with the job; returns queue jobs to withdraw."""
        made = _blobs_of(result)
        await _require(tx, made)
        await use_blobs(tx, f"result:{task.id}", made)
        await transitions.complete_task(tx, task, result)
        if isinstance(result, PrepareResult):
            await tx.run("add_notes", id=job.id, notes=Jsonb(list(result.notes)))
            try:
                planned = plan_after_prepare(result, job.settings, job.gates, self._config.limits.tiles)
            except InputError as error:
                return await transitions.fail_job(tx, job, error.problem(), transitions.COORDINATOR)
            source = await renders_to_reuse(tx, job, result)
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
        await _fan_in(tx, job, task, result)
        return []

    async def fail(self, task_id: str, failure: Failure) -> None:
        """An attempt ended without a result: try again, or fail the task and its job."""
        idle: list[int] = []
        async with self._database.transaction() as tx:
            job, task = await lock_task(tx, task_id)
            _check_fence(task, failure.attempt)
            await _add_log(tx, task.id, failure.attempt, failure.log)
            idle = await self.end_attempt(
                tx,
                job,
                task,
                failure.problem,
                kind="task.retried",
                actor=f"worker:{task.worker_id}",
                retryable=failure.retryable,
            )
        await withdraw(self._database, idle)

    async def end_attempt(
        self, tx: Tx, job: JobRow, task: TaskRow, problem: Problem, *, kind: str, actor: str, retryable: bool
    ) -> list[int]:
        """What follows when the running attempt of a locked task is over without a result.

        Returns queue jobs to withdraw after the transaction. An input error is final, whatever the worker says.
        """
        if job.state not in LIVE_JOB_STATES:
            await transitions.cancel_task(tx, task, actor, f"the job is {job.state}")
            await settle_cancel(tx, job)
            return []
        input_error = isinstance(KilnError.from_problem(problem), InputError)
        released = problem.code == RELEASED_CODE
        last = not released and task.strikes + 1 >= self._config.max_attempts
        if retryable and not input_error and not last:
            reason = problem.sentence()
            await transitions.requeue_task(tx, job, task, kind, actor, strike=not released, reason=reason)
            return []
        return await transitions.fail_task(tx, job, task, problem, actor)


class _Outcome:
    """Why a claim got no task."""


_NOTHING: Final = _Outcome()
_DROPPED: Final = _Outcome()
"""The queue gave a job whose task is not queued any more; look again at once."""


async def lock_task(tx: Tx, task_id: str) -> tuple[JobRow, TaskRow]:
    """A task and its job, both locked, the job first."""
    owner = await tx.maybe("job_of_task", id=task_id)
    if owner is None:
        raise NotFound(f"no task '{task_id}'", where="task")
    job = await lock_job(tx, owner["job_id"])
    return job, TaskRow.of(await tx.one("lock_task", id=task_id))


async def _seen(tx: Tx, worker_id: str) -> WorkerRow:
    """The worker, marked as alive here and in procrastinate."""
    row = await tx.maybe("see_worker", id=worker_id)
    if row is None:
        raise NotFound(f"no worker '{worker_id}'", where="worker", remedy="Register it with POST /v1/workers.")
    worker = WorkerRow.of(row)
    await queue.beat(tx, worker.queue_worker)
    return worker


async def _fan_in(tx: Tx, job: JobRow, task: TaskRow, result: Result) -> None:
    """After a completed task: release the next stage, or finish the job, if it was its stage's last."""
    if await _unfinished(tx, job, task.kind):
        return
    stage = METHODS[job.method].stage_after(task.kind)
    while stage is not None and not await _unfinished(tx, job, stage):
        stage = METHODS[job.method].stage_after(stage)
    if stage is None:
        await transitions.finish_job(tx, job, result.gates if isinstance(result, PackageResult) else ())
        return
    await add_event(tx, job.id, "stage.completed", transitions.COORDINATOR, detail={"kind": task.kind.value})
    for row in await tx.all("tasks_in_state", job_id=job.id, kind=stage, state=TaskState.WAITING):
        await transitions.release_task(tx, job, TaskRow.of(row))


async def _unfinished(tx: Tx, job: JobRow, kind: TaskKind) -> int:
    """Tasks of a kind that have not completed; none also where the job has no such task."""
    return int((await tx.one("count_unfinished", job_id=job.id, kind=kind))["tasks"])


def _check_fence(task: TaskRow, attempt: int) -> None:
    if task.state is not TaskState.ACTIVE or task.attempt != attempt:
        raise StaleAttempt(
            f"attempt {attempt} of the task is over: it is {task.state} in attempt {task.attempt}",
            where=task.label,
            remedy="Drop the work and claim again.",
        )


def _is_repeated(task: TaskRow, commit: Commit) -> bool:
    return (
        task.state is TaskState.COMPLETED
        and task.attempt == commit.attempt
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
            return [result.scene, result.texel_map, *result.between]
        case FitResult():
            return [result.weights]
        case RefineResult():
            return [result.lobes]
        case PackageResult():
            return [artifact.sha256 for artifact in result.artifacts]
        case RenderResult():
            return []


async def _require(tx: Tx, hashes: Sequence[str]) -> None:
    if absent := await require_blobs(tx, hashes):
        raise Conflict(
            f"blobs were not uploaded: {', '.join(absent)}",
            where="blobs",
            remedy="PUT them to /v1/blobs/{sha256} and repeat the call.",
        )


async def _add_log(tx: Tx, task_id: str, attempt: int, lines: str) -> None:
    if lines:
        await tx.run("add_log", task_id=task_id, attempt=attempt, lines=lines)
