"""Quality gates on the command line: `--junit FILE`, and what a job that missed gates is told with."""

from collections.abc import Sequence
from pathlib import Path

from kiln_schemas.errors import Canceled, GateFailed, InternalError, KilnError, Problem
from kiln_schemas.gates import GateResult, gate_problem
from kiln_schemas.job import JobView
from kiln_schemas.junit import junit, junit_of_error
from kiln_schemas.states import FINAL_JOB_STATES, PUBLISHED_JOB_STATES, JobState
from kiln_service.cli.fetch import writing


def end_of(job: JobView) -> Problem | None:
    """What a job that is over ended with, archived or not; None where it completed."""
    if job.outcome is JobState.COMPLETED:
        return None
    if job.outcome is JobState.CANCELED:
        return Canceled(f"the job {job.id} was canceled").problem()
    return job.error or InternalError(f"the job {job.id} is {job.state} without an error").problem()


def raise_unless_completed(job: JobView) -> JobView:
    """The job, if it completed; else the error that it ended with."""
    problem = end_of(job)
    if problem is not None:
        raise KilnError.from_problem(problem)
    return job


def raise_if_missed(results: Sequence[GateResult]) -> None:
    """GateFailed where a gate is missed."""
    problem = gate_problem(results)
    if problem is not None:
        raise GateFailed.from_problem(problem)


def write_junit(path: Path | None, job: JobView) -> None:
    """Write the JUnit file of a job that is over, however it ended; nothing without a path or before the end."""
    if path is None or job.state not in FINAL_JOB_STATES:
        return
    problem = end_of(job)
    if problem is None or job.state in PUBLISHED_JOB_STATES:
        write_results(path, job.name, job.gate_results)
    else:
        _write(path, junit_of_error(job.name, list(job.gates.thresholds()), problem))


def write_results(path: Path, job_name: str, results: Sequence[GateResult]) -> None:
    """Write the JUnit file of measured gates: the bytes of the package's `gates.xml`."""
    _write(path, junit(job_name, results))


def _write(path: Path, document: bytes) -> None:
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(document)
