"""One farm, the faults done to it one after the other, and what became of its bakes.

The recovery of a fault is the time from the fault, or from its end where it lasts, to the next committed task or the
job's end. Every bake must have the bytes of the undisturbed one, every task must have been completed once.
"""

import contextlib
import itertools
import os
import random
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any
from unittest.mock import patch

import seaweed
from chaos_farm import ChaosFarm, small_disk
from chaos_faults import GONE, Fault, Repair, faults_of
from e2e_farm import digests, room, settings, sky, wait_until
from faulty_proxy import FaultyProxy

from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.examples import write_exr

SMALL = (
    *("lightmap.tile=4", "render.irradiance_samples=16", "fit.lobes=4", "fit.start_steps=60"),
    *("fit.visibility_refine_steps=20", "fit.refine_steps=20", "fit.checkpoint_s=1"),
)
"""Tasks so short that the time to the next one committed is that of the recovery and not of the task."""
OVER = ("completed", "gate-failed", "failed", "canceled")
SLOW_S = 30.0
"""Of a recovery that takes longer the job's history is printed."""
GIVEN_UP_S = 300.0
"""A fault after which nothing moves for so long was not recovered from."""
REPAIRS = 3
"""A job that fails so often after it was repaired has failed."""
BAD = ("bakes_differ", "bakes_failed", "tiles_lost", "tiles_doubled", "not_recovered", "processes_leaked")
"""Counts that have to be zero."""


class Bench:
    """See above; `disk` is the one that may be filled, `objects` the wire to S3."""

    def __init__(
        self, farm: ChaosFarm, folder: Path, seed: int, store_url: str, disk: Path | None, objects: FaultyProxy | None
    ) -> None:
        self.farm, self.store_url, self.disk, self.objects = farm, store_url, disk, objects
        self.chance = random.Random(seed)
        self.recoveries: list[tuple[str, float]] = []
        self.verdicts: Counter[str] = Counter(dict.fromkeys(("bakes", *BAD), 0))
        self.repaired: Counter[str] = Counter()
        """Bakes that failed with a reason, went on after a repair and a `retry`, by the fault."""
        self.undisturbed: dict[str, float] = {}
        self.job = ""
        self._folder = folder
        self._repairs: list[tuple[str, Repair]] = []
        self._expected: dict[str, str] = {}
        (folder / "room.glb").write_bytes(encode_glb(room()))
        write_exr(folder / "sky.exr", sky())

    def run(self, faults: int, until: float, only: Collection[str] = ()) -> None:
        """An undisturbed bake, then so many faults, all kinds in turn or some, then the last bake to its end."""
        self._submit()
        self._settle(wait=True)
        assert self._expected, "the undisturbed bake failed"
        turn: list[str] = []
        kinds = {kind: fault for kind, fault in faults_of(self).items() if not only or kind in only}
        while len(self.recoveries) < faults and time.monotonic() < until:
            self._settle(wait=False)
            time.sleep(self.chance.uniform(0.0, 3.0))
            if not turn:
                turn = self.chance.sample(sorted(kinds), len(kinds))
            if not self._fault(turn[-1], kinds[turn[-1]]):
                turn.insert(0, turn[-1])
            turn.pop()
        self._settle(wait=True)

    def reach(self, stage: str) -> dict[str, Any]:
        """An active task of a stage, of a later bake where this one has it behind itself."""

        def active() -> dict[str, Any] | None:
            self._settle(wait=False)
            tasks = self.farm.ask("GET", f"/v1/jobs/{self.job}/tasks", kind=stage, state="active") or []
            return tasks[0] if tasks else None

        task: dict[str, Any] = wait_until(f"{stage} is at work", active, 4 * GIVEN_UP_S)
        return task

    def note(self, text: str) -> None:
        """Tell who watches the run."""
        print(f"     {text}", file=sys.stderr, flush=True)

    def _fault(self, kind: str, fault: Fault) -> bool:
        """Do it and wait for the recovery; False where there was nothing to be hit."""
        wait_until("the coordinator answers", lambda: self._committed() >= 0)
        try:
            repair = fault(self)
        except GONE as error:
            self.note(f"{kind}: {error!r}")
            return False
        began = time.monotonic()
        if repair is not None:
            self._repairs.append((kind, repair))
        # What was committed while the fault lasted is no recovery from it.
        before = wait_until("the coordinator answers", lambda: (done := self._committed()) >= 0 and done + 1) - 1
        moved, last = began, None
        while self._committed() <= before and self._state() not in OVER:
            if (now := self._sign()) != last:
                moved, last = time.monotonic(), now
            if time.monotonic() - moved > GIVEN_UP_S:
                self.verdicts["not_recovered"] += 1
                break
            time.sleep(0.25)
        seconds = time.monotonic() - began
        self.recoveries.append((kind, seconds))
        self.note(f"{len(self.recoveries):4d} {kind:28} recovered in {seconds:5.1f} s")
        if seconds > SLOW_S:
            self._tell_history(seconds)
        return True

    def _submit(self) -> None:
        files = (self._folder / "room.glb", self._folder / "sky.exr")
        self.job = self.farm.submit(*files, *settings(*SMALL))
        self._repairs = []

    def _settle(self, *, wait: bool) -> None:
        """Judge the bake that is over and begin another; with `wait` wait for its end and begin none."""
        if wait:
            wait_until("the bake ends", lambda: self._state() in OVER, 4 * GIVEN_UP_S)
        if (state := self._state()) not in OVER:
            return
        events = wait_until("the history is read", lambda: self._events(self.job))
        tasks = wait_until("the tasks are read", lambda: self.farm.ask("GET", f"/v1/jobs/{self.job}/tasks"))
        self._judge(state, events, tasks)
        if not wait or not self.recoveries:
            self._submit()

    def _judge(self, state: str, events: list[dict[str, Any]], tasks: list[dict[str, Any]]) -> None:
        completed = Counter(event["task_id"] for event in events if event["kind"] == "task.completed")
        self.verdicts["tiles_doubled"] += doubled(events)
        if state != "completed":
            self.verdicts["bakes_failed"] += 1
            view = self.farm.ask("GET", f"/v1/jobs/{self.job}") or {}
            self.note(f"job {self.job} is {state}: {view.get('error')}")
            return
        self.verdicts["bakes"] += 1
        self.verdicts["tiles_lost"] += sum(task["state"] != "completed" or not completed[task["id"]] for task in tasks)
        if not self._expected:
            self.undisturbed = pace(events)
        package = digests(self._download())
        self._expected = self._expected or package
        self.verdicts["bakes_differ"] += package != self._expected
        # So that the next bake renders and does not read this one's light fields.
        wait_until("it is archived", lambda: self.farm.ask("POST", f"/v1/jobs/{self.job}/archive"))

    def _download(self) -> Path:
        """The package; a damaged file of it, which only its reader notices, is uploaded again as an operator would."""
        folder = self._folder / f"package-{self.job}"
        try:
            return self.farm.download(self.job, folder)
        except AssertionError:
            if not self._repairs:
                raise
        for kind, repair in self._repairs:
            repair()
            self.repaired[kind] += 1
        return self.farm.download(self.job, folder)

    def _state(self) -> str:
        """Of the job; one that failed and can be repaired is, and is not over then."""
        view = self.farm.ask("GET", f"/v1/jobs/{self.job}")
        if view and view["state"] == "failed" and self._repairs:
            return self._repair(view)
        return str(view["state"]) if view else ""

    def _repair(self, view: dict[str, Any]) -> str:
        kinds = [kind for kind, _ in self._repairs]
        if len(kinds) > REPAIRS * len(set(kinds)):
            return "failed"
        self.note(f"failed, is repaired: {view['error']['detail'] if view['error'] else ''}")
        for _, repair in {kind: (kind, repair) for kind, repair in self._repairs}.values():
            repair()
        self.repaired[kinds[-1]] += 1
        self._repairs.append(self._repairs[-1])
        wait_until("the job is tried again", lambda: self.farm.ask("POST", f"/v1/jobs/{self.job}/retry"))
        return ""

    def _committed(self) -> int:
        view = self.farm.ask("GET", f"/v1/jobs/{self.job}")
        return sum(stage["completed"] for stage in view["stages"]) if view else -1

    def _sign(self) -> Any:
        """What changes whenever anything of the job moves."""
        events = self.farm.ask("GET", f"/v1/jobs/{self.job}/events", format="json", after=0, limit=1000) or []
        view = self.farm.ask("GET", f"/v1/jobs/{self.job}") or {}
        return len(events), [stage["fraction"] for stage in view.get("stages", [])]

    def _events(self, job: str) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = []
        while page := self.farm.ask(
            "GET", f"/v1/jobs/{job}/events", format="json", after=found[-1]["id"] if found else 0
        ):
            found += page
        return found

    def _tell_history(self, seconds: float) -> None:
        for event in self._events(self.job)[-40:]:
            self.note(f"{event['at']} {event['kind']} {event['detail']}")


def doubled(events: list[dict[str, Any]]) -> int:
    """How many tasks were completed once more though nothing that they had made was lost in between."""
    count, completed = 0, set[str]()
    for event in events:
        if event["kind"] == "tasks.lost":
            completed.clear()
        elif event["kind"] == "task.completed":
            count += event["task_id"] in completed
            completed.add(event["task_id"])
    return count


def pace(events: list[dict[str, Any]]) -> dict[str, float]:
    """Seconds from a job's first task to its last, and the longest between two committed tasks."""
    times = [datetime.fromisoformat(event["at"]) for event in events if event["kind"] == "task.completed"]
    gaps = [(after - before).total_seconds() for before, after in itertools.pairwise(times)]
    return {"tasks": len(times), "seconds": sum(gaps), "longest_gap_s": max(gaps)}


@contextlib.contextmanager
def bench(folder: Path, store: str, seed: int) -> Iterator[Bench]:
    """A bench on a store in a bucket ("s3"), or on a small disk ("disk"; never full where none can be mounted).

    After its end `processes_leaked` is counted.
    """
    # Without a reserve nothing but a full disk is noticed of it, and the small one has less than the usual reserve.
    farm = ChaosFarm(folder / "farm", config={"limits": {"reserve_bytes": 0}})
    farm.folder.mkdir()
    with contextlib.ExitStack() as stack:
        disk: Path | None = None
        objects: FaultyProxy | None = None
        if store == "s3":
            (folder / "seaweedfs").mkdir()
            server = stack.enter_context(seaweed.running(folder / "seaweedfs"))
            objects = FaultyProxy(int(server.endpoint.rsplit(":", 1)[1]))
            stack.callback(objects.close)
            reached = server.environment() | {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{objects.port}"}
            stack.enter_context(patch.dict(os.environ, reached))
            url = f"s3://{server.bucket}/light-fields"
        else:
            disk = stack.enter_context(small_disk(folder / "disk"))
            if disk is None:
                print("no disk can be filled here: mounting a tmpfs is not allowed", file=sys.stderr)
            url = (folder / "disk").as_uri()
        running = Bench(farm, folder, seed, url, disk, objects)
        try:
            farm.open("--store", url)
            yield running
        finally:
            farm.close()
            leaked = farm.leaked()
            running.verdicts["processes_leaked"] += len(leaked)
            for process in leaked:
                running.note(f"was left behind: {process}")
                process.kill()
