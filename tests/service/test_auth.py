"""Tokens and scopes."""

import hashlib
import re
import stat

import httpx
import pytest

from kiln_schemas.operators import Scope
from kiln_service.auth import own_token
from kiln_service.config import TokenEntry

OPEN = {"/healthz", "/readyz"}
PLACEHOLDERS = {"sha256": "0" * 64}


def routes(shared):
    """Every method and path of the interface, with something in place of its parameters."""
    document = shared.client.get("/v1/openapi.json").json()
    for path, operations in document["paths"].items():
        filled = re.sub(r"{(\w+)}", lambda match: PLACEHOLDERS.get(match[1], "x"), path)
        yield from ((method.upper(), filled) for method in operations)


@pytest.mark.parametrize("header", [None, "Bearer wrong", "Basic dXNlcjpwdw==", "Bearer", "Bearer \xff\xfe"])
def test_every_route_refuses_without_a_valid_token(shared, header):
    headers = {} if header is None else {"Authorization": header.encode("latin-1")}
    found = list(routes(shared))
    assert len(found) > 15
    with httpx.Client(base_url=shared.url, headers=headers) as stranger:
        for method, path in found:
            reply = stranger.request(method, path)
            if path in OPEN:
                assert reply.status_code == 200, path
                continue
            assert reply.status_code == 401, (method, path)
            assert reply.headers["www-authenticate"] == "Bearer"
            if method != "HEAD":
                assert reply.headers["content-type"] == "application/problem+json"
                assert reply.json()["code"] == "unauthorized" and reply.json()["remedy"]


def test_a_token_that_differs_in_its_last_letter_is_refused(shared):
    for token in (shared.token[:-1], shared.token + "x", shared.token[:-1] + ("a" if shared.token[-1] != "a" else "b")):
        reply = httpx.get(f"{shared.url}/v1/jobs", headers={"Authorization": f"Bearer {token}"})
        assert reply.status_code == 401


def test_the_body_of_a_stranger_is_not_read(home):
    reply = httpx.put(f"{home.url}/v1/blobs/{'0' * 64}", content=b"x" * 1000)
    assert reply.status_code == 401 and home.sql("SELECT * FROM blobs") == []


def test_scopes_bound_what_a_token_may_do(start):
    tokens = tuple(
        TokenEntry(name=scope, sha256=hashlib.sha256(scope.encode()).hexdigest(), scopes=(scope,)) for scope in Scope
    )
    allowed = {
        ("GET", "/v1/jobs"): {Scope.READ},
        ("POST", "/v1/jobs"): {Scope.SUBMIT},
        ("POST", "/v1/jobs/x/cancel"): {Scope.SUBMIT},
        ("POST", "/v1/blobs/missing"): {Scope.SUBMIT, Scope.WORKER},
        ("GET", f"/v1/blobs/{'0' * 64}"): {Scope.READ, Scope.WORKER},
        ("POST", "/v1/workers"): {Scope.WORKER},
        ("POST", "/v1/tasks/x/commit"): {Scope.WORKER},
    }
    with start(tokens=tokens) as home:
        for (method, path), scopes in allowed.items():
            for scope in Scope:
                headers = {"Authorization": f"Bearer {scope}"}
                refused = httpx.request(method, home.url + path, headers=headers).status_code == 403
                assert refused == (scope not in scopes | {Scope.ADMIN}), (method, path, scope)


def test_the_token_file_is_the_owners_alone_and_stays(tmp_path):
    first = own_token(tmp_path)
    assert stat.S_IMODE((tmp_path / "token").stat().st_mode) == 0o600
    assert own_token(tmp_path) == first
    assert [file.name for file in tmp_path.iterdir()] == ["token"]
    assert len((tmp_path / "token").read_text().strip()) >= 43


def test_a_token_that_may_only_submit_sees_no_job_by_what_it_asks_of_one(home, result):
    """PATCH, and every other route of its scope that answers with a job."""
    scopes = {"name": "ci", "scopes": ["submit"]}
    token = home.client.post("/v1/tokens", json=scopes).raise_for_status().json()["token"]
    done, worker = home.submit(name="secret name"), home.worker()
    while home.job(done["id"])["state"] != "completed":
        worker.finish(worker.must_claim())
    live = home.submit(name="secret name")
    with httpx.Client(base_url=home.url, headers={"Authorization": f"Bearer {token}"}) as client:
        replies = {"patch": client.patch(f"/v1/jobs/{live['id']}", json={})}
        for job, actions in ((live, ("pause", "resume", "cancel", "retry", "cancel", "archive")), (done, ("requeue",))):
            for action in actions:
                path = f"/v1/jobs/{job['id']}/{action}"
                body = {"kind": "package"} if action == "requeue" else None
                replies[f"{job['id']} {action}"] = client.post(path, json=body)
        assert {name: reply.status_code for name, reply in replies.items()} == dict.fromkeys(replies, 204)
        assert not any(reply.content for reply in replies.values())
        for path in (f"/v1/jobs/{live['id']}", "/v1/jobs", "/v1/workers", "/v1/metrics"):
            assert client.get(path).status_code == 403
    assert home.job(live["id"])["state"] == "archived" and home.job(done["id"])["state"] == "queued"
    assert home.client.patch(f"/v1/jobs/{done['id']}", json={}).json()["name"] == "secret name"
