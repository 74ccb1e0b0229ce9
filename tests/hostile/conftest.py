"""One coordinator for all hostile input, as an operator starts it, and what has to hold of it after every case.

It is one process from the first case to the last, so a case that brings it down, or leaves it bloated or deaf, fails.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import psutil
import pytest
from e2e_farm import Farm


@pytest.fixture(scope="session")
def hostile_folder() -> Iterator[Path]:
    """Everything of the farm; outside pytest's own folder (see tests/e2e/conftest.py)."""
    with tempfile.TemporaryDirectory(prefix="lightkiln-hostile-") as folder:
        yield Path(folder)


@pytest.fixture(scope="session")
def target(hostile_folder: Path) -> Iterator[Farm]:
    """The coordinator that takes it all; its process is the same at the end."""
    often = {"per_s": 1e6, "burst": 1_000_000}
    rates = {"clients": often, "workers": often, "failures": often}
    farm = Farm(hostile_folder / "farm", config={"limits": {"rates": rates}})
    farm.folder.mkdir()
    try:
        farm.start_coordinator()
        process = psutil.Process(farm.processes["coordinator"].pid)
        yield farm
        assert process.is_running() and httpx.get(farm.url + "/readyz").status_code == 200
    finally:
        farm.stop()


@pytest.fixture(scope="session")
def owner(target: Farm) -> Iterator[httpx.Client]:
    """The client of a token with every scope."""
    headers = {"Authorization": f"Bearer {target.token}"}
    with httpx.Client(base_url=target.url, headers=headers, timeout=30) as client:
        yield client
