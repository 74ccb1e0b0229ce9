"""A commit that lists many tiles is read in pieces, and to the same as FastAPI reads it at once."""

import json

import pytest

from kiln_schemas.tasks import MOST_TILES, Commit
from kiln_service.api.commits import PIECE, read_commit

SHA = "0" * 64


def body(count, **changes):
    tiles = [{"row": 8 * (i // 256), "column": 8 * (i % 256), "size": 8, "texels": 5} for i in range(count)]
    result = {"kind": "prepare", "scene": SHA, "texel_map": SHA, "scene_hash": SHA, "tiles": tiles, "seconds": 1}
    result |= {"resolution": 32, "has_environment": False, "has_light": True, "triangles": 1} | changes
    return {"attempt": 1, "lease": "x" * 43, "result": result}


@pytest.mark.parametrize("count", [0, 2, PIECE, PIECE + 1, 2 * PIECE + 1, MOST_TILES])
def test_pieces_make_the_same_as_the_whole(count):
    tree = body(count)
    read = read_commit(json.dumps(tree).encode())
    assert isinstance(read, Commit) == (count > PIECE)
    assert Commit.model_validate(read) == Commit.model_validate(tree)


@pytest.mark.parametrize(
    "change", [{"triangles": -1}, {"unknown": 1}, {"kind": "render"}, {"tiles": "x"}, {"tiles": {}}]
)
def test_what_has_faults_is_left_to_the_contract(change):
    tree = body(PIECE + 1, **change)
    assert read_commit(json.dumps(tree).encode()) == tree


@pytest.mark.parametrize("tree", [None, [], 1, {}, {"result": 1}, {"result": {"tiles": []}}])
def test_what_is_no_commit_is_left_to_the_contract(tree):
    assert read_commit(json.dumps(tree).encode()) == tree


def test_a_bad_tile_of_many_is_named(home):
    job = home.submit()
    worker = home.worker()
    claim = worker.must_claim()
    tree = body(PIECE + 2) | {"attempt": claim["attempt"], "lease": claim["lease"]}
    tree["result"]["tiles"][PIECE]["size"] = 0
    reply = home.client.post(f"/v1/tasks/{claim['task_id']}/commit", json=tree)
    assert reply.status_code == 422 and reply.json()["where"].endswith(f"tiles.{PIECE}.size")
    path = f"/v1/tasks/{claim['task_id']}/commit"
    assert home.client.post(path, content=b"{", headers={"Content-Type": "application/json"}).status_code == 422
    blobs = dict.fromkeys(("scene", "texel_map", "scene_hash"), home.upload(b"packed"))
    tree = body(2 * PIECE, **blobs) | {"attempt": claim["attempt"], "lease": claim["lease"]}
    assert home.client.post(path, json=tree).status_code == 204
    assert "leave the light map" in home.job(job["id"])["error"]["detail"]
