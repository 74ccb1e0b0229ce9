"""Jobs told to a real HTTP server: signed, tried again where it refuses, by a coordinator that starts later."""

import hashlib
import hmac
import ipaddress
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from kiln_schemas.receivers import is_refused


class Receiver(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.told.append((dict(self.headers), body))
        answers = self.server.answers
        self.send_response(answers.pop(0) if answers else 204)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def receiver() -> Iterator[ThreadingHTTPServer]:
    """`told`: what came; `answers`: statuses of the next answers, 204 afterwards."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
    server.told, server.answers = [], []
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def add(home, server, **body):
    url = f"http://127.0.0.1:{server.server_address[1]}/hook"
    return home.client.post("/v1/webhooks", json={"url": url} | body).raise_for_status().json()


def fail_a_job(home):
    job, worker = home.submit(), home.worker()
    worker.fail(worker.must_claim(), retryable=False).raise_for_status()
    return job["id"]


def test_an_end_is_told_with_a_signature(start, fast, receiver, eventually):
    with start(timing=fast) as home:
        hook = add(home, receiver)
        job = fail_a_job(home)
        eventually(lambda: receiver.told)
        ((headers, body),) = receiver.told
        document = json.loads(body)
        assert (document["event"], document["job_id"]) == ("job.failed", job)
        assert document["detail"]["problem"]["detail"] == "it broke" and headers["X-Lightkiln-Event"] == "job.failed"
        seconds, digest = (part.partition("=")[2] for part in headers["X-Lightkiln-Signature"].split(","))
        expected = hmac.new(hook["secret"].encode(), f"{seconds}.".encode() + body, hashlib.sha256).hexdigest()
        assert digest == expected and abs(time.time() - int(seconds)) < 30
        (delivery,) = eventually(lambda: [d for d in deliveries(home, hook) if d["outcome"] == "delivered"])
        assert (delivery["attempts"], delivery["status"]) == (1, 204)
        (listed,) = home.client.get("/v1/webhooks").json()
        assert "secret" not in listed and listed["created_by"] == "client:owner"


def deliveries(home, hook):
    return home.client.get(f"/v1/webhooks/{hook['id']}/deliveries").raise_for_status().json()


def test_a_refusal_is_tried_again_until_it_is_taken(start, fast, receiver, eventually):
    receiver.answers[:] = [500, 302]
    with start(timing=fast) as home:
        hook = add(home, receiver)
        fail_a_job(home)
        (delivery,) = eventually(lambda: [d for d in deliveries(home, hook) if d["outcome"] == "delivered"])
        assert delivery["attempts"] == 3 == len(receiver.told)
        assert len({headers["X-Lightkiln-Delivery"] for headers, _ in receiver.told}) == 1


def test_nobody_there_is_given_up_after_twelve_attempts(start, fast, receiver, eventually, monkeypatch):
    monkeypatch.setattr("kiln_service.webhooks.LONGEST_PAUSE_S", 0.01)
    with start(timing=fast) as home:
        hook = home.client.post("/v1/webhooks", json={"url": "http://127.0.0.1:9/"}).json()
        fail_a_job(home)
        (delivery,) = eventually(lambda: [d for d in deliveries(home, hook) if d["outcome"] == "failed"])
        assert delivery["attempts"] == 12 and delivery["status"] is None and delivery["error"]


def test_what_happened_before_a_crash_is_told_by_the_next_coordinator(start, fast, receiver, eventually):
    with start(timing=fast.model_copy(update={"maintenance_s": 600})) as home:
        time.sleep(0.3)
        add(home, receiver)
        fail_a_job(home)
    assert receiver.told == []
    with start(timing=fast):
        eventually(lambda: receiver.told)


def test_only_the_events_asked_for_are_told_and_none_after_the_removal(start, fast, receiver, eventually):
    with start(timing=fast) as home:
        hook = add(home, receiver, events=["job.created"])
        fail_a_job(home)
        eventually(lambda: receiver.told)
        assert home.client.delete(f"/v1/webhooks/{hook['id']}").status_code == 204
        fail_a_job(home)
        time.sleep(0.5)
        assert [json.loads(body)["event"] for _, body in receiver.told] == ["job.created"]
        assert home.client.delete(f"/v1/webhooks/{hook['id']}").status_code == 404


@pytest.mark.parametrize(
    "url", ["ftp://a/", "file:///etc/passwd", "http://", "http://user:pw@host/", "x", "http://a b/"]
)
def test_urls_that_are_refused(shared, url):
    assert shared.client.post("/v1/webhooks", json={"url": url}).status_code == 422


def test_a_name_is_looked_up_and_sent_as_the_host(start, fast, receiver, eventually):
    with start(timing=fast) as home:
        port = receiver.server_address[1]
        home.client.post("/v1/webhooks", json={"url": f"http://localhost:{port}/hook"}).raise_for_status()
        fail_a_job(home)
        eventually(lambda: receiver.told)
        assert receiver.told[0][0]["Host"] == f"localhost:{port}"


def test_a_name_at_a_refused_address_is_not_called(start, fast, receiver, eventually, monkeypatch):
    """Names are held to the rule when they are looked up: they may point elsewhere than when they were given."""
    monkeypatch.setattr("kiln_service.webhooks.is_refused", lambda address: address.is_loopback)
    with start(timing=fast) as home:
        url = f"http://localhost:{receiver.server_address[1]}/hook"
        hook = home.client.post("/v1/webhooks", json={"url": url}).raise_for_status().json()
        fail_a_job(home)
        (delivery,) = eventually(lambda: [d for d in deliveries(home, hook) if d["error"]])
        assert "to which nothing is sent" in delivery["error"] and delivery["status"] is None
        assert receiver.told == []


def test_a_receiver_that_does_not_answer_keeps_no_other_waiting(start, fast, receiver, eventually, monkeypatch):
    """Its deliveries would wait for an hour; a healthy receiver that was added after it is told of every event."""
    monkeypatch.setattr("kiln_service.webhooks.TIMEOUT_S", 3600.0)
    with start(timing=fast) as home, socket.create_server(("127.0.0.1", 0)) as dead:
        home.client.post("/v1/webhooks", json={"url": f"http://127.0.0.1:{dead.getsockname()[1]}/"}).raise_for_status()
        for _ in range(20):
            fail_a_job(home)
        add(home, receiver)
        jobs = [fail_a_job(home) for _ in range(20)]
        eventually(lambda: {json.loads(body)["job_id"] for _, body in list(receiver.told)} == set(jobs))


@pytest.mark.parametrize(
    "address",
    [
        *("169.254.169.254", "168.63.129.16", "100.100.100.200", "192.0.0.192", "0.0.0.0", "224.0.0.1"),
        *("fd00:ec2::254", "fd00:ec2::23", "fd20:ce::254", "fd00:c1::a9fe:a9fe", "fe80::1", "fec0::1", "ff02::1", "::"),
        *("2002:a9fe:a9fe::", "2002:a83f:8110::1", "64:ff9b::a9fe:a9fe", "64:ff9b:1::168.63.129.16"),
        *("::ffff:169.254.169.254", "::169.254.169.254", "2001:0:a9fe:a9fe::1", "255.255.255.255"),
    ],
)
def test_no_metadata_service_is_called_however_its_address_is_written(shared, address):
    assert is_refused(ipaddress.ip_address(address))
    host = f"[{address}]" if ":" in address else address
    assert shared.client.post("/v1/webhooks", json={"url": f"http://{host}/"}).status_code == 422


@pytest.mark.parametrize(
    "address",
    [
        *("127.0.0.1", "::1", "10.0.0.1", "192.168.1.1", "172.16.0.1", "100.64.0.1", "1.1.1.1", "fd12:3456::1"),
        *("2606:4700::1111", "::ffff:10.0.0.1", "2002:0a00:0001::1", "64:ff9b::1.1.1.1"),
    ],
)
def test_receivers_may_be_in_the_farms_network(address):
    assert not is_refused(ipaddress.ip_address(address))


def test_an_answer_without_an_end_is_not_waited_for(start, fast, receiver, eventually):
    """Its status is all that counts; the connection is closed on it."""

    def answer(self) -> None:
        self.send_response(200)
        self.end_headers()
        with suppress(ConnectionError):
            while True:
                self.wfile.write(b"x" * 65536)
        self.server.told.append("hung up")
        self.close_connection = True

    receiver.RequestHandlerClass = type("Endless", (Receiver,), {"do_POST": answer})
    with start(timing=fast) as home:
        hook = add(home, receiver)
        fail_a_job(home)
        (delivery,) = eventually(lambda: [d for d in deliveries(home, hook) if d["outcome"] == "delivered"])
        assert delivery["status"] == 200
        eventually(lambda: receiver.told == ["hung up"])
