"""A short siege: attacks of every class with valid tokens, while another client bakes (`make hostile`: many more).

Nothing here depends on the machine's speed: of the other client it is asked that its bakes end with the same bytes and
that all its answers come, some of them to questions that were asked and answered during each attack.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from contract_bounds import DOCUMENT, Variant, sample, variants
from siege import ATTACKS, Siege, report, siege

from kiln_schemas.job import JobRequest

SEED = 11


@pytest.fixture(scope="module")
def ended() -> Iterator[Siege]:
    """The siege after its last attack."""
    # Not under pytest's folder, which is private to this user: the database server is another one.
    with TemporaryDirectory(prefix="lightkiln-hostile-") as folder, siege(Path(folder), amount=0, seed=SEED) as run:
        run.run(ATTACKS)
        yield run


@pytest.mark.parametrize("name", ATTACKS)
def test_a_class_of_attacks_holds(ended: Siege, name: str) -> None:
    tally = ended.tallies[name]
    assert tally.attempts > 0
    assert tally.broken == [] and tally.held == tally.attempts


def test_the_other_client_has_noticed_nothing(ended: Siege) -> None:
    verdicts = ended.verdicts()
    assert ended.bakes() >= 2
    assert {name: count for name, count in verdicts.items() if count and name != "attempts_not_held"} == {}
    print(json.dumps(report(ended)["classes"], indent=1))


def test_variants_know_what_a_contract_refuses() -> None:
    """Against the models themselves: what the schema refuses they refuse."""
    schema = DOCUMENT["components"]["schemas"]["JobRequest"]
    document = sample(schema)
    found: list[Variant] = [case for case in variants(schema, document) if case.refused and len(case.body()) < 10_000]
    assert len(found) > 300
    for case in found:
        with pytest.raises(ValueError):
            JobRequest.model_validate_json(case.body())
