"""Rows as an older version may have left them: no view, page, metric or order fails because of them."""

import json

import pytest
from pydantic import ValidationError

from kiln_schemas.errors import Problem
from kiln_schemas.job import EventView, JobView
from kiln_schemas.settings import PRESETS, BakeSettings
from kiln_schemas.tasks import Progress, RenderResult
from kiln_service.db.lenient import readable

HUGE = "1" + 400 * "0"
"""A number that jsonb holds and a float does not."""

NUMBERS = ["1e308", "-1e308", "1e-308", HUGE, f"1e-{400}", "0", "-1", '"abc"', "null", "[]", "{}"]


def views(home, job_id):
    """Status and text of whatever shows jobs, tasks and figures."""
    page = {"headers": {"Accept": "text/html"}}
    paths = ["/v1/jobs", f"/v1/jobs/{job_id}", f"/v1/jobs/{job_id}/tasks", f"/v1/jobs/{job_id}/curves"]
    paths += [f"/v1/jobs/{job_id}/events?format=json", f"/v1/jobs/{job_id}/artifacts", "/v1/metrics", "/v1/workers"]
    replies = {path: home.client.get(path) for path in paths}
    pages = ["/jobs", f"/jobs/{job_id}", "/workers", f"/tasks/{home.tasks(job_id)[0]['id']}"]
    return replies | {path: home.client.get(path, **page) for path in pages}


def check_views(home, job_id):
    replies = views(home, job_id)
    assert {path: reply.status_code for path, reply in replies.items()} == dict.fromkeys(replies, 200)
    assert job_id in [job["id"] for job in replies["/v1/jobs"].json()["jobs"]]
    return replies


@pytest.mark.parametrize("done", NUMBERS)
def test_progress_of_any_kind_breaks_no_view_and_no_cancel(shared, done):
    home = shared
    job, worker = home.submit(name="odd"), home.worker()
    worker.must_claim()
    for total in NUMBERS:
        progress = f'{{"done": {done}, "total": {total}, "unit": "{"u" * 300}", "loss": {HUGE}}}'
        home.sql("UPDATE tasks SET progress = %s::jsonb WHERE job_id = %s", progress, job["id"])
        listed = home.client.get("/v1/jobs")
        assert listed.status_code == 200, total
        (stage,) = next(one for one in listed.json()["jobs"] if one["id"] == job["id"])["stages"]
        assert 0 <= stage["fraction"] <= 1
    check_views(home, job["id"])
    assert home.client.post(f"/v1/jobs/{job['id']}/cancel").json()["state"] == "cancel-requested"
    home.sql("UPDATE tasks SET state = 'canceled' WHERE job_id = %s", job["id"])


def test_results_and_losses_of_any_kind_break_neither_metrics_nor_claims(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=12)
    for _ in range(12):
        worker.finish(worker.must_claim("render"))
    renders = home.sql("SELECT id, result FROM tasks WHERE kind = 'render' ORDER BY ordinal")
    for row, number in zip(renders, ["1e308", "1e308", HUGE, "-1e308"] * 3, strict=True):
        texts = {name: json.loads("0") for name in ("paths", "seconds")}
        document = json.dumps(row["result"] | texts).replace('"seconds": 0', f'"seconds": {number}')
        document = document.replace('"paths": 0', f'"paths": {number}')
        spec = f'{{"tile": {{"row": 0, "column": 0, "size": 8, "texels": {HUGE}}}}}'
        home.sql("UPDATE tasks SET result = %s::jsonb, spec = %s::jsonb WHERE id = %s", document, spec, row["id"])
    claim = worker.must_claim("fit")
    assert len(claim["payload"]["renders"]) == 12
    insert = "INSERT INTO losses (task_id, step, loss) VALUES (%s, %s, %s)"
    for step, loss in ((1, "NaN"), (2, "Infinity"), (3, 0.5), ("Infinity", 1), ("NaN", 1)):
        home.sql(insert, claim["task_id"], step, loss)
    replies = check_views(home, job["id"])
    metrics = replies["/v1/metrics"].text
    assert 'lightkiln_task_seconds_count{kind="render"} 12.0' in metrics
    assert "nan" not in metrics.lower() and "inf" not in metrics.lower().replace('le="+inf"', "")
    (curve,) = replies[f"/v1/jobs/{job['id']}/curves"].json()
    assert [3.0, 0.5] in curve["points"]
    worker.finish(claim)
    (done,) = home.tasks(job["id"], kind="fit")
    for curve in (f'[{{"step": 1e308, "loss": {HUGE}}}]', '"none"', "[1]"):
        home.sql("UPDATE tasks SET result = jsonb_set(result, '{curve}', %s::jsonb) WHERE id = %s", curve, done["id"])
        check_views(home, job["id"])


def test_texts_of_any_length_break_no_view(home):
    job, worker = home.submit(), home.worker()
    worker.fail(worker.must_claim()).raise_for_status()
    long = "x" * 2**20
    problem = {"title": long, "status": 99999, "detail": long, "code": long, "extra": 1}
    home.sql("UPDATE jobs SET error = %s, name = %s", json.dumps(problem), long)
    home.sql("UPDATE jobs SET notes = %s, labels = %s", json.dumps([long] * 3), json.dumps({"k": long}))
    home.sql("UPDATE jobs SET settings = jsonb_set(settings, '{preset}', %s)", json.dumps(long))
    home.sql("UPDATE jobs SET gate_results = %s", json.dumps([{"name": 5}, {"name": long, "value": 1e308}]))
    home.sql("UPDATE tasks SET error = %s", json.dumps(problem))
    home.sql("UPDATE workers SET name = %s, device = %s", long, long)
    home.sql(
        "INSERT INTO events (job_id, kind, actor, detail) VALUES (%s, %s, %s, %s)",
        job["id"],
        "k" * 100,
        long,
        json.dumps({"problem": problem, "more": [long, long]}),
    )
    replies = check_views(home, job["id"])
    assert len(replies["/v1/jobs"].content) < 50_000
    assert replies["/v1/jobs"].json()["jobs"][0]["error"]["code"] == "x" * 64
    assert home.client.post(f"/v1/jobs/{job['id']}/cancel").json()["state"] == "canceled"


def test_a_job_that_cannot_be_read_is_left_out_of_lists_and_no_other(home, caplog):
    good, bad, last = (home.submit(name=name)["id"] for name in ("good", "bad", "last"))
    home.sql("UPDATE jobs SET settings = '{}' WHERE id = %s", bad)
    assert [job["id"] for job in home.client.get("/v1/jobs").json()["jobs"]] == [last, good]
    pages, cursor = [], {}
    while True:
        page = home.client.get("/v1/jobs", params={"limit": 1} | cursor).json()
        pages += [job["id"] for job in page["jobs"]]
        if page["next"] is None:
            break
        cursor = {"cursor": page["next"]}
    assert pages == [last, good]
    assert home.client.get("/jobs", headers={"Accept": "text/html"}).status_code == 200
    assert any(bad in record.message and "left out" in record.message for record in caplog.records)


@pytest.mark.parametrize(
    ("contract", "tree", "mended"),
    [
        (Progress, {"done": 1e308, "total": 1e-308, "unit": "u" * 99}, {"done": 1e15, "total": 1e-6, "unit": "u" * 64}),
        (Progress, {"done": float("nan"), "total": float("inf"), "unit": ""}, {"done": 0.0, "total": 1e15}),
        (Problem, {"title": "t", "status": 0, "detail": "d", "code": "c", "new": 1}, {"status": 100, "code": "c"}),
        (BakeSettings, PRESETS["draft"].model_dump() | {"preset": "x" * 99}, {"preset": "x" * 64}),
    ],
)
def test_what_is_over_a_bound_is_cut_to_it(contract, tree, mended):
    found = readable(contract, tree).model_dump()
    assert {name: found[name] for name in mended} == mended


@pytest.mark.parametrize("contract", [Progress, Problem, EventView, JobView, RenderResult])
@pytest.mark.parametrize("tree", [{}, None, 1, [], {"done": []}])
def test_what_cannot_be_mended_is_an_error(contract, tree):
    with pytest.raises(ValidationError):
        readable(contract, tree)
