"""The farm's database from beside its coordinator: held at a claim, and restarted there with `pg_ctl`."""

import contextlib
import os
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psycopg
from chaos_farm import ChaosFarm
from e2e_farm import wait_until

from kiln_schemas import __version__

KINDS = ["prepare", "render", "fit", "refine", "package"]


def restart_in_claim(farm: ChaosFarm, mode: str) -> None:
    """Restart the database server while a claim's transaction is open; `mode` is pg_ctl's (fast or immediate)."""
    server, _ = farm.postgres()
    # The server names its folder by its working directory, as its user may not be let through the folders above.
    folder, own = server.cwd(), "/proc/self/cwd"
    pg_ctl, owner = Path(server.exe()).with_name("pg_ctl"), server.uids().real
    dsn = f"host='{folder}' user=postgres dbname=postgres"
    # The restart ends the holder's connection, so nothing is left to be committed or rolled back.
    with contextlib.closing(psycopg.connect(dsn, autocommit=False)) as holder:
        holder.execute("LOCK TABLE tasks IN ACCESS EXCLUSIVE MODE")
        with psycopg.connect(dsn, autocommit=True) as watcher:
            wait_until("a claim waits in its transaction", _claiming(farm, watcher))
        # The new server is no child of the coordinator, which therefore ends and starts its own.
        subprocess.run(
            [str(pg_ctl), "restart", "-D", own, "-m", mode, "-o", f"-k {own} -c listen_addresses=''", "-w"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            user=owner if os.geteuid() == 0 else None,
            env=farm.environment("coordinator"),
            cwd=folder,
            timeout=120,
        )


def _claiming(farm: ChaosFarm, watcher: "psycopg.Connection[Any]") -> Callable[[], bool]:
    """A check whether a claim waits for the lock; claims of a worker of our own are sent for it until one does.

    What such a claim is given, if anything, is lost with its answer: the task has to be taken back from nobody.
    """
    asked: list[threading.Thread] = []

    def claim() -> None:
        registration = {
            **{"name": "bystander", "kinds": KINDS, "memory_bytes": 1 << 30, "threads": 1},
            **{"device": "none", "version": __version__},
        }
        welcome = farm.send("POST", "/v1/workers", json=registration)
        if welcome is not None and welcome.status_code == 201:
            path = f"/v1/workers/{welcome.json()['worker_id']}/claim"
            farm.send("POST", path, json={"kinds": KINDS, "wait_s": 0})

    def waits() -> bool:
        if not any(thread.is_alive() for thread in asked):
            asked.append(threading.Thread(target=claim, daemon=True))
            asked[-1].start()
        waiting = watcher.execute(
            "SELECT query FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND query ILIKE '%next_task%'"
        )
        return waiting.fetchone() is not None

    return waits
