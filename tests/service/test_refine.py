"""The stage refine in the coordinator: what is accepted and refused, which tiles a block gets, older jobs."""

import pytest

from kiln_schemas.conventions import REFINE_HALO

SIDE = 8
"""Texels along a tile of the draft preset and along a block of these tests."""


def to_refine(home, **choices):
    """A job whose last fit has just completed, and its worker."""
    job, worker = home.submit(set=[f"fit.block={SIDE}"]), home.worker()
    worker.advance(job["id"], "refine", **choices)
    return job["id"], worker


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("fit.solver", "coherent"),
        ("fit.solver", "cnn"),
        ("fit.block", 8),
        ("fit.block", 256),
        ("fit.refine_steps", 1),
        ("render.between_samples", 0),
    ],
)
def test_settings_that_are_accepted(shared, setting, value):
    group, _, name = setting.partition(".")
    assert shared.submit(set=[f"{setting}={value}"])["settings"][group][name] == value


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("fit.solver", "magic"),
        ("fit.block", 7),
        ("fit.block", 257),
        ("fit.refine_steps", 0),
        ("render.between_samples", -1),
    ],
)
def test_settings_that_are_refused(shared, setting, value):
    reply = shared.client.post("/v1/jobs", json=shared.request(set=[f"{setting}={value}"]))
    problem = reply.json()
    assert (reply.status_code, problem["where"]) == (422, setting) and str(value) in problem["detail"]


def test_each_block_gets_the_tiles_in_it_and_around_it_and_no_others(home):
    """A light map of 4 x 4 tiles, against tiles chosen texel by texel; the halo reaches one tile far."""
    _, worker = to_refine(home, tiles=16)
    counts = []
    while (claim := worker.claim("refine")) is not None:
        payload = claim["payload"]
        block = payload["block"]
        near = [
            (row, column)
            for row in range(0, 4 * SIDE, SIDE)
            for column in range(0, 4 * SIDE, SIDE)
            if any(
                -REFINE_HALO <= y - block["row"] < SIDE + REFINE_HALO
                and -REFINE_HALO <= x - block["column"] < SIDE + REFINE_HALO
                for y in range(row, row + SIDE)
                for x in range(column, column + SIDE)
            )
        ]
        assert [(r["tile"]["row"], r["tile"]["column"]) for r in payload["renders"]] == near
        counts.append(len(near))
    assert sorted(counts) == [4] * 4 + [6] * 8 + [9] * 4, "corners, edges, inside"


def test_a_result_must_be_of_the_block_and_its_lobes_here(home, result):
    job_id, worker = to_refine(home)
    claim = worker.must_claim("refine")
    good = result(home, claim)
    for changes, status, word in (
        ({"block": good["block"] | {"column": 8}}, 422, "block"),
        ({"block": good["block"] | {"size": 16}}, 422, "block"),
        ({"block": good["block"] | {"row": -1}}, 422, "-1"),
        ({"block": good["block"] | {"size": 0}}, 422, "0"),
        ({"lobes": "no hash"}, 422, "no hash"),
        ({"lobes": "e" * 64}, 409, "e" * 64),
        ({"function": "visibility"}, 422, "visibility"),
    ):
        refused = worker.commit(claim, good | changes)
        assert refused.status_code == status and word in refused.json()["detail"], changes
    assert {task["state"] for task in home.tasks(job_id, kind="refine")} == {"active", "queued"}
    assert [worker.commit(claim, good).status_code for _ in range(2)] == [204, 204], "again is no error"
    uses = home.sql("SELECT owner FROM blob_uses WHERE sha256 = %s", good["lobes"])
    assert uses == [{"owner": f"result:{claim['task_id']}"}]
    (prepare,) = home.tasks(job_id, kind="prepare")
    between = claim["payload"]["between"]
    kept = home.sql("SELECT sha256 FROM blob_uses WHERE owner = %s", f"result:{prepare['id']}")
    assert len(between) == 3 and set(between) <= {row["sha256"] for row in kept}


def test_refined_blocks_reach_the_package_in_the_order_of_planning(home):
    job_id, worker = to_refine(home, tiles=4)
    claims = [worker.must_claim("refine") for _ in range(4)]
    for claim in reversed(claims):
        assert home.tasks(job_id, kind="package")[0]["state"] == "waiting"
        worker.finish(claim)
    refines = worker.must_claim("package")["payload"]["refines"]
    assert [refine["block"]["column"] for refine in refines] == [0, 8, 16, 24]


def test_a_job_that_an_older_version_planned_ends_without_the_stage(home):
    """Its coherent solver is only the default of a setting that its request did not have."""
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim("prepare"))
    home.sql("DELETE FROM tasks WHERE kind = 'refine'")
    home.sql("UPDATE jobs SET settings = settings #- '{fit,solver}' #- '{fit,block}'")
    home.sql("UPDATE jobs SET prepared = prepared - 'between'")
    home.sql("UPDATE tasks SET result = result - 'between' WHERE kind = 'prepare'")
    render = worker.must_claim("render")
    assert render["payload"]["between"] == []
    worker.finish(render)
    worker.advance(job["id"], "package")
    claim = worker.must_claim("package")
    assert claim["payload"]["refines"] == [] and claim["payload"]["prepare"]["between"] == []
    worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"
