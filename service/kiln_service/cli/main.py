"""The `lightkiln` command.

Exit codes: 0 done; 1 a defect of lightkiln; 2 wrong usage; 3 an input (scene, file, setting, id) is wrong; 4 the bake
failed or the request contradicts the present state; 5 canceled; 6 the coordinator does not answer or refuses the token;
7 this machine lacks something; 8 the package is there, but misses a quality gate; 130 interrupted
(docs/cli.md, kiln_schemas.errors).
"""

import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Annotated, Final, NoReturn

import typer
from rich.markup import escape
from rich.table import Table

from kiln_schemas import __version__, program
from kiln_schemas.errors import InputError, KilnError, MachineLacks
from kiln_schemas.gates import check_gates, read_cameras, read_gates
from kiln_schemas.job import DEFAULT_PRIORITY, JobRequest, JobView, read_labels
from kiln_schemas.logs import LogFormat
from kiln_schemas.options import check_key, of_options
from kiln_schemas.settings import make_settings
from kiln_schemas.states import FINAL_JOB_STATES, PUBLISHED_JOB_STATES, JobState
from kiln_schemas.tasks import TaskKind, read_tags
from kiln_schemas.text import told
from kiln_service.cli import bake as baking
from kiln_service.cli import options
from kiln_service.cli.become import become
from kiln_service.cli.bundle import collect
from kiln_service.cli.compare import add_compare_command
from kiln_service.cli.doctor import examine
from kiln_service.cli.fetch import damaged_files, download_package
from kiln_service.cli.gates import end_of, raise_if_missed, raise_unless_completed, write_junit
from kiln_service.cli.jobs import add_job_commands
from kiln_service.cli.operators import add_operator_commands
from kiln_service.cli.output import (
    duration,
    notices,
    print_error,
    print_json,
    results,
    shown_path,
    stage_table,
)
from kiln_service.cli.pictures import add_picture_commands
from kiln_service.cli.progress import follow, make_display
from kiln_service.cli.upload import upload_and_submit

INTERRUPTED: Final = 130
NOTES_SHOWN: Final = 5

app = typer.Typer(
    name="lightkiln",
    help="Bake glossy global illumination into spherical Gaussian light-field textures.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
examples_app = typer.Typer(help="Example scenes.", no_args_is_help=True)
app.add_typer(examples_app, name="examples")


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        print(__version__)
        raise typer.Exit


@app.command()
def bake(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the package.")],
    scene: Annotated[
        str | None,
        typer.Argument(
            metavar="SCENE", help="glTF, FBX, DAE, OBJ, PLY, STL, OFF or Mitsuba XML; or gallery, courtyard."
        ),
    ] = None,
    env: options.Environment = None,
    env_scale: options.EnvironmentScale = 1.0,
    env_rotation: options.EnvironmentRotation = 0.0,
    preset: options.Preset = "preview",
    overrides: options.Overrides = None,
    gate: options.Gate = None,
    camera: options.Cameras = None,
    junit: options.Junit = None,
    workers: Annotated[int | None, typer.Option("--workers", min=1, max=256, help="Local workers.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the interrupted bake in DIR.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace what is in DIR.")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="Keep DIR/.lightkiln: the store, the database, logs.")] = False,
    json: options.Json = False,
) -> None:
    """Bake a scene on this machine: starts everything, shows progress, cleans up."""
    summary = baking.bake(
        baking.BakeOptions(
            scene=scene,
            out=out,
            environment=env,
            environment_scale=env_scale,
            environment_rotation_deg=env_rotation,
            preset=preset,
            overrides=tuple(overrides or ()),
            gates=read_gates(gate or ()),
            cameras=read_cameras(camera or ()),
            junit=junit,
            workers=workers,
            resume=resume,
            force=force,
            keep=keep,
        )
    )
    if json:
        raise_if_missed(summary.gates)
        print_json(summary)
        return
    if summary.already_done:
        results.print(f"This bake is already done: the same files and settings are in {escape(str(out))}.")
    else:
        spans = ", ".join(f"{kind} {duration(s)}" for kind, s in summary.stage_wall_seconds.items())
        results.print(f"Baked in {duration(summary.seconds)} ({spans}).")
        for note in summary.notes[:NOTES_SHOWN]:
            results.print(f"note: {note}", markup=False)
        if len(summary.notes) > NOTES_SHOWN:
            results.print(f"{len(summary.notes) - NOTES_SHOWN} more notes are in the manifest.")
    for word, path in (("package", summary.out), ("manifest", summary.manifest), ("report", summary.report)):
        if path is not None:
            results.print(f"{word:9} {shown_path(Path(path).absolute())}", markup=False, soft_wrap=True)
    if summary.report is not None:
        results.print("The pictures are in the report: open it in a browser.")
    for result in summary.gates:
        results.print(f"gate      {result.sentence()}", markup=False, soft_wrap=True)
    raise_if_missed(summary.gates)


@app.command()
def serve(
    data: Annotated[Path, typer.Option("--data", metavar="DIR", help="Folder for the database, blobs, token, stores.")],
    port: Annotated[int, typer.Option("--port", help="0 takes a free one.")] = 8321,
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    database: Annotated[
        str | None,
        typer.Option(
            "--database", envvar="LIGHTKILN_DATABASE", metavar="DSN", help="PostgreSQL; an embedded one by default."
        ),
    ] = None,
    storage: Annotated[
        str | None,
        typer.Option("--storage", metavar="URL", help="Light fields and blobs: file:// or s3://; --data by default."),
    ] = None,
    store: Annotated[
        str | None, typer.Option("--store", metavar="URL", help="Light-field stores alone: file:// or s3://.")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", metavar="FILE", help="JSON with all settings.")] = None,
    log_format: options.LogLines = LogFormat.TEXT,
    json: options.Json = False,
) -> None:
    """Run a coordinator."""
    if database is not None:
        # By the environment: a connection string may hold a password.
        os.environ["LIGHTKILN_DATABASE"] = database
    command = ["--host", host, "--port", str(port), "--data", str(data), "--log-format", log_format.value]
    for flag, value in (("--storage", storage), ("--store", store), ("--config", config)):
        command += [flag, str(value)] if value is not None else []
    become("kiln_service", [*command, *(["--json"] if json else [])])


@app.command()
def worker(
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    token_file: Annotated[Path | None, typer.Option("--token-file", help="File that holds the token.")] = None,
    data: options.Data = None,
    kinds: Annotated[str, typer.Option("--kinds", help="Kinds of tasks to take, separated by commas.")] = ",".join(
        TaskKind
    ),
    memory: Annotated[str | None, typer.Option("--memory", help="Main memory to use, e.g. 4GiB.")] = None,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Cores to use; all by default.")] = None,
    name: Annotated[str | None, typer.Option("--name", help="As the dashboard shows it.")] = None,
    scratch: Annotated[Path | None, typer.Option("--scratch", help="Folder for temporary files.")] = None,
    log_format: options.LogLines = LogFormat.TEXT,
    json: options.Json = False,
) -> None:
    """Work for a coordinator until told to stop."""
    # The token goes by the environment: command lines are visible to every user of the machine.
    if token_file is None:
        os.environ["LIGHTKILN_TOKEN"] = token or options.read_token(data)
    command = ["worker", "--url", url, "--kinds", kinds, "--log-format", log_format.value]
    flags = (("--token-file", token_file), ("--memory", memory), ("--threads", threads), ("--name", name))
    for flag, value in (*flags, ("--scratch", scratch)):
        command += [flag, str(value)] if value is not None else []
    become("kiln_workers", [*command, *(["--json"] if json else [])])


@app.command()
def submit(
    scene: Annotated[Path, typer.Argument(metavar="SCENE")],
    env: options.Environment = None,
    env_scale: options.EnvironmentScale = 1.0,
    env_rotation: options.EnvironmentRotation = 0.0,
    preset: options.Preset = "preview",
    overrides: options.Overrides = None,
    gate: options.Gate = None,
    camera: options.Cameras = None,
    name: Annotated[str | None, typer.Option("--name", help="The job's name; the file's by default.")] = None,
    priority: options.JobPriority = DEFAULT_PRIORITY,
    label: options.Label = None,
    tag: options.Tag = None,
    key: Annotated[
        str | None,
        typer.Option("--idempotency-key", help="Sent twice under the same key, a request makes one job."),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Until it is over; the exit code tells how it ended.")] = False,
    junit: options.Junit = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="With --wait: download the package into DIR.")
    ] = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Upload a scene and submit a job to a coordinator; --wait follows it to its end."""
    for flag, value in (("--junit", junit), ("--out", out)):
        if value is not None and not wait:
            raise typer.BadParameter("needs --wait", param_hint=flag)
    make_settings(preset, overrides or ())
    cameras = read_cameras(camera or ())
    gates = check_gates(read_gates(gate or ()), cameras)
    local = collect(scene, env, scale=env_scale, rotation_deg=env_rotation)
    if key is not None:
        check_key(key, "--idempotency-key")
    request = of_options(
        JobRequest,
        {"name": "--name", "set": "--set"},
        name=name or scene.stem[:128],
        bundle=local.bundle,
        preset=preset,
        set=tuple(overrides or ()),
        gates=gates,
        cameras=cameras,
        priority=priority,
        labels=read_labels(label or ()),
        tags=read_tags(tag or ()),
    )
    with options.connect(url, token, data) as api:
        job = upload_and_submit(api, local, request, key=key)
    if not wait:
        if json:
            print_json(job)
        else:
            results.print(job.id, markup=False)
        return
    if not json:
        results.print(job.id, markup=False)
    # A coordinator that is restarted meanwhile does not end the waiting.
    with options.connect(url, token, data, patience_s=60) as api:
        with make_display(quiet=json) as display:
            job = follow(api, job.id, display)
        write_junit(junit, job)
        if out is not None and job.state in PUBLISHED_JOB_STATES:
            download_package(api, job.id, out, force=False)
    if json:
        print_json(job)
    _exit_as_ended(job, json=json)


@app.command()
def status(
    job: Annotated[str | None, typer.Argument(metavar="JOB", help="All recent jobs without it.")] = None,
    label: options.Label = None,
    text: Annotated[str | None, typer.Option("--name", help="Only jobs with this in their name.")] = None,
    state: Annotated[
        list[JobState] | None, typer.Option("--state", help="Only jobs in this state; archived ones only with it.")
    ] = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Show one job, or the newest ones."""
    with options.connect(url, token, data) as api:
        if job is None:
            if text is not None and len(text) > 128:
                raise InputError("is longer than 128 characters", where="--name", remedy="No job's name is as long.")
            read_labels(label or ())
            page = api.jobs(labels=label or (), text=text, states=state or ())
            if json:
                print_json(page)
                return
            table = Table("job", "name", "state", "priority", "labels", "created", box=None)
            for view in page.jobs:
                words = ", ".join(f"{key}={value}" for key, value in view.labels.items())
                cells = (view.id, escape(view.name), view.state.value, str(view.priority), escape(words))
                table.add_row(*cells, f"{view.created:%Y-%m-%d %H:%M}")
            results.print(table)
            return
        view = api.job(job)
    if json:
        print_json(view)
        return
    left = f", about {duration(view.remaining_s)} left" if view.remaining_s is not None else ""
    results.print(f"{view.name}: {view.state.value}{left}", markup=False)
    if view.waits_for is not None:
        results.print(view.waits_for, markup=False, soft_wrap=True)
    results.print(stage_table(view))
    for result in view.gate_results:
        results.print(f"gate: {result.sentence()}", markup=False, soft_wrap=True)
    if view.error is not None:
        results.print(view.error.sentence(), markup=False, soft_wrap=True)


@app.command()
def watch(
    job: options.JobId,
    junit: options.Junit = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON document a line at every change.")] = False,
) -> None:
    """Follow a job until it is over; the exit code tells how it ended."""
    # A coordinator that is restarted meanwhile does not end the watching.
    with options.connect(url, token, data, patience_s=60) as api, make_display(quiet=json) as display:
        view = follow(api, job, display, on_change=print_json if json else None)
    write_junit(junit, view)
    _exit_as_ended(view, json=json)


def _exit_as_ended(job: JobView, *, json: bool) -> None:
    """End with the code of a job that is over; with --json its last document has told the error already."""
    ended = end_of(job)
    if json and ended is not None:
        raise typer.Exit(KilnError.from_problem(ended).exit_code)
    raise_unless_completed(job)


@app.command()
def download(
    job: options.JobId,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the package.")],
    force: Annotated[bool, typer.Option("--force", help="Replace the package in DIR.")] = False,
    junit: options.Junit = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Download a job's package, whether it meets its quality gates or not."""
    with options.connect(url, token, data) as api:
        view = api.job(job)
        write_junit(junit, view)
        if view.state in FINAL_JOB_STATES - PUBLISHED_JOB_STATES:
            raise_unless_completed(view)
        files = download_package(api, job, out, force=force)
    if view.state is JobState.GATE_FAILED and view.error is not None:
        notices.print(view.error.sentence(), markup=False, soft_wrap=True)
    if json:
        print_json({"out": str(out), "files": [str(path.relative_to(out)) for path in files]})
    else:
        results.print(f"{len(files)} files in {shown_path(out.absolute())}", markup=False)


@app.command()
def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A package.")], json: options.Json = False
) -> None:
    """Check a package's files against the hashes in its manifest."""
    count, damaged = damaged_files(folder)
    if damaged:
        raise InputError(
            f"{len(damaged)} of {count} files are missing or changed: {', '.join(damaged[:8])}",
            where=str(folder),
            remedy="Download the package again.",
        )
    if json:
        print_json({"out": str(folder), "files": count})
    else:
        results.print(f"{count} files are as the manifest says.", markup=False)


@app.command()
def view(
    package: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with a manifest.json.")],
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0 takes a free one.")] = 0,
) -> None:
    """Show a package in a browser, in real time; served to this machine alone, until interrupted."""
    # Here, because only this command needs a server.
    from kiln_service.viewer.local import view_folder

    view_folder(package, port)


@app.command()
def doctor(
    data: Annotated[Path, typer.Option("--data", help="Folder where a bake's data would go.")] = Path(),
    json: options.Json = False,
) -> None:
    """Say what this machine can do and how to mend what it lacks."""
    checks = examine(data.absolute())
    if json:
        print_json([check.model_dump() for check in checks])
    else:
        colours = {"ok": "green", "warn": "yellow", "fail": "bold red"}
        table = Table("", "check", "finding", box=None)
        for check in checks:
            remedy = f"\n{check.remedy}" if check.remedy else ""
            mark = f"[{colours[check.status]}]{check.status}[/]"
            table.add_row(mark, check.name, escape(check.detail + remedy))
        results.print(table)
    if any(check.status == "fail" for check in checks):
        raise typer.Exit(MachineLacks.exit_code)


@examples_app.command("write")
def examples_write(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Made where it is missing.")],
    json: options.Json = False,
) -> None:
    """Write the example scenes, gallery and courtyard, as GLB and EXR."""
    files = [str(path) for path in baking.write_examples(folder)]
    if json:
        print_json({"files": files})
    else:
        results.print("\n".join(files), markup=False, soft_wrap=True)


add_job_commands(app)
add_operator_commands(app)
add_picture_commands(app)
add_compare_command(app)


def main() -> NoReturn:
    """Run the command line and exit with the documented code; users see sentences, never tracebacks."""
    program.begin()
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        app()
    except SystemExit as error:
        program.end(error.code if isinstance(error.code, int) else 0)
    except KeyboardInterrupt:
        program.end(INTERRUPTED)
    except BrokenPipeError as error:
        sys.exit(program.output_lost(error))
    except UnicodeEncodeError as error:
        _leave(_not_text(error), as_json="--json" in sys.argv)
    except Exception as error:
        _leave(program.explained(error), as_json="--json" in sys.argv)
    program.end(0)


def _not_text(error: UnicodeEncodeError) -> KilnError:
    """Bytes of the command line that are no UTF-8, which Python holds as halves of surrogate pairs, or a defect."""
    for before, word in zip(["", *sys.argv], sys.argv, strict=False):
        if any("\ud800" <= letter <= "\udfff" for letter in word):
            option = before if before.startswith("-") else word.partition("=")[0]
            return InputError("is not UTF-8", where=told(option, 80), remedy="Write it in UTF-8.")
    return program.explained(error)


def _leave(error: KilnError, *, as_json: bool) -> NoReturn:
    try:
        print_error(error, as_json=as_json)
    except OSError as lost:
        sys.exit(program.output_lost(lost))
    program.end(error.exit_code)


def _interrupt(signum: int, frame: FrameType | None) -> None:
    """SIGTERM is treated as Ctrl-C, so that everything that was started is stopped."""
    raise KeyboardInterrupt
