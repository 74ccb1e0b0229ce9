"""`python other_client.py URL TOKEN SCENE SKY LOG`: an honest client that bakes, one bake after the other, and watches.

Everything that it asks is timed and written to LOG, one line of JSON an answer: what (`route`), when it was asked
(`began`, seconds of the monotonic clock), how long it took, the status. A bake that is over is a line with its state
and the hashes of its textures. SIGTERM: the bake at hand is finished and is the last one.
"""

import hashlib
import json
import signal
import sys
import time
from pathlib import Path
from typing import Any, Final

import httpx
from e2e_farm import TINY

SMALL: Final = (
    *("lightmap.tile=4", "render.irradiance_samples=16", "fit.lobes=4", "fit.start_steps=60"),
    *("fit.visibility_refine_steps=20", "fit.refine_steps=20"),
)
TAG: Final = "honest"
"""Of the client's jobs and of the worker that does them: it is not robbed of its tasks, which a worker may claim."""
PATIENCE_S: Final = 600.0
"""No bound on a farm's speed: an answer that takes so long will never come."""
OVER: Final = ("completed", "failed", "canceled", "gate-failed")


class OtherClient:
    """See above."""

    def __init__(self, url: str, token: str, scene: Path, sky: Path, log: Path) -> None:
        self._http = httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=PATIENCE_S)
        self._browser = httpx.Client(base_url=url, timeout=PATIENCE_S)
        self._files = {path.name: path.read_bytes() for path in (scene, sky)}
        self._token, self._log = token, log.open("a")
        self._ending = False
        signal.signal(signal.SIGTERM, self._end)

    def run(self) -> None:
        """Bake until SIGTERM."""
        form = {"token": self._token}
        reply = self._browser.post("/login", data=form, headers={"Sec-Fetch-Site": "same-origin"})
        self._write(route="POST /login", status=reply.status_code, began=time.monotonic(), seconds=0.0)
        while not self._ending:
            self._bake()

    def _end(self, *_: object) -> None:
        self._ending = True

    def _bake(self) -> None:
        hashes = {name: hashlib.sha256(data).hexdigest() for name, data in self._files.items()}
        self._ask("POST", "/v1/blobs/missing", json={"sha256": list(hashes.values())})
        for name, sha256 in hashes.items():
            self._ask("PUT", f"/v1/blobs/{sha256}", "PUT /v1/blobs/SHA", content=self._files[name])
        scene, sky = hashes
        bundle = {"entry": scene, "files": hashes, "environment": {"file": sky}}
        request = {"name": "honest", "preset": "draft", "set": [*TINY, *SMALL], "bundle": bundle, "tags": [TAG]}
        job = self._ask("POST", "/v1/jobs", json=request)["id"]
        while (state := self._look(job)) not in OVER:
            time.sleep(0.1)
        artifacts = self._ask("GET", f"/v1/jobs/{job}/artifacts", "GET /v1/jobs/JOB/artifacts")
        digests = {
            item["name"]: item["sha256"] for item in artifacts if item["name"].endswith((".ktx2", ".exr", ".glb"))
        }
        self._write(bake=job, state=state, digests=digests, intact=all(map(self._is_intact, artifacts)))
        # So that the next bake renders and does not read this one's light fields.
        self._ask("POST", f"/v1/jobs/{job}/archive", "POST /v1/jobs/JOB/archive")

    def _look(self, job: str) -> str:
        """A round of all that a user looks at; the job's state."""
        state = str(self._ask("GET", f"/v1/jobs/{job}", "GET /v1/jobs/JOB")["state"])
        tasks = self._ask("GET", f"/v1/jobs/{job}/tasks", "GET /v1/jobs/JOB/tasks")
        self._ask("GET", f"/v1/jobs/{job}/events", "GET /v1/jobs/JOB/events", params={"format": "json"})
        if tasks:
            self._ask("GET", f"/v1/tasks/{tasks[0]['id']}/log", "GET /v1/tasks/TASK/log", params={"tail": 1})
        for path in ("/v1/jobs", "/v1/workers", "/v1/metrics", "/readyz"):
            self._ask("GET", path)
        for path in ("/jobs", f"/jobs/{job}"):
            self._ask("GET", path, path.replace(job, "JOB"), client=self._browser)
        self._write(round=job)
        return state

    def _is_intact(self, artifact: dict[str, Any]) -> bool:
        path = f"/v1/blobs/{artifact['sha256']}"
        began = time.monotonic()
        reply = self._http.get(path)
        self._write(route="GET /v1/blobs/SHA", status=reply.status_code, began=began, seconds=time.monotonic() - began)
        return hashlib.sha256(reply.content).hexdigest() == artifact["sha256"]

    def _ask(
        self, method: str, path: str, route: str | None = None, client: httpx.Client | None = None, **request: Any
    ) -> Any:
        """The answer as JSON, timed. One that came to nothing is written down as status 0 and asked for again."""
        while True:
            began, status, reply = time.monotonic(), 0, None
            try:
                reply = (client or self._http).request(method, path, **request)
                status = reply.status_code
            except httpx.TransportError as error:
                self._write(lost=repr(error))
            self._write(route=f"{method} {route or path}", status=status, began=began, seconds=time.monotonic() - began)
            if reply is not None and reply.is_success:
                return reply.json() if "json" in reply.headers.get("content-type", "") else None
            if reply is not None:
                self._write(refused=reply.text[:300])
            time.sleep(0.5)

    def _write(self, **line: Any) -> None:
        self._log.write(json.dumps({"at": time.monotonic(), **line}) + "\n")
        self._log.flush()


if __name__ == "__main__":
    OtherClient(sys.argv[1], sys.argv[2], *map(Path, sys.argv[3:])).run()
