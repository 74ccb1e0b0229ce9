"""`lightkiln pause | resume | cancel | retry | archive | change | logs JOB`: what people do with jobs on a farm."""

from typing import Annotated, Final, Literal

import typer

from kiln_schemas.errors import InputError
from kiln_schemas.job import JobChange, JobView, TaskView, read_labels
from kiln_service.cli import options
from kiln_service.cli.output import print_json, results

Action = Literal["pause", "resume", "cancel", "retry", "archive"]

ACTIONS: Final[dict[Action, str]] = {
    "pause": "Give no more of a job's tasks to workers; those that run go on.",
    "resume": "Go on with a paused job.",
    "cancel": "Ask a job to stop.",
    "retry": "Do a failed or canceled job's unfinished tasks again.",
    "archive": "Put a job that is over aside: `status` leaves it out.",
}


def add_job_commands(app: typer.Typer) -> None:
    """Add them to the command line."""
    for action, text in ACTIONS.items():
        app.command(name=action, help=text)(_act(action))
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
            _tell(api.act(job, action), json=json)

    return command


def change(
    job: options.JobId,
    priority: Annotated[int | None, typer.Option("--priority", min=0, max=100, help="0 to 100.")] = None,
    label: options.Label = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Rank a job anew, or label it anew: all labels that it shall have."""
    labels = None if label is None else read_labels(label)
    with options.connect(url, token, data) as api:
        _tell(api.change(job, JobChange(priority=priority, labels=labels)), json=json)


def logs(
    job: options.JobId,
    task: Annotated[
        str | None,
        typer.Argument(metavar="TASK", help="Label (as in 'tile 0,16') or id; else those that failed or run."),
    ] = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Print what tasks wrote: the one named, or those that failed or run."""
    with options.connect(url, token, data) as api:
        tasks = _chosen(api.tasks(job), task)
        texts = {one.id: api.task_log(one.id) for one in tasks}
    if json:
        shown = [{"id": t.id, "kind": t.kind, "label": t.label, "state": t.state, "log": texts[t.id]} for t in tasks]
        print_json(shown)
        return
    for one in tasks:
        results.print(f"{one.kind} {one.label} ({one.state}, attempt {one.attempt})", markup=False, soft_wrap=True)
        results.print(texts[one.id].rstrip() or "It wrote no log.", markup=False, highlight=False, soft_wrap=True)


def _chosen(tasks: tuple[TaskView, ...], wanted: str | None) -> list[TaskView]:
    if wanted is None:
        return [task for task in tasks if task.state in ("failed", "active")]
    found = [task for task in tasks if wanted in (task.id, task.label)]
    if not found:
        some = ", ".join(task.label for task in tasks[:8])
        raise InputError(f"the job has no task '{wanted}'", where="TASK", remedy=f"Its tasks are {some}, ...")
    return found


def _tell(view: JobView, *, json: bool) -> None:
    if json:
        print_json(view)
    else:
        results.print(f"{view.name}: {view.state.value}, priority {view.priority}", markup=False)
