"""A coordinator under the load of a big farm: prints a table and writes JSON.

    python benchmarks/load.py [--workers 1000] [--tiles 10000] [--tile-s 20] [--json FILE]

A real coordinator process on a real PostgreSQL, and simulated workers in processes of their own that say over HTTP what
real ones say (register, claim with a long poll, heartbeat, checkpoint, commit) but sleep in place of rendering. Three
loads one after the other:

- idle: all workers wait for work, and small jobs of a few tasks come in: how soon is a task claimed that was queued;
- steady: one job of many tiles, each of which takes about `--tile-s`: latencies, planning, memory, connections, losses;
- full: few workers that render in no time: what the coordinator can do at all.

Latencies are the client's, from sending a request to having read its answer. A claim may wait for work on purpose, so
`claim` has those alone that were sent while tiles were queued and that got a task; the claims that waited when the
job was planned are the row `queued > claimed, all at once`, in which times are the database's (of its events).
"""

import argparse
import asyncio
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import psutil
import psycopg

from kiln_schemas import __version__
from kiln_service.embedded import EmbeddedPostgres

KINDS = ("prepare", "render", "fit", "refine", "package")
TILE = 8
SMALL_JOBS = 8
FULL_WORKERS, FULL_TILES = 16, 600
RELEASED = 0.002
"""Of all tiles, so many are given back by a worker that leaves in good order."""


class Farm:
    """Simulated workers on one event loop, and what they measured."""

    def __init__(self, url: str, token: str, tile_s: float, seed: int) -> None:
        self._url, self._token, self._tile_s, self._chance = url, token, tile_s, random.Random(seed)
        self.samples: list[tuple[str, float, float, int]] = []
        """Route, when sent (seconds of time.time), seconds until answered, status (0: no answer)."""

    async def live(self, name: str, delay_s: float, stop: asyncio.Event) -> None:
        """One worker's life, until told to stop."""
        headers = {"Authorization": f"Bearer {self._token}", "Content-Type": "application/json"}
        transport = httpx.AsyncHTTPTransport(verify=False, limits=httpx.Limits(max_connections=2))
        async with httpx.AsyncClient(base_url=self._url, headers=headers, transport=transport, timeout=90) as http:
            await asyncio.sleep(delay_s)
            registration = {"name": name, "kinds": KINDS, "memory_bytes": 2**30, "threads": 1, "device": "none"}
            welcome = await self._ask(http, "register", "/v1/workers", registration | {"version": __version__})
            me = welcome.json()
            while not stop.is_set():
                reply = await self._ask(http, "claim", f"/v1/workers/{me['worker_id']}/claim", {"kinds": KINDS})
                if reply.status_code == 200:
                    await self._work(http, me, reply.json())

    async def _work(self, http: httpx.AsyncClient, me: dict[str, Any], claim: dict[str, Any]) -> None:
        """Beat as long as the work takes, then commit, or give it back."""
        payload, held = claim["payload"], {"attempt": claim["attempt"], "lease": claim["lease"]}
        task = f"/v1/tasks/{claim['task_id']}"
        left = self._tile_s * self._chance.uniform(0.5, 1.5) * (payload["kind"] == "render")
        while left > 0:
            # As kiln_workers.runner.parent does: at once, then at the interval told.
            beat = {"task_id": claim["task_id"], "log": "rendering\n"} | held
            beat |= {"progress": {"done": 1, "total": 2, "unit": "texels"}}
            reply = await self._ask(http, "heartbeat", f"/v1/workers/{me['worker_id']}/heartbeat", beat)
            if reply.json()["stop"]:
                return
            await asyncio.sleep(min(left, me["heartbeat_s"]))
            left -= me["heartbeat_s"]
        if payload["kind"] == "render" and self._chance.random() < RELEASED:
            problem = {"title": "t", "status": 409, "detail": "the worker was stopped", "code": "canceled"}
            await self._ask(http, "fail", f"{task}/fail", held | {"problem": problem, "retryable": True})
            return
        result = {"kind": payload["kind"], "seconds": 0.5} | await self._result(http, claim)
        await self._ask(http, f"commit {payload['kind']}", f"{task}/commit", held | {"result": result})

    async def _result(self, http: httpx.AsyncClient, claim: dict[str, Any]) -> dict[str, Any]:
        payload = claim["payload"]
        match payload["kind"]:
            case "prepare":
                side = payload["settings"]["lightmap"]["resolution"] // TILE
                places = [divmod(i, side) for i in range(int(payload["bundle"]["entry"].removesuffix(".glb")))]
                return {
                    "scene": await self._put(http, b"packed scene"),
                    "texel_map": await self._put(http, b"texel map"),
                    "scene_hash": hashlib.sha256(claim["job_id"].encode()).hexdigest(),
                    "tiles": [{"row": r * TILE, "column": c * TILE, "size": TILE, "texels": 64} for r, c in places],
                    "has_environment": False,
                    "has_light": True,
                    "triangles": 12,
                }
            case "render":
                return {"tile": payload["tile"], "paths": 10, "overflows": 0, "invalid": 0}
            case "fit":
                sha256 = await self._put(http, os.urandom(2**16))
                body = {"attempt": claim["attempt"], "lease": claim["lease"], "sha256": sha256}
                await self._ask(http, "checkpoint", f"/v1/tasks/{claim['task_id']}/checkpoint", body)
                metrics = {"log_mse": 0.1, "log_mse_zero": 1, "log_mse_rel": 0.1, "texels": 10, "signal": True}
                fit = {"function": payload["function"], "weights": sha256, "exposure": 1, "metrics": metrics}
                return fit | {"curve": [], "steps": 1}
            case "refine":
                return {
                    "block": payload["block"],
                    "lobes": await self._put(http, os.urandom(2**16)),
                    "texels": 10,
                    "steps": 1,
                }
            case _:
                data = os.urandom(2**20)
                file = {"name": "lightfield.ktx2", "sha256": await self._put(http, data), "media_type": "image/ktx2"}
                return {"artifacts": [file | {"size": len(data)}]}

    async def _put(self, http: httpx.AsyncClient, data: bytes) -> str:
        sha256 = hashlib.sha256(data).hexdigest()
        missing = await self._ask(http, "blobs missing", "/v1/blobs/missing", {"sha256": [sha256]})
        if missing.json()["missing"]:
            await self._ask(http, "put blob", f"/v1/blobs/{sha256}", data)
        return sha256

    async def _ask(self, http: httpx.AsyncClient, route: str, path: str, body: Any) -> httpx.Response:
        """The answer, asked for again while there is none; every try is a sample."""
        while True:
            sent, began = time.time(), time.perf_counter()
            try:
                if isinstance(body, bytes):
                    reply = await http.put(path, content=body)
                else:
                    reply = await http.post(path, content=json.dumps(body).encode())
            except httpx.TransportError:
                self.samples.append((route, sent, time.perf_counter() - began, 0))
            else:
                self.samples.append((route, sent, time.perf_counter() - began, reply.status_code))
                if reply.status_code < 500:
                    return reply
            await asyncio.sleep(self._chance.uniform(0.1, 0.2))


async def simulate(url: str, token: str, workers: int, tile_s: float, seed: int) -> None:
    """Run workers until a line comes on standard input; write what they measured to standard output."""
    farm, stop = Farm(url, token, tile_s, seed), asyncio.Event()
    lives = [asyncio.create_task(farm.live(f"w{seed}-{i}", 0.06 * i, stop)) for i in range(workers)]
    told = asyncio.get_running_loop().run_in_executor(None, sys.stdin.readline)
    done, _ = await asyncio.wait([told, *lives], return_when=asyncio.FIRST_COMPLETED)  # type: ignore[type-var]
    for life in done & set(lives):  # type: ignore[operator]
        life.result()
    for life in lives:
        life.cancel()
    await asyncio.gather(*lives, return_exceptions=True)
    json.dump(farm.samples, sys.stdout)


@contextmanager
def coordinator(data: Path, database: str) -> Iterator[tuple[psutil.Process, str, str]]:
    """A coordinator process with the settings that it has by default: the process, its URL, its token."""
    command = [sys.executable, "-m", "kiln_service", "--data", str(data), "--database", database, "--port", "0"]
    with (data.parent / "coordinator.log").open("w") as log:
        process = subprocess.Popen([*command, "--json"], stdout=subprocess.PIPE, stderr=log, text=True)
    assert process.stdout is not None
    try:
        ready = json.loads(process.stdout.readline())
        yield psutil.Process(process.pid), ready["url"], Path(ready["token_file"]).read_text().strip()
    finally:
        process.terminate()
        process.wait()


class Load:
    """One coordinator and its database, looked at while it works."""

    def __init__(self, process: psutil.Process, url: str, token: str, server: EmbeddedPostgres) -> None:
        self.process, self.url, self.token, self.server = process, url, token, server
        self.http = httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=90)
        self.watched: list[tuple[str, float, float, int]] = []
        self.peaks: Counter[str] = Counter()
        self.averages: list[float] = []

    @contextmanager
    def workers(self, count: int, processes: int, tile_s: float) -> Iterator[list[Any]]:
        """Workers for the time of the block; afterwards the list has their samples."""
        samples: list[Any] = []
        shares = [count // processes + (i < count % processes) for i in range(processes)]
        running = [
            subprocess.Popen(
                [sys.executable, __file__, "--simulate", self.url, self.token, str(share), str(tile_s), str(i)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for i, share in enumerate(shares)
        ]
        began = self.sql("SELECT now() AS now")[0][0]
        while (there := self.sql("SELECT count(*) FROM workers WHERE registered > %s", began)[0][0]) < count:
            time.sleep(0.2)
            assert all(process.poll() is None for process in running), f"simulated workers ended, {there} registered"
        time.sleep(3)
        try:
            yield samples
        finally:
            for process in running:
                samples += json.loads(process.communicate("stop\n", timeout=120)[0])

    def sql(self, query: str, *parameters: Any) -> list[Any]:
        with psycopg.connect(self.server.dsn, autocommit=True) as connection:
            return connection.execute(query, parameters).fetchall()

    def get(self, route: str, path: str) -> httpx.Response:
        sent, began = time.time(), time.perf_counter()
        reply = self.http.get(path)
        self.watched.append((route, sent, time.perf_counter() - began, reply.status_code))
        return reply

    def submit(self, tiles: int) -> str:
        """A job of so many tiles; simulated workers read their number from the name of its scene."""
        sha256 = hashlib.sha256(b"a scene").hexdigest()
        self._insist("PUT", f"/v1/blobs/{sha256}", content=b"a scene")
        side = TILE * max(4, next(n for n in range(1, 1025) if n * n >= tiles))
        bundle = {"entry": f"{tiles}.glb", "files": {f"{tiles}.glb": sha256}}
        changes = [f"lightmap.resolution={side}", f"lightmap.tile={TILE}"]
        request = {"name": f"{tiles} tiles", "preset": "draft", "set": changes, "bundle": bundle}
        return str(self._insist("POST", "/v1/jobs", json=request).json()["id"])

    def _insist(self, method: str, path: str, **content: Any) -> httpx.Response:
        """The answer of a coordinator that may be too busy at first."""
        while (reply := self.http.request(method, path, **content)).status_code == 503:
            time.sleep(0.5)
        return reply.raise_for_status()

    def follow(self, job: str) -> float:
        """Look at a job as people do until it has completed; the seconds that took."""
        began = time.monotonic()
        while True:
            view = self.get("get job", f"/v1/jobs/{job}")
            self._look()
            state = view.json()["state"] if view.is_success else "active"
            if state not in ("queued", "active"):
                assert state == "completed", f"job {job} is {state}"
                return time.monotonic() - began
            self.get("list jobs", "/v1/jobs")
            self.get("list tasks", f"/v1/jobs/{job}/tasks?state=active")
            self.get("list workers", "/v1/workers")
            self.get("events", f"/v1/jobs/{job}/events?format=json")
            self.get("metrics", "/v1/metrics")
            self.get("healthz", "/healthz")
            time.sleep(1)

    def _look(self) -> None:
        """Keep the peaks of what the processes have."""
        postgres = psutil.Process(self.server._process.pid)  # type: ignore[union-attr]
        backends = self.sql("SELECT count(*) FROM pg_stat_activity WHERE backend_type = 'client backend'")[0][0] - 1
        now = {
            "coordinator_rss_mib": self.process.memory_info().rss / 2**20,
            "database_pss_mib": sum(map(_pss, (postgres, *postgres.children()))) / 2**20,
            "database_connections": backends,
            "coordinator_open_files": self.process.num_fds(),
        }
        self.averages.append(os.getloadavg()[0])
        for key, value in now.items():
            self.peaks[key] = max(self.peaks[key], value)

    def waits(self, job: str, first: int | None = None) -> list[float]:
        """Seconds from being queued to being claimed first, of a job's tasks (or the `first` ones to be claimed)."""
        rows = self.sql(
            """
            SELECT extract(epoch FROM min(claimed.at) - (
                SELECT max(at) FROM events
                WHERE job_id = tasks.job_id AND at <= min(claimed.at) AND kind = CASE tasks.kind
                    WHEN 'prepare' THEN 'job.created' WHEN 'render' THEN 'tasks.planned' ELSE 'stage.completed' END
                AND (kind <> 'tasks.planned' OR detail ? 'render')))
            FROM tasks JOIN events AS claimed ON claimed.task_id = tasks.id AND claimed.kind = 'task.claimed'
            WHERE tasks.job_id = %s AND (%s::int IS NULL OR tasks.kind = 'render')
            GROUP BY tasks.id ORDER BY 1 LIMIT %s
            """,
            job,
            first,
            first,
        )
        return [float(row[0]) for row in rows]

    def losses(self, job: str) -> dict[str, int]:
        """What must be zero."""
        [[lost, failed, unfinished, doubled]] = self.sql(
            """
            SELECT count(*) FILTER (WHERE kind = 'task.lost'),
                   count(*) FILTER (WHERE kind IN ('task.soft-failed', 'task.failed')),
                   (SELECT count(*) FROM tasks WHERE job_id = %s AND state <> 'completed'),
                   count(*) FILTER (WHERE kind = 'task.completed')
                       - count(DISTINCT task_id) FILTER (WHERE kind = 'task.completed')
            FROM events WHERE job_id = %s
            """,
            job,
            job,
        )
        return {"lost_heartbeats": lost, "failed": failed, "tiles_lost": unfinished, "tiles_doubled": doubled}


def _pss(process: psutil.Process) -> int:
    """Memory of a process that shares most of it with its siblings; 0 where it has just ended."""
    try:
        return int(process.memory_full_info().pss)
    except psutil.NoSuchProcess:
        return 0


def quantiles(seconds: list[float]) -> dict[str, float]:
    ordered = sorted(seconds) or [float("nan")]

    def at(share: float) -> float:
        return round(1e3 * ordered[min(len(ordered) - 1, int(share * len(ordered)))], 1)

    return {"count": len(seconds), "p50_ms": at(0.5), "p99_ms": at(0.99), "max_ms": at(1.0)}


def processor_s(*processes: psutil.Process) -> float:
    """Seconds of processor time of processes and their children."""
    return sum(sum(p.cpu_times()[:4]) for p in processes)


def measure(arguments: argparse.Namespace, folder: Path, server: EmbeddedPostgres) -> dict[str, Any]:
    """Everything that the table shows."""
    report: dict[str, Any] = {
        "workers": arguments.workers,
        "tiles": arguments.tiles,
        "tile_s": arguments.tile_s,
        "cores": len(os.sched_getaffinity(0)),
        "load_average_before": os.getloadavg()[0],
    }
    with coordinator(folder / "data", server.dsn) as (process, url, token):
        load = Load(process, url, token, server)
        with load.workers(arguments.workers, arguments.processes, arguments.tile_s) as samples:
            report["idle"] = idle = {}
            before, began = processor_s(process), time.monotonic()
            time.sleep(10)
            idle["coordinator_cores"] = round((processor_s(process) - before) / (time.monotonic() - began), 3)
            small = [load.submit(1) for _ in range(SMALL_JOBS) if not time.sleep(0.5)]
            for job in small:
                load.follow(job)
            idle["queued_to_claimed"] = quantiles([wait for job in small for wait in load.waits(job)])
            load.watched.clear()
            before = processor_s(process)
            job = load.submit(arguments.tiles)
            seconds = load.follow(job)
            report["steady"] = {"seconds": round(seconds, 1)}
            report["steady"]["coordinator_cores"] = round((processor_s(process) - before) / seconds, 3)
            print(f"the job of {arguments.tiles} tiles took {seconds:.0f} s", file=sys.stderr)
        report["steady"] |= steady(load, job, samples, arguments.workers)
        with load.workers(FULL_WORKERS, 1, 0.0) as samples:
            job = load.submit(FULL_TILES)
            load.follow(job)
        report["full"] = full(load, job, samples)
    report["peaks"] = {key: round(value) for key, value in load.peaks.items()}
    report["load_average"] = round(sum(load.averages) / len(load.averages), 1)
    return report


def steady(load: Load, job: str, samples: list[Any], workers: int) -> dict[str, Any]:
    """Figures of the long job."""
    planned, last = (
        float(row[0])
        for row in load.sql(
            "SELECT extract(epoch FROM max(at)) FROM events WHERE job_id = %s AND kind = 'tasks.planned' UNION ALL"
            " SELECT extract(epoch FROM max(at)) FROM events"
            ' WHERE job_id = %s AND kind = \'task.claimed\' AND detail @> \'{"kind": "render", "attempt": 1}\'',
            job,
            job,
        )
    )
    routes: dict[str, list[float]] = defaultdict(list)
    statuses: Counter[str] = Counter()
    for route, sent, seconds, status in (*samples, *load.watched):
        statuses[f"{route} {status}"] += 1
        if route != "claim":
            routes[route].append(seconds)
        elif status == 200 and planned <= sent <= last:
            routes["claim"].append(seconds)
    planning = max(seconds for route, _, seconds, _ in samples if route == "commit prepare")
    return {
        "planning_s": round(planning, 2),
        "claims_per_s": round((len(routes["claim"]) + workers) / (last - planned), 1),
        "all_at_once": quantiles(load.waits(job, first=workers)),
        "routes": {route: quantiles(values) for route, values in sorted(routes.items())},
        "refused": {key: count for key, count in statuses.items() if key.split()[-1][0] not in "2"},
        **load.losses(job),
    }


def full(load: Load, job: str, samples: list[Any]) -> dict[str, Any]:
    """What the coordinator can do at all."""
    claims = [(sent, seconds) for route, sent, seconds, status in samples if route == "claim" and status == 200]
    commits = [(sent, seconds) for route, sent, seconds, _ in samples if route == "commit render"]
    began, ended = min(sent for sent, _ in commits), max(sent for sent, _ in commits)
    inside = [seconds for sent, seconds in claims if began <= sent <= ended]
    return {
        "workers": FULL_WORKERS,
        "claims_and_commits_per_s": round(len(commits) / (ended - began), 1),
        "claim": quantiles(inside),
        "commit": quantiles([seconds for _, seconds in commits]),
        **load.losses(job),
    }


def table(report: dict[str, Any]) -> str:
    """The report for people."""
    steady, full, peaks = report["steady"], report["full"], report["peaks"]

    def row(name: str, values: dict[str, float]) -> str:
        return f"{name:32}" + "".join(f" {values[key]:9.10g}" for key in ("count", "p50_ms", "p99_ms", "max_ms"))

    lines = [
        f"{report['workers']} workers, {report['tiles']} tiles of {report['tile_s']} s, {report['cores']} cores,"
        f" load average {report['load_average']} (before: {report['load_average_before']:.1f})",
        f"{'':32} {'count':>9} {'p50 ms':>9} {'p99 ms':>9} {'max ms':>9}",
        *(row(route, values) for route, values in steady["routes"].items()),
        row("queued > claimed, idle workers", report["idle"]["queued_to_claimed"]),
        row("queued > claimed, all at once", steady["all_at_once"]),
        row(f"claim, {full['workers']} workers without rest", full["claim"]),
        row(f"commit, {full['workers']} workers without rest", full["commit"]),
        "",
    ]
    figures = {
        "planning s": steady["planning_s"],
        "claims/s, steady": steady["claims_per_s"],
        "claims and commits/s, full": full["claims_and_commits_per_s"],
        "coordinator's cores, idle": report["idle"]["coordinator_cores"],
        "coordinator's cores, steady": steady["coordinator_cores"],
        "lost heartbeats": steady["lost_heartbeats"] + full["lost_heartbeats"],
        "tiles lost": steady["tiles_lost"] + full["tiles_lost"],
        "tiles doubled": steady["tiles_doubled"] + full["tiles_doubled"],
        "refused or unanswered": steady["refused"] or 0,
        **peaks,
    }
    return "\n".join([*lines, *(f"{name:32} {value!s:>9}" for name, value in figures.items())])


def main() -> None:
    if sys.argv[1:2] == ["--simulate"]:
        url, token, workers, tile_s, seed = sys.argv[2:]
        asyncio.run(simulate(url, token, int(workers), float(tile_s), int(seed)))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=1000)
    parser.add_argument("--tiles", type=int, default=10_000)
    parser.add_argument("--tile-s", type=float, default=20.0, help="mean seconds that a tile takes")
    parser.add_argument("--processes", type=int, default=2, help="of simulated workers")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="lightkiln-load-") as name,
        EmbeddedPostgres(Path(name) / "postgres") as server,
    ):
        (Path(name) / "data").mkdir()
        report = measure(arguments, Path(name), server)
    print(table(report))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
