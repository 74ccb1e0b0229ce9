"""A farm under attack while another client bakes: prints what was tried and what held, and writes JSON.

    make hostile
    python tests/hostile/siege.py [--amount 0.5] [--seed 1] [--only CLASS] [--json FILE]

The other client (`other_client`) bakes and looks at the farm without a pause, first undisturbed, then during each
class of attacks. Its bakes must end with the same bytes, its answers must come, and how much longer than undisturbed
they take is told. Every attacker has valid tokens.
"""

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import floods
import fuzz
import httpx
import psutil
import thefts
from e2e_farm import Farm, room, sky, wait_until
from ground import Attack, Ground, Tally
from other_client import TAG

from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.examples import write_exr

ATTACKS: Final[Mapping[str, Attack]] = {
    "contracts at their bounds": fuzz.contracts,
    "parameters at their bounds": fuzz.parameters,
    "reports of tasks at their bounds": fuzz.claimed,
    "text of megabytes": fuzz.huge_text,
    "tokens of other scopes": fuzz.scopes,
    "tasks of others": thefts.tasks_of_others,
    "jobs of others": thefts.jobs_of_others,
    "damaged blobs": thefts.damaged_blobs,
    "a damaged scene": thefts.damaged_scene,
    "half-sent requests": floods.half_sent,
    "event streams": floods.event_streams,
    "followed logs": floods.followed_logs,
    "claims that wait": floods.long_polls,
    "slow readers": floods.slow_readers,
    "registrations": floods.registrations,
    "logs without an end": floods.long_logs,
    "useless blobs": floods.useless_blobs,
    "jobs submitted and canceled": floods.many_jobs,
    "requests without a token": floods.unasked,
    "bad tokens": floods.bad_tokens,
}
CONFIG: Final[dict[str, Any]] = {"limits": {"unused_bytes": 64 << 20, "workers": 256}}
"""Of the coordinator: as an operator has it who configures nothing, but that blobs and workers are too many sooner."""
MARKS: Final = ("<!-- begin of the table that make hostile writes -->", "<!-- end of the table -->")
CALM_ROUNDS: Final = 20
"""Of the other client, and at least a whole bake, before the first attack."""
LAST_RESORT_S: Final = 1800.0
"""A bake that has not ended after so long never will; no bound on a farm's speed."""


@dataclass
class Siege:
    """A farm, the other client's log, and the tallies of the attacks."""

    farm: Farm
    log: Path
    amount: float
    seed: int
    tallies: dict[str, Tally] = field(default_factory=dict)
    spans: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Of the monotonic clock, by class; "undisturbed" is the time before."""
    memory: tuple[int, int] = (0, 0)
    """Of the coordinator in bytes, before and after."""

    def run(self, attacks: Mapping[str, Attack]) -> None:
        """All of them, one class after the other, beside a client that bakes; returns when its last bake has ended."""
        coordinator = psutil.Process(self.farm.processes["coordinator"].pid)
        with self._other_client() as other:
            began = time.monotonic()
            wait_until("a bake ends undisturbed", lambda: self._lines("bake") and self._still(other), LAST_RESORT_S)
            wait_until("the client looks", lambda: len(self._lines("round")) >= CALM_ROUNDS, LAST_RESORT_S)
            self.spans["undisturbed"] = began, time.monotonic()
            before = coordinator.memory_info().rss
            ground = Ground(
                self.farm,
                amount=self.amount,
                seed=self.seed,
                rounds=lambda: len(self._lines("round")),
                honest_job=self._job,
            )
            for name, attack in attacks.items():
                began = time.monotonic()
                self.tallies[name] = attack(ground)
                self.spans[name] = began, time.monotonic()
                tally = self.tallies[name]
                print(f"{name:34} {tally.attempts:6d} {tally.held:6d} {time.monotonic() - began:7.1f} s", flush=True)
                for line in tally.broken:
                    print(f"     {line[:300]}", flush=True)
            ground.close()
            self.memory = before, coordinator.memory_info().rss
            other.send_signal(signal.SIGTERM)
            wait_until("the last bake ends", lambda: other.poll() is not None, LAST_RESORT_S)
        assert httpx.get(self.farm.url + "/readyz").status_code == 200

    def verdicts(self) -> dict[str, int]:
        """What has to be zero."""
        bakes = self._lines("bake")
        answers = [line for line in self._lines("route") if not line["route"].startswith("POST /login")]
        after = [line for line in answers if line["began"] > self.spans["undisturbed"][1]]
        return {
            "attempts_not_held": sum(tally.attempts - tally.held for tally in self.tallies.values()),
            "bakes_not_completed": sum(bake["state"] != "completed" for bake in bakes),
            "bakes_differ": sum(bake["digests"] != bakes[0]["digests"] or not bake["intact"] for bake in bakes),
            "answers_lost": sum(not 200 <= line["status"] < 400 for line in after),
            "processes_ended": sum(process.poll() is not None for process in self.farm.processes.values()),
        }

    def refused(self) -> list[str]:
        """What the other client was told where it got no answer or none that it wanted."""
        return [str(line.get("lost") or line["refused"]) for line in self._lines("lost") + self._lines("refused")]

    def bakes(self) -> int:
        """Of the other client, the undisturbed one included."""
        return len(self._lines("bake"))

    def delays(self) -> dict[str, Any]:
        """How long the other client's answers took undisturbed, and how much longer during each class of attacks.

        `more_s` is the greatest answer of a route less the greatest of the same route undisturbed, of the route where
        that is the most; `p99_more_s` the same of the 99th percentiles.
        """
        answers = self._lines("route")
        calm = by_route(answers, self.spans["undisturbed"])
        rows = {}
        for name, span in self.spans.items():
            found = by_route(answers, span)
            every = sorted(seconds for values in found.values() for seconds in values) or [0.0]
            worse = {route: max(values) - max(calm[route]) for route, values in found.items() if route in calm}
            p99 = {route: high(values) - high(calm[route]) for route, values in found.items() if route in calm}
            rows[name] = {
                "answers": len(every) if found else 0,
                "seconds": span[1] - span[0],
                "median_s": every[len(every) // 2],
                "p99_s": high(every),
                "worst_s": every[-1],
                "more_s": max(worse.values(), default=0.0),
                "route": max(worse, key=lambda route: worse[route], default=""),
                "p99_more_s": max(p99.values(), default=0.0),
            }
        return rows

    def _job(self) -> str:
        """The job that the other client looked at last."""
        return str(self._lines("round")[-1]["round"])

    def _lines(self, key: str) -> list[dict[str, Any]]:
        text = self.log.read_text() if self.log.exists() else ""
        return [json.loads(line) for line in text.splitlines(keepends=True) if f'"{key}"' in line and line[-1] == "\n"]

    @staticmethod
    def _still(other: "subprocess.Popen[bytes]") -> bool:
        assert other.poll() is None, "the other client ended"
        return True

    @contextlib.contextmanager
    def _other_client(self) -> Iterator["subprocess.Popen[bytes]"]:
        folder = self.farm.folder
        (folder / "room.glb").write_bytes(encode_glb(room()))
        write_exr(folder / "sky.exr", sky())
        headers = {"Authorization": f"Bearer {self.farm.token}"}
        token = httpx.post(
            self.farm.url + "/v1/tokens", json={"name": "other", "scopes": ["read", "submit"]}, headers=headers
        ).raise_for_status()
        command = [sys.executable, str(Path(__file__).with_name("other_client.py")), self.farm.url]
        command += [token.json()["token"], *(str(folder / name) for name in ("room.glb", "sky.exr")), str(self.log)]
        paths = os.pathsep.join(filter(None, sys.path))
        with (
            (folder / "other.log").open("wb") as log,
            subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | {"PYTHONPATH": paths}) as other,
        ):
            try:
                yield other
            finally:
                other.kill()


def by_route(answers: list[dict[str, Any]], span: tuple[float, float]) -> dict[str, list[float]]:
    """Seconds of the answers that were asked for in the span."""
    found: dict[str, list[float]] = {}
    for answer in answers:
        if span[0] <= answer["began"] <= span[1]:
            found.setdefault(answer["route"], []).append(answer["seconds"])
    return found


def high(values: list[float]) -> float:
    """The 99th percentile."""
    return sorted(values)[min(len(values) - 1, int(0.99 * len(values)))]


@contextlib.contextmanager
def siege(folder: Path, *, amount: float, seed: int) -> Iterator[Siege]:
    """A farm with a worker for the other client; its processes are the same at the end."""
    farm = Farm(folder / "farm", config=CONFIG)
    farm.folder.mkdir()
    try:
        farm.start_coordinator()
        farm.start_worker("honest", "--threads", "1", "--tag", TAG)
        yield Siege(farm, folder / "other.jsonl", amount, seed)
    finally:
        farm.stop()


def report(siege: Siege) -> dict[str, Any]:
    """What was tried and what came of it."""
    delays = siege.delays()
    return {
        "seed": siege.seed,
        "load_average": os.getloadavg()[2],
        "attempts": sum(tally.attempts for tally in siege.tallies.values()),
        "held": sum(tally.held for tally in siege.tallies.values()),
        "classes": {
            name: {
                "attempts": tally.attempts,
                "held": tally.held,
                "answers": {str(status): count for status, count in sorted(tally.answers.items())},
                "figures": tally.figures,
                "broken": tally.broken,
                "other_client": delays[name],
            }
            for name, tally in siege.tallies.items()
        },
        "undisturbed": delays["undisturbed"],
        "bakes": siege.bakes(),
        "refused": siege.refused(),
        "coordinator_mb": [size / 1e6 for size in siege.memory],
        **siege.verdicts(),
    }


def write_page(path: Path, result: Mapping[str, Any]) -> None:
    """Put the table in its place on the page."""
    before, _, rest = path.read_text().partition(MARKS[0])
    _, _, after = rest.partition(MARKS[1])
    path.write_text(f"{before}{MARKS[0]}\n{table(result)}\n{MARKS[1]}{after}")


def table(result: Mapping[str, Any]) -> str:
    """One row a class of attacks, in Markdown."""
    rows = [
        "| class | attempts | held | other client's answers | median ms | p99 ms | worst ms | beyond undisturbed, ms |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines = {"undisturbed": ("", "", result["undisturbed"])}
    lines |= {name: (row["attempts"], row["held"], row["other_client"]) for name, row in result["classes"].items()}
    for name, (attempts, held, other) in lines.items():
        times = " | ".join(f"{1000 * other[key]:.0f}" for key in ("median_s", "p99_s", "worst_s", "more_s"))
        rows.append(f"| {name} | {attempts} | {held} | {other['answers']} | {times} |")
    rows.append(f"| **all** | {result['attempts']} | {result['held']} | | | | | |")
    return "\n".join(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--amount", type=float, default=1.0, help="0: as the tests have it; 1: all that there is")
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 16))
    parser.add_argument("--only", action="append", choices=ATTACKS, help="a class; may be repeated")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", type=Path, help="a page whose table, between two marks, is replaced")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # and so through the end of what was started
    print(f"seed {arguments.seed}", flush=True)
    attacks = {name: attack for name, attack in ATTACKS.items() if name in (arguments.only or ATTACKS)}
    with (
        tempfile.TemporaryDirectory(prefix="lightkiln-hostile-") as folder,
        siege(Path(folder), amount=arguments.amount, seed=arguments.seed) as running,
    ):
        running.run(attacks)
        result = report(running)
    print(table(result))
    zeros = {key: value for key, value in result.items() if key in running.verdicts()}
    print(*result["refused"], sep="\n")
    print(zeros, f"{result['bakes']} bakes, memory {result['coordinator_mb']} MB")
    if arguments.page:
        write_page(arguments.page, result)
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")
    return int(any(zeros.values()))


if __name__ == "__main__":
    sys.exit(main())
