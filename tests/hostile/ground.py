"""Where attacks happen: the farm, a token of each scope, and the tally of what was tried and what held."""

import contextlib
import hashlib
import itertools
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import httpx
from contract_bounds import DOCUMENT, resolved, sample
from e2e_farm import Farm

from kiln_schemas import __version__

SCOPES: Final = ("read", "submit", "worker", "admin")
TAG: Final = "hostile"
"""Of the attackers' jobs: no honest worker does them, and theirs may claim them."""
SCENE: Final = b"no scene at all"
SHOWN: Final = 30
"""Broken attempts that a tally describes."""
PATIENCE_S: Final = 600.0
"""An answer that takes so long does not come; no bound on a farm's speed."""
BUSY: Final = 429
LEAST_STREAMED: Final = 256


@dataclass
class Tally:
    """Of a class of attacks."""

    attempts: int = 0
    held: int = 0
    broken: list[str] = field(default_factory=list)
    answers: Counter[int] = field(default_factory=Counter)
    """By status; 0 is a connection that was closed without an answer."""
    figures: dict[str, float] = field(default_factory=dict)

    def count(self, holds: bool, what: str, status: int | None = None, times: int = 1) -> None:
        """Note an attempt, or several of the same."""
        self.attempts += times
        if status is not None:
            self.answers[status] += times
        if holds:
            self.held += times
        elif len(self.broken) < SHOWN:
            self.broken.append(what)


class Ground:
    """A farm under attack. `rounds` counts those of the other client, `honest_job` is the one that it bakes."""

    def __init__(
        self, farm: Farm, *, amount: float, seed: int, rounds: Callable[[], int], honest_job: Callable[[], str]
    ) -> None:
        self.farm, self.amount, self.seed = farm, amount, seed
        self.rounds, self.honest_job = rounds, honest_job
        self.tokens: dict[str, str] = {}
        self.clients: dict[str, httpx.Client] = {}
        owner = self._client(farm.token)
        for scope in SCOPES:
            reply = owner.post("/v1/tokens", json={"name": f"hostile-{scope}", "scopes": [scope]}).raise_for_status()
            self.tokens[scope] = reply.json()["token"]
            self.clients[scope] = self._client(self.tokens[scope])
        self.owner = owner
        self._tags = itertools.count()
        self.sha256 = hashlib.sha256(SCENE).hexdigest()
        self.clients["submit"].put(f"/v1/blobs/{self.sha256}", content=SCENE).raise_for_status()

    def close(self) -> None:
        """End the connections."""
        for client in (self.owner, *self.clients.values()):
            client.close()

    def many(self, short: int, long: int) -> int:
        """How often: `short` in the tests, `long` in the whole run, between them in a part of it."""
        return round(short + self.amount * (long - short))

    def send(self, scope: str, method: str, path: str, **request: Any) -> httpx.Response | None:
        """The answer to an attempt, None where the connection ends without; one that is told to wait waits."""
        while True:
            try:
                reply = self.clients[scope].request(method, path, **request)
            except httpx.TransportError:
                return None
            if reply.status_code != BUSY:
                return reply
            time.sleep(min(2.0, float(reply.headers.get("retry-after", 1))))

    def job(self, **changes: Any) -> str:
        """A job of the attackers' own that no worker but theirs does; its id."""
        request = {
            **{"name": "hostile", "preset": "draft", "tags": [TAG]},
            **{"bundle": {"entry": "a.glb", "files": {"a.glb": self.sha256}}},
        }
        reply = self.send("submit", "POST", "/v1/jobs", json=request | changes)
        assert reply is not None and reply.status_code == 201, reply and reply.text
        return str(reply.json()["id"])

    def cancel(self, job: str) -> int:
        """Cancel a job; the answer's status."""
        reply = self.send("submit", "POST", f"/v1/jobs/{job}/cancel")
        return 0 if reply is None else reply.status_code

    def worker(self, name: str = "hostile", *kinds: str, tag: str | None = None) -> "Robber":
        """A worker of the attackers, which gets tasks of its own jobs, or of those with the tag, and no other."""
        tag = tag or f"{TAG}-{next(self._tags)}"
        return Robber(self, name, tag, kinds or ("prepare", "render", "fit", "refine", "package"))

    def new_client(self, scope: str) -> httpx.Client:
        """Another connection with the token of a scope."""
        return self._client(self.tokens[scope])

    def disk_bytes(self) -> int:
        """What the coordinator's data folder takes, its database included."""
        total = 0
        for path in (self.farm.folder / "data").rglob("*"):
            with contextlib.suppress(FileNotFoundError):
                total += path.stat().st_blocks * 512
        return total

    def _client(self, token: str) -> httpx.Client:
        # Reading the certificates that plain HTTP does not need takes 0.2 s of a processor that the farm shares.
        headers = {"Authorization": f"Bearer {token}"}
        return httpx.Client(base_url=self.farm.url, headers=headers, timeout=PATIENCE_S, verify=False)


class Robber:
    """A worker that claims tasks of the attackers' jobs and says what it likes of them."""

    def __init__(self, ground: Ground, name: str, tag: str, kinds: tuple[str, ...]) -> None:
        self._ground, self.tag, self._kinds = ground, tag, list(kinds)
        registration = {
            **{"name": name, "kinds": self._kinds, "tags": [tag], "memory_bytes": 1 << 30, "threads": 1},
            **{"device": "none", "version": __version__},
        }
        reply = ground.send("worker", "POST", "/v1/workers", json=registration)
        assert reply is not None and reply.status_code == 201, reply and reply.text
        self.id = str(reply.json()["worker_id"])

    def job(self) -> str:
        """A job that this worker alone does; its id."""
        return self._ground.job(tags=[self.tag], set=["lightmap.resolution=64"])

    def must_claim(self) -> dict[str, Any]:
        """The next task of its jobs, of which there must be one."""
        claim = self.claim(wait_s=20)
        assert claim is not None, "no task of the attackers came"
        return claim

    def claim(self, wait_s: float = 1) -> dict[str, Any] | None:
        """A task, if there is one."""
        body = {"kinds": self._kinds, "wait_s": wait_s}
        reply = self._ground.send("worker", "POST", f"/v1/workers/{self.id}/claim", json=body)
        return reply.json() if reply is not None and reply.status_code == 200 else None

    def call(self, claim: Mapping[str, Any], what: str, **body: Any) -> httpx.Response | None:
        """`heartbeat`, `commit`, `fail` or `checkpoint` of a claimed task."""
        path = f"/v1/workers/{self.id}/heartbeat" if what == "heartbeat" else f"/v1/tasks/{claim['task_id']}/{what}"
        return self._ground.send("worker", "POST", path, json=held(claim, what) | body)

    def prepare(self, tiles: int) -> dict[str, Any]:
        """Commit the prepare task of the next job, which has so many tiles then; the claim."""
        claim = self.must_claim()
        places = [{"row": 8 * (i // 8), "column": 8 * (i % 8), "size": 8, "texels": 5} for i in range(tiles)]
        result = {
            **{"kind": "prepare", "scene": self._ground.sha256, "texel_map": self._ground.sha256},
            **{"scene_hash": "0" * 64, "tiles": places, "has_environment": False, "has_light": True},
            **{"triangles": 1, "seconds": 1.0},
        }
        reply = self.call(claim, "commit", result=result)
        assert reply is not None and reply.status_code == 204, reply and reply.text
        return claim


def held(claim: Mapping[str, Any], what: str) -> dict[str, Any]:
    """What a call says of the attempt that it is about: the fields that the contract and the claim have in common."""
    path = "/v1/workers/{worker_id}/heartbeat" if what == "heartbeat" else f"/v1/tasks/{{task_id}}/{what}"
    reference = DOCUMENT["paths"][path]["post"]["requestBody"]["content"]["application/json"]["schema"]["$ref"]
    fields = DOCUMENT["components"]["schemas"][reference.rsplit("/", 1)[1]]["properties"]
    return {key: value for key, value in claim.items() if key in fields and key in ("task_id", "attempt", "lease")}


def document_of(path: str, method: str) -> tuple[Mapping[str, Any], Any]:
    """The schema of an operation's JSON body and a sample of it; nothing where it has none."""
    content = DOCUMENT["paths"][path][method].get("requestBody", {}).get("content", {})
    schema = resolved(content.get("application/json", {}).get("schema", {}))
    return schema, sample(schema) if schema else None


Attack = Callable[[Ground], Tally]
