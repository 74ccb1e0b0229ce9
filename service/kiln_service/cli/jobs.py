"""`lightkiln pause | resume | cancel | retry | requeue | archive | change | logs JOB`: what people do with jobs."""

import re
from typing import Annotated, Final, Literal

import typer

from kiln_schemas.client import Client
from kiln_schemas.errors import InputError
from kiln_schemas.job import JobChange, JobView, RequeueRequest, TaskView, read_labels
from kiln_schemas.options import of_options
from kiln_schemas.tasks import read_tags
from kiln_service.cli import options
from kiln_service.cli.output import print_json, results

Action = Literal["pause", "resume", "cancel", "retry", "archive"]

ACTIONS: Final[dict[Action, str]] = {
    "pause": "Give no more of a job's tasks to workers; those that run go on.",
    "resume": "Go on with a paused job.",
    "cancel": "Ask a job to stop.",
    "retry": "Do a failed or canceled job's unfinished tasks again, or the failed ones of a job that goes on.",
    "archive": "Put a job that is over aside: `status` leaves it out.",
}


def add_job_commands(app: typer.Typer) -> None:
    """Add them to the command line."""
    for action, text in ACTIONS.items():
        app.command(name=action, help=text)(_act(action))
    app.command()(requeue)
    app.command()(change)
    app.command()(logs)


def _act(action: Action):  # type: ignore[no-untyped-def]  # typer reads the parameters
    def command(
        job: options.JobId,
        url: options.Url = options.DEFAULT_URL,
        token: options.Token = None,
        data: options.Data = None,
        json: options.Json = False,
    ) -> None:
        with options.connect(url, token, data) as api:
            _tell(job, api.act(job, action), json=json)

    return command


def requeue(
    job: options.JobId,
    kind: Annotated[str, typer.Option("--kind", metavar="KIND", help="render, fit, refine or package.")] = "render",
    rows: Annotated[
        str | None, typer.Option("--rows", metavar="FIRST:STOP", help="Only tiles with texels in these rows.")
    ] = None,
    columns: Annotated[
        str | None, typer.Option("--columns", metavar="FIRST:STOP", help="Only tiles with texels in these columns.")
    ] = None,
    task: Annotated[
        list[str] | None, typer.Option("--task", help="Only the task with this label; may be repeated.")
    ] = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Do tasks again though they are done, and all that follows from them."""
    request = of_options(
        RequeueRequest,
        {"kind": "--kind", "labels": "--task"},
        kind=kind,
        rows=_span(rows, "--rows"),
        columns=_span(columns, "--columns"),
        labels=task,
    )
    with options.connect(url, token, data) as api:
        _tell(job, api.requeue(job, request), json=json)


def change(
    job: options.JobId,
    priority: Annotated[int | None, typer.Option("--priority", min=0, max=100, help="0 to 100.")] = None,
    label: options.Label = None,
    tag: options.Tag = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Rank a job anew, or label it anew: all labels, or all tags, that it shall have."""
    labels = None if label is None else read_labels(label)
    wanted = JobChange(priority=priority, labels=labels, tags=None if tag is None else read_tags(tag))
    with options.connect(url, token, data) as api:
        _tell(job, api.change(job, wanted), json=json)


def logs(
    job: options.JobId,
    task: Annotated[
        str | None,
        typer.Argument(metavar="TASK", help="Label (as in 'tile 0,16') or id; else those that failed or run."),
    ] = None,
    tail: Annotated[int | None, typer.Option("--tail", min=0, metavar="N", help="Only the last N lines.")] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Stay until the task is over; one task.")] = False,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Print what tasks wrote: the one named, or those that failed or run."""
    with options.connect(url, token, data) as api:
        tasks = _chosen(api.tasks(job), task)
        if follow:
            _follow(api, tasks, tail)
            return
        texts = {one.id: api.task_log(one.id, tail) for one in tasks}
    if json:
        shown = [{"id": t.id, "kind": t.kind, "label": t.label, "state": t.state, "log": texts[t.id]} for t in tasks]
        print_json(shown)
        return
    for one in tasks:
        results.print(f"{one.kind} {one.label} ({one.state}, attempt {one.attempt})", markup=False, soft_wrap=True)
        results.print(texts[one.id].rstrip() or "It wrote no log.", markup=False, highlight=False, soft_wrap=True)


def _follow(api: Client, tasks: list[TaskView], tail: int | None) -> None:
    if len(tasks) != 1:
        labels = ", ".join(task.label for task in tasks[:8]) or "none"
        raise InputError(
            f"{len(tasks)} tasks failed or run: {labels}",
            where="--follow",
            remedy="Name one: `lightkiln logs JOB TASK -f`.",
        )
    for piece in api.follow_log(tasks[0].id, tail):
        results.print(piece, end="", markup=False, highlight=False, soft_wrap=True)


def _span(text: str | None, where: str) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,6}):(\d{1,6})", text)
    if match is None or int(match[1]) >= int(match[2]):
        raise InputError(
            f"'{text}' is not a range", where=where, remedy="Write FIRST:STOP, as in 0:32 for the first 32."
        )
    return int(match[1]), int(match[2])


def _chosen(tasks: tuple[TaskView, ...], wanted: str | None) -> list[TaskView]:
    if wanted is None:
        return [task for task in tasks if task.state in ("failed", "soft-failed", "active")]
    found = [task for task in tasks if wanted in (task.id, task.label)]
    if not found:
        some = ", ".join(task.label for task in tasks[:8])
        raise InputError(f"the job has no task '{wanted}'", where="TASK", remedy=f"Its tasks are {some}, ...")
    return found


def _tell(job: str, view: JobView | None, *, json: bool) -> None:
    if view is None:  # the token may not look at jobs
        if json:
            print_json({"id": job})
        else:
            results.print(f"{job}: done", markup=False)
    elif json:
        print_json(view)
    else:
        results.print(f"{view.name}: {view.state.value}, priority {view.priority}", markup=False)
