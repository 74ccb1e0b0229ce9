"""The pipelines in deploy/ci: their `lightkiln` line is one that the command line takes."""

import re
import shlex
from pathlib import Path

import pytest
import typer
import yaml

from kiln_service.cli.main import app

FOLDER = Path(__file__).parents[2] / "deploy" / "ci"


def lines(tree: object) -> list[str]:
    """All strings of a document."""
    if isinstance(tree, dict):
        return [line for value in tree.values() for line in lines(value)]
    if isinstance(tree, list):
        return [line for value in tree for line in lines(value)]
    return [tree] if isinstance(tree, str) else []


@pytest.mark.parametrize("name", ["github-actions.yml", "gitlab-ci.yml"])
def test_the_submission_is_understood(name: str) -> None:
    document = yaml.safe_load((FOLDER / name).read_text())
    (line,) = [line for line in lines(document) if line.startswith("lightkiln submit")]
    words = shlex.split(re.sub(r"\$\{\{[^}]*\}\}|\$\w+", "x", line))
    command = typer.main.get_command(app).commands["submit"]
    context = command.make_context("submit", words[2:])
    assert context.params["wait"] and str(context.params["junit"]) == "gates.xml"
    assert context.params["key"] and len(context.params["label"]) == 2 and len(context.params["gate"]) == 2
