"""A worker that floods its log: what the coordinator keeps, and how soon it answers. Prints a table and writes JSON.

    python benchmarks/logs.py [--megabytes 300] [--seconds 60] [--json FILE]

A real coordinator on a real PostgreSQL. Another process sends heartbeats with 64 KiB of log each, one after the other,
until it has sent so much or for so long, then asks for the last line of the log (`tail=1`), and for the log. Meanwhile
a task on the coordinator's loop notes how late its sleeps end and how much processor time the loop's thread took.
"""

import argparse
import asyncio
import hashlib
import json
import os
import socket
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import httpx
import psutil
import psycopg
import uvicorn

from kiln_schemas import __version__
from kiln_service.app import create_app
from kiln_service.config import Limits, Rate, Rates, ServiceConfig
from kiln_service.embedded import EmbeddedPostgres
from kiln_service.serve import server_config

LINE = "x" * 127 + "\n"
PIECE = LINE * 511
STEP_S = 0.005
ASKED = 5


def flood(url: str, token: str, megabytes: float, seconds: float) -> dict[str, float]:
    """What was sent, and how long the questions afterwards took."""
    http = httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=600)
    sha256 = hashlib.sha256(b"bytes").hexdigest()
    http.put(f"/v1/blobs/{sha256}", content=b"bytes").raise_for_status()
    bundle = {"entry": "a.glb", "files": {"a.glb": sha256}}
    http.post("/v1/jobs", json={"name": "n", "preset": "draft", "bundle": bundle}).raise_for_status()
    body: dict[str, Any] = {"name": "w", "kinds": ["prepare"], "memory_bytes": 1, "threads": 1, "device": "none"}
    worker = http.post("/v1/workers", json=body | {"version": __version__}).raise_for_status().json()["worker_id"]
    claim = http.post(f"/v1/workers/{worker}/claim", json={"kinds": ["prepare"], "wait_s": 30}).json()
    beat = {"task_id": claim["task_id"], "attempt": claim["attempt"], "lease": claim["lease"], "log": PIECE}
    content = json.dumps(beat).encode()
    headers = {"Content-Type": "application/json"}
    sent, began = 0, time.monotonic()
    while sent < megabytes * 1e6 and time.monotonic() - began < seconds:
        http.post(f"/v1/workers/{worker}/heartbeat", content=content, headers=headers).raise_for_status()
        sent += len(PIECE)
    took = time.monotonic() - began
    times: dict[str, list[float]] = {"tail": [], "whole": []}
    for _ in range(ASKED):
        for name, params in (("tail", {"tail": 1}), ("whole", {})):
            asked = time.monotonic()
            http.get(f"/v1/tasks/{claim['task_id']}/log", params=params).raise_for_status()
            times[name].append(time.monotonic() - asked)
    return {
        "sent_bytes": sent,
        "sent_s": took,
        "tail_1_s": median(times["tail"]),
        "tail_1_worst_s": max(times["tail"]),
        "log_s": median(times["whole"]),
    }


async def sample(late: list[tuple[float, float]]) -> None:
    """How late a sleep of STEP_S ends, and the loop thread's processor time meanwhile, both in seconds."""
    while True:
        began, used = time.monotonic(), time.thread_time()
        await asyncio.sleep(STEP_S)
        late.append((time.monotonic() - began - STEP_S, time.thread_time() - used))


async def serve(config: ServiceConfig, words: list[str]) -> dict[str, float]:
    """Serve while another process floods."""
    app, late = create_app(config), list[tuple[float, float]]()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = uvicorn.Server(server_config(app, config))
        running = asyncio.create_task(server.serve(sockets=[listening]))
        while not server.started:
            await asyncio.sleep(0.05)
        memory = psutil.Process().memory_info().rss
        sampling = asyncio.create_task(sample(late))
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        command = [sys.executable, __file__, "--flood", url, (config.data / "token").read_text().strip(), *words]
        process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
        out, _ = await process.communicate()
        sampling.cancel()
        grown = psutil.Process().memory_info().rss - memory
        server.should_exit = True
        await running
    assert process.returncode == 0
    stalls = {"stall_s": max(stall for stall, _ in late), "busy_s": max(busy for _, busy in late)}
    return json.loads(out) | stalls | {"memory_bytes": grown}


def kept(dsn: str) -> dict[str, float]:
    """Bytes of log and the disk that they take."""
    with psycopg.connect(dsn) as connection:
        row = connection.execute(
            "SELECT COALESCE(sum(octet_length(lines)), 0), pg_total_relation_size('task_logs') FROM task_logs"
        ).fetchone()
    assert row is not None
    return {"kept_bytes": int(row[0]), "disk_bytes": int(row[1])}


def main() -> None:
    if sys.argv[1:2] == ["--flood"]:
        print(json.dumps(flood(sys.argv[2], sys.argv[3], float(sys.argv[4]), float(sys.argv[5]))))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=300)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    before = os.getloadavg()[0]
    often = Rate(per_s=1e6, burst=1_000_000)
    limits = Limits(reserve_bytes=0, rates=Rates(clients=often, workers=often, failures=often))
    with (
        tempfile.TemporaryDirectory(prefix="lightkiln-logs-") as name,
        EmbeddedPostgres(Path(name) / "postgres") as server,
    ):
        config = ServiceConfig(data=Path(name) / "data", database=server.dsn, limits=limits)
        figures = asyncio.run(serve(config, [str(arguments.megabytes), str(arguments.seconds)])) | kept(server.dsn)
    for figure, value in figures.items():
        print(f"{figure:16} {value:14,.3f}")
    print(f"load average {before:.1f} before, {os.getloadavg()[0]:.1f} after")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures | {"load_average": [before, os.getloadavg()[0]]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
