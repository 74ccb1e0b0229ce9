"""`lightkiln view`: only the package's files, only to this machine, under a strict policy; vendored files unchanged."""

import asyncio
import hashlib
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from kiln_schemas.errors import NotFound
from kiln_service.viewer import FOLDER, STATIC
from kiln_service.viewer.local import create_local_app


@pytest.fixture
def get(tmp_path: Path) -> Callable[..., httpx.Response]:
    folder = tmp_path / "<b>package"
    folder.mkdir()
    (folder / "manifest.json").write_text("{}")
    (tmp_path / "secret").write_text("secret")
    (folder / "link").symlink_to(tmp_path / "secret")
    transport = httpx.ASGITransport(create_local_app(folder))

    async def ask(path: str, headers: dict[str, str]) -> httpx.Response:
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.get(path, headers=headers)

    def get(path: str, **headers: str) -> httpx.Response:
        # In a thread of its own: playwright, once started, keeps a loop running in this one.
        with ThreadPoolExecutor(1) as threads:
            return threads.submit(asyncio.run, ask(path, headers)).result()

    return get


def test_the_page_has_a_strict_policy_and_escapes_the_name(get) -> None:
    page = get("/")
    assert page.status_code == 200
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert "&lt;b&gt;package" in page.text
    assert "<b>" not in page.text


def test_files_of_the_package_do_not_run(get) -> None:
    answer = get("/package/manifest.json")
    assert answer.status_code == 200
    assert answer.headers["content-security-policy"] == "sandbox; default-src 'none'"


@pytest.mark.parametrize(
    "path",
    [
        *("/package/../secret", "/package/%2e%2e/secret", "/package/..%2fsecret", "/package/link", "/package/"),
        *(f"{STATIC}/{name}" for name in ("__init__.py", "local.py", "page/../local.py", "page/%2e%2e/local.py")),
    ],
)
def test_nothing_else_is_served(get, path) -> None:
    assert get(path).status_code == 404


def test_other_host_names_are_refused(get) -> None:
    assert get("/package/manifest.json", Host="evil.example").status_code == 400


def test_a_folder_without_a_manifest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="there is no package"):
        create_local_app(tmp_path)


def test_vendored_files_are_those_of_the_table() -> None:
    vendor = Path(str(FOLDER)) / "vendor"
    table = dict(
        re.findall(r"^\| `([^`]+)` .*`([0-9a-f]{64})` \|$", (vendor / "VENDORED.md").read_text(), re.MULTILINE)
    )
    files = {str(path.relative_to(vendor)): path for path in vendor.rglob("*") if path.is_file()}
    assert set(table) == set(files) - {"VENDORED.md"}
    for name, path in files.items():
        if name != "VENDORED.md":
            assert hashlib.sha256(path.read_bytes()).hexdigest() == table[name], name
