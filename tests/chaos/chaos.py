"""Bakes of a small scene under faults of every kind: prints a table and writes JSON.

    make chaos
    python tests/chaos/chaos.py [--faults 200] [--seed 1] [--store disk] [--minutes 30] [--only KIND] [--json FILE]

Processes are killed and ended, wires cut, writes refused, bytes flipped, light fields deleted, clocks set: one fault
after the other, of all kinds in turn and at random moments (`chaos_faults`, `chaos_bench`).
"""

import argparse
import json
import os
import signal
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from chaos_bench import BAD, Bench, bench
from chaos_farm import RESTART_S
from e2e_farm import TIMING


def report(bench: Bench, seed: int, store: str) -> dict[str, Any]:
    """What was done and what came of it."""
    kinds = sorted({kind for kind, _ in bench.recoveries})
    by_kind = {kind: [seconds for other, seconds in bench.recoveries if other == kind] for kind in kinds}
    every = [seconds for _, seconds in bench.recoveries] or [0.0]
    return {
        "seed": seed,
        "store": store,
        "timing": TIMING | {"restart_s": RESTART_S},
        "load_average": os.getloadavg()[2],
        "undisturbed": bench.undisturbed,
        "faults": {
            kind: {
                "count": len(found),
                "median_s": statistics.median(found),
                "worst_s": max(found),
                "repaired": bench.repaired[kind],
            }
            for kind, found in by_kind.items()
        },
        "all": {
            "count": len(bench.recoveries),
            "median_s": statistics.median(every),
            "worst_s": max(every),
            "repaired": bench.repaired.total(),
        },
        "restarts": bench.farm.restarts,
        **bench.verdicts,
    }


def table(result: dict[str, Any]) -> str:
    rows = [
        f"seed {result['seed']}, store {result['store']}, load average {result['load_average']:.1f}",
        "undisturbed: {tasks} tasks in {seconds:.1f} s, {longest_gap_s:.1f} s between two at most".format(
            **result["undisturbed"]
        ),
        f"{'fault':30} {'count':>6} {'median s':>9} {'worst s':>9} {'repaired':>9}",
    ]
    for kind, row in (result["faults"] | {"all": result["all"]}).items():
        rows.append(f"{kind:30} {row['count']:6d} {row['median_s']:9.1f} {row['worst_s']:9.1f} {row['repaired']:9d}")
    return "\n".join(
        [*rows, *(f"{name.replace('_', ' '):30} {result[name]:6d}" for name in ("bakes", *BAD, "restarts"))]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--store", choices=("s3", "disk"), default="disk")
    parser.add_argument("--minutes", type=float, default=180.0, help="no new fault after so long")
    parser.add_argument("--only", action="append", default=[], help="a kind of fault; may be repeated")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # and so through the end of what was started
    print(f"seed {arguments.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="lightkiln-chaos-") as name:
        with bench(Path(name), arguments.store, arguments.seed) as running:
            running.run(arguments.faults, time.monotonic() + 60 * arguments.minutes, arguments.only)
        result = report(running, arguments.seed, arguments.store)
    print(table(result))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")
    return int(any(result[name] for name in BAD))


if __name__ == "__main__":
    sys.exit(main())
