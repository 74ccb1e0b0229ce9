"""A worker that is told to stop stops, wherever in its code the signal finds it."""

import subprocess
import sys

PROGRAM = """
import os, signal, sys, time
from pathlib import Path
from kiln_schemas.tasks import TaskKind
from kiln_workers.runner.parent import Worker, WorkerOptions


class Finalized:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):  # the handler runs here, and what it raises is lost
            pass


class Busy(Worker):
    def step(self):
        Finalized()
        while True:
            time.sleep(3600)


options = WorkerOptions(
    url="http://127.0.0.1:9", token="t", name="w", kinds=(TaskKind.RENDER,), memory_bytes=1, threads=1,
    folder=Path(sys.argv[1]),
)
Busy(options, lambda event, details: print(event, flush=True)).run()
"""
MINUTES_S = 120
"""No test of speed: a worker that has not stopped after minutes never will."""


def test_a_signal_that_is_lost_in_a_finalizer_is_heard(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], capture_output=True, text=True, timeout=MINUTES_S
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "worker.stopping\n" and "Exception ignored" in done.stderr
