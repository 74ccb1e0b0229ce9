"""`python -m kiln_service.generate [FOLDER]`: write the contracts as JSON Schema and OpenAPI for other languages.

The files in schemas/generated/ are checked in; a test compares them with what this module makes.
"""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from kiln_schemas.errors import Problem
from kiln_schemas.job import EventView, JobRequest, JobView, TaskView
from kiln_schemas.manifest import Manifest
from kiln_schemas.settings import BakeSettings
from kiln_schemas.tasks import Claim, Commit, Failure, Heartbeat, WorkerRegistration
from kiln_service.app import create_app, openapi_document
from kiln_service.config import ServiceConfig

FOLDER: Final = Path("schemas/generated")

MODELS: Final[Sequence[type[BaseModel]]] = (
    BakeSettings,
    JobRequest,
    JobView,
    TaskView,
    EventView,
    Manifest,
    Problem,
    WorkerRegistration,
    Claim,
    Heartbeat,
    Commit,
    Failure,
    ServiceConfig,
)


def documents() -> dict[str, str]:
    """File name to content of everything generated."""
    found = {f"{model.__name__}.schema.json": _text(model.model_json_schema()) for model in MODELS}
    with tempfile.TemporaryDirectory() as folder:
        found["openapi.json"] = _text(openapi_document(create_app(ServiceConfig(data=Path(folder)))))
    return found


def main(folder: Path = FOLDER) -> None:
    """Write all files, and delete those of models that are gone."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = documents()
    for name, text in wanted.items():
        (folder / name).write_text(text)
    for file in folder.glob("*.json"):
        if file.name not in wanted:
            file.unlink()


def _text(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=2, sort_keys=True) + "\n"


if __name__ == "__main__":
    main()
