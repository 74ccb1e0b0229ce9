"""A finished job's package in the viewer of its coordinator, for whoever is signed in."""

from collections.abc import Iterator
from pathlib import Path

import packages
import pytest
from playwright.sync_api import Browser, expect, sync_playwright

KINDS = {".ktx2": "image/ktx2", ".glb": "model/gltf-binary", ".json": "application/json", ".glsl": "text/plain"}
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox", *SOFTWARE_GL])
        yield browser
        browser.close()


@pytest.fixture
def finished(home, tmp_path: Path) -> str:
    """A completed job that published a package."""
    folder = packages.write_package(tmp_path / "package", packages.cabinet_scene(), size=8, lobes=2)
    job, worker = str(home.submit(name="cabinet")["id"]), home.worker()
    worker.advance(job, until="package")
    artifacts = [
        {
            "name": str(path.relative_to(folder)),
            "sha256": home.upload(path.read_bytes()),
            "size": path.stat().st_size,
            "media_type": KINDS.get(path.suffix, "application/octet-stream"),
        }
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    ]
    result = {"kind": "package", "seconds": 1.0, "artifacts": artifacts}
    assert worker.commit(worker.must_claim("package"), result).status_code == 204
    return job


def test_a_finished_job_is_viewed_from_its_page(dashboard, finished) -> None:
    page = dashboard.open(f"/jobs/{finished}", viewport={"width": 480, "height": 300})
    page.get_by_role("link", name="View", exact=True).click()
    expect(page).to_have_url(f"{dashboard.url}/jobs/{finished}/view")
    page.set_default_timeout(30_000)
    page.wait_for_load_state()
    assert page.evaluate("viewer.then((picture) => picture.firstFrame.bytes)") > 10_000
    shown = page.evaluate(
        """viewer.then((picture) => {
            picture.setCamera({ position: [0.4, 1.6, 4.2], target: [0, 0.7, -0.5], fov_deg: 45 });
            return Array.from(picture.capture(16, 9)).reduce((sum, value) => sum + value, 0);
        })"""
    )
    assert shown > 10.0
    assert page.title().startswith("cabinet")


def test_it_needs_a_sign_in_and_a_job(home, finished) -> None:
    stranger = home.client.get(f"/jobs/{finished}/view", headers={"Authorization": "Bearer nobody"})
    assert stranger.status_code == 401
    assert home.client.get("/jobs/none/view").status_code == 404
    policy = home.client.get(f"/jobs/{finished}/view").headers["content-security-policy"]
    assert "unsafe" not in policy
    assert "script-src 'self';" in policy
