"""How long each route holds up the coordinator's event loop on a job of 65,536 tiles: prints a table and writes JSON.

    python benchmarks/stall.py [--tiles 65536] [--json FILE]

A real coordinator on a real PostgreSQL. While another process asks one route after the other, a task on the loop of
the coordinator sleeps 5 ms at a time and notes how late it wakes, and how much processor time the loop's thread took
meanwhile: for so long nobody was served. On a machine with other load the second figure is the one to go by: the
first has the time in which the process was not run. The routes are those of the OpenAPI document that are asked by
GET, the dashboard's pages, and the claims and commits of the tasks that carry lists of all tiles.
"""

import argparse
import asyncio
import hashlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
import psycopg
import uvicorn

from kiln_schemas import __version__
from kiln_service.app import create_app
from kiln_service.config import Limits, ServiceConfig
from kiln_service.embedded import EmbeddedPostgres
from kiln_service.serve import server_config, spare_what_stays

TILE = 8
STEP_S = 0.005
TIMES = 3
KINDS = ("prepare", "render", "fit", "refine", "package")


class Asker:
    """Asks everything once it is there, and notes when."""

    def __init__(self, url: str, token: str, dsn: str, tiles: int) -> None:
        self._http = httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=600)
        self._dsn, self._tiles = dsn, tiles
        self.asked: list[dict[str, Any]] = []

    def ask(self, name: str, method: str, path: str, **content: Any) -> httpx.Response:
        began = time.monotonic()
        reply = self._http.request(method, path, **content)
        ended = time.monotonic()
        size = len(reply.content)
        note = {"route": name, "began": began, "ended": ended, "status": reply.status_code, "bytes": size}
        self.asked.append(note)
        time.sleep(0.05)
        return reply

    def run(self) -> None:
        """A job from its submission to its package, and all that can be read of it before the fit."""
        blob = b"bytes"
        sha256 = hashlib.sha256(blob).hexdigest()
        self._http.put(f"/v1/blobs/{sha256}", content=blob).raise_for_status()
        side = TILE * next(n for n in range(4, 1025) if n * n >= self._tiles)
        changes = [f"lightmap.resolution={side}", f"lightmap.tile={TILE}", "fit.solver=cnn"]
        request = {"name": "all", "preset": "draft", "set": changes}
        request["bundle"] = {"entry": "a.glb", "files": {"a.glb": sha256}}
        job = self.ask("submit", "POST", "/v1/jobs", json=request).json()["id"]
        registration = {"name": "w", "kinds": KINDS, "memory_bytes": 2**30, "threads": 1, "device": "none"}
        worker = self.ask("register", "POST", "/v1/workers", json=registration | {"version": __version__}).json()
        claim = self._claim(worker)
        places = [divmod(i, side // TILE) for i in range(self._tiles)]
        result = {
            "scene": sha256,
            "texel_map": sha256,
            "scene_hash": sha256,
            "tiles": [{"row": r * TILE, "column": c * TILE, "size": TILE, "texels": 64} for r, c in places],
            "has_environment": False,
            "has_light": True,
            "triangles": 12,
        }
        self._commit(claim, result)
        for _ in range(TIMES):
            claim = self._claim(worker)
            self._commit(claim, {"tile": claim["payload"]["tile"], "paths": 10, "overflows": 0, "invalid": 0})
            self._read(job, claim["task_id"])
        claim = self._claim(worker)
        self._render_the_rest(job)
        self._read(job, claim["task_id"])
        self._commit(claim, {"tile": claim["payload"]["tile"], "paths": 10, "overflows": 0, "invalid": 0})
        claim = self._claim(worker)
        metrics = {"log_mse": 0.1, "log_mse_zero": 1, "log_mse_rel": 0.1, "texels": 10, "signal": True}
        curve = [{"step": step, "loss": 1.0} for step in range(1000)]
        fit = {"function": claim["payload"]["function"], "weights": sha256, "exposure": 1, "metrics": metrics}
        assert len(claim["payload"]["renders"]) == self._tiles
        self._commit(claim, fit | {"curve": curve, "steps": 1000})
        claim = self._claim(worker)
        assert len(claim["payload"]["renders"]) == len(claim["payload"]["prepare"]["tiles"]) == self._tiles
        artifact = {"name": "a.ktx2", "sha256": sha256, "size": len(blob), "media_type": "image/ktx2"}
        self._commit(claim, {"artifacts": [artifact]})
        self._read(job, claim["task_id"])

    def _claim(self, worker: dict[str, Any]) -> Any:
        path = f"/v1/workers/{worker['worker_id']}/claim"
        reply = self.ask("claim", "POST", path, json={"kinds": KINDS, "wait_s": 30}).raise_for_status()
        self.asked[-1]["route"] = f"claim {reply.json()['payload']['kind']}"
        return reply.json()

    def _commit(self, claim: dict[str, Any], result: dict[str, Any]) -> None:
        kind = claim["payload"]["kind"]
        body = {"attempt": claim["attempt"], "lease": claim["lease"], "result": {"kind": kind, "seconds": 0.5} | result}
        path = f"/v1/tasks/{claim['task_id']}/commit"
        assert self.ask(f"commit {kind}", "POST", path, json=body).status_code == 204

    def _render_the_rest(self, job: str) -> None:
        """What workers would do for hours: all tiles but the one that is active are rendered, each with its events."""
        with psycopg.connect(self._dsn, autocommit=True) as connection:
            connection.execute(
                """
                WITH done AS (
                    UPDATE tasks SET state = 'completed', attempt = 1, started = now(), finished = now(),
                        result = '{"kind": "render", "paths": 4096, "overflows": 0, "invalid": 0, "seconds": 1.5,
                            "invalid_texels": []}'::jsonb || jsonb_build_object('tile', spec -> 'tile')
                    WHERE job_id = %s AND kind = 'render' AND state = 'queued' RETURNING id, job_id
                )
                INSERT INTO events (job_id, task_id, kind, actor)
                SELECT job_id, id, kind, 'worker:w'
                FROM done CROSS JOIN (VALUES ('task.claimed'), ('task.completed')) AS told (kind)
                """,
                [job],
            )
            connection.execute("ANALYZE")

    def _read(self, job: str, task: str) -> None:
        """Every GET route but streams and files, and the pages."""
        document = self._http.get("/v1/openapi.json").json()
        known = {"job_id": job, "task_id": task}
        for path, operations in document["paths"].items():
            names = [part[1:-1] for part in path.split("/") if part.startswith("{")]
            if "get" in operations and set(names) <= set(known):
                filled = path.format(**known)
                params = {"format": "json", "limit": 10_000} if path.endswith("/events") else {}
                self.ask(f"GET {path}", "GET", filled, params=params)
        version = 0
        for since in (0, None):
            reply = self.ask("GET tasks, since", "GET", f"/v1/jobs/{job}/tasks", params={"since": since or version})
            version = int(reply.headers.get("X-Version", 0))
        for path in (f"/jobs/{job}", "/jobs", "/workers", f"/tasks/{task}"):
            self.ask(f"page {path.replace(job, 'JOB').replace(task, 'TASK')}", "GET", path)


async def sample(late: list[tuple[float, float, float]]) -> None:
    """How late a sleep of STEP_S ends, as (when it ended, seconds, seconds of the thread's processor time)."""
    while True:
        began, used = time.monotonic(), time.thread_time()
        await asyncio.sleep(STEP_S)
        now = time.monotonic()
        late.append((now, now - began - STEP_S, time.thread_time() - used))


async def serve(config: ServiceConfig, tiles: int) -> tuple[list[dict[str, Any]], list[tuple[float, float, float]]]:
    """What was asked, and the samples of the loop meanwhile."""
    app, late = create_app(config), list[tuple[float, float, float]]()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = uvicorn.Server(server_config(app, config))
        running = asyncio.create_task(server.serve(sockets=[listening]))
        while not server.started:
            await asyncio.sleep(0.05)
        spare_what_stays()
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        words = [sys.executable, __file__, "--ask", url, (config.data / "token").read_text().strip()]
        sampling = asyncio.create_task(sample(late))
        asker = await asyncio.create_subprocess_exec(*words, config.database or "", str(tiles), stdout=subprocess.PIPE)
        out, _ = await asker.communicate()
        sampling.cancel()
        server.should_exit = True
        await running
    assert asker.returncode == 0
    return json.loads(out), late


def rows_of(asked: list[dict[str, Any]], late: list[tuple[float, float, float]]) -> list[dict[str, Any]]:
    """The worst of each route."""
    rows: dict[str, dict[str, Any]] = {}
    for one in asked:
        within = [sample for sample in late if one["began"] <= sample[0] <= one["ended"] + 2 * STEP_S + 0.03]
        empty = dict.fromkeys(("asked", "status", "bytes", "ms", "stall_ms", "busy_ms"), 0)
        row = rows.setdefault(one["route"], {"route": one["route"], **empty})
        row["asked"] += 1
        row["status"] = max(row["status"], one["status"])
        row["bytes"] = max(row["bytes"], one["bytes"])
        row["ms"] = max(row["ms"], round(1e3 * (one["ended"] - one["began"])))
        row["stall_ms"] = max(row["stall_ms"], round(1e3 * max((late for _, late, _ in within), default=0.0)))
        row["busy_ms"] = max(row["busy_ms"], round(1e3 * max((busy for _, _, busy in within), default=0.0)))
    return sorted(rows.values(), key=lambda row: -row["busy_ms"])


def main() -> None:
    if sys.argv[1:2] == ["--ask"]:
        asker = Asker(*sys.argv[2:5], int(sys.argv[5]))
        asker.run()
        print(json.dumps(asker.asked))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, default=65536)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    before = os.getloadavg()[0]
    with (
        tempfile.TemporaryDirectory(prefix="lightkiln-stall-") as name,
        EmbeddedPostgres(Path(name) / "postgres") as server,
    ):
        config = ServiceConfig(data=Path(name) / "data", database=server.dsn, limits=Limits(reserve_bytes=0))
        rows = rows_of(*asyncio.run(serve(config, arguments.tiles)))
    report = {"tiles": arguments.tiles, "load_average": [before, os.getloadavg()[0]], "routes": rows}
    print(f"{arguments.tiles} tiles, load average {before:.1f} before, {os.getloadavg()[0]:.1f} after")
    print(f"{'route':44} {'asked':>6} {'status':>6} {'bytes':>9} {'ms':>7} {'late ms':>8} {'busy ms':>8}")
    for row in rows:
        print("{route:44} {asked:6} {status:6} {bytes:9} {ms:7} {stall_ms:8} {busy_ms:8}".format(**row))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
