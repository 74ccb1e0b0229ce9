"""axe-core finds nothing serious on the page, in light and in dark."""

import pytest


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(scheme, node_modules, made, serve, viewer) -> None:
    with serve(made("courtyard")) as url:
        page = viewer.open(url, viewport={"width": 700, "height": 400}, color_scheme=scheme)
        page.evaluate((node_modules / "axe-core" / "axe.min.js").read_text())
        found = page.evaluate("axe.run()")
    assert len(found["passes"]) > 10
    serious = [rule for rule in found["violations"] if rule["impact"] in ("serious", "critical")]
    assert [(rule["id"], rule["help"], [node["html"] for node in rule["nodes"]]) for rule in serious] == []
