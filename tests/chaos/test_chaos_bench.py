"""A short run of the chaos bench: a fault of every kind from a fixed seed, and nothing is lost, doubled or different.

On a disk that is filled; with S3, which `make chaos` has too, it would take twice as long.
"""

import math
from pathlib import Path
from tempfile import TemporaryDirectory

from chaos_bench import BAD, bench
from chaos_faults import faults_of

SEED = 7


def test_nothing_is_lost_doubled_or_different() -> None:
    # Not under pytest's folder, which is private to this user: the database server is another one.
    with TemporaryDirectory(prefix="lightkiln-chaos-") as folder, bench(Path(folder), "disk", SEED) as running:
        assert running.farm.clock.works, "libfaketime is missing: deploy/install/faketime.sh"
        kinds = faults_of(running)
        running.run(len(kinds), math.inf)
    assert {kind for kind, _ in running.recoveries} == set(kinds)
    assert running.verdicts["bakes"] >= 2
    assert {name: running.verdicts[name] for name in BAD} == dict.fromkeys(BAD, 0), running.recoveries
