"""Metrics for Prometheus, read from the database at each scrape: so any coordinator of several tells the same."""

from collections.abc import Iterator
from typing import Final

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
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

Rows = list[DictRow]


async def text(database: Database) -> bytes:
    """All metrics in the text format."""
    async with database.transaction() as tx:
        tasks, jobs = await tx.all("count_tasks"), await tx.all("count_jobs")
        done, ended = await tx.all("sum_seconds"), await tx.all("count_events", kinds=list(ENDS))
        blobs = await tx.one("sum_blobs")
    workers = await operators.list_workers(database)
    states = {state: sum(worker.state is state for worker in workers) for state in WorkerState}
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Once([*_queue(tasks, jobs), *_work(done, ended), *_workers(states), *_storage(blobs)]))
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
    by_kind = {row["kind"]: row for row in done}
    for name, column, help_text in (
        ("lightkiln_tasks_completed", "tasks", "Tasks that workers completed."),
        ("lightkiln_task_seconds", "seconds", "Busy seconds of completed tasks."),
    ):
        family = CounterMetricFamily(name, help_text, labels=["kind"])
        for kind in TaskKind:
            row = by_kind.get(kind.value)
            family.add_metric([kind.value], row[column] if row else 0)
        yield family
    rendered = by_kind.get(TaskKind.RENDER.value)
    yield CounterMetricFamily(
        "lightkiln_rendered_texels", "Texels of completed tiles.", value=rendered["texels"] if rendered else 0
    )
    yield CounterMetricFamily(
        "lightkiln_traced_paths", "Paths of completed tiles.", value=rendered["paths"] if rendered else 0
    )
    counted = {row["kind"]: row["events"] for row in ended}
    family = CounterMetricFamily("lightkiln_attempts_without_result", "Attempts by how they ended.", labels=["how"])
    for event, how in ENDS.items():
        family.add_metric([how], counted.get(event, 0))
    yield family


def _workers(states: dict[WorkerState, int]) -> Iterator[Metric]:
    family = GaugeMetricFamily("lightkiln_workers", "Workers seen within a week, by state.", labels=["state"])
    for state, count in states.items():
        family.add_metric([state.value], count)
    yield family


def _storage(blobs: DictRow) -> Iterator[Metric]:
    yield GaugeMetricFamily("lightkiln_blob_bytes", "Bytes of blobs; light-field stores not counted.", blobs["bytes"])
    yield GaugeMetricFamily("lightkiln_blobs", "Blobs.", blobs["blobs"])
