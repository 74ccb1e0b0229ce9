"""What follows when bytes that jobs need turn out to be damaged or gone: whoever can make them again does.

A checkpoint is dropped, and its task begins from its start. The task whose result named the blob is done again. A file
of the bundle can only come from the client: the job fails and names it, and may be retried once it was uploaded again.
A job that is over keeps its state; its next `retry` or `requeue` does the same before it goes on.
"""

from kiln_schemas.errors import Damaged
from kiln_schemas.states import LIVE_JOB_STATES, TaskState
from kiln_schemas.tasks import TaskKind
from kiln_service import transitions
from kiln_service.blobs import drop_blobs, require_blobs
from kiln_service.db import Database, JobRow, Tx
from kiln_service.events import add_event


async def make_again(database: Database, sha256: str) -> None:
    """A blob is damaged: see to it that each live job that uses it gets it again, or fails with a sentence."""
    async with database.transaction() as tx:
        rows = await tx.all("jobs_of_blob", sha256=sha256)
    for row in rows:
        async with database.turn(row["job_id"]), database.transaction() as tx:
            job = JobRow.of(await tx.one("lock_job", id=row["job_id"]))
            if job.state in LIVE_JOB_STATES and (error := await redo_damaged(tx, job)) is not None:
                await transitions.fail_job(tx, job, error.problem(), transitions.COORDINATOR)


async def redo_damaged(tx: Tx, job: JobRow) -> Damaged | None:
    """Have the damaged blobs of a locked job made again; the error where one of them is a file that it still needs."""
    rows = await tx.all("damaged_tasks", job_id=job.id)
    begin_again = [row["id"] for row in rows if row["use"] == "checkpoint"]
    if begin_again:
        await tx.run("forget_checkpoints", ids=begin_again)
        await drop_blobs(tx, *(f"checkpoint:{task_id}" for task_id in begin_again))
        await add_event(tx, job.id, "checkpoints.lost", transitions.COORDINATOR, detail={"count": len(begin_again)})
    lost = [row for row in rows if row["use"] == "result"]
    if lost:
        kinds = {TaskKind(row["kind"]) for row in lost}
        choice = transitions.Choice(ids=[row["id"] for row in lost])
        await transitions.redo_lost(tx, job, kinds, choice, "blobs of their results are damaged")
    return await damaged_files(tx, job)


async def damaged_files(tx: Tx, job: JobRow) -> Damaged | None:
    """The error of a locked job whose scene is still to be read and has a damaged file."""
    if (await tx.one("prepare_state", job_id=job.id))["state"] == TaskState.COMPLETED:
        return None
    absent = set(await require_blobs(tx, job.bundle.files.values()))
    names = sorted(f"{path} ({sha256})" for path, sha256 in job.bundle.files.items() if sha256 in absent)
    if not names:
        return None
    return Damaged(
        f"the stored bytes of {len(names)} files of the bundle are damaged or gone: {', '.join(names[:8])}",
        where="bundle.files",
        remedy="Upload the files again (`PUT /v1/blobs/{sha256}`; `lightkiln bake` does it) and retry the job.",
    )
