"""schemas/generated/ is what the code says."""

from pathlib import Path

from kiln_service.generate import documents

FOLDER = Path(__file__).parents[2] / "schemas" / "generated"


def test_generated_files_are_current():
    there = {file.name: file.read_text() for file in FOLDER.glob("*.json")}
    assert there == documents(), "run `python -m kiln_service.generate`"


def test_every_operation_names_its_token_and_its_errors(shared):
    document = shared.client.get("/v1/openapi.json").json()
    found = 0
    for path, operations in document["paths"].items():
        if not path.startswith("/v1/"):
            continue
        for operation in operations.values():
            assert operation["security"] and operation["description"], path
            assert "422" not in operation["responses"] or "application/problem+json" in str(operation["responses"])
            found += 1
    assert found > 15
