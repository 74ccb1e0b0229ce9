"""Tiles as a byte each, and tasks page by page and change by change: held against the plain list of all tasks."""

import random

import pytest

from kiln_schemas.client import Client
from kiln_schemas.states import TaskState
from kiln_schemas.tasks import TaskKind

STATES = [None, *(state.value for state in TaskState)]


def states_of(home, job):
    """The slow, obvious answer: states of render tasks by row and column of their tile, in a grid of four by four."""
    grid = [None] * 16
    for task in home.tasks(job, kind="render"):
        row, column = (int(word) // 8 for word in task["label"].removeprefix("tile ").split(","))
        grid[4 * row + column] = task["state"]
    return grid


def tiles_of(home, job, side=4):
    reply = home.client.get(f"/v1/jobs/{job}/tiles").raise_for_status()
    assert reply.headers["x-side"] == str(side)
    return [STATES[code] for code in reply.content], reply.headers["etag"]


def moves(home, worker, job, chance):
    """Everything that moves tasks of a job, one after the other and in any order."""
    url, claims = f"/v1/jobs/{job}", []
    while True:
        match chance.randrange(9):
            case 0 | 1 | 2:
                claims += [claim for claim in [worker.claim("render")] if claim]
            case 3 | 4 if claims:
                worker.commit(claims[-1], {"kind": "render", "tile": claims.pop()["payload"]["tile"], **RENDERED})
            case 5 if claims:
                worker.fail(claims.pop(), code="canceled", status=409)
            case 6 if claims:
                worker.fail(claims.pop())
            case 7:
                home.client.post(url + "/requeue", json={"kind": "render", "columns": [0, 8]})
            case 8:
                home.client.post(f"{url}/{chance.choice(('cancel', 'retry', 'pause', 'resume'))}")
        yield


RENDERED = {"paths": 10, "overflows": 0, "invalid": 0, "seconds": 1}


@pytest.mark.parametrize("seed", range(3))
def test_the_map_and_the_changes_are_those_of_the_list(start, seed):
    with start(max_attempts=1000) as home:
        worker, job = home.worker(), home.submit()["id"]
        assert tiles_of(home, job, side=0)[0] == [], "the size of the light map is not chosen yet"
        worker.finish(worker.must_claim("prepare"), tiles=13)
        known, version = {}, 0
        for _, _ in zip(range(60), moves(home, worker, job, random.Random(seed)), strict=False):
            assert tiles_of(home, job)[0] == states_of(home, job)
            reply = home.client.get(f"/v1/jobs/{job}/tasks", params={"since": version}).raise_for_status()
            version = int(reply.headers["x-version"])
            known |= {task["id"]: task for task in reply.json()}
            assert known == {task["id"]: task for task in home.tasks(job)}


def test_what_has_not_changed_is_not_sent_again(home):
    worker, job = home.worker(), home.submit()["id"]
    worker.finish(worker.must_claim("prepare"), tiles=5)
    _, etag = tiles_of(home, job)
    url, headers = f"/v1/jobs/{job}/tiles", {"If-None-Match": etag}
    assert home.client.get(url, headers=headers).status_code == 304
    with Client(home.url, home.token, patience_s=5) as client:
        first = client.tiles(job)
        assert client.tiles(job, first) is first and list(first.states())[:6] == [*5 * [TaskState.QUEUED], None]
        worker.must_claim("render")
        assert TaskState.ACTIVE in client.tiles(job, first).states()
    assert home.client.get("/v1/jobs/none/tiles").status_code == 404


def test_one_change_of_many_tasks_is_one_task(home):
    worker, job = home.worker(), home.submit()["id"]
    worker.finish(worker.must_claim("prepare"), tiles=12)
    claim = worker.must_claim("render")
    url = f"/v1/jobs/{job}/tasks"
    version = home.client.get(url).headers["x-version"]
    worker.finish(claim)
    (changed,) = home.client.get(url, params={"since": version}).json()
    assert changed["id"] == claim["task_id"] and changed["state"] == "completed"


def test_tasks_come_in_pages(home):
    worker, job = home.worker(), home.submit()["id"]
    worker.finish(worker.must_claim("prepare"), tiles=12)
    url, seen, params = f"/v1/jobs/{job}/tasks", [], {"limit": 5}
    while True:
        reply = home.client.get(url, params=params).raise_for_status()
        seen += reply.json()
        assert len(reply.json()) <= 5
        if "x-next-cursor" not in reply.headers:
            break
        params["cursor"] = reply.headers["x-next-cursor"]
    assert seen == home.tasks(job) and sum(task["kind"] == "render" for task in seen) == 12
    with Client(home.url, home.token, patience_s=5) as client:
        client._http.params = {"limit": 5}
        assert [task.id for task in client.tasks(job)] == [task["id"] for task in seen]
        assert len(client.tasks(job, TaskKind.RENDER)) == 12
    for refused in ({"limit": 501}, {"cursor": "x"}, {"since": -1}):
        assert home.client.get(url, params=refused).status_code == 422
