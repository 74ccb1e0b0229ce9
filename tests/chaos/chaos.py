"""Bakes of a small scene while processes are killed, wires cut and writes refused: prints a table and writes JSON.

    make chaos
    python tests/chaos/chaos.py [--faults 200] [--seed 1] [--store disk] [--minutes 30] [--json FILE]

One fault after the other, of all kinds in turn and at random moments. The recovery of a fault is the time from the
fault, or from its end where it lasts, to the next committed task or the job's end. Every bake must have the bytes of
the undisturbed one, every task must have been completed once.
"""

import argparse
import contextlib
import itertools
import json
import os
import random
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil
import seaweed
from chaos_farm import RESTART_S, WORKERS, ChaosFarm, fill, small_disk
from e2e_farm import TIMING, digests, room, settings, sky, wait_until
from faulty_proxy import FaultyProxy

from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.examples import write_exr

SMALL = (
    *("lightmap.tile=4", "render.irradiance_samples=16", "fit.lobes=4", "fit.start_steps=60"),
    *("fit.visibility_steps=60", "fit.refine_steps=20", "fit.checkpoint_s=1"),
)
"""Tasks so short that the time to the next one committed is that of the recovery and not of the task."""
OVER = ("completed", "gate-failed", "failed", "canceled")
SLOW_S = 30.0
"""Of a recovery that takes longer the job's history is printed."""
GIVEN_UP_S = 180.0
"""A fault after which nothing is committed for so long was not recovered from."""


class Bench:
    """One farm, the faults done to it and what became of its bakes."""

    def __init__(
        self, farm: ChaosFarm, folder: Path, seed: int, disk: Path | None, objects: FaultyProxy | None
    ) -> None:
        self.farm, self._folder, self._disk, self._objects = farm, folder, disk, objects
        self.chance = random.Random(seed)
        self.recoveries: list[tuple[str, float]] = []
        self.verdicts: Counter[str] = Counter(
            dict.fromkeys(("bakes", "bakes_differ", "bakes_failed", "tiles_lost", "tiles_doubled", "not_recovered"), 0)
        )
        self.undisturbed: dict[str, float] = {}
        self._job = ""
        self._expected: dict[str, str] = {}
        (folder / "room.glb").write_bytes(encode_glb(room()))
        write_exr(folder / "sky.exr", sky())

    def kinds(self) -> dict[str, Callable[[], None]]:
        """The faults that this farm can have; each returns when it is over."""
        faults: dict[str, Callable[[], None]] = {
            "kill worker": lambda: self.farm.kill(self._worker()),
            "kill worker's child": lambda: self.farm.kill(self._worker(), children_only=True),
            "kill coordinator": lambda: self.farm.kill("coordinator"),
            "kill postmaster": lambda: self.farm.postgres()[0].kill(),
            "kill backend": lambda: self.chance.choice(self.farm.postgres()[1]).kill(),
            "pause worker": self._pause,
            "cut network": lambda: self._during(self.farm.wire, "cut"),
            "hang network": lambda: self._during(self.farm.wire, "hang"),
        }
        if self._objects is not None:
            objects = self._objects
            faults["S3 answers 503"] = lambda: self._during(objects, "503")
            faults["S3 is slow"] = lambda: self._during(objects, "slow")
        if self._disk is not None:
            faults["disk full"] = self._fill
        return faults

    def run(self, faults: int, until: float) -> None:
        """An undisturbed bake, then so many faults, then the last bake to its end."""
        self._submit()
        self._settle(wait=True)
        turn: list[str] = []
        while len(self.recoveries) < faults and time.monotonic() < until:
            self._settle(wait=False)
            time.sleep(self.chance.uniform(0.0, 3.0))
            if not turn:
                turn = self.chance.sample(sorted(self.kinds()), len(self.kinds()))
            self._fault(turn.pop())
        self._settle(wait=True)

    def _fault(self, kind: str) -> None:
        before = wait_until("the coordinator answers", lambda: (tasks := self._committed()) >= 0 and tasks + 1) - 1
        try:
            self.kinds()[kind]()
        except (psutil.Error, ProcessLookupError, IndexError, ValueError):
            return  # the process to be hit is just being started again
        began = time.monotonic()
        # What was committed while the fault lasted is no recovery from it.
        before = max(before, self._committed())
        while self._committed() <= before and self._state() not in OVER:
            if time.monotonic() - began > GIVEN_UP_S:
                self.verdicts["not_recovered"] += 1
                break
            time.sleep(0.1)
        seconds = time.monotonic() - began
        self.recoveries.append((kind, seconds))
        print(f"{len(self.recoveries):4d} {kind:20} recovered in {seconds:5.1f} s", file=sys.stderr, flush=True)
        if seconds > SLOW_S:
            for event in self._events(self._job):
                age = time.time() - datetime.fromisoformat(event["at"]).timestamp()
                if age < seconds + SLOW_S:
                    print(f"     {seconds - age:7.1f} s  {event['kind']} {event['detail']}", file=sys.stderr)

    def _submit(self) -> None:
        files = (self._folder / "room.glb", self._folder / "sky.exr")
        self._job = self.farm.submit(*files, *settings(*SMALL))

    def _settle(self, *, wait: bool) -> None:
        """Judge the bake that is over and begin another; with `wait` wait for its end and begin none."""
        if wait:
            wait_until("the bake ends", lambda: self._state() in OVER, 400)
        if (state := self._state()) not in OVER:
            return
        events = wait_until("the history is read", lambda: self._events(self._job))
        tasks = wait_until("the tasks are read", lambda: self.farm.ask("GET", f"/v1/jobs/{self._job}/tasks"))
        completed = Counter(event["task_id"] for event in events if event["kind"] == "task.completed")
        self.verdicts["tiles_doubled"] += sum(count > 1 for count in completed.values())
        if state == "completed":
            self.verdicts["bakes"] += 1
            self.verdicts["tiles_lost"] += sum(
                task["state"] != "completed" or not completed[task["id"]] for task in tasks
            )
            if not self._expected:
                self.undisturbed = pace(events)
            got = digests(self.farm.download(self._job, self._folder / f"package-{self._job}"))
            self._expected = self._expected or got
            self.verdicts["bakes_differ"] += got != self._expected
            # So that the next bake renders and does not read this one's light fields.
            wait_until("it is archived", lambda: self.farm.ask("POST", f"/v1/jobs/{self._job}/archive"))
        else:
            self.verdicts["bakes_failed"] += 1
            print(f"     job {self._job} is {state}: {self.farm.ask('GET', f'/v1/jobs/{self._job}')}", file=sys.stderr)
        if not wait or not self.recoveries:
            self._submit()

    def _state(self) -> str:
        view = self.farm.ask("GET", f"/v1/jobs/{self._job}")
        return str(view["state"]) if view else ""

    def _committed(self) -> int:
        view = self.farm.ask("GET", f"/v1/jobs/{self._job}")
        return sum(stage["completed"] for stage in view["stages"]) if view else -1

    def _events(self, job: str) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = []
        while page := self.farm.ask(
            "GET", f"/v1/jobs/{job}/events", format="json", after=found[-1]["id"] if found else 0
        ):
            found += page
        return found

    def _worker(self) -> str:
        return self.chance.choice(WORKERS)

    def _pause(self) -> None:
        """Stopped for longer than a heartbeat may be missing, then back with what it had."""
        name = self._worker()
        self.farm.signal_worker(name, signal.SIGSTOP)
        time.sleep(TIMING["stale_s"] + 2)
        self.farm.signal_worker(name, signal.SIGCONT)

    def _during(self, proxy: FaultyProxy, mode: str) -> None:
        proxy.mode = mode
        time.sleep(self.chance.uniform(1.0, 6.0))
        proxy.mode = "pass"

    def _fill(self) -> None:
        assert self._disk is not None
        ballast = fill(self._disk)
        time.sleep(self.chance.uniform(1.0, 4.0))
        ballast.unlink()


def pace(events: list[dict[str, Any]]) -> dict[str, float]:
    """Seconds from a job's first task to its last, and the longest between two committed tasks."""
    times = [datetime.fromisoformat(event["at"]) for event in events if event["kind"] == "task.completed"]
    gaps = [(after - before).total_seconds() for before, after in itertools.pairwise(times)]
    return {"tasks": len(times), "seconds": sum(gaps), "longest_gap_s": max(gaps)}


@contextlib.contextmanager
def bench(folder: Path, store: str, seed: int) -> Iterator[Bench]:
    """A bench on a store in a bucket ("s3"), or on a small disk ("disk"; never full where none can be mounted)."""
    farm = ChaosFarm(folder / "farm")
    farm.folder.mkdir()
    with contextlib.ExitStack() as stack:
        disk: Path | None = None
        objects: FaultyProxy | None = None
        flags: tuple[str, ...] = ()
        if store == "s3":
            (folder / "seaweedfs").mkdir()
            server = stack.enter_context(seaweed.running(folder / "seaweedfs"))
            objects = FaultyProxy(int(server.endpoint.rsplit(":", 1)[1]))
            stack.callback(objects.close)
            reached = server.environment() | {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{objects.port}"}
            stack.enter_context(patch.dict(os.environ, reached))
            flags = ("--store", f"s3://{server.bucket}/light-fields")
        else:
            disk = stack.enter_context(small_disk(folder / "disk"))
            if disk is None:
                print("no disk can be filled here: mounting a tmpfs is not allowed", file=sys.stderr)
            flags = ("--store", (folder / "disk").as_uri())
        stack.callback(farm.close)
        farm.open(*flags)
        yield Bench(farm, folder, seed, disk, objects)


def report(bench: Bench, seed: int, store: str) -> dict[str, Any]:
    """What was done and what came of it."""
    kinds = sorted({kind for kind, _ in bench.recoveries})
    by_kind = {kind: [seconds for other, seconds in bench.recoveries if other == kind] for kind in kinds}
    every = [seconds for _, seconds in bench.recoveries] or [0.0]
    return {
        "seed": seed,
        "store": store,
        "timing": TIMING | {"restart_s": RESTART_S},
        "load_average": os.getloadavg()[2],
        "undisturbed": bench.undisturbed,
        "faults": {
            kind: {"count": len(found), "median_s": statistics.median(found), "worst_s": max(found)}
            for kind, found in by_kind.items()
        },
        "all": {"count": len(bench.recoveries), "median_s": statistics.median(every), "worst_s": max(every)},
        "restarts": bench.farm.restarts,
        **bench.verdicts,
    }


def table(result: dict[str, Any]) -> str:
    rows = [
        f"seed {result['seed']}, store {result['store']}, load average {result['load_average']:.1f}",
        "undisturbed: {tasks} tasks in {seconds:.1f} s, {longest_gap_s:.1f} s between two at most".format(
            **result["undisturbed"]
        ),
        f"{'fault':24} {'count':>6} {'median s':>9} {'worst s':>9}",
    ]
    for kind, row in (result["faults"] | {"all": result["all"]}).items():
        rows.append(f"{kind:24} {row['count']:6d} {row['median_s']:9.1f} {row['worst_s']:9.1f}")
    names = ("bakes", "bakes_differ", "bakes_failed", "tiles_lost", "tiles_doubled", "not_recovered", "restarts")
    return "\n".join([*rows, *(f"{name.replace('_', ' '):24} {result[name]:6d}" for name in names)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--store", choices=("s3", "disk"), default="disk")
    parser.add_argument("--minutes", type=float, default=180.0, help="no new fault after so long")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print(f"seed {arguments.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="lightkiln-chaos-") as name:
        with bench(Path(name), arguments.store, arguments.seed) as running:
            running.run(arguments.faults, time.monotonic() + 60 * arguments.minutes)
        result = report(running, arguments.seed, arguments.store)
    print(table(result))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")
    bad = ("bakes_differ", "bakes_failed", "tiles_lost", "tiles_doubled", "not_recovered")
    return int(any(result[name] for name in bad))


if __name__ == "__main__":
    sys.exit(main())
