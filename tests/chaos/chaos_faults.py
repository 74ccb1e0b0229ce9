"""The faults that the chaos bench does to its farm, by name.

A fault is a function of the bench that returns when the fault is over. One that no program can mend by itself (an
uploaded file that is damaged on the coordinator's disk) returns its repair: what an operator does once the job has
failed and said so, before `retry`.
"""

import contextlib
import hashlib
import random
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import psutil
import tensorstore as ts
from chaos_farm import WORKERS, fill
from claim_database import restart_in_claim
from e2e_farm import TIMING
from faulty_proxy import FaultyProxy

from kiln_workers.store.location import kvstore_spec

if TYPE_CHECKING:
    from chaos_bench import Bench

Repair = Callable[[], None]
Fault = Callable[["Bench"], Repair | None]

STAGES: Final = ("prepare", "render", "fit", "refine", "package")
HOUR_S: Final = 3600


class MissedTarget(Exception):
    """What was to be hit is not there at this moment: another time, then."""


def faults_of(bench: "Bench") -> dict[str, Fault]:
    """The faults that this bench's farm can have."""
    faults: dict[str, Fault] = {
        "kill worker": lambda bench: bench.farm.kill(_worker(bench)),
        "kill worker's child": lambda bench: bench.farm.kill(_worker(bench), children_only=True),
        "kill coordinator": lambda bench: bench.farm.kill("coordinator"),
        "kill postmaster": lambda bench: bench.farm.postgres()[0].kill(),
        "kill backend": lambda bench: bench.chance.choice(bench.farm.postgres()[1]).kill(),
        "kill everything": lambda bench: bench.farm.kill_everything(),
        "restart database in a claim": _restart_database,
        "end coordinator": lambda bench: bench.farm.processes["coordinator"].terminate(),
        "pause worker": _pause,
        "cut network": lambda bench: _during(bench, bench.farm.wire, "cut"),
        "hang network": lambda bench: _during(bench, bench.farm.wire, "hang"),
        "flip byte of a blob": _flip_blob,
        "flip byte of a worker's copy": _flip_copy,
        "flip byte of a shard": _flip_shard,
        "delete shard": _delete_shard,
        "delete store": _delete_store,
    }
    faults |= {f"end worker in {stage}": _ending(stage) for stage in STAGES}
    if bench.farm.clock.works:
        faults |= {"set clock forth": _set_forth, "set clock back": _set_back}
    if bench.objects is not None:
        objects = bench.objects
        faults["S3 answers 503"] = lambda bench: _during(bench, objects, "503")
        faults["S3 is slow"] = lambda bench: _during(bench, objects, "slow")
    if bench.disk is not None:
        faults["disk full"] = _fill
    return faults


def _worker(bench: "Bench") -> str:
    return bench.chance.choice(WORKERS)


def _pause(bench: "Bench") -> None:
    """Stopped for longer than a heartbeat may be missing, then back with what it had."""
    name = _worker(bench)
    bench.farm.signal_worker(name, signal.SIGSTOP)
    time.sleep(TIMING["stale_s"] + 2)
    bench.farm.signal_worker(name, signal.SIGCONT)


def _during(bench: "Bench", proxy: FaultyProxy, mode: str) -> None:
    proxy.mode = mode
    time.sleep(bench.chance.uniform(1.0, 6.0))
    proxy.mode = "pass"


def _fill(bench: "Bench") -> None:
    assert bench.disk is not None
    ballast = fill(bench.disk)
    time.sleep(bench.chance.uniform(1.0, 4.0))
    ballast.unlink()


def _restart_database(bench: "Bench") -> None:
    restart_in_claim(bench.farm, bench.chance.choice(("fast", "immediate")))


def _ending(stage: str) -> Fault:
    def end(bench: "Bench") -> None:
        """SIGTERM of the worker that is in a task of the stage."""
        task = bench.reach(stage)
        if task["worker"] not in WORKERS:
            raise MissedTarget(f"{stage} is done by nobody")
        bench.farm.processes[task["worker"]].terminate()

    return end


def _set_forth(bench: "Bench") -> None:
    bench.farm.clock.set(bench.farm.clock.offset_s + HOUR_S)


def _set_back(bench: "Bench") -> None:
    """The worker of an active task dies just before: its last sign of life lies in the future from now on."""
    task = bench.reach(bench.chance.choice(("render", "fit")))
    if task["worker"] in WORKERS:
        bench.farm.kill(task["worker"])
    bench.farm.clock.set(bench.farm.clock.offset_s - HOUR_S)


def _flip_blob(bench: "Bench") -> Repair:
    """Of the coordinator's own copy, while no worker has one."""
    bench.reach(bench.chance.choice(STAGES))
    folder = bench.farm.folder / "data" / "blobs"
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size)
    # The last ones are those of this bake: earlier ones that it has in common with it are touched again.
    path = bench.chance.choice(sorted(paths, key=_changed)[-8:])
    good = path.read_bytes()
    _flip(path, bench.chance)
    for name in WORKERS:
        for copies in bench.farm.scratch(name).glob("*/blobs"):
            shutil.rmtree(copies, ignore_errors=True)
        bench.farm.kill(name)
    bench.note(f"blob {path.name} of {len(good)} bytes")

    def upload() -> None:
        reply = bench.farm.send("PUT", f"/v1/blobs/{hashlib.sha256(good).hexdigest()}", content=good)
        bench.note(f"uploaded it again: {reply.status_code if reply else 'no answer'}")

    return upload


def _flip_copy(bench: "Bench") -> None:
    """Of a blob that a worker has fetched."""
    bench.reach(bench.chance.choice(STAGES[1:]))
    copies = [path for name in WORKERS for path in bench.farm.scratch(name).glob("*/blobs/*")]
    if not copies:
        raise MissedTarget("no worker has a blob")
    with contextlib.suppress(FileNotFoundError):
        _flip(bench.chance.choice(sorted(copies)), bench.chance)


def _flip_shard(bench: "Bench") -> None:
    store, key = _shard(bench)
    data = bytearray(store.read(key).result().value)
    _flip_in(data, bench.chance)
    store.write(key, bytes(data)).result()
    bench.note(f"shard {key}")


def _delete_shard(bench: "Bench") -> None:
    store, key = _shard(bench)
    del store[key]
    bench.note(f"shard {key}")


def _delete_store(bench: "Bench") -> None:
    bench.reach(bench.chance.choice(STAGES[1:4]))
    _store(bench).delete_range(ts.KvStore.KeyRange()).result()


def _shard(bench: "Bench") -> tuple[Any, str]:
    """The bake's store and the key of a part of a tile in it."""
    bench.reach(bench.chance.choice(STAGES[1:4]))
    store = _store(bench)
    keys = sorted(key for key in (raw.decode() for raw in store.list().result()) if "/c/" in key)
    tiles = [key for key in keys if not key.startswith(("state/", "position/", "normal/", "alpha/"))]
    if not tiles:
        raise MissedTarget("no tile is there")
    return store, bench.chance.choice(tiles)


def _store(bench: "Bench") -> Any:
    return ts.KvStore.open(kvstore_spec(f"{bench.store_url}/{bench.job}.zarr")).result()


def _flip(path: Path, chance: random.Random) -> None:
    data = bytearray(path.read_bytes())
    _flip_in(data, chance)
    path.write_bytes(data)


def _flip_in(data: bytearray, chance: random.Random) -> None:
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


def _changed(path: Path) -> int:
    return path.stat().st_mtime_ns


GONE: Final = (psutil.Error, ProcessLookupError, IndexError, ValueError, MissedTarget, FileNotFoundError)
"""Raised where the process or file to be hit is not there just now."""
