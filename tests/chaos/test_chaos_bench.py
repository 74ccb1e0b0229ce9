"""A short run of the chaos bench: some faults from a fixed seed, nothing lost, doubled or different.

On a disk that is filled; with S3, which `make chaos` has too, it would take twice as long.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

from chaos import bench

FAULTS, SEED = 8, 7
SECONDS = 600
"""No test of speed: a bench that hangs shall end."""


def test_nothing_is_lost_doubled_or_different() -> None:
    # Not under pytest's folder, which is private to this user: the database server is another one.
    with TemporaryDirectory(prefix="lightkiln-chaos-") as folder, bench(Path(folder), "disk", SEED) as running:
        running.run(FAULTS, time.monotonic() + SECONDS)
    assert len(running.recoveries) == FAULTS and running.verdicts["bakes"] >= 2
    left = {name: count for name, count in running.verdicts.items() if name != "bakes" and count}
    assert left == {}, running.recoveries
