"""axe-core finds nothing serious on the page, in light and in dark."""

import subprocess
from pathlib import Path

import pytest

AXE = "axe-core@4.14.1"


@pytest.fixture(scope="session")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The text of axe-core's script, from npm."""
    folder: Path = tmp_path_factory.mktemp("axe")
    command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefix", str(folder), AXE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    return (folder / "node_modules" / "axe-core" / "axe.min.js").read_text()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(scheme, axe, made, serve, viewer) -> None:
    with serve(made("courtyard")) as url:
        page = viewer.open(url, viewport={"width": 700, "height": 400}, color_scheme=scheme)
        page.evaluate(axe)
        found = page.evaluate("axe.run()")
    assert len(found["passes"]) > 10
    serious = [rule for rule in found["violations"] if rule["impact"] in ("serious", "critical")]
    assert [(rule["id"], rule["help"], [node["html"] for node in rule["nodes"]]) for rule in serious] == []
