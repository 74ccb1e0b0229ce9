"""What others own, touched with a valid token: tasks of another worker, jobs of another client, blobs on a bad disk."""

import hashlib
import time
from pathlib import Path
from typing import Any, Final

from contract_bounds import branches, sample
from ground import PATIENCE_S, Ground, Tally, document_of, held

GUESSES: Final = ("0" * 32, "0" * 43, "a" * 43, "x", "")
OVER: Final = ("completed", "failed", "canceled", "gate-failed")


def tasks_of_others(ground: Ground) -> Tally:
    """Commit, fail, checkpoint and beat the other client's running tasks with what a worker's token can find out."""
    tally = Tally()
    thief = ground.worker("thief")
    thief.job()
    own = thief.must_claim()
    deadline = time.monotonic() + PATIENCE_S
    done = 0
    while done < ground.many(4, 40) and time.monotonic() < deadline:
        tasks = ground.owner.get(f"/v1/jobs/{ground.honest_job()}/tasks", params={"state": "active"})
        for task in tasks.json() if tasks.is_success else ():
            for lease in (None, own.get("lease"), *GUESSES):
                _rob(ground, tally, thief.id, task, lease)
            done += 1
        time.sleep(0.05)
    tally.figures["running tasks of others"] = done
    # A claim that is given back must not open the next attempt to who had the one before.
    thief.call(own, "fail", problem=_problem("canceled", 409), retryable=True)
    second = ground.worker("second", tag=thief.tag).claim(20)
    if second is not None and second["task_id"] == own["task_id"]:
        for attempt in (own["attempt"], second["attempt"]):
            reply = thief.call(own | {"attempt": attempt}, "fail", problem=_problem("input", 422), retryable=False)
            status = 0 if reply is None else reply.status_code
            tally.count(400 <= status < 500, f"fail of attempt {attempt} by who had the one before: {status}", status)
    ground.cancel(own["job_id"])
    return tally


def jobs_of_others(ground: Ground) -> Tally:
    """What a token without `read` may see of jobs: nothing."""
    tally = Tally()
    job = ground.honest_job()
    for scope, method, path, body in (
        ("submit", "PATCH", f"/v1/jobs/{job}", {}),
        ("submit", "POST", f"/v1/jobs/{job}/resume", None),
        ("worker", "PATCH", f"/v1/jobs/{job}", {}),
        ("worker", "GET", f"/v1/jobs/{job}", None),
        ("submit", "GET", f"/v1/jobs/{job}", None),
        ("read", "PATCH", f"/v1/jobs/{job}", {"priority": 0}),
        ("read", "POST", f"/v1/jobs/{job}/cancel", None),
    ):
        reply = ground.send(scope, method, path, json=body)
        status = 0 if reply is None else reply.status_code
        seen = reply is not None and reply.is_success and "bundle" in reply.text
        tally.count(not seen and 0 < status < 500, f"{scope}: {method} {path}: {status}", status)
    return tally


def damaged_blobs(ground: Ground) -> Tally:
    """Blobs whose bytes rot on the coordinator's disk: never handed out as good, and mended by an upload."""
    tally = Tally()
    for number in range(ground.many(6, 40)):
        good = hashlib.sha256(f"{ground.seed} {number}".encode()).digest() * (1 + number * 1000)
        sha256 = hashlib.sha256(good).hexdigest()
        ground.owner.put(f"/v1/blobs/{sha256}", content=good).raise_for_status()
        path = next((ground.farm.folder / "data" / "blobs").rglob(sha256))
        _damage(path, good, number)
        reply = ground.send("read", "GET", f"/v1/blobs/{sha256}")
        bad = reply is not None and reply.status_code == 200 and reply.content != good
        tally.count(
            not bad, f"a blob of {len(good)} bytes: its damaged bytes came with 200", reply and reply.status_code
        )
        again = ground.owner.put(f"/v1/blobs/{sha256}", content=good)
        reply = ground.send("read", "GET", f"/v1/blobs/{sha256}")
        mended = reply is not None and reply.status_code == 200 and reply.content == good
        tally.count(
            mended, f"an upload ({again.status_code}) does not mend a blob of {len(good)} bytes", again.status_code
        )
    return tally


def damaged_scene(ground: Ground) -> Tally:
    """A job whose scene rots before it is read: it fails and says which blob it is; its worker goes on."""
    tally = Tally()
    good = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" + f"# {ground.seed}\n".encode()
    sha256 = hashlib.sha256(good).hexdigest()
    ground.owner.put(f"/v1/blobs/{sha256}", content=good).raise_for_status()
    _damage(next((ground.farm.folder / "data" / "blobs").rglob(sha256)), good, 0)
    job = ground.job(bundle={"entry": "a.obj", "files": {"a.obj": sha256}}, tags=["honest"], priority=100)
    view: dict[str, Any] = {}
    target, deadline = ground.rounds() + 3, time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and (ground.rounds() < target or view.get("state") not in OVER):
        view = ground.owner.get(f"/v1/jobs/{job}").json()
        time.sleep(0.2)
    tally.count(view["state"] == "failed", f"the job is {view['state']} after a damaged upload")
    told = str(view.get("error") or "")
    tally.count(sha256[:12] in told or view["state"] != "failed", f"the error does not name the blob: {told}")
    ground.owner.post(f"/v1/jobs/{job}/cancel")
    return tally


def _rob(ground: Ground, tally: Tally, thief: str, task: dict[str, Any], lease: str | None) -> None:
    """Every way to end or to keep a task that is another's; none may be taken."""
    schema, _ = document_of("/v1/tasks/{task_id}/commit", "post")
    results = [sample(branch) for branch in branches(schema["properties"]["result"])]
    result = next(result for result in results if result["kind"] == task["kind"])
    claim = {"task_id": task["id"], "attempt": task["attempt"]} | ({} if lease is None else {"lease": lease})
    for what, body in (
        ("heartbeat", {"log": "owned\n"}),
        ("checkpoint", {"sha256": ground.sha256}),
        ("fail", {"problem": _problem("input", 422), "retryable": False}),
        ("commit", {"result": result}),
    ):
        url = f"/v1/workers/{thief}/heartbeat" if what == "heartbeat" else f"/v1/tasks/{task['id']}/{what}"
        reply = ground.send("worker", "POST", url, json=held(claim, what) | body)
        status = 0 if reply is None else reply.status_code
        stopped = what == "heartbeat" and reply is not None and status == 200 and reply.json()["stop"]
        tally.count(400 <= status < 500 or stopped, f"{what} of another's {task['kind']}: {status}", status)


def _problem(code: str, status: int) -> dict[str, Any]:
    return {"title": "t", "status": status, "detail": "hostile", "code": code}


def _damage(path: Path, good: bytes, number: int) -> None:
    data = bytearray(good)
    data[(number * 7919) % len(data)] ^= 0x10
    path.write_bytes(data)
