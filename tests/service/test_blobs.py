"""Uploads arrive whole or not at all."""

import asyncio
import hashlib
import json
import resource
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from kiln_service.blobs import Blobs
from kiln_service.config import Limits, Timing
from kiln_service.db import Database

DATA = bytes(range(256)) * 8192  # 2 MiB
SHA256 = hashlib.sha256(DATA).hexdigest()


def left_behind(home):
    """Files in the upload folder, objects, rows."""
    blobs = Path(home.config.data) / "blobs"
    objects = [file for file in blobs.rglob("*") if file.is_file()]
    return [*home.config.incoming.iterdir(), *objects, *home.sql("SELECT * FROM blobs")]


def test_round_trip(home):
    assert home.client.post("/v1/blobs/missing", json={"sha256": [SHA256]}).json() == {"missing": [SHA256]}
    assert home.client.put(f"/v1/blobs/{SHA256}", content=DATA).status_code == 201
    assert home.client.put(f"/v1/blobs/{SHA256}", content=DATA).status_code == 201, "twice is no error"
    other = "0" * 64
    reply = home.client.post("/v1/blobs/missing", json={"sha256": [other, SHA256, other]})
    assert reply.json() == {"missing": [other]}
    assert home.client.get(f"/v1/blobs/{SHA256}").content == DATA
    head = home.client.head(f"/v1/blobs/{SHA256}")
    assert head.headers["content-length"] == str(len(DATA)) and head.headers["etag"] == f'"{SHA256}"'
    assert home.client.head(f"/v1/blobs/{other}").status_code == 404
    assert list(home.config.incoming.iterdir()) == []


def test_an_empty_blob(home):
    sha256 = home.upload(b"")
    assert home.client.get(f"/v1/blobs/{sha256}").content == b""


def test_a_body_without_a_length(home):
    reply = home.client.put(f"/v1/blobs/{SHA256}", content=iter([DATA[:1000], DATA[1000:]]))
    assert reply.status_code == 201
    assert home.client.get(f"/v1/blobs/{SHA256}").content == DATA


def test_a_wrong_hash_leaves_nothing(home):
    reply = home.client.put(f"/v1/blobs/{SHA256}", content=DATA[:-1] + b"x")
    assert reply.status_code == 422 and reply.json()["where"] == SHA256 and "sha256" in reply.json()["detail"]
    assert left_behind(home) == []


def test_a_name_that_is_no_hash(home):
    for name in ("abc", "G" * 64, "0" * 63, "%2e%2e%2fetc"):
        assert home.client.put(f"/v1/blobs/{name}", content=b"").status_code in (404, 422)
    assert left_behind(home) == []


@pytest.mark.parametrize("half_close", [True, False])
def test_a_truncated_upload_leaves_nothing(home, eventually, half_close):
    address = httpx.URL(home.url)
    with socket.create_connection((address.host, address.port)) as connection:
        connection.sendall(
            f"PUT /v1/blobs/{SHA256} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {home.token}\r\n"
            f"Content-Length: {len(DATA)}\r\n\r\n".encode()
        )
        connection.sendall(DATA[: len(DATA) * 3 // 4])
        eventually(lambda: list(home.config.incoming.iterdir()))
        if half_close:
            connection.shutdown(socket.SHUT_WR)
            answer = connection.recv(4096)
            assert answer == b"" or b" 400 " in answer.split(b"\r\n")[0]
    eventually(lambda: left_behind(home) == [])
    assert home.client.post("/v1/blobs/missing", json={"sha256": [SHA256]}).json() == {"missing": [SHA256]}


def test_a_body_shorter_than_announced_is_400(home):
    """As the application sees it behind a server that does not compare the lengths itself."""
    sent = []
    headers = [(b"authorization", f"Bearer {home.token}".encode()), (b"content-length", b"11")]
    scope = {"type": "http", "method": "PUT", "path": f"/v1/blobs/{SHA256}", "headers": headers}

    body = [{"type": "http.request", "body": DATA[:10], "more_body": False}]

    async def receive():
        return body.pop() if body else await asyncio.Event().wait()  # the client stays

    async def send(message):
        sent.append(message)

    asyncio.run(home.app(scope | {"query_string": b"", "http_version": "1.1", "root_path": ""}, receive, send))
    assert sent[0]["status"] == 400 and b"truncated" in sent[1]["body"]
    assert left_behind(home) == []


def test_too_large(start):
    with start(limits=Limits(reserve_bytes=0, blob_bytes=1000)) as home:
        assert home.client.put(f"/v1/blobs/{SHA256}", content=DATA).status_code == 413
        assert home.client.put(f"/v1/blobs/{SHA256}", content=iter([DATA])).status_code == 413
        assert left_behind(home) == []


def test_no_space_left_by_the_reserve(start):
    with start(limits=Limits(reserve_bytes=2**60)) as home:
        reply = home.client.put(f"/v1/blobs/{SHA256}", content=DATA)
        assert reply.status_code == 507 and reply.json()["code"] == "machine-lacks" and reply.json()["remedy"]
        assert left_behind(home) == []


def test_a_full_disk(start, eventually):
    """A real coordinator whose files may not grow over 1 MiB: writing fails in the middle, as on a full disk."""
    config = start.config()
    start.data.mkdir()
    file = start.data / "config.json"
    file.write_text(config.model_dump_json())
    process = subprocess.Popen(
        [sys.executable, "-m", "kiln_service", "--config", str(file), "--port", "0", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20)),
        text=True,
    )
    with process:
        try:
            url = json.loads(process.stdout.readline())["url"]
            headers = {"Authorization": f"Bearer {(start.data / 'token').read_text().strip()}"}
            with httpx.Client(base_url=url, headers=headers) as client:
                reply = client.put(f"/v1/blobs/{SHA256}", content=DATA)
                assert reply.status_code == 507 and "full" in reply.json()["detail"]
                assert list(config.incoming.iterdir()) == []
                small = hashlib.sha256(b"small").hexdigest()
                assert client.put(f"/v1/blobs/{small}", content=b"small").status_code == 201
        finally:
            process.terminate()


def test_blobs_that_nothing_uses_are_collected(start, eventually):
    timing = Timing(poll_s=0.1, maintenance_s=0.1, stale_s=600, blob_grace_s=0.5)
    with start(timing=timing) as home:
        job = home.submit()
        used = job["bundle"]["files"]["scene.glb"]
        unused = home.upload(b"nobody wants me")
        eventually(lambda: home.client.get(f"/v1/blobs/{unused}").status_code == 404)
        time.sleep(0.5)
        assert home.client.get(f"/v1/blobs/{used}").status_code == 200
        assert home.upload(b"nobody wants me") == unused
        assert home.client.get(f"/v1/blobs/{unused}").content == b"nobody wants me"


def test_a_token_may_store_only_so_much_that_no_job_uses(start):
    """By bytes and by number; what a job uses counts no more, nor what was collected, nor does it keep others out."""
    limits = Limits(reserve_bytes=0, unused_bytes=10_000, unused_blobs=4)
    with start(limits=limits) as home:
        made = home.client.post("/v1/tokens", json={"name": "farm", "scopes": ["worker"]}).json()["token"]
        other = {"Authorization": f"Bearer {made}"}

        def put(data, **headers):
            return home.client.put(f"/v1/blobs/{hashlib.sha256(data).hexdigest()}", content=data, headers=headers)

        assert put(b"a" * 6000).status_code == 201
        for body in (b"b" * 6000, iter([b"b" * 3000, b"b" * 3000])):
            sha256 = hashlib.sha256(b"b" * 6000).hexdigest()
            refused = home.client.put(f"/v1/blobs/{sha256}", content=body)
            assert refused.status_code == 507 and refused.json()["code"] == "quota"
            assert "12000 bytes" in refused.json()["detail"] and "10000 are allowed" in refused.json()["detail"]
            assert refused.json()["where"] == "limits.unused_bytes" and refused.json()["remedy"]
        assert list(home.config.incoming.iterdir()) == []
        assert put(b"b" * 6000, **other).status_code == 201
        bundle = {"entry": "scene.glb", "files": {"scene.glb": hashlib.sha256(b"a" * 6000).hexdigest()}}
        home.client.post("/v1/jobs", json={"name": "t", "bundle": bundle, "preset": "draft"}).raise_for_status()
        assert put(b"c" * 6000).status_code == 201, "the job uses the first"
        assert [put(bytes([number])).status_code for number in range(4)] == [201, 201, 201, 507]
        home.sql("UPDATE blobs SET touched = now() - interval '1 day'")
        assert asyncio.run(collected(home)) == 5
        assert put(b"d" * 6000).status_code == 201


async def collected(home):
    """How many blobs a collection frees, with a connection of its own."""
    async with Database(home.config.database) as database:
        return await Blobs(database, home.config).collect(3600)


def test_an_artifact_of_another_size_than_its_blob_is_refused(home, result):
    job, worker = home.submit(), home.worker()
    while (claim := worker.must_claim())["payload"]["kind"] != "package":
        worker.finish(claim)
    package = result(home, claim)
    package["artifacts"][0]["size"] += 1
    refused = worker.commit(claim, package)
    assert refused.status_code == 422 and "1001 bytes, its blob has 1000" in refused.json()["detail"]
    assert home.job(job["id"])["state"] == "active"
    worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"


def test_within_the_reserve_work_ends_and_nothing_begins(start):
    """On a disk as full as that uploads, jobs, tasks and log lines stop; commits, heartbeats and cancel go on."""
    with start() as home:
        request = home.request()
        job, other = home.submit(), home.submit(name="other")
        worker = home.worker()
        prepare = worker.must_claim("prepare")
        made = {"seconds": 1.0, "kind": "prepare", "scene": home.upload(b"s")}
        tiles = [{"row": 0, "column": 0, "size": 8, "texels": 5}]
        made |= {"texel_map": home.upload(b"t"), "scene_hash": "0" * 64, "tiles": tiles, "has_light": True}
        made |= {"has_environment": False, "triangles": 1, "resolution": 32}
    with start(limits=Limits(reserve_bytes=2**60)) as full:
        worker.home = full
        assert full.client.put(f"/v1/blobs/{SHA256}", content=DATA).status_code == 507
        refused = full.client.post("/v1/jobs", json=request)
        assert refused.status_code == 507 and "reserve" in refused.json()["detail"]
        assert worker.claim() is None
        assert worker.beat(prepare, log="a line\n")["stop"] is False
        assert full.client.get(f"/v1/tasks/{prepare['task_id']}/log").text == ""
        assert worker.commit(prepare, made).status_code == 204
        assert full.job(job["id"])["stages"][0]["completed"] == 1
        assert full.client.post(f"/v1/jobs/{other['id']}/cancel").status_code == 200
        assert full.job(other["id"])["state"] == "canceled"
        assert full.client.post(f"/v1/jobs/{other['id']}/archive").status_code == 200
        assert full.client.post("/v1/gc", json={}).status_code == 200
        assert worker.claim() is None
    with start() as home:
        worker.home = home
        assert worker.must_claim("render") is not None
