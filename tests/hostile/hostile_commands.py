"""Odd command lines, files and surroundings for every command, each run as a process of the real program.

The processes are forked from one that has imported the program, so that thousands cost minutes; a program that
`become` would replace the process by (`serve`, `worker`, `shade`, ...) runs in the forked process itself. Whoever
answers at the coordinator's URL (`Impostor`) is no coordinator, or one that says nonsense.
"""

import json
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, Final

import typer.main

from kiln_service import serve
from kiln_service.cli import compare, main, pictures
from kiln_workers import __main__ as worker_main

CODES: Final = frozenset({0, 2, 3, 4, 5, 6, 7, 8, 130, 141})
"""Exit codes of the documentation but 1, which is a defect."""
DEADLINE_S: Final = 300.0
"""A last resort: what waits for a pipe or a reader waits for ever."""
GOOD: Final = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
STARTS: Final = frozenset({"doctor", "view"})
"""Commands of which a good call runs on; they are called with what they refuse only."""

VALUES: Final = (
    *("", " ", ".", "..", "/", "-", "--", "-1", "0", "1e999", "nan", "inf", "9" * 400, "1" * 5000, "x" * 60_000),
    *("\udcff\udcfe", "é\n\t\x1b[31m", "\u202e\u2066", "%s%n{0}", "[bold]", "a=b", "=", "a:b:c", "0,0,1:0,0,0:40"),
    *("fifo", "folder", "good.obj", "loop", "gone/gone", "unreadable", "/dev/zero", "/dev/null", "/proc/self/mem"),
    *(
        "deep.json",
        "bytes.json",
        "manifest.json",
        "http://",
        "file:///",
        "s3://",
        "ftp://x",
        "http://[::1",
        "socks5://x",
    ),
)


@dataclass(frozen=True)
class Attempt:
    """A command line and its surroundings."""

    arguments: tuple[str, ...]
    variables: tuple[tuple[str, str | None], ...] = ()
    closed: tuple[int, ...] = ()
    """Standard streams that are closed."""
    full: bool = False
    """Standard output is a disk without space."""
    unread: bool = False
    """Standard output is a pipe that nobody reads."""
    as_nobody: bool = False
    """The folder, the temporary one too, can be read and not written (root is somebody else then)."""


@dataclass
class Ended:
    """How an attempt ended."""

    attempt: Attempt
    code: int
    said: str
    problems: list[str] = field(default_factory=list)


class Impostor(BaseHTTPRequestHandler):
    """Answers in turn with what a coordinator never says."""

    ANSWERS: Final = (
        (200, b"<html>sign in</html>"),
        (200, b""),
        (200, b"[" * 100_000),
        (200, b'{"jobs": 5, "id": []}'),
        (404, b"not here"),
        (422, json.dumps({"title": "t", "status": 422, "detail": "\u001b[31m" * 99, "code": "input"}).encode()),
        (302, b""),
        (500, b"\xff\xfe"),
    )
    turn = 0

    def answer(self) -> None:
        status, body = self.ANSWERS[Impostor.turn % len(self.ANSWERS)]
        Impostor.turn += 1
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Location", "http://127.0.0.1:9/")
        self.end_headers()
        self.wfile.write(body)

    do_GET = do_PUT = do_POST = do_PATCH = do_DELETE = answer

    def log_message(self, *_: object) -> None:
        pass


def furnish(folder: Path) -> None:
    """The files that attempts name."""
    folder.mkdir(parents=True, exist_ok=True)
    os.mkfifo(folder / "fifo")
    (folder / "folder").mkdir()
    (folder / "good.obj").write_text(GOOD)
    (folder / "loop").symlink_to("loop")
    (folder / "deep.json").write_bytes(b"[" * 100_000)
    (folder / "bytes.json").write_bytes(b"\xff\xfe\x00")
    (folder / "manifest.json").write_text('{"files": [{"name": 5}]}')
    (folder / "unreadable").write_text("{}")
    (folder / "unreadable").chmod(0)
    (folder / "package").mkdir()
    for name in ("manifest.json", "scene.glb", "irradiance.exr", "lightfield.ktx2"):
        os.mkfifo(folder / "package" / name)


def commands() -> dict[str, Any]:
    """Every command by the words that call it."""

    def of(group: Any, words: str) -> Iterator[tuple[str, Any]]:
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                yield from of(command, f"{words}{name} ")
            else:
                yield f"{words}{name}", command

    top = typer.main.get_command(main.app)
    return dict(of(top, ""))


def attempts(url: str) -> list[Attempt]:
    """Each command with each of its parameters at each odd value, and in odd surroundings."""
    found = []
    for words, command in sorted(commands().items()):
        for parameter in command.params:
            if getattr(parameter, "is_flag", False):
                continue
            found += [Attempt(_line(words, command, url, parameter.name, value)) for value in VALUES]
        plain = _line(words, command, url, None, "")
        if words in STARTS:
            plain = (*words.split(), "gone", "--no-such-flag")
        for arguments in (plain, (*plain, "--json"), (*words.split(), "--help"), (*words.split(), *("x",) * 50)):
            found += [Attempt(arguments, closed=closed) for closed in ((), (0,), (1,), (2,), (0, 1, 2))]
            found += [
                Attempt(arguments, full=True),
                Attempt(arguments, unread=True),
                Attempt(arguments, as_nobody=True),
            ]
            for variables in (
                {"HOME": None, "TMPDIR": "/nowhere"},
                {"HOME": "/nowhere", "TMPDIR": "/proc"},
                {"LC_ALL": "C", "LANG": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"},
                {"LIGHTKILN_TOKEN": "\udcff"},
                {"LIGHTKILN_URL": "\udcff", "LIGHTKILN_DATA": "fifo"},
                {"ALL_PROXY": "nonsense://", "NO_PROXY": ",,,"},
                {"COLUMNS": "0", "TERM": "dumb"},
            ):
                found.append(Attempt(arguments, variables=tuple(variables.items())))
    return found


def _line(words: str, command: Any, url: str, odd: str | None, value: str) -> tuple[str, ...]:
    """A command line that ends soon by itself, with one parameter at a value."""
    line, positional = words.split(), []
    usual = {"url": url, "token": "t", "out": "folder/out", "scene": "gone.obj", "camera": "0,0,5:0,0,0:40"}
    usual |= {"job": "f" * 32, "package": "package", "folder": "package", "subject": "package", "worker": "w"}
    if words == "serve":
        usual |= {"data": "good.obj", "port": "0"}
    if words == "worker":
        usual |= {"scratch": "good.obj"}
    if words == "examples write":
        usual |= {"folder": "good.obj"}
    if words == "reference":
        usual |= {"out": "folder/out.png"}
    for parameter in command.params:
        name = parameter.name or ""
        if name != odd and name not in usual and not parameter.required:
            continue
        chosen = value if name == odd else usual.get(name, "x")
        if parameter.param_type_name == "option":
            line.append(f"{parameter.opts[0]}={chosen}")
        else:
            positional.append(chosen)
    return (*line, "--", *positional) if positional else tuple(line)


def run(attempt: Attempt, folder: Path) -> Ended:
    """Fork, be the program, and say how it ended."""
    output = tempfile.TemporaryFile()  # noqa: SIM115
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            _surround(attempt, folder, output.fileno(), reading, writing)
            code = _be_the_program(attempt.arguments)
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 0
        except BaseException:
            os.write(output.fileno(), f"ESCAPED {traceback.format_exc()}".encode(errors="replace"))
        finally:
            os._exit(code)
    os.close(reading)
    os.close(writing)
    status = _wait(pid)
    output.seek(0)
    said = output.read().decode(errors="replace")
    output.close()
    ended = Ended(attempt, os.waitstatus_to_exitcode(status) if status is not None else -999, said)
    # Where standard error is closed, nobody hears of what is wrong.
    if ended.code not in CODES and not (ended.code == 1 and attempt.closed):
        ended.problems.append(f"exit code {ended.code}")
    ended.problems += [word for word in ("Traceback", "a defect in lightkiln", "ESCAPED") if word in said]
    if "\x1b[31m\x1b[31m" in said:
        ended.problems.append("another's escape sequence")
    return ended


def _surround(attempt: Attempt, folder: Path, output: int, reading: int, writing: int) -> None:
    os.setsid()
    os.chdir(folder)
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    if attempt.full:
        os.dup2(os.open("/dev/full", os.O_WRONLY), 1)
    if attempt.unread:
        os.close(reading)
        os.dup2(writing, 1)
    for number in attempt.closed:
        os.close(number)
    for name in [name for name in os.environ if name.startswith("LIGHTKILN_") or "PROXY" in name.upper()]:
        del os.environ[name]
    for name, value in attempt.variables:
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    tempfile.tempdir = None
    if attempt.as_nobody and os.geteuid() == 0:
        os.setgroups([])
        os.setgid(65534)
        os.setuid(65534)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        # As an interpreter that starts has them.
        try:
            os.fstat(number)
        except OSError:
            setattr(sys, name, None)
        else:
            encoding = os.environ.get("PYTHONIOENCODING", "utf-8")
            mode = "r" if number == 0 else "w"
            setattr(sys, name, open(number, mode, encoding=encoding, closefd=False))  # noqa: SIM115


def _be_the_program(arguments: Sequence[str]) -> int:
    sys.argv = ["lightkiln", *arguments]
    for module in (main, pictures, compare):
        module.become = _become  # type: ignore[attr-defined]
    try:
        main.main()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                if stream is not None:
                    stream.flush()
            except OSError:
                pass
    return 0


def _become(module: str, arguments: list[str]) -> None:
    program = {"kiln_service": serve.main, "kiln_workers": worker_main.main}[module]
    sys.exit(program(arguments))


def _wait(pid: int) -> int | None:
    """The wait status; None where it had to be killed."""
    deadline = time.monotonic() + DEADLINE_S
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return status
        if time.monotonic() > deadline:
            os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return None
        time.sleep(0.005)
