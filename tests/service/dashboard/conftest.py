"""Debian's chromium with the dashboard open, and a bake whose light fields are known without rendering."""

import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from kiln_schemas.settings import Function, make_settings
from kiln_schemas.tasks import Tile
from kiln_workers.package import ktx2
from kiln_workers.package.half import as_stored, lobes_to_layers
from kiln_workers.scene.texel_map import TexelMap, pack_texel_map
from kiln_workers.sphere.gaussian import evaluate
from kiln_workers.sphere.octahedral import pixel_directions
from kiln_workers.store.light_field import LightFieldStore

expect.set_options(timeout=60_000)  # milliseconds: a last resort, no bound on the machine's speed

SCREENSHOTS = Path("test-artifacts/dashboard")
NODE = Path(__file__).parent / "node"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        yield browser
        browser.close()


@dataclass
class Dashboard:
    """Opens pages, signed in; each is watched for requests to others, errors in scripts and breaches of the policy."""

    browser: Browser
    url: str
    token: str
    pages: list[Page]
    faults: list[str]

    def open(self, path: str, token: str | None = None, **context: Any) -> Page:
        """A page for somebody who has signed in."""
        page = self.stranger(**context)
        page.goto(f"{self.url}/login?next={path}")
        page.fill("#token", token or self.token)
        page.press("#token", "Enter")
        page.wait_for_url(self.url + path)
        return page

    def stranger(self, **context: Any) -> Page:
        """A page before any sign-in."""
        page = self.browser.new_page(viewport=context.pop("viewport", {"width": 1280, "height": 900}), **context)
        page.set_default_timeout(8000)
        page.on("request", self._check_request)
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.on("console", lambda told: self.faults.append(told.text) if "Content Security" in told.text else None)
        self.pages.append(page)
        return page

    def _check_request(self, request: Any) -> None:
        parts = urlsplit(request.url)
        if parts.scheme in ("http", "https", "ws", "wss") and f"{parts.scheme}://{parts.netloc}" != self.url:
            self.faults.append(f"a request left the origin: {request.url}")


@pytest.fixture
def dashboard(browser: Browser, home: Any) -> Iterator[Dashboard]:
    """The dashboard of the test's coordinator; fails where a page had a fault."""
    dashboard = Dashboard(browser, home.url, home.token, [], [])
    yield dashboard
    for page in dashboard.pages:
        page.context.close()
    assert dashboard.faults == []


@pytest.fixture(scope="session")
def axe(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Page], list[str]]:
    """Serious findings of axe-core on a page: rule, and the element at fault."""
    folder = tmp_path_factory.mktemp("axe")
    shutil.copy(NODE / "package.json", folder)
    command = ["npm", "install", "--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, f"npm could not install axe-core:\n{done.stderr}"
    source = (folder / "node_modules/axe-core/axe.min.js").read_text()

    def check(page: Page) -> list[str]:
        page.evaluate(source)
        serious = []
        for scheme in ("dark", "light"):
            page.emulate_media(color_scheme=scheme)
            found = page.evaluate("axe.run()")
            assert len(found["passes"]) > 10, "axe has checked nothing"
            bad = [finding for finding in found["violations"] if finding["impact"] in ("serious", "critical")]
            serious += [f"{scheme}, {finding['id']}: {finding['nodes'][0]['html'][:200]}" for finding in bad]
        return serious

    return check


@dataclass
class KnownBake:
    """Four tiles in the first eight rows of a draft's light map; every texel's light field is that of its lobes."""

    home: Any
    store: LightFieldStore
    texel_map: str
    lobes: np.ndarray  # [32, 32, 8, 7], as textures hold them
    images: np.ndarray  # [32, 32, R, R, 3]
    errors: np.ndarray  # [32, 32]

    def render(self, tile: dict[str, int]) -> None:
        """What a worker does before it commits the tile."""
        place = Tile.model_validate(tile)
        at = np.s_[place.row : place.row + 8, place.column : place.column + 8]
        inside = np.flatnonzero(self.state[at].reshape(-1) == 1)
        images = self.images[at].reshape(64, *self.images.shape[2:])[inside]
        irradiance = np.tile(np.float32([3.0, 1.0, 0.2]), (len(inside), 1))
        self.store.write_tile(place, inside, images, None, irradiance)
        half = images.shape[1] // 2
        self.store.write_between(place, inside[:1], np.zeros((1, 3, half, half, 3), np.float16))

    def irradiance(self, row: int, column: int) -> np.ndarray:
        """[8, 8, 3] of a tile, as it is stored."""
        tile = Tile(row=row, column=column, size=8, texels=1)
        return self.store.read_irradiance([tile])[row : row + 8, column : column + 8]

    @property
    def state(self) -> np.ndarray:
        """[32, 32]: the first eight rows but for a gutter every eighth column."""
        state = np.zeros((32, 32), np.uint8)
        state[:8] = 1
        state[:, 7::8] = 0
        return state

    def artifacts(self, folder: Path) -> list[dict[str, Any]]:
        """The package's files that the page reads."""
        layers, _ = lobes_to_layers(self.lobes)
        ktx2.write(folder / "lightfield.ktx2", ktx2.texture_array(layers, {}), supercompress=True)
        told = np.zeros((32, 32, 4), np.float16)
        told[..., 0], told[..., 3] = self.errors, self.state
        ktx2.write(folder / "errors.ktx2", ktx2.texture_2d(told, {}))
        (folder / "report.html").write_text("<!doctype html><title>report</title><script>document.title='ran'</script>")
        kinds = {".ktx2": "image/ktx2", ".html": "text/html; charset=utf-8"}
        return [
            {
                "name": file.name,
                "sha256": self.home.upload(file.read_bytes()),
                "size": file.stat().st_size,
                "media_type": kinds[file.suffix],
            }
            for file in sorted(folder.iterdir())
        ]


@pytest.fixture
def known_bake(home: Any) -> Callable[[str], KnownBake]:
    """Make one for a job."""

    def make(job_id: str) -> KnownBake:
        settings = make_settings("draft")
        side = settings.render.image_size
        rng = np.random.default_rng(3)
        lobes = np.zeros((32, 32, 8, 7), np.float32)
        axes = rng.normal(size=(32, 32, 8, 3))
        lobes[..., :3] = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
        lobes[..., 3] = rng.uniform(2.0, 30.0, (32, 32, 8))
        lobes[..., 4:] = rng.uniform(0.0, 2.0, (32, 32, 8, 3))
        lobes = as_stored(lobes)
        directions = pixel_directions(side)
        normal = np.broadcast_to(np.float32([0.0, 0.6, 0.8]), (32, 32, 3))
        images = np.zeros((32, 32, side, side, 3))
        lit = evaluate(directions.reshape(-1, 3), lobes[:8].astype(np.float64)).reshape(8, 32, side, side, 3)
        images[:8] = lit * (directions @ np.array([0.0, 0.6, 0.8]) > 0.0)[..., None]
        store_url = home.sql("SELECT store_url FROM jobs WHERE id = %s", job_id)[0]["store_url"]
        store = LightFieldStore.create(
            store_url,
            shape=(32, 32),
            image_size=side,
            tile=8,
            functions=[Function.LIGHT_FIELD],
            between=True,
            attributes={},
        )
        bake = KnownBake(home, store, "", lobes, images.astype(np.float16), np.zeros((32, 32)))
        plain = np.zeros((32, 32), np.float32)
        texel_map = TexelMap(
            state=bake.state,
            position=np.zeros((32, 32, 3), np.float32),
            normal=np.ascontiguousarray(normal),
            shading_normal=np.ascontiguousarray(normal),
            alpha=plain,
            texel_size=plain,
            mesh=np.zeros((32, 32), np.int32),
            chart=np.zeros((32, 32), np.int32),
        )
        bake.texel_map = home.upload(pack_texel_map(texel_map))
        bake.errors = np.float16(0.001) * (1.0 + np.arange(1024).reshape(32, 32) % 32)
        return bake

    return make


@pytest.fixture
def job(home: Any) -> str:
    return str(home.submit()["id"])


@pytest.fixture
def rendered(home: Any, job: str, known_bake: Callable[[str], KnownBake]) -> KnownBake:
    """The job with two of four tiles rendered."""
    bake, worker = known_bake(job), home.worker()
    worker.finish(worker.must_claim(), tiles=4, texel_map=bake.texel_map)
    for _ in range(2):
        claim = worker.must_claim("render")
        bake.render(claim["payload"]["tile"])
        worker.finish(claim)
    return bake


@pytest.fixture(scope="session")
def screenshot() -> Callable[[Page, str], None]:
    """Keep the page as it is, in both schemes, on a desk and on a phone, for people to look at."""
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)

    def take(page: Page, name: str) -> None:
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            for device, size in (("desktop", (1280, 900)), ("phone", (390, 800))):
                page.set_viewport_size({"width": size[0], "height": size[1]})
                page.wait_for_timeout(60)
                page.screenshot(path=SCREENSHOTS / f"{name}-{scheme}-{device}.png", full_page=True)
        page.emulate_media(color_scheme="light")
        page.set_viewport_size({"width": 1280, "height": 900})

    return take
