"""A short run of the chaos bench: some faults from a fixed seed, nothing lost, doubled or different."""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from chaos import bench

FAULTS = {"disk": 8, "s3": 4}
SEED = 7


@pytest.mark.parametrize("store", FAULTS)
def test_nothing_is_lost_doubled_or_different(store: str) -> None:
    # Not under pytest's folder, which is private to this user: the database server is another one.
    with TemporaryDirectory(prefix="lightkiln-chaos-") as folder, bench(Path(folder), store, SEED) as running:
        running.run(FAULTS[store], time.monotonic() + 120)
    assert running.recoveries and running.verdicts["bakes"] >= 2
    left = {name: count for name, count in running.verdicts.items() if name != "bakes" and count}
    assert left == {}, running.recoveries
