"""`python -m kiln_workers worker|doctor|examples|shade|reference|compare`: commands without the coordinator's code.

The package's `lightkiln` command runs these as subprocesses; a farm node that has only `lightkiln[worker]` installed
can run them directly. Exit codes are those of `kiln_schemas.errors`, and 2 for wrong usage.
"""

import argparse
import json
import logging
import os
import platform
import re
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from kiln_schemas import program
from kiln_schemas.errors import AuthError, InputError, KilnError, MachineLacks
from kiln_schemas.files import read_small
from kiln_schemas.logs import LogFormat, set_up
from kiln_schemas.tasks import NAME_LENGTH, TaskKind, read_tags
from kiln_schemas.text import is_line, told
from kiln_workers.compare.arguments import add_compare
from kiln_workers.runner.machine import claim_folder, cores, default_memory_bytes, parse_size
from kiln_workers.shade.arguments import add_commands

log = logging.getLogger("kiln_workers")

MOST_THREADS: Final = 4096


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; its exit code."""
    program.begin()
    options = _parser().parse_args(arguments)
    try:
        code: int = options.command(options)
        sys.stdout.flush()
        return code
    except BrokenPipeError as error:
        return program.output_lost(error)
    except Exception as error:
        return _tell(program.explained(error), options.json)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m kiln_workers", description="Work for a lightkiln coordinator.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    worker = commands.add_parser("worker", help="claim tasks and run them until told to stop")
    worker.add_argument("--url", default=os.environ.get("LIGHTKILN_URL"), help="coordinator; or LIGHTKILN_URL")
    worker.add_argument("--token", default=os.environ.get("LIGHTKILN_TOKEN"), help="or LIGHTKILN_TOKEN")
    worker.add_argument("--token-file", type=Path, help="file that holds the token")
    worker.add_argument("--kinds", default=",".join(TaskKind), help="kinds of tasks to take, separated by commas")
    worker.add_argument("--tag", action="append", default=[], help="what it is good for, for jobs that require it")
    worker.add_argument("--memory", help="main memory to use, e.g. 4GiB")
    worker.add_argument("--threads", type=int, help="cores to use; all by default")
    worker.add_argument("--name", help="as the dashboard shows it; the host's and a number by default")
    worker.add_argument("--scratch", type=Path, help="folder for temporary files and the blob cache")
    worker.add_argument(
        "--log-format",
        default=LogFormat.TEXT.value,
        choices=[form.value for form in LogFormat],
        help="on standard error: lines for people, or JSON with job and task ids",
    )
    worker.add_argument("--json", action="store_true", help="one JSON object a line on standard output")
    worker.set_defaults(command=_worker)

    doctor = commands.add_parser("doctor", help="say what this machine can do as a worker")
    doctor.add_argument("--json", action="store_true", help="a JSON array of checks")
    doctor.set_defaults(command=_doctor)

    examples = commands.add_parser("examples", help="write the example scenes")
    action = examples.add_subparsers(required=True, metavar="ACTION")
    write = action.add_parser("write", help="write them as GLB and EXR")
    write.add_argument("folder", type=Path)
    write.add_argument("--json", action="store_true", help="a JSON object with the files' paths")
    write.set_defaults(command=_examples)
    add_commands(commands)
    add_compare(commands)
    return parser


def _worker(options: argparse.Namespace) -> int:
    from kiln_workers.runner.parent import Worker, WorkerOptions

    if not options.url:
        raise InputError("no coordinator is named", where="--url", remedy="Pass --url or set LIGHTKILN_URL.")
    token, kinds, threads = _token(options), _kinds(options.kinds), options.threads or cores()
    if not 1 <= threads <= MOST_THREADS:
        raise InputError(f"{threads} threads are refused", where="--threads", remedy=f"Give 1 to {MOST_THREADS}.")
    memory = parse_size(options.memory) if options.memory else default_memory_bytes()
    if options.name is not None:
        _check_name(options.name)
    folder, lock = claim_folder(options.scratch)
    structured = options.log_format == LogFormat.JSON
    announce = _print_json if options.json else Log() if structured else _print_line
    if structured:
        set_up(LogFormat.JSON)
    with lock:
        Worker(
            WorkerOptions(
                url=options.url,
                token=token,
                name=options.name or f"{platform.node()}-{folder.name}",
                kinds=kinds,
                tags=read_tags(options.tag),
                memory_bytes=memory,
                threads=threads,
                folder=folder,
            ),
            announce,
        ).run()
    return 0


def _doctor(options: argparse.Namespace) -> int:
    from kiln_workers.runner.doctor import examine

    checks = examine()
    if options.json:
        print(json.dumps([check.model_dump() for check in checks]))
    else:
        for check in checks:
            print(f"{check.status:4} {check.name}: {check.detail}{f'. {check.remedy}' if check.remedy else ''}")
    return MachineLacks.exit_code if any(check.status == "fail" for check in checks) else 0


def _examples(options: argparse.Namespace) -> int:
    from kiln_workers.scene.examples import write_examples

    try:
        options.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder cannot be made: {error.strerror}", where=str(options.folder)) from None
    files = [str(path) for path in write_examples(options.folder)]
    print(json.dumps({"files": files}) if options.json else "\n".join(files))
    return 0


def _token(options: argparse.Namespace) -> str:
    if options.token_file is not None:
        try:
            token: str = read_small(options.token_file).decode("ascii", "replace").strip()
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", where=str(options.token_file)) from None
    else:
        token = options.token or ""
    remedy = "Pass --token or --token-file, or set LIGHTKILN_TOKEN."
    if not token:
        raise AuthError("no token is given", where="--token", remedy=remedy)
    if not re.fullmatch(r"[\x21-\x7e]+", token):
        raise AuthError("the token has characters that no token has", where="--token", remedy=remedy)
    return token


def _check_name(name: str) -> None:
    if not 1 <= len(name) <= NAME_LENGTH or not is_line(name):
        raise InputError(
            f"'{told(name, 80)}' is refused", where="--name", remedy=f"Give 1 to {NAME_LENGTH} characters on one line."
        )


def _kinds(text: str) -> tuple[TaskKind, ...]:
    try:
        return tuple(dict.fromkeys(TaskKind(part.strip()) for part in text.split(",")))
    except ValueError:
        raise InputError(
            f"'{text}' is refused", where="--kinds", remedy=f"Choose some of {','.join(TaskKind)}."
        ) from None


def _print_json(event: str, detail: dict[str, Any]) -> None:
    print(json.dumps({"event": event, **detail}), flush=True)


class Log:
    """Logs what happens in the coordinator's terms, with the worker's id once it is registered."""

    def __init__(self) -> None:
        self._worker: dict[str, Any] = {}

    def __call__(self, event: str, detail: dict[str, Any]) -> None:
        """Log one event; a child's line is the message itself."""
        fields = {_FIELDS.get(name, name): value for name, value in detail.items()}
        if event == "worker.registered":
            self._worker = {"worker_id": fields["worker_id"]}
        line = fields.pop("line", None)
        bad = event in ("task.failed", "coordinator.away")
        log.log(
            logging.WARNING if bad else logging.INFO,
            "%s",
            event if line is None else line,
            extra=self._worker | fields,
        )


_FIELDS = {"task": "task_id", "job": "job_id", "worker": "worker_id", "message": "reason"}


def _print_line(event: str, detail: dict[str, Any]) -> None:
    words = detail["line"] if event == "log" else f"{event} {' '.join(f'{k}={v}' for k, v in detail.items())}"
    print(f"{datetime.now():%H:%M:%S} {words}", file=sys.stderr, flush=True)


def _tell(error: KilnError, as_json: bool) -> int:
    try:
        if as_json:
            print(json.dumps(error.problem().model_dump()), flush=True)
        else:
            print(f"error: {error}", file=sys.stderr)
    except OSError as lost:
        return program.output_lost(lost)
    return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
