"""Artifacts over HTTP: validators, conditional requests, ranges."""

import hashlib

import pytest

from kiln_schemas.errors import InputError
from kiln_service.api.files import matches, parse_range

DATA = b"0123456789" * 100
ETAG = f'"{hashlib.sha256(DATA).hexdigest()}"'


@pytest.fixture(scope="module")
def url(shared):
    """The address of an artifact of a completed job."""
    job, worker = shared.submit(), shared.worker()
    while shared.job(job["id"])["state"] != "completed":
        claim = worker.must_claim()
        worker.finish(claim)
    return f"/v1/jobs/{job['id']}/artifacts/shaders/light.glsl"


def test_whole(shared, url):
    reply = shared.client.get(url)
    assert reply.status_code == 200 and reply.content == DATA
    assert reply.headers["etag"] == ETAG and reply.headers["accept-ranges"] == "bytes"
    assert reply.headers["content-type"].startswith("text/plain") and reply.headers["content-length"] == "1000"


def test_head(shared, url):
    reply = shared.client.head(url, headers={"Range": "bytes=0-1"})
    assert reply.status_code == 200 and reply.headers["content-length"] == "1000" and reply.headers["etag"] == ETAG
    assert reply.content == b""


@pytest.mark.parametrize(
    ("header", "start", "end"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=5-14", 5, 15),
        ("bytes=990-", 990, 1000),
        ("bytes=-7", 993, 1000),
        ("bytes=998-5000", 998, 1000),
        ("bytes=-5000", 0, 1000),
    ],
)
def test_ranges(shared, url, header, start, end):
    reply = shared.client.get(url, headers={"Range": header})
    assert reply.status_code == 206 and reply.content == DATA[start:end]
    assert reply.headers["content-range"] == f"bytes {start}-{end - 1}/1000"
    assert reply.headers["content-length"] == str(end - start) and reply.headers["etag"] == ETAG


@pytest.mark.parametrize("header", ["bytes=1000-", "bytes=5000-6000", "bytes=-0"])
def test_ranges_outside_the_file(shared, url, header):
    reply = shared.client.get(url, headers={"Range": header})
    assert reply.status_code == 416 and reply.headers["content-range"] == "bytes */1000"
    assert reply.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("header", ["bytes=5-1", "lines=1-2", "bytes=a-b", "bytes=-", "bytes=0-1,5-6"])
def test_ranges_that_are_ignored(shared, url, header):
    reply = shared.client.get(url, headers={"Range": header})
    assert reply.status_code == 200 and reply.content == DATA


def test_a_download_in_two_parts_is_the_whole(shared, url):
    parts = [shared.client.get(url, headers={"Range": r, "If-Range": ETAG}) for r in ("bytes=0-499", "bytes=500-")]
    assert [part.status_code for part in parts] == [206, 206]
    assert hashlib.sha256(parts[0].content + parts[1].content).hexdigest() == ETAG.strip('"')
    changed = shared.client.get(url, headers={"Range": "bytes=0-499", "If-Range": '"other"'})
    assert changed.status_code == 200 and changed.content == DATA


@pytest.mark.parametrize(
    ("header", "status"), [(ETAG, 304), (f'"x", W/{ETAG}', 304), ("*", 304), ('"x"', 200), (ETAG.strip('"'), 200)]
)
def test_if_none_match(shared, url, header, status):
    reply = shared.client.get(url, headers={"If-None-Match": header})
    assert reply.status_code == status and reply.headers["etag"] == ETAG
    assert reply.content == (b"" if status == 304 else DATA)


@pytest.mark.parametrize("name", ["nothing.ktx2", "../../../etc/passwd", "shaders", "%2e%2e/token"])
def test_names_that_are_not_published(shared, url, name):
    base = url.removesuffix("shaders/light.glsl")
    assert shared.client.get(base + name).status_code == 404


def test_ranges_of_an_empty_file():
    assert parse_range("bytes=0-", 1) == (0, 1)
    with pytest.raises(InputError):
        parse_range("bytes=0-", 0)
    assert not matches(None, ETAG)
