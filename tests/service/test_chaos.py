"""Many workers that finish, fail, vanish, repeat themselves, are paused and canceled, all at once."""

import random
import threading
import time

WORKERS = 6
ROUNDS = 150
"""Claims of all workers together, before the last one finishes what is left."""
LAST_RESORT_S = 900


def live(home, jobs, seed, rounds, result, faults):
    """One worker's life; anything but the expected codes is a fault."""
    chance, worker = random.Random(seed), home.worker(f"w{seed}")
    deadline = time.monotonic() + LAST_RESORT_S
    while len(rounds) < ROUNDS and time.monotonic() < deadline:
        claim = worker.claim(wait_s=0.05)
        if claim is None:
            if {home.job(job["id"])["state"] for job in jobs} <= {"completed", "canceled", "paused"}:
                return  # there is nothing left to do until somebody resumes
            continue
        rounds.append(claim["task_id"])
        dice = chance.random()
        if dice < 0.08:
            continue  # vanishes; the reaper takes the task back
        if dice < 0.16:
            codes = [worker.fail(claim, code="canceled", status=409).status_code]
        elif dice < 0.20:
            job = chance.choice(jobs)["id"]
            codes = [home.client.post(f"/v1/jobs/{job}/cancel").status_code]
        elif dice < 0.28:
            job, action = chance.choice(jobs)["id"], chance.choice(("pause", "resume"))
            codes = [home.client.post(f"/v1/jobs/{job}/{action}").status_code]
        else:
            worker.beat(claim, log="x\n")
            document = result(home, claim, tiles=6, has_environment=True)
            codes = [worker.commit(claim, document).status_code for _ in range(chance.choice((1, 2)))]
        faults += [code for code in codes if code not in (200, 204, 409)]


def test_everything_ends_well(start, fast, result, eventually):
    timing = fast.model_copy(update={"stale_s": 0.5})
    with start(timing=timing, max_attempts=1000) as home:
        # The first six have light of their own; of the others some find theirs rendered.
        light = [f"render.samples={8 + min(i, 6)}" for i in range(12)]
        jobs, faults = [home.submit(name=f"job {i}", set=[light[i]]) for i in range(12)], []
        rounds = []
        threads = [threading.Thread(target=live, args=(home, jobs, i, rounds, result, faults)) for i in range(WORKERS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert faults == []

        for job in jobs:
            home.client.post(f"/v1/jobs/{job['id']}/resume")
        closer = home.worker("closer")
        deadline = time.monotonic() + LAST_RESORT_S
        while {home.job(job["id"])["state"] for job in jobs} - {"completed", "canceled"}:
            assert time.monotonic() < deadline
            claim = closer.claim(wait_s=0.2)
            if claim is not None:
                closer.commit(claim, result(home, claim, tiles=6, has_environment=True))
        for job in jobs:
            check(home, home.job(job["id"]))
        assert "completed" in {home.job(job["id"])["state"] for job in jobs}


def check(home, job):
    """The history of a finished job is one that could have happened without any fault."""
    events = home.events(job["id"])
    kinds = [event["kind"] for event in events]
    reused = sum(event["detail"]["count"] for event in events if event["kind"] == "tasks.reused")
    tasks = home.tasks(job["id"])
    assert {task["state"] for task in tasks} <= {"completed", "canceled"}
    assert kinds.count("task.completed") + reused == sum(task["state"] == "completed" for task in tasks)
    if job["state"] == "completed":
        assert [(s["kind"], s["total"]) for s in job["stages"]] == [
            ("prepare", 1),
            ("render", 6),
            ("fit", 2),
            ("refine", 1),
            ("package", 1),
        ]
        assert all(task["state"] == "completed" for task in tasks)
        assert kinds.count("stage.completed") == (3 if reused else 4) and reused in (0, 6)
        assert kinds.count("job.completed") == 1
