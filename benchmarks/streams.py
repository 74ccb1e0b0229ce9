"""Tiles a second of a coordinator while 200 event streams follow another job: prints a table and writes JSON.

    python benchmarks/streams.py [--streams 200] [--seconds 10] [--rounds 3] [--json FILE]

A real coordinator process on its own PostgreSQL. Workers that render in no time claim and commit tiles of one job; in
every other span as many streams as asked for are open on another job, which is paused. What counts is the ratio of
the two rates within a run: the spans take turns, so load of other programs falls on both.
"""

import argparse
import asyncio
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import httpx

from kiln_schemas import __version__

TILE, SIDE = 8, 256
WORKERS = 4
PATIENCE_S = 600
BLOB = b"bytes"
SHA256 = hashlib.sha256(BLOB).hexdigest()


class Farm:
    """The client of one coordinator."""

    def __init__(self, url: str, token: str) -> None:
        headers = {"Authorization": f"Bearer {token}"}
        self.http = httpx.Client(base_url=url, headers=headers, timeout=PATIENCE_S)
        self.http.put(f"/v1/blobs/{SHA256}", content=BLOB).raise_for_status()

    def submit(self, name: str) -> str:
        """The id of a new job."""
        settings = [f"lightmap.resolution={TILE * SIDE}", f"lightmap.tile={TILE}", "fit.solver=cnn"]
        bundle = {"entry": "a.glb", "files": {"a.glb": SHA256}}
        body = {"name": name, "preset": "draft", "set": settings, "bundle": bundle}
        return str(self.http.post("/v1/jobs", json=body).raise_for_status().json()["id"])

    def register(self) -> str:
        """The id of a new worker."""
        body = {"name": "w", "kinds": ["prepare", "render"], "memory_bytes": 2**30, "threads": 1, "device": "none"}
        reply = self.http.post("/v1/workers", json=body | {"version": __version__}).raise_for_status()
        return str(reply.json()["worker_id"])

    def work(self, worker: str) -> None:
        """Claim a task and commit a result."""
        body = {"kinds": ["prepare", "render"], "wait_s": 30}
        claim = self.http.post(f"/v1/workers/{worker}/claim", json=body).raise_for_status().json()
        kind = claim["payload"]["kind"]
        result: dict[str, Any] = {"kind": kind, "seconds": 0.1}
        if kind == "prepare":
            places = [divmod(i, SIDE) for i in range(SIDE * SIDE // 4)]
            tiles = [{"row": r * TILE, "column": c * TILE, "size": TILE, "texels": 64} for r, c in places]
            result |= {"scene": SHA256, "texel_map": SHA256, "scene_hash": SHA256, "tiles": tiles, "triangles": 12}
            result |= {"has_environment": False, "has_light": True}
        else:
            result |= {"tile": claim["payload"]["tile"], "paths": 1, "overflows": 0, "invalid": 0}
        body = {"attempt": claim["attempt"], "lease": claim["lease"], "result": result}
        self.http.post(f"/v1/tasks/{claim['task_id']}/commit", json=body).raise_for_status()

    def rate(self, workers: list[str], seconds: float) -> float:
        """Tiles a second that the workers claim and commit within a span."""
        until, done = time.monotonic() + seconds, [0] * len(workers)

        def work(place: int) -> None:
            while time.monotonic() < until:
                self.work(workers[place])
                done[place] += 1

        began = time.monotonic()
        threads = [threading.Thread(target=work, args=[place]) for place in range(len(workers))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return sum(done) / (time.monotonic() - began)


async def listen(url: str, token: str, job: str, count: int) -> None:
    """Open streams on a job, say so once all have begun, and read them until the process is killed."""
    begun = asyncio.Semaphore(0)

    async def follow(client: httpx.AsyncClient) -> None:
        async with client.stream("GET", f"/v1/jobs/{job}/events") as reply:
            reply.raise_for_status()
            begun.release()
            async for _ in reply.aiter_bytes():
                pass

    limits = httpx.Limits(max_connections=count)
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(base_url=url, headers=headers, timeout=PATIENCE_S, limits=limits) as client:
        streams = [asyncio.create_task(follow(client)) for _ in range(count)]
        for _ in range(count):
            await begun.acquire()
        print("ready", flush=True)
        await asyncio.gather(*streams)


@contextmanager
def listening(*words: str) -> Iterator[None]:
    """`listen` in a process of its own."""
    with subprocess.Popen([sys.executable, __file__, "--listen", *words], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline().strip() == "ready"
            yield
            assert process.poll() is None, "the streams ended"
        finally:
            process.kill()


@contextmanager
def coordinator(folder: Path) -> Iterator[tuple[str, str]]:
    """A coordinator's URL and token."""
    often = {"per_s": 1e6, "burst": 1_000_000}
    rates = {"clients": often, "workers": often, "failures": often}
    limits = {"streams": 10_000, "reserve_bytes": 0, "rates": rates}
    (folder / "config.json").write_text(json.dumps({"limits": limits}))
    words = ["--data", str(folder / "data"), "--config", str(folder / "config.json"), "--port", "0", "--json"]
    command = [sys.executable, "-m", "kiln_service", *words]
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True) as process,
    ):
        assert process.stdout is not None
        try:
            ready = json.loads(process.stdout.readline())
            yield ready["url"], Path(ready["token_file"]).read_text().strip()
        finally:
            process.terminate()


def main() -> None:
    if sys.argv[1:2] == ["--listen"]:
        asyncio.run(listen(*sys.argv[2:5], int(sys.argv[5])))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streams", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rates: dict[int, list[float]] = {0: [], arguments.streams: []}
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="lightkiln-streams-") as name, coordinator(Path(name)) as (url, token):
        farm = Farm(url, token)
        paused = farm.submit("paused")
        farm.http.post(f"/v1/jobs/{paused}/pause").raise_for_status()
        farm.submit("baked")
        workers = [farm.register() for _ in range(WORKERS)]
        farm.work(workers[0])
        for _ in range(arguments.rounds):
            rates[0].append(farm.rate(workers, arguments.seconds))
            with listening(url, token, paused, str(arguments.streams)):
                rates[arguments.streams].append(farm.rate(workers, arguments.seconds))
        log = (Path(name) / "log").read_text()
        assert "Traceback" not in log, log[-2000:]
    print(f"{'streams':>8} {'tiles/s, median':>16}   of each span")
    for count, found in rates.items():
        print(f"{count:8} {median(found):16.1f}   {' '.join(f'{rate:.1f}' for rate in found)}")
    ratio = median(rates[arguments.streams]) / median(rates[0])
    print(f"ratio {ratio:.2f}; load average {before:.1f} before, {os.getloadavg()[0]:.1f} after")
    if arguments.json:
        report = {"tiles_per_s": rates, "ratio": ratio, "load_average": [before, os.getloadavg()[0]]}
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
