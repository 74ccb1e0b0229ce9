"""Who answers at the URL is no coordinator: a sentence and exit code 6, whatever it answers."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest


@contextmanager
def answering(status: int, body: bytes) -> Iterator[str]:
    """The URL of a server that has one answer for all."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Silent."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    ("status", "body"),
    [
        pytest.param(404, b"<html><h1>Not found</h1></html>", id="a page"),
        pytest.param(403, b"", id="nothing"),
        pytest.param(418, b'{"error": "I am a teapot"}', id="another program's JSON"),
    ],
)
def test_an_error_that_is_not_a_coordinators(lightkiln, status: int, body: bytes) -> None:
    with answering(status, body) as url:
        said = lightkiln("status", "--url", url, "--token", "x" * 40)
        told = lightkiln("status", "--url", url, "--token", "x" * 40, "--json")
    assert said.code == told.code == 6
    assert f"no coordinator: it answered GET /v1/jobs with {status}" in said.err.replace("\n", " ")
    assert json.loads(told.out)["code"] == "unreachable"
