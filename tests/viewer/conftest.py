"""Debian's chromium on software GL, with `lightkiln view` as the server; every page is watched for faults."""

import base64
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import packages
import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from kiln_schemas.camera import Camera

SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
LIGHTKILN = Path(sys.executable).parent / "lightkiln"
NODE = Path(__file__).parent / "node"


@pytest.fixture(scope="module")  # while playwright runs, nothing else in this process may run an event loop
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox", *SOFTWARE_GL])
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def node_modules(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What package.json pins, from npm."""
    folder = tmp_path_factory.mktemp("node")
    shutil.copy(NODE / "package.json", folder)
    command = ["npm", "install", "--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, f"npm could not install what package.json pins:\n{done.stderr}"
    return folder / "node_modules"


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    """`lightkiln view` as people start it; the URL that it prints."""
    with subprocess.Popen(
        [LIGHTKILN, "view", str(folder)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as server:
        try:
            assert server.stdout is not None and server.stderr is not None
            url = server.stdout.readline().strip()
            assert url.startswith("http://127.0.0.1:"), server.stderr.read()
            yield url
        finally:
            server.terminate()


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The package of a scene, made once."""
    folders: dict[str, Path] = {}

    def make(name: str) -> Path:
        if name not in folders:
            folders[name] = packages.write_package(tmp_path_factory.mktemp(name) / name, packages.SCENES[name]())
        return folders[name]

    return make


@pytest.fixture
def serve() -> Callable[[Path], Any]:
    """Serve a package folder: a context manager of the URL."""
    return serving


@dataclass
class Viewer:
    """Opens viewers; each is watched for requests to others, errors in scripts and breaches of the policy."""

    browser: Browser
    pages: list[Page] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def open(self, url: str, *, ready: bool = True, init: str = "", **context: Any) -> Page:
        """The page, once it has drawn; `init` runs before its scripts."""
        page = self.browser.new_page(viewport=context.pop("viewport", {"width": 960, "height": 540}), **context)
        page.set_default_timeout(20_000)
        origin = "{0.scheme}://{0.netloc}".format(urlsplit(url))
        page.on("request", lambda request: self._check(request.url, origin))
        page.on("pageerror", lambda error: self.faults.append(str(error)) if ready else None)
        page.on("console", lambda told: self.faults.append(told.text) if told.type == "error" and ready else None)
        self.pages.append(page)
        if init:
            page.add_init_script(init)
        page.goto(url)
        if ready:
            page.evaluate("viewer.then(() => null)")
        return page

    def _check(self, url: str, origin: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("blob", "data") and f"{parts.scheme}://{parts.netloc}" != origin:
            self.faults.append(f"a request left the origin: {url}")


@pytest.fixture
def viewer(browser: Browser) -> Iterator[Viewer]:
    opened = Viewer(browser)
    yield opened
    for page in opened.pages:
        page.close()
    assert opened.faults == []


@pytest.fixture(scope="session")
def capture() -> Callable[..., np.ndarray]:
    """Linear radiance [H, W, 4] of a sum of terms, as the page draws it."""

    def capture(page: Page, camera: Camera, terms: Sequence[str], width: int, height: int, finer: int) -> np.ndarray:
        data = page.evaluate(
            """async ([camera, terms, width, height, finer]) => {
                const picture = await viewer;
                picture.setTerms(terms);
                picture.setCamera(camera);
                const bytes = new Uint8Array(picture.capture(width, height, finer).buffer);
                let text = "";
                for (let at = 0; at < bytes.length; at += 32768) {
                    text += String.fromCharCode(...bytes.subarray(at, at + 32768));
                }
                return btoa(text);
            }""",
            [camera.model_dump(mode="json"), list(terms), width, height, finer],
        )
        return np.frombuffer(base64.b64decode(data), np.float32).reshape(height, width, 4)

    return capture
