"""`python -m kiln_service`: run one coordinator until it is told to stop.

Locks the data folder, starts the embedded PostgreSQL where no --database is given, serves, and stops everything in
the reverse order. With --json one line on standard output says when it is ready and how to reach it.
"""

import argparse
import asyncio
import contextlib
import fcntl
import gc
import json
import logging
import os
import shutil
import signal
import socket
import stat
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final

import psycopg
import uvicorn
from fastapi import FastAPI
from psycopg.conninfo import conninfo_to_dict
from psycopg_pool import PoolTimeout

from kiln_schemas import program
from kiln_schemas.errors import Conflict, InputError, InternalError, KilnError, MachineLacks
from kiln_schemas.files import read_small
from kiln_schemas.logs import LogFormat, Seldom, set_up
from kiln_schemas.redact import redacted
from kiln_service.app import create_app
from kiln_service.auth import OWNER_VARIABLE, TOKEN_FILE
from kiln_service.config import ServiceConfig, make_config
from kiln_service.connections import ACCEPTED_AT_ONCE, Connections, protocol, raise_descriptors
from kiln_service.embedded import EmbeddedPostgres

log = logging.getLogger("kiln_service")

GRACE_S: Final = 5
"""Open connections get this long to end when the coordinator stops."""
BACKLOG: Final = 2048
"""Connections that the kernel keeps until they are accepted."""
INTERRUPTED: Final = 130
DATABASE_VARIABLE: Final = "LIGHTKILN_DATABASE"
"""A connection string may hold a password, and command lines are visible to every user of the machine."""
WATCH_S: Final = 1.0
"""Between two looks at whether the embedded database still runs."""
FLOODED: Final = {
    "asyncio": lambda record: str(record.msg)[:32],
    "uvicorn.error": lambda record: str(record.msg)[:32],
    "kiln_service.connections": lambda record: str(record.msg),
    "kiln_service.requests": lambda record: None if record.token is not None else f"{record.route} {record.status}",
}
"""Loggers of lines that anybody without a token can cause, and the kinds of these lines."""


class Server(uvicorn.Server):
    """uvicorn's server, which says when it is ready, ends long polls when it stops, and stops with its database."""

    def __init__(self, app: FastAPI, config: uvicorn.Config, announce: str, database: EmbeddedPostgres | None) -> None:
        config.lifespan = "off"  # `serve_all` enters it, so that what hinders the start is raised and not logged
        super().__init__(config)
        self._app, self._announce, self._database = app, announce, database
        self.lost_database = False

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        for listening in sockets or ():
            listening.listen(BACKLOG)
        if not self.should_exit:
            print(self._announce, flush=True)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        super().handle_exit(sig, frame)
        self._end_waiting()

    async def watch_database(self) -> None:
        """Stop when the embedded database is gone: a supervisor restarts both together."""
        while self._database is None or self._database.alive():
            await asyncio.sleep(WATCH_S)
        self.lost_database = True
        self.should_exit = True
        self._end_waiting()

    async def serve_all(self, sockets: list[socket.socket]) -> None:
        """Serve, watching the database on the side."""
        with self.capture_signals():
            await self._live(sockets)

    async def _live(self, sockets: list[socket.socket]) -> None:
        async with self._app.router.lifespan_context(self._app):
            watch = asyncio.create_task(self.watch_database())
            try:
                await self.serve(sockets=sockets)
            finally:
                watch.cancel()

    def _end_waiting(self) -> None:
        parts = getattr(self._app.state, "parts", None)
        if parts is not None:
            parts.signals.stop()


def main(argv: Sequence[str] | None = None) -> int:
    """Run; the exit code (errors as in kiln_schemas.errors)."""
    program.begin()
    arguments = _parser().parse_args(argv)
    set_up(LogFormat(arguments.log_format), arguments.log_level)
    for name, kind in FLOODED.items():
        logging.getLogger(name).addFilter(Seldom(kind))
    try:
        config = _config(arguments)
        _prepare_folder(config.data)
        with _locked(config.data), contextlib.ExitStack() as stack:
            shutil.rmtree(config.incoming, ignore_errors=True)
            database = None
            if config.database is None:
                database = stack.enter_context(EmbeddedPostgres(config.data / "postgres"))
                config = config.model_copy(update={"database": database.dsn})
            return _serve(config, database, as_json=arguments.json)
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:
        told = _explained(error)
        try:
            if arguments.json:
                print(told.problem().model_dump_json(), flush=True)
            print(f"lightkiln: {told}", file=sys.stderr)
        except OSError as lost:
            return program.output_lost(lost)
        return told.exit_code


def _explained(error: Exception) -> KilnError:
    """What hinders the coordinator, with a sentence; what a database driver says may quote the connection string."""
    if isinstance(error, psycopg.Error | PoolTimeout):
        return MachineLacks(
            f"the database does not answer: {redacted(' '.join(str(error).split()))}",
            where="database",
            remedy="Check --database, and whether that server runs and takes this user.",
        )
    return program.explained(error)


def _serve(config: ServiceConfig, database: EmbeddedPostgres | None, *, as_json: bool) -> int:
    with _bound(config.host, config.port) as listening:
        host, port = listening.getsockname()[:2]
        url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        given = bool(os.environ.get(OWNER_VARIABLE))
        token_file = None if given else str((config.data / TOKEN_FILE).absolute())
        ready = {"url": url, "token_file": token_file, "data": str(config.data.absolute()), "pid": os.getpid()}
        where = f"given by {OWNER_VARIABLE}" if given else f"in {token_file}"
        announce = json.dumps(ready) if as_json else f"lightkiln serves {url} (token {where})"
        app = create_app(config)
        server = Server(app, server_config(app, config), announce, database)
        spare_what_stays()
        # uvicorn ends the process where the application does not start; the sentence below is ours.
        with _quiet_signals(), contextlib.suppress(SystemExit):
            asyncio.run(server.serve_all([listening]))
    if server.lost_database:
        # Not MachineLacks: whoever supervises us must not take it for something that a restart does not mend.
        raise InternalError(
            "the embedded database stopped",
            where=str(config.data),
            remedy="Start the coordinator again; postgres.log there tells more.",
        )
    if not server.started:
        raise MachineLacks(
            "the coordinator could not start", remedy="Check --database; the log on standard error says more."
        )
    return 0


def spare_what_stays() -> None:
    """Keep the garbage collector from looking at modules and the application, which stay until the end.

    A full collection looked at some hundred thousand of their objects, and nobody was served for 0.1 s to 0.6 s. It
    also comes less often now: reading a result of 65,536 tiles makes more objects than a day of other requests.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def server_config(app: FastAPI, config: ServiceConfig) -> uvicorn.Config:
    """How uvicorn serves the application: bounded connections, forwarded addresses from named proxies only."""
    connections = Connections(config.limits.connections, raise_descriptors())
    return uvicorn.Config(
        app,
        http=protocol(connections),
        backlog=ACCEPTED_AT_ONCE,
        proxy_headers=bool(config.trusted_proxies),
        forwarded_allow_ips=list(config.trusted_proxies),
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=GRACE_S,
        lifespan="on",
    )


@contextlib.contextmanager
def _quiet_signals() -> Iterator[None]:
    """uvicorn raises the signals that stopped it once more after its shutdown; we have an orderly end to reach."""
    kept = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)


def _bound(host: str, port: int) -> socket.socket:
    """A listening socket; Conflict where the port is taken.

    The protocol is named because asyncio turns Nagle's algorithm off only where it is: without, every small answer
    waits 40 ms for the client's delayed acknowledgement.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OSError as error:
        listening.close()
        raise Conflict(
            f"cannot listen there: {error.strerror or error}",
            where=f"{host}:{port}",
            remedy="Choose another --port (0 takes a free one) or --host.",
        ) from None
    listening.listen(BACKLOG)
    return listening


def _prepare_folder(data: Path) -> None:
    """Make the data folder for its owner alone; one that others may read is left with a warning."""
    try:
        data.mkdir(parents=True, mode=0o700)
    except FileExistsError:
        if not data.is_dir():
            raise InputError("is not a folder", where=str(data), remedy="Choose another --data.") from None
        mode = stat.S_IMODE(data.stat().st_mode)
        if mode & 0o077:
            log.warning("%s has mode %04o: other users of the machine may read scenes and logs; chmod 700", data, mode)
    except OSError as error:
        raise MachineLacks(
            f"cannot make the data folder: {error.strerror}", where=str(data), remedy="Choose another --data."
        ) from None


@contextlib.contextmanager
def _locked(data: Path) -> Iterator[None]:
    """Hold the data folder; the kernel lets go of it when the process ends, however it ends.

    Who can open the lock can hold it, so it is the owner's alone.
    """
    handle = os.open(data / "lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    with os.fdopen(handle, "w") as file:
        os.fchmod(handle, 0o600)  # also one that an earlier version left open to all
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Conflict(
                "another coordinator uses this data folder", where=str(data), remedy="Stop it or choose another --data."
            ) from None
        yield


def _config(arguments: argparse.Namespace) -> ServiceConfig:
    """The file given with --config, with the flags given on top."""
    tree: dict[str, Any] = {}
    if arguments.config is not None:
        try:
            tree = json.loads(read_small(arguments.config))
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", where=str(arguments.config)) from None
        except (ValueError, RecursionError) as error:
            reason = type(error).__name__ if isinstance(error, RecursionError) else error
            raise InputError(f"is not JSON: {reason}", where=str(arguments.config)) from None
        if not isinstance(tree, dict):
            raise InputError("is not a JSON object", where=str(arguments.config))
    flags = {
        "data": arguments.data,
        "host": arguments.host,
        "port": arguments.port,
        "database": arguments.database or os.environ.get(DATABASE_VARIABLE) or None,
        "storage_url": arguments.storage,
        "store_url": arguments.store,
    }
    tree |= {key: value for key, value in flags.items() if value is not None}
    if "data" not in tree:
        raise InputError("no data folder was given", where="--data", remedy="Pass --data DIR.")
    config = make_config(tree)
    if config.database is not None:
        try:
            conninfo_to_dict(config.database)
        except psycopg.Error:
            raise InputError(
                "is not a connection string of PostgreSQL",
                where="database",
                remedy="Write postgresql://USER@HOST/NAME, or `host=... dbname=...`.",
            ) from None
    return config


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m kiln_service", description="Run a lightkiln coordinator.")
    parser.add_argument("--data", type=Path, help="folder for the database, the token, blobs and stores")
    parser.add_argument("--host", help="address to listen on (127.0.0.1)")
    parser.add_argument("--port", type=int, help="port to listen on (8321; 0 takes a free one)")
    parser.add_argument(
        "--database",
        help=f"connection string of a PostgreSQL server, or {DATABASE_VARIABLE} (default: an embedded one)",
    )
    parser.add_argument("--storage", help="URL of the folder for light fields and blobs, file:// or s3:// (--data)")
    parser.add_argument("--store", help="URL of the folder for light-field stores alone")
    parser.add_argument("--config", type=Path, help="JSON file with everything else (kiln_service.config)")
    parser.add_argument("--json", action="store_true", help="announce readiness as one JSON line")
    parser.add_argument("--log-format", default=LogFormat.TEXT.value, choices=[form.value for form in LogFormat])
    parser.add_argument("--log-level", default="info", choices=["debug", "info", "warning", "error"])
    return parser
