"""Scripts and style sheets are gzip'd on the wire and nothing else is; validators and ranges stay right."""

import gzip
from importlib import resources

import pytest

SCRIPTS = ("/static/vendor/htmx/htmx.min.js", "/static/dashboard.css", "/static/viewer/vendor/three/three.core.min.js")


@pytest.mark.parametrize("path", SCRIPTS)
def test_a_script_is_the_same_with_and_without_gzip(path, shared) -> None:
    package, _, name = path.removeprefix("/static/").partition("/")
    where = resources.files("kiln_service.viewer") if package == "viewer" else resources.files("kiln_service.dashboard")
    folder = where if package == "viewer" else where / ("vendor" if package == "vendor" else "static")
    data = (folder / (name or package)).read_bytes()
    plain = shared.client.get(path, headers={"Accept-Encoding": "identity"})
    with shared.client.stream("GET", path, headers={"Accept-Encoding": "gzip"}) as packed:
        raw = b"".join(packed.iter_raw())
    assert plain.content == gzip.decompress(raw) == data
    assert len(raw) < 0.4 * len(data)
    assert packed.headers["content-encoding"] == "gzip" and "content-encoding" not in plain.headers
    for reply in (plain, packed):
        assert "Accept-Encoding" in reply.headers["vary"]
        assert reply.headers["etag"].startswith('W/"') and reply.headers["cache-control"] == "no-cache"
        again = shared.client.get(path, headers={"If-None-Match": reply.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
    part = shared.client.get(path, headers={"Accept-Encoding": "gzip", "Range": "bytes=10-19"})
    assert (part.status_code, part.content) == (206, data[10:20]) and "content-encoding" not in part.headers
    assert part.headers["content-range"] == f"bytes 10-19/{len(data)}"


def test_nothing_else_is_compressed(home) -> None:
    """Pages hold CSRF tokens, blobs are read by range and streams as they come."""
    job, text = home.submit()["id"], b"a" * 100_000
    sha256 = home.upload(text)
    for path in ("/jobs", f"/jobs/{job}", "/submit", f"/v1/jobs/{job}", f"/v1/blobs/{sha256}", "/v1/openapi.json"):
        reply = home.client.get(path, headers={"Accept": "text/html", "Accept-Encoding": "gzip"})
        assert reply.status_code == 200 and len(reply.content) > 500, path
        assert "content-encoding" not in reply.headers, path
    with home.client.stream("GET", f"/v1/jobs/{job}/events", headers={"Accept-Encoding": "gzip"}) as events:
        assert events.headers["content-type"].startswith("text/event-stream")
        assert "content-encoding" not in events.headers
        assert b"job.created" in next(events.iter_raw())
