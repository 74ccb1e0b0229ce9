"""Metrics for Prometheus, read from the database at each scrape: so any coordinator of several tells the same.

The seconds of requests alone are a coordinator's own, counted since its start.
"""

from collections.abc import Iterator
from typing import Final

from prometheus_client import CollectorRegistry, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.registry import Collector
from psycopg.rows import DictRow

from kiln_schemas.operators import WorkerState
from kiln_schemas.states import JobState, TaskState
from kiln_schemas.tasks import TaskKind
from kiln_service import operators
from kiln_service.db import Database

MEDIA_TYPE: Final = CONTENT_TYPE_PLAIN_0_0_4
ENDS: Final = {"task.retried": "failed", "task.lost": "lost", "task.failed": "gave-up"}
"""Events of attempts that ended without a result, and what they are called."""

TASK_SECONDS: Final = (1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 3600.0, 14400.0)
REQUEST_SECONDS: Final = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 30.0)
"""Bounds of the histograms' buckets."""

Rows = list[DictRow]


async def text(database: Database) -> bytes:
    """All metrics in the text format."""
    async with database.transaction() as tx:
        tasks, jobs = await tx.all("count_tasks"), await tx.all("count_jobs")
        done = await tx.all("sum_work", bounds=[bound + 1e-9 for bound in TASK_SECONDS])
        ended = await tx.all("count_events", kinds=list(ENDS))
        blobs, light = await tx.one("sum_blobs"), await tx.one("sum_light_fields")
    workers = await operators.list_workers(database)
    states = {state: sum(worker.state is state for worker in workers) for state in WorkerState}
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Once([*_queue(tasks, jobs), *_work(done, ended), *_workers(states), *_storage(blobs, light)]))
    return generate_latest(registry)


class _Once(Collector):
    """Metrics that were read before."""

    def __init__(self, metrics: list[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> Iterator[Metric]:
        yield from self._metrics


def _queue(tasks: Rows, jobs: Rows) -> Iterator[Metric]:
    counted = {(row["kind"], row["state"]): row["tasks"] for row in tasks}
    family = GaugeMetricFamily(
        "lightkiln_tasks", "Tasks by kind and state; queued ones wait.", labels=["kind", "state"]
    )
    for kind in TaskKind:
        for task_state in TaskState:
            family.add_metric([kind.value, task_state.value], counted.get((kind.value, task_state.value), 0))
    yield family
    by_state = {row["state"]: row["jobs"] for row in jobs}
    family = GaugeMetricFamily("lightkiln_jobs", "Jobs by state.", labels=["state"])
    for job_state in JobState:
        family.add_metric([job_state.value], by_state.get(job_state.value, 0))
    yield family


def _work(done: Rows, ended: Rows) -> Iterator[Metric]:
    yield _durations(done)
    rendered = [row for row in done if row["kind"] == TaskKind.RENDER.value]
    for name, column in (("lightkiln_rendered_texels", "texels"), ("lightkiln_traced_paths", "paths")):
        value = sum(row[column] for row in rendered)
        yield CounterMetricFamily(name, f"{column.capitalize()} of completed tiles.", value=value)
    counted = {row["kind"]: row["events"] for row in ended}
    family = CounterMetricFamily("lightkiln_attempts_without_result", "Attempts by how they ended.", labels=["how"])
    for event, how in ENDS.items():
        family.add_metric([how], counted.get(event, 0))
    yield family


def _durations(done: Rows) -> Metric:
    """Busy seconds of completed tasks, as a histogram."""
    family = HistogramMetricFamily("lightkiln_task_seconds", "Busy seconds of completed tasks.", labels=["kind"])
    for kind in TaskKind:
        rows = [row for row in done if row["kind"] == kind.value]
        buckets, count = list[tuple[str, float]](), 0
        for number, bound in enumerate((*TASK_SECONDS, None)):
            count += sum(row["tasks"] for row in rows if row["bucket"] == number)
            buckets.append(("+Inf" if bound is None else str(bound), count))
        family.add_metric([kind.value], buckets, sum(row["seconds"] for row in rows))
    return family


class RequestSeconds:
    """How long this coordinator's answers took, by route."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry(auto_describe=False)
        self._seconds = Histogram(
            "lightkiln_request_seconds",
            "Seconds to answer requests, held claims and streams included.",
            ["method", "route", "status"],
            registry=self._registry,
            buckets=REQUEST_SECONDS,
        )

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request."""
        self._seconds.labels(method, route, f"{status // 100}xx").observe(seconds)

    def text(self) -> bytes:
        """In the text format."""
        return generate_latest(self._registry)


def _workers(states: dict[WorkerState, int]) -> Iterator[Metric]:
    family = GaugeMetricFamily("lightkiln_workers", "Workers seen within a week, by state.", labels=["state"])
    for state, count in states.items():
        family.add_metric([state.value], count)
    yield family


def _storage(blobs: DictRow, light: DictRow) -> Iterator[Metric]:
    help_text = "Bytes of radiance in light-field stores; their compressed visibility is not counted."
    yield GaugeMetricFamily("lightkiln_store_bytes", help_text, light["bytes"])
    yield GaugeMetricFamily("lightkiln_blob_bytes", "Bytes of blobs; light-field stores not counted.", blobs["bytes"])
    yield GaugeMetricFamily("lightkiln_blobs", "Blobs.", blobs["blobs"])
