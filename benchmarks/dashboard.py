"""How long the dashboard's pages take with many jobs and tiles: prints a table and writes JSON.

    python benchmarks/dashboard.py [--jobs 1000] [--tiles 10000] [--repeats 20] [--browser] [--json FILE]

A coordinator of its own with an embedded PostgreSQL is filled: one job has all the tiles, half of them rendered, the
others ten each. Times are those of a client on the same machine; `--browser` also measures Debian's chromium until the
page's load event, its scripts and styles included (the budget: the first page under a second).
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
import psycopg

from kiln_schemas.settings import PRESETS
from kiln_service.embedded import EmbeddedPostgres

PORT = 8377
BUDGET_S = 1.0
STATES = ("queued", "active", "paused", "failed", "completed", "gate-failed", "canceled")


def fill(dsn: str, jobs: int, tiles: int) -> str:
    """Rows as after weeks of work; the id of the job with all the tiles."""
    settings = PRESETS["production"].model_dump_json()
    bundle = json.dumps({"entry": "s.glb", "files": {"s.glb": "0" * 64}, "environment": None})
    ids = [f"{number:032x}" for number in range(1, jobs + 1)]
    with psycopg.connect(dsn) as connection:
        cursor = connection.cursor()
        cursor.executemany(
            "INSERT INTO jobs (id, name, method, state, settings, bundle, store_url, labels, submitter, started)"
            " VALUES (%s, %s, 'sg_lightfield', %s, %s, %s, 'file:///nowhere', %s, 'owner', now() - interval '1 hour')",
            [
                (
                    job,
                    f"shot {place} of the courtyard",
                    "active" if job == ids[-1] else STATES[place % len(STATES)],
                    settings,
                    bundle,
                    json.dumps({"project": f"p{place % 7}"}),
                )
                for place, job in enumerate(ids)
            ],
        )
        for kind, count in (("prepare", 1), ("fit", 2), ("refine", 4), ("package", 1)):
            cursor.execute(
                "INSERT INTO tasks (id, job_id, ordinal, kind, label, state, spec)"
                " SELECT %(kind)s || n || jobs.id, jobs.id, n, %(kind)s, n::text, 'waiting', '{}'"
                " FROM jobs, generate_series(1, %(count)s) AS n",
                {"kind": kind, "count": count},
            )
        cursor.execute(
            "INSERT INTO tasks (id, job_id, ordinal, kind, label, state, spec, result, started, finished)"
            " SELECT 'render' || n || jobs.id, jobs.id, 100 + n, 'render', n::text,"
            "        CASE WHEN n %% 2 = 0 THEN 'completed' ELSE 'queued' END,"
            "        jsonb_build_object('tile', jsonb_build_object('row', 16 * (n / 100), 'column', 16 * (n %% 100),"
            "                                                      'size', 16, 'texels', 200)),"
            "        CASE WHEN n %% 2 = 0 THEN '{}'::jsonb END, now() - interval '9 min', now() - interval '8 min'"
            " FROM jobs, generate_series(0, CASE WHEN jobs.id = %s THEN %s ELSE 10 END - 1) AS n",
            (ids[-1], tiles),
        )
        cursor.execute(
            "INSERT INTO events (job_id, kind, actor) SELECT %s, 'task.completed', 'worker:x'"
            " FROM generate_series(1, %s)",
            (ids[-1], tiles),
        )
        connection.commit()
        connection.autocommit = True
        connection.execute("ANALYZE")
    return ids[-1]


def measure(url: str, token: str, paths: dict[str, str], repeats: int) -> list[dict[str, object]]:
    rows = []
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}", "Accept": "text/html"}) as client:
        for name, path in paths.items():
            took, size = [], 0
            for _ in range(repeats):
                start = time.perf_counter()
                size = len(client.get(path, timeout=60).raise_for_status().content)
                took.append(time.perf_counter() - start)
            rows.append(
                {
                    "page": name,
                    "first_s": took[0],
                    "median_s": statistics.median(took),
                    "max_s": max(took),
                    "bytes": size,
                }
            )
    return rows


def measure_browser(url: str, token: str, paths: dict[str, str], repeats: int) -> list[dict[str, object]]:
    """Seconds from the click to the load event, in a browser that has seen none of the files yet."""
    from playwright.sync_api import sync_playwright

    rows = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        for name, path in paths.items():
            took = []
            for _ in range(repeats):
                page = browser.new_page()
                page.goto(f"{url}/login?next=/static/icon.svg")
                page.fill("#token", token)
                page.click("button.main")
                page.goto(url + path)
                took.append(page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd") / 1000)
                page.close()
            rows.append(
                {
                    "page": f"{name}, browser",
                    "first_s": took[0],
                    "median_s": statistics.median(took),
                    "max_s": max(took),
                    "bytes": 0,
                }
            )
        browser.close()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--tiles", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="kiln-bench-") as folder,
        EmbeddedPostgres(Path(folder) / "postgres") as server,
    ):
        command = [sys.executable, "-m", "kiln_service", "--data", folder, "--database", server.dsn]
        coordinator = subprocess.Popen(
            [*command, "--port", str(PORT)], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        try:
            url = f"http://127.0.0.1:{PORT}"
            wait_for(f"{url}/readyz")
            big = fill(server.dsn, arguments.jobs, arguments.tiles)
            token = (Path(folder) / "token").read_text().strip()
            paths = {
                "jobs, first page": "/jobs",
                "jobs, searched": "/jobs?q=shot+7+project%3Dp3",
                "jobs, completed": "/jobs?state=completed",
                "workers": "/workers",
                f"job of {arguments.tiles} tiles": f"/jobs/{big}",
                f"its {arguments.tiles} tiles": f"/v1/jobs/{big}/tiles",
            }
            rows = measure(url, token, paths, arguments.repeats)
            if arguments.browser:
                shown = {name: path for name, path in paths.items() if not path.endswith("/tiles")}
                rows += measure_browser(url, token, shown, min(arguments.repeats, 5))
        finally:
            coordinator.terminate()
            coordinator.wait()
    print(f"{arguments.jobs} jobs, {arguments.tiles} tiles in one of them")
    print(f"{'page':<30} {'first s':>8} {'median s':>9} {'max s':>8} {'KiB':>7}")
    for row in rows:
        seconds = f"{row['first_s']:8.3f} {row['median_s']:9.3f} {row['max_s']:8.3f}"
        print(f"{row['page']:<30} {seconds} {row['bytes'] / 1024:7.0f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))
    if max(row["max_s"] for row in rows if row["page"].startswith("jobs, first page")) > BUDGET_S:
        sys.exit(f"the first page took more than {BUDGET_S} s")


def wait_for(url: str) -> None:
    for _ in range(600):
        try:
            if httpx.get(url).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    sys.exit("the coordinator did not start")


if __name__ == "__main__":
    main()
