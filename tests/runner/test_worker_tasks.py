"""A worker against a recording coordinator: results, failures, cancellations, outages."""

import json
import threading
import time

import pytest

from kiln_schemas.errors import AuthError, NotFound
from kiln_schemas.logs import JsonFormatter
from kiln_schemas.settings import PRESETS
from kiln_schemas.tasks import Block, Claim, FitResult, RefinePayload
from kiln_workers.__main__ import Log
from kiln_workers.runner.parent import Worker


def weights(coordinator, index: int = -1) -> bytes:
    return coordinator.blobs[coordinator.named("/commit")[index]["result"]["weights"]]


def test_a_result_is_committed_with_its_attempt_and_what_libraries_print_is_log(coordinator, worker: Worker) -> None:
    coordinator.add("print", attempt=3)
    worker.step()
    (commit,) = coordinator.named("/commit")
    assert (commit["attempt"], commit["lease"]) == (3, "secret") and commit["result"]["kind"] == "fit"
    beats = coordinator.named("/heartbeat")
    assert {(beat["attempt"], beat["lease"]) for beat in beats} == {(3, "secret")}
    log = "".join(beat["log"] for beat in beats)
    for line in ("stray words on standard output", "stray bytes on descriptor 1", "a line for the log"):
        assert log.count(line) == 1
    assert beats[-1]["progress"] == {"done": 1, "total": 4, "unit": "steps", "message": "print", "loss": 0.5}


def test_the_child_stays_warm_and_scratch_does_not(coordinator, worker: Worker) -> None:
    for instruction in ("", "", "scratch", "scratch"):
        coordinator.add(instruction)
        worker.step()
    commits = coordinator.named("/commit")
    assert [commit["result"]["steps"] for commit in commits] == [1, 2, 3, 4]
    assert weights(coordinator, 0) == weights(coordinator, 1) != b""
    assert weights(coordinator, 2) == weights(coordinator, 3) == b"['left']"
    assert len(coordinator.named("/v1/workers")) == 1


def test_the_threads_of_libraries_are_bounded_from_the_start(coordinator, worker: Worker) -> None:
    coordinator.add("environment")
    worker.step()
    assert weights(coordinator) == b"1"


def test_a_crash_is_a_retryable_failure_with_the_last_lines(coordinator, worker: Worker) -> None:
    coordinator.add("segfault")
    worker.step()
    (failure,) = coordinator.named("/fail")
    assert failure["retryable"] and "SIGSEGV" in failure["problem"]["detail"]
    assert failure["problem"]["code"] == "internal" and "last words" in failure["log"]
    coordinator.add("")
    worker.step()
    assert len(coordinator.named("/commit")) == 1


def test_a_child_that_the_system_killed_points_to_memory(coordinator, worker: Worker) -> None:
    coordinator.add("exhaust")
    worker.step()
    (failure,) = coordinator.named("/fail")
    assert failure["problem"]["code"] == "machine-lacks" and "--memory" in failure["problem"]["remedy"]


@pytest.mark.parametrize(
    ("instruction", "code", "retryable"),
    [("refuse", "input", False), ("defect", "internal", True), ("disk-full", "machine-lacks", True)],
)
def test_errors_travel_as_problems(coordinator, worker: Worker, instruction: str, code: str, retryable: bool) -> None:
    coordinator.add(instruction)
    worker.step()
    (failure,) = coordinator.named("/fail")
    assert (failure["problem"]["code"], failure["retryable"]) == (code, retryable)
    assert not coordinator.named("/commit")


def test_a_defect_shows_an_id_and_keeps_its_traceback_in_the_log(coordinator, worker: Worker) -> None:
    coordinator.add("defect")
    worker.step()
    (failure,) = coordinator.named("/fail")
    shown = " ".join(str(part) for part in failure["problem"].values())
    assert "Traceback" not in shown and "a secret detail" not in shown
    name = failure["problem"]["detail"].rpartition("defect ")[2].rstrip(")")
    assert f"defect {name}" in failure["log"] and "ValueError: a secret detail" in failure["log"]


def test_a_task_that_is_not_wanted_is_killed_and_not_reported(coordinator, worker: Worker) -> None:
    coordinator.add("hang")
    coordinator.stop = True
    began = time.monotonic()
    worker.step()
    assert time.monotonic() - began < 15
    coordinator.stop = False
    coordinator.add("")
    worker.step()
    assert not coordinator.named("/fail")
    # The killed child's successor has run one task.
    assert [commit["result"]["steps"] for commit in coordinator.named("/commit")] == [1]


def test_a_stage_that_looks_whether_it_is_canceled_keeps_its_child(coordinator, worker: Worker) -> None:
    coordinator.add("until-canceled")
    coordinator.stop = True
    worker.step()
    coordinator.stop = False
    coordinator.add("")
    worker.step()
    assert not coordinator.named("/fail")
    assert [commit["result"]["steps"] for commit in coordinator.named("/commit")] == [2]


@pytest.mark.parametrize("route", ["heartbeat", "commit"])
def test_a_stale_attempt_is_dropped(coordinator, worker: Worker, stale, route: str) -> None:
    coordinator.add("until-canceled" if route == "heartbeat" else "")
    coordinator.refuse[route] = stale
    worker.step()
    assert coordinator.named(f"/{route}") and not coordinator.named("/fail")
    coordinator.refuse.clear()
    coordinator.add("")
    worker.step()
    assert coordinator.named("/commit")[-1]["result"]["steps"] == 2


def test_a_stale_checkpoint_ends_the_attempt_in_silence(coordinator, worker: Worker, stale) -> None:
    coordinator.add("checkpoint")
    coordinator.refuse["checkpoint"] = stale
    worker.step()
    assert len(coordinator.named("/checkpoint")) == 1 and not coordinator.named("/fail")


def test_a_later_attempt_gets_the_checkpoint(coordinator, worker: Worker) -> None:
    coordinator.add("checkpoint")
    worker.step()
    (checkpoint,) = coordinator.named("/checkpoint")
    (failure,) = coordinator.named("/fail")
    assert failure["problem"]["code"] == "machine-lacks"
    coordinator.add("resume", attempt=2, checkpoint=checkpoint["sha256"])
    worker.step()
    assert weights(coordinator) == b"half way"


def test_a_result_waits_for_a_coordinator_that_is_away(coordinator, worker: Worker) -> None:
    coordinator.add("print")
    threading.Timer(0.2, coordinator.down).start()
    threading.Timer(1.5, coordinator.up).start()
    worker.step()
    (commit,) = coordinator.named("/commit")
    assert commit["attempt"] == 1 and not coordinator.named("/fail")


def test_a_worker_that_the_coordinator_forgot_registers_again(coordinator, worker: Worker) -> None:
    coordinator.add("")
    worker.step()
    coordinator.refuse["claim"] = NotFound("no such worker")
    worker.step()
    coordinator.refuse.clear()
    coordinator.add("")
    worker.step()
    assert len(coordinator.named("/v1/workers")) == 2 and len(coordinator.named("/commit")) == 2


def test_a_wrong_token_ends_the_worker(coordinator, worker: Worker) -> None:
    coordinator.refuse["workers"] = AuthError("wrong token")
    with pytest.raises(AuthError):
        worker.step()


def test_a_node_for_fit_and_refine_runs_both_without_a_renderer(coordinator, worker: Worker) -> None:
    coordinator.add("")
    worker.step()
    fit = FitResult.model_validate(coordinator.named("/commit")[0]["result"])
    payload = RefinePayload(
        block=Block(row=32, column=64, size=32),
        texel_map="0" * 64,
        renders=(),
        fits=(fit,),
        settings=PRESETS["draft"],
        store_url="file:///store",
    )
    coordinator.claims.append(Claim(task_id="refine", job_id="job", attempt=2, lease="secret", payload=payload))
    worker.step()
    commit = coordinator.named("/v1/tasks/refine/commit")[0]
    assert (commit["attempt"], commit["result"]["kind"], commit["result"]["steps"]) == (2, "refine", 1)
    assert commit["result"]["block"] == {"row": 32, "column": 64, "size": 32}
    assert coordinator.blobs[commit["result"]["lobes"]] == b"imported: []"
    (registration,) = coordinator.named("/v1/workers")
    assert (registration["kinds"], registration["device"]) == (["fit", "refine"], "1 threads")


def test_blobs_come_whole(coordinator, worker: Worker) -> None:
    sha256 = coordinator.put(b"scene")
    coordinator.damaged.add(sha256)
    for _ in range(2):
        coordinator.add(f"blob:{sha256}")
        worker.step()
        assert weights(coordinator) == b"scenescene"
    # Once damaged, once whole, and from the cache ever after.
    assert len(coordinator.named(f"/v1/blobs/{sha256}")) == 2


def test_what_a_worker_logs_bears_the_ids_of_job_and_task(coordinator, worker: Worker, caplog) -> None:
    caplog.set_level("INFO", "kiln_workers")
    worker._announce = Log()
    coordinator.add("print", attempt=3)
    task = coordinator.claims[0].task_id
    worker.step()
    lines = [json.loads(JsonFormatter().format(record)) for record in caplog.records]
    ends = ("task.claimed", "task.completed")
    claimed, done = (next(line for line in lines if line["message"] == end) for end in ends)
    heard = next(line for line in lines if line["message"] == "a line for the log")
    for line in (claimed, heard, done):
        found = (line["job_id"], line["task_id"], line["worker_id"], line["kind"], line["attempt"])
        assert found == ("job", task, "w1", "fit", 3)
    assert done["seconds"] > 0 and done["level"] == "info"


def test_a_blob_that_never_arrives_whole_fails_the_attempt_by_its_name(coordinator, worker: Worker) -> None:
    """One wrong byte each time: the child gives up after some tries, so the heartbeats do not go on for ever."""
    sha256 = coordinator.put(b"the scene")
    coordinator.blobs[sha256] = b"the scenf"
    coordinator.add(f"blob:{sha256}")
    worker.step()
    (failure,) = coordinator.named("/fail")
    assert failure["problem"]["code"] == "damaged" and failure["retryable"]
    assert sha256 in failure["problem"]["where"] and "10 tries" in failure["problem"]["detail"]
    asked = [path for path, _ in coordinator.calls if path.endswith(sha256)]
    assert len(asked) == 10


def test_a_checkpoint_that_is_lost_is_none(coordinator, worker: Worker) -> None:
    coordinator.add("resume", checkpoint="ab" * 32)
    worker.step()
    assert len(coordinator.named("/commit")) == 1 and weights(coordinator) == b""
