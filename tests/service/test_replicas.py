"""Two coordinators, real processes, on one database and one storage: one is killed or stopped, the other goes on."""

import hashlib
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import httpx
import psycopg
import pytest

from kiln_schemas import __version__
from kiln_service.auth import OWNER_VARIABLE
from kiln_service.maintenance import LEADER_LOCK

TOKEN = "the-same-at-every-coordinator"
TIMING = {"heartbeat_s": 0.2, "stale_s": 2, "poll_s": 0.1, "maintenance_s": 0.2}
LEADERS = """
    SELECT activity.application_name AS name FROM pg_locks JOIN pg_stat_activity AS activity USING (pid)
    WHERE locktype = 'advisory' AND classid = %s AND objid = %s AND granted AND datname = current_database()
"""


class Replica:
    """One coordinator; `PGAPPNAME` tells its connections from the other's."""

    def __init__(self, name, dsn, folder):
        self.name = name
        (folder / name).mkdir()
        (folder / f"{name}.json").write_text(json.dumps({"timing": TIMING}))
        command = [sys.executable, "-m", "kiln_service", "--data", str(folder / name), "--port", "0", "--json"]
        command += ["--database", dsn, "--storage", (folder / "shared").as_uri()]
        command += ["--config", str(folder / f"{name}.json")]
        self.log = folder / f"{name}.log"
        with self.log.open("wb") as log:
            environment = os.environ | {OWNER_VARIABLE: TOKEN, "PGAPPNAME": name}
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment)
        line = self.process.stdout.readline()
        assert line, self.log.read_text()
        ready = json.loads(line)
        assert ready["token_file"] is None
        headers = {"Authorization": f"Bearer {TOKEN}"}
        self.client = httpx.Client(base_url=ready["url"], headers=headers, timeout=300)

    def end(self, number):
        self.process.send_signal(number)
        return self.process.wait(600)

    def close(self):
        self.client.close()
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


@pytest.fixture
def replicas(dsn, tmp_path):
    started = []
    try:
        for name in ("one", "two"):
            started.append(Replica(name, dsn, tmp_path))
        yield started
    finally:
        for replica in started:
            replica.close()


@pytest.fixture
def leaders(dsn):
    """Names of the coordinators that lead."""

    def ask():
        with psycopg.connect(dsn, autocommit=True) as connection:
            rows = connection.execute(LEADERS, [LEADER_LOCK >> 32, LEADER_LOCK & 0xFFFFFFFF]).fetchall()
        return [name for (name,) in rows]

    return ask


class Roamer(threading.Thread):
    """A worker that asks the coordinators in turn, as behind a proxy, and the next one where one does not answer."""

    def __init__(self, name, replicas, finish, over):
        super().__init__()
        self.name, self._clients, self._finish, self._over = name, [one.client for one in replicas], finish, over
        self.used, self.defects = set(), []

    def call(self, method, path, **arguments):
        for _ in range(50):
            client = self._clients[0]
            self._clients.append(self._clients.pop(0))
            try:
                reply = client.request(method, path, **arguments)
            except httpx.TransportError:
                continue
            self.used.add(str(client.base_url))
            return reply
        raise AssertionError("no coordinator answers")

    def run(self):
        try:
            registration = {"name": self.name, "kinds": ["prepare", "render", "fit", "refine", "package"]}
            registration |= {"memory_bytes": 1, "threads": 1, "device": "", "version": __version__}
            worker = self.call("POST", "/v1/workers", json=registration).json()["worker_id"]
            while not self._over.is_set():
                body = {"kinds": registration["kinds"], "wait_s": 0.2}
                reply = self.call("POST", f"/v1/workers/{worker}/claim", json=body)
                if reply.status_code == 200:
                    claim = reply.json()
                    path = f"/v1/tasks/{claim['task_id']}/commit"
                    result = self._finish(self, claim)
                    held = {"attempt": claim["attempt"], "lease": claim["lease"]}
                    answer = self.call("POST", path, json=held | {"result": result})
                    assert answer.status_code in (204, 409), answer.text
        except BaseException as error:
            self.defects.append(error)
            raise


def test_one_of_two_is_killed_and_the_other_goes_on(replicas, leaders, result, eventually):
    one, two = replicas
    assert eventually(leaders) == ["one"], "of two, one leads"
    over = threading.Event()

    class Home:
        """What `result_of` uploads with: through either coordinator."""

        def __init__(self, roamer):
            self.roamer = roamer

        def upload(self, data):
            sha256 = hashlib.sha256(data).hexdigest()
            assert self.roamer.call("PUT", f"/v1/blobs/{sha256}", content=data).status_code == 201
            return sha256

    midway, killed, rendered = threading.Event(), threading.Event(), itertools.count(1)

    def finish(roamer, claim):
        if claim["payload"]["kind"] == "render" and next(rendered) >= 6:
            midway.set()
            assert killed.wait(600)
        return result(Home(roamer), claim, tiles=16)

    roamers = [Roamer(f"w{n}", replicas, finish, over) for n in range(3)]
    client = Roamer("client", replicas, None, over)
    bundle = {"entry": "a.glb", "files": {"a.glb": Home(client).upload(b"a scene")}}
    request = {"name": "n", "preset": "draft", "bundle": bundle}
    job = client.call("POST", "/v1/jobs", json=request, headers={"Idempotency-Key": "k"}).json()["id"]

    for roamer in roamers:
        roamer.start()
    try:
        assert midway.wait(600), client.call("GET", f"/v1/jobs/{job}").text
        one.end(signal.SIGKILL)
        killed.set()
        eventually(lambda: client.call("GET", f"/v1/jobs/{job}").json()["state"] == "completed", 300)
        assert eventually(leaders) == ["two"], "leadership has moved"
    finally:
        killed.set()
        over.set()
        for roamer in roamers:
            roamer.join()
    assert [roamer.defects for roamer in roamers] == [[], [], []]
    assert all(len(roamer.used) == 2 for roamer in roamers), "every worker has talked to both"
    artifact = two.client.get(f"/v1/jobs/{job}/artifacts/lightfield.ktx2")
    assert artifact.content == b"0123456789" * 100
    events = two.client.get(f"/v1/jobs/{job}/events", params={"format": "json", "limit": 500}).json()
    labels = [event["detail"]["label"] for event in events if event["kind"] == "task.completed"]
    assert len(labels) == len(set(labels)) > 16, "no task is completed twice"


def test_sigterm_ends_polls_and_lets_requests_finish(replicas, leaders, eventually, tmp_path):
    """Requests that it has begun to answer: one whose bytes it has not yet read may find its connection closed."""
    one, two = replicas
    eventually(leaders)
    registration = {"name": "w", "kinds": ["package"], "memory_bytes": 1, "threads": 1, "device": ""}
    registration["version"] = __version__
    worker = one.client.post("/v1/workers", json=registration).json()["worker_id"]
    [registered] = [view["seen"] for view in two.client.get("/v1/workers").json()]
    sent = threading.Event()
    data = b"x" * 1000
    sha256 = hashlib.sha256(data).hexdigest()

    def pieces():
        yield data[:500]
        sent.wait(600)
        yield data[500:]

    with ThreadPoolExecutor() as threads:
        body = {"kinds": ["package"], "wait_s": 25}
        poll = threads.submit(one.client.post, f"/v1/workers/{worker}/claim", json=body)
        upload = threads.submit(one.client.put, f"/v1/blobs/{sha256}", content=pieces())
        eventually(lambda: two.client.get("/v1/workers").json()[0]["seen"] != registered)
        eventually(lambda: any((tmp_path / "one" / "incoming").iterdir()))
        one.process.send_signal(signal.SIGTERM)
        assert poll.result(20).status_code == 204, "the poll ends at once, in order"

        def refused():
            try:
                httpx.get(f"{one.client.base_url}/healthz")
            except httpx.ConnectError:
                return True
            return False

        eventually(refused)
        assert one.process.poll() is None, "it waits for the upload"
        sent.set()
        assert upload.result(20).status_code == 201, "the upload is taken"
    assert one.process.wait(600) == 0
    assert "Traceback" not in one.log.read_text()
    assert eventually(leaders) == ["two"] and two.client.get("/readyz").status_code == 200
