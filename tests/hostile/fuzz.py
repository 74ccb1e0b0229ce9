"""Every operation of the interface asked with what its contracts say at their bounds, with a token of each scope.

What a schema refuses must be refused with a problem document, what it takes must not break anything: no answer is a
server's error, and views still answer afterwards (the other client looks at them all the while).
"""

import random
from collections.abc import Iterator, Mapping
from typing import Any, Final
from urllib.parse import quote, urlencode

import httpx
from contract_bounds import DOCUMENT, HUGE, Raw, Variant, branches, sample, variants
from ground import SCOPES, Ground, Robber, Tally, document_of, held

JSON: Final = {"Content-Type": "application/json"}
BROKEN_STREAMS: Final = ("/v1/jobs/{job_id}/events", "/v1/tasks/{task_id}/log")
"""These may answer without an end; they are asked for a document."""
WITH_CLAIM: Final = ("heartbeat", "checkpoint", "fail", "commit")
QUIET: Final = 8192
"""Bytes of an error: it is no echo of the request."""


def contracts(ground: Ground) -> Tally:
    """Bodies of all operations, by a token that may send them."""
    tally, chance = Tally(), random.Random(ground.seed)
    cases = list(_bodies(ground))
    for path, method, variant in chance.sample(cases, min(len(cases), ground.many(260, len(cases)))):
        _send(ground, tally, _scope_of(path, method), method, _filled(ground, path), variant)
    return tally


def parameters(ground: Ground) -> Tally:
    """Parameters of the paths and queries of all operations, by a token that may send them."""
    tally, chance = Tally(), random.Random(ground.seed + 1)
    cases = list(_parameters(ground))
    for path, method, url, name in chance.sample(cases, min(len(cases), ground.many(160, len(cases)))):
        reply = ground.send(_scope_of(path, method), method.upper(), url, json=document_of(path, method)[1])
        _judge(tally, f"{method} {path}: {name}", reply, refused=False)
    return tally


def scopes(ground: Ground) -> Tally:
    """Every operation by every token that must not use it."""
    tally = Tally()
    for path, operations in DOCUMENT["paths"].items():
        for method, operation in operations.items():
            if "security" not in operation:
                continue
            _, body = document_of(path, method)
            for scope in SCOPES:
                if scope == "admin" or scope in allowed(path, method):
                    continue
                reply = ground.send(scope, method.upper(), _filled(ground, path), json=body)
                status = 0 if reply is None else reply.status_code
                tally.count(status == 403, f"{scope}: {method} {path}: {status}", status)
    return tally


def claimed(ground: Ground) -> Tally:
    """What a worker says of a task that it holds: numbers and text at the bounds of the contract, which are stored."""
    tally, chance = Tally(), random.Random(ground.seed + 2)
    robber, job = _with_tiles(ground)
    jobs, claim = [job], robber.must_claim()
    for what in WITH_CLAIM:
        cases = list(variants(_claim_contract(what)[0], _said(what)))
        for variant in chance.sample(cases, min(len(cases), ground.many(40, len(cases)))):
            content = _of_claim(variant, claim, what).body()
            url = _claim_url(what, robber, claim)
            reply = ground.send("worker", "POST", url, content=content, headers=JSON)
            _judge(tally, f"{what}: {variant.name}", reply, variant.refused)
            if reply is not None and reply.is_success:
                _look(ground, tally, jobs[-1], f"{what}: {variant.name}")
            if what in ("fail", "commit") and reply is not None and reply.status_code in (204, 404, 409):
                following = robber.claim(0)
                if following is None:
                    robber, job = _with_tiles(ground)
                    jobs, following = [*jobs, job], robber.must_claim()
                claim = following
    for job in jobs:
        status = ground.cancel(job)
        tally.count(status in (200, 204, 409), f"cancel afterwards: {status}", status)
    return tally


def huge_text(ground: Ground) -> Tally:
    """Strings of megabytes in every place for one, the two of issue 11 first, against tasks and jobs that are there."""
    tally, chance = Tally(), random.Random(ground.seed + 3)
    robber, job = _with_tiles(ground)
    claim = robber.must_claim()
    tile = claim["payload"]["tile"]
    labels = [f"tile {tile['row']},{tile['column']}", "x" * HUGE]
    reply = ground.send("submit", "POST", f"/v1/jobs/{job}/requeue", json={"kind": "render", "labels": labels})
    _judge(tally, "requeue of a task and of a label of 5 MB", reply, refused=True)
    for length in (900_000, 1_500_000, HUGE):
        problem = {"title": "x" * length, "status": 500, "detail": "d", "code": "internal"}
        reply = robber.call(claim, "fail", problem=problem, retryable=True)
        _judge(tally, f"fail with a title of {length} letters", reply, refused=True)
    cases = [case for case in _bodies(ground) if f"{HUGE} " in case[2].name or "1500000 " in case[2].name]
    for path, method, variant in chance.sample(cases, min(len(cases), ground.many(12, len(cases)))):
        url = _filled(ground, path, {"job_id": job, "task_id": claim["task_id"], "worker_id": robber.id})
        _send(ground, tally, _scope_of(path, method), method, url, variant)
    ground.cancel(job)
    return tally


def allowed(path: str, method: str) -> tuple[str, ...]:
    """The scopes whose tokens may use an operation."""
    if path.startswith("/v1/blobs"):
        return ("read", "worker") if method in ("get", "head") else ("submit", "worker")
    if path.startswith("/v1/tasks/") and method == "post":
        return ("worker",)
    if path.startswith("/v1/workers") and method == "post" and "orders" not in path:
        return ("worker",)
    if path.startswith("/v1/jobs"):
        return ("read",) if method in ("get", "head") else ("submit",)
    if path in ("/v1/workers", "/v1/metrics", "/v1/openapi.json", "/v1/tasks/{task_id}/log"):
        return ("read",)
    return ("admin",)


def _scope_of(path: str, method: str) -> str:
    return allowed(path, method)[0]


def _bodies(ground: Ground) -> Iterator[tuple[str, str, Variant]]:
    for path, operations in DOCUMENT["paths"].items():
        for method in operations:
            schema, document = document_of(path, method)
            if not schema:
                continue
            if path == "/v1/jobs":
                document = {key: document[key] for key in document if key not in ("preset", "set")}
                document["tags"] = ["hostile"]
                document["bundle"] = {"entry": "a.glb", "files": {"a.glb": ground.sha256}}
            for result in branches(schema["properties"]["result"]) if path.endswith("/commit") else [None]:
                base = document if result is None else document | {"result": sample(result)}
                for variant in variants(schema, base):
                    yield path, method, variant


def _parameters(ground: Ground) -> Iterator[tuple[str, str, str, str]]:
    for path, operations in DOCUMENT["paths"].items():
        for method, operation in operations.items():
            for parameter in operation.get("parameters", ()):
                name, schema = parameter["name"], parameter["schema"]
                if parameter["in"] == "header" or name == "follow":
                    continue
                for variant in variants(schema, sample(schema, name)):
                    text = _as_text(variant.document)
                    if len(text) > 60_000:
                        continue
                    if parameter["in"] == "path":
                        url = _filled(ground, path, {name: quote(text, safe="")})
                    else:
                        fixed = {"format": "json"} if path in BROKEN_STREAMS[:1] and name != "format" else {}
                        url = f"{_filled(ground, path)}?{urlencode({name: text} | fixed)}"
                    if name == "format" and text == "sse":
                        continue
                    yield path, method, url, f"{name}, {variant.name}"


def _as_text(value: Any) -> str:
    text = value.text if isinstance(value, Raw) else str(value)
    return text.encode("utf-8", "replace").decode()


def _filled(ground: Ground, path: str, given: Mapping[str, str] | None = None) -> str:
    """The path with ids of things that are not there, or of what is given."""
    for name in ("job_id", "task_id", "worker_id", "webhook_id"):
        path = path.replace(f"{{{name}}}", (given or {}).get(name, "0" * 32))
    names = {"sha256": ground.sha256, "name": "nobody", "worker": "nobody", "order": "wake"} | dict(given or {})
    for name, value in names.items():
        path = path.replace(f"{{{name}}}", value)
    return path


def _send(ground: Ground, tally: Tally, scope: str, method: str, url: str, variant: Variant) -> None:
    reply = ground.send(scope, method.upper(), url, content=variant.body(), headers=JSON)
    _judge(tally, f"{method} {url}: {variant.name}", reply, variant.refused)


def _judge(tally: Tally, what: str, reply: httpx.Response | None, refused: bool) -> None:
    """An answer holds that is no server's error, refuses what it must, and refuses with a short problem document."""
    if reply is None:
        tally.count(False, f"{what}: no answer", 0)
        return
    status, is_problem = reply.status_code, reply.headers.get("content-type") == "application/problem+json"
    holds = status < 500 and not (refused and status < 400)
    if status >= 400:
        holds &= is_problem and len(reply.content) < QUIET
    tally.count(holds, f"{what}: {status} {reply.text[:200]}", status)


def _look(ground: Ground, tally: Tally, job: str, after: str) -> None:
    """Views go on whatever is in their rows."""
    for view in ("/v1/jobs", "/v1/metrics", f"/v1/jobs/{job}"):
        seen = ground.send("admin", "GET", view)
        if (status := 0 if seen is None else seen.status_code) != 200:
            tally.count(False, f"{view} after {after}: {status}", status)


def _with_tiles(ground: Ground) -> tuple[Robber, str]:
    """A worker with tiles to claim, and their job."""
    robber = ground.worker()
    job = robber.job()
    robber.prepare(48)
    return robber, job


def _claim_url(what: str, robber: Robber, claim: Mapping[str, Any]) -> str:
    return f"/v1/workers/{robber.id}/heartbeat" if what == "heartbeat" else f"/v1/tasks/{claim['task_id']}/{what}"


def _claim_contract(what: str) -> tuple[Mapping[str, Any], Any]:
    path = "/v1/workers/{worker_id}/heartbeat" if what == "heartbeat" else f"/v1/tasks/{{task_id}}/{what}"
    return document_of(path, "post")


def _said(what: str) -> dict[str, Any]:
    """A sample of what a worker says of a tile."""
    schema, document = _claim_contract(what)
    if what == "commit":
        document["result"] = sample(branches(schema["properties"]["result"])[1])
    return dict(document)


def _of_claim(variant: Variant, claim: Mapping[str, Any], what: str) -> Variant:
    """The variant with what it leaves alone taken from the claim, so that it is about a task that is held."""
    document = variant.document
    if not isinstance(document, dict):
        return variant
    alone = {key: value for key, value in held(claim, what).items() if key in document and key not in variant.name}
    result = document.get("result")
    if isinstance(result, dict) and "tile" in result and "tile" not in variant.name:
        alone["result"] = result | {"tile": claim["payload"]["tile"]}
    return Variant(variant.name, document | alone, variant.refused)
