"""schemathesis over the whole interface: no 5xx, and no answer that the OpenAPI document does not describe.

Every operation gets requests that fit its schema and requests that break it, with ids of things that there are and of
things that there are not. Seeds are fixed: a run is repeatable. `LIGHTKILN_HOSTILE_EXAMPLES` (`make hostile`) asks for
more examples an operation.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any, Final

import httpx
import pytest
import schemathesis
from e2e_farm import Farm
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from kiln_schemas import __version__

EXAMPLES: Final = int(os.environ.get("LIGHTKILN_HOSTILE_EXAMPLES", "12"))
DOCUMENT: Final = Path(__file__).parents[2] / "schemas/generated/openapi.json"
CHECKS: Final = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]
SCHEMA: Final = schemathesis.openapi.from_dict(json.loads(DOCUMENT.read_text()))
OPERATIONS: Final = {found.ok().label: found.ok() for found in SCHEMA.get_all_operations()}
SCENE: Final = b"a scene"
BUNDLE: Final = {"entry": "a.glb", "files": {"a.glb": hashlib.sha256(SCENE).hexdigest()}}
GOOD: Final[dict[str, Any]] = {
    **{"name": "x", "bundle": BUNDLE, "preset": "draft", "set": [], "settings": None, "gates": {}, "cameras": {}},
    **{"attempt": 1, "version": __version__, "device": "none"},
}
"""Values that lead further than the first check: the files are there, the attempt runs."""
CASES: Final = [
    (label, mode)
    for label, operation in OPERATIONS.items()
    for mode in GenerationMode
    if mode is GenerationMode.POSITIVE or operation.body or list(operation.iter_parameters())  # else: nothing to break
]


@pytest.fixture(scope="module")
def there(target: Farm, owner: httpx.Client) -> dict[str, list[str]]:
    """Path parameters of things that are there, by name."""
    (sha256,) = BUNDLE["files"].values()
    owner.put(f"/v1/blobs/{sha256}", content=SCENE).raise_for_status()
    request = {"name": "x", "preset": "draft", "bundle": BUNDLE}
    jobs = [owner.post("/v1/jobs", json=request).raise_for_status().json()["id"] for _ in range(3)]
    worker = {
        "name": "w",
        "kinds": ["prepare"],
        "memory_bytes": 1 << 30,
        "threads": 1,
        "device": "none",
        "version": __version__,
    }
    worker_id = owner.post("/v1/workers", json=worker).raise_for_status().json()["worker_id"]
    claim = owner.post(f"/v1/workers/{worker_id}/claim", json={"kinds": ["prepare"], "wait_s": 0}).json()
    hook = {"url": "http://127.0.0.1:9/"}
    return {
        "job_id": jobs,
        "task_id": [claim["task_id"]],
        "worker_id": [worker_id],
        "webhook_id": [owner.post("/v1/webhooks", json=hook).raise_for_status().json()["id"]],
        "sha256": [sha256],
    }


@pytest.mark.parametrize(("label", "mode"), CASES, ids=[f"{label}-{mode.name.lower()}" for label, mode in CASES])
def test_every_answer_is_a_documented_one(
    target: Farm, there: dict[str, list[str]], label: str, mode: GenerationMode
) -> None:
    answers: dict[int, int] = {}

    @seed(20201)
    @settings(
        max_examples=EXAMPLES,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=OPERATIONS[label].as_strategy(generation_mode=mode), data=st.data())
    def ask(case: Any, data: st.DataObject) -> None:
        for name in set(case.path_parameters or {}) & set(there):
            case.path_parameters[name] = data.draw(
                st.one_of(st.just(case.path_parameters[name]), st.sampled_from(there[name]))
            )
        if label.endswith("/claim") and isinstance(case.body, dict):
            wait_s = case.body.get("wait_s", 10.0)
            if isinstance(wait_s, int | float) and 0 <= wait_s <= 30:
                case.body["wait_s"] = 0  # held open otherwise
        if isinstance(case.body, dict) and data.draw(st.booleans()):
            case.body |= {key: value for key, value in GOOD.items() if key in case.body}
        if label.endswith("/events"):
            case.query = {**(case.query or {}), "format": "json"}  # a stream of a live job has no end
        if label.endswith("/log"):
            case.query = {key: value for key, value in (case.query or {}).items() if key != "follow"}
        response = case.call(base_url=target.url, headers={"Authorization": f"Bearer {target.token}"}, timeout=20)
        answers[response.status_code] = answers.get(response.status_code, 0) + 1
        case.validate_response(response, checks=CHECKS)

    ask()
    assert sum(answers.values()) > 0
    print(label, mode.name, answers)
