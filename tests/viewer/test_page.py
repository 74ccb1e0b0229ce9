"""The page in a browser: controls change the picture, nothing leaves the origin, faults are said in sentences.

`Viewer` fails a test whose page logs an error (a breach of the Content-Security-Policy is one) or asks another origin.
"""

import json

import numpy as np
import OpenImageIO as oiio
import packages
import pytest
import torch
from packages import SCREENSHOTS
from playwright.sync_api import Page

from kiln_schemas import conventions
from kiln_schemas.manifest import Manifest, ReferenceView
from kiln_workers.package import colour, png
from kiln_workers.shade.gbuffer import render_gbuffer
from kiln_workers.shade.package import ShadePackage
from kiln_workers.shade.picture import shade

SMALL = {"width": 420, "height": 260}


def canvas(page: Page) -> str:
    """The canvas as it is once drawn."""
    return page.evaluate(
        "viewer.then((picture) => { picture.finish(); return picture.renderer.domElement.toDataURL(); })"
    )


def change(page: Page, name: str, value: object) -> str:
    """Set a control as a person does, wait for the frame; the canvas."""
    page.evaluate(
        """async ([name, value]) => {
            const control = document.querySelector(`[name=${name}]`);
            if (control.type === "checkbox") control.checked = value; else control.value = value;
            control.dispatchEvent(new Event("input", { bubbles: true }));
            await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
        }""",
        [name, value],
    )
    return canvas(page)


def test_every_control_changes_the_picture(made, serve, viewer) -> None:
    with serve(made("courtyard")) as url:
        page = viewer.open(f"{url}#camera={packages.CAMERAS['courtyard']}", viewport=SMALL)
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        seen = [canvas(page)]
        for name, value in {
            "exposure": "1",
            "tone": "neutral",
            "lobes": "3",
            "override": True,
            "roughness": "0.9",
            "grid": True,
            "occlusion": False,
        }.items():
            seen.append(change(page, name, value))
            assert seen[-1] != seen[-2], name
        page.focus("#picture")
        for key in ("ArrowLeft", "w"):
            page.keyboard.press(key)
            page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            seen.append(canvas(page))
            assert seen[-1] != seen[-2], key
        page.evaluate("viewer.then((picture) => picture.pointAt(0, -0.5))")
        assert page.evaluate("viewer.then((picture) => picture.at.length)") == 2
        assert change(page, "sphere", True) != seen[-1]
        page.screenshot(path=SCREENSHOTS / "controls.png")
        with page.expect_download() as saved:
            page.evaluate("document.getElementById('save').click()")
        assert saved.value.suggested_filename == "courtyard.png"
        assert saved.value.path().read_bytes().startswith(b"\x89PNG")


def test_a_zstd_package_draws_the_same(serve, viewer, capture, tmp_path) -> None:
    scene = packages.cabinet_scene()
    pictures = []
    for compressed in (False, True):
        folder = packages.write_package(tmp_path / str(compressed), scene, supercompress=compressed)
        with serve(folder) as url:
            page = viewer.open(url, viewport=SMALL)
            camera = packages.camera("cabinet")
            pictures.append(capture(page, camera, ["interreflection", "environment"], 48, 27, 1))
    assert pictures[0].max() > 0.1
    np.testing.assert_array_equal(*pictures)


def test_compressed_textures_that_arrive_together_are_all_decoded(serve, viewer, tmp_path) -> None:
    """The decoder of Zstandard is loaded once, and those that come meanwhile wait for it."""
    folder = packages.write_package(tmp_path / "package", packages.cabinet_scene(), supercompress=True)
    with serve(folder) as url:
        page = viewer.open(url, viewport=SMALL)
        described = json.loads((folder / conventions.MANIFEST_JSON).read_text())["textures"][
            conventions.LIGHT_FIELD_KTX2
        ]
        told = page.evaluate(
            """(described) => new Promise((done) => {
                const worker = new Worker("/static/viewer/page/decode.js", { type: "module" });
                const told = [];
                worker.onmessage = ({ data }) => told.push(data.error ?? data.texture.layers) === 6 && done(told);
                const { href: url } = new URL("/package/lightfield.ktx2", location);
                for (let name = 0; name < 6; name += 1) worker.postMessage({ name, url, described });
            })""",
            described,
        )
    assert told == [16] * 6


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("webgl", "has no WebGL2"),
        ("version", "format version 99"),
        ("texture", "lightfield.ktx2 cannot be read"),
        ("larger", "it has 16384 as its width; the manifest says 8"),
        ("declared", "lightfield.ktx2 has 16384 as its width; the settings of the bake allow 1 to 8"),
    ],
)
def test_what_cannot_work_is_said(fault, sentence, serve, viewer, tmp_path) -> None:
    folder = packages.write_package(tmp_path / "package", packages.cabinet_scene(), size=8, lobes=2)
    init = ""
    if fault == "webgl":
        init = "HTMLCanvasElement.prototype.getContext = () => null"
    elif fault == "version":
        manifest = json.loads((folder / conventions.MANIFEST_JSON).read_text())
        (folder / conventions.MANIFEST_JSON).write_text(json.dumps(manifest | {"format_version": 99}))
    elif fault == "larger":
        path = folder / conventions.LIGHT_FIELD_KTX2
        data = path.read_bytes()
        path.write_bytes(data[:20] + (16384).to_bytes(4, "little") + data[24:])
    elif fault == "declared":
        manifest = json.loads((folder / conventions.MANIFEST_JSON).read_text())
        manifest["textures"][conventions.LIGHT_FIELD_KTX2]["width"] = 16384
        (folder / conventions.MANIFEST_JSON).write_text(json.dumps(manifest))
    else:
        path = folder / conventions.LIGHT_FIELD_KTX2
        path.write_bytes(path.read_bytes()[:500])
    with serve(folder) as url:
        page = viewer.open(url, ready=False, init=init, viewport=SMALL)
        page.wait_for_selector("#status[data-failed]")
        assert sentence in page.inner_text("#status")


def test_a_package_with_older_shaders_says_which_switches_it_lacks(serve, viewer, capture, tmp_path) -> None:
    """Those controls are off, and the picture is the same as with newer shaders and all terms."""
    pictures, camera = [], packages.camera("cabinet")
    for name in ("new", "old"):
        folder = packages.write_package(tmp_path / name, packages.cabinet_scene())
        shader = folder / "shaders" / "surface.frag.glsl"
        text = shader.read_text()
        if name == "old":
            for declared, constant in (
                ("uniform vec4 uTerms;", "const vec4 uTerms = vec4(1.0);"),
                ("uniform bool uOcclusion;", "const bool uOcclusion = true;"),
                ("uniform float uRoughnessBias;", "const float uRoughnessBias = 0.0;"),
            ):
                assert declared in text
                text = text.replace(declared, constant)
        shader.write_text(text)
        with serve(folder) as url:
            page = viewer.open(url, viewport=SMALL)
            off = page.eval_on_selector_all("#controls :disabled", "controls => controls.map(({ name }) => name)")
            note = page.inner_text("#lacking")
            pictures.append(capture(page, camera, ["emission", "diffuse", "interreflection", "environment"], 48, 27, 1))
            if name == "old":
                page.screenshot(path=SCREENSHOTS / "older_shaders.png")
                assert note.endswith(
                    "older than this viewer and have no switches for: single terms, visibility, one roughness."
                )
                assert off == [*["term"] * 4, "occlusion", "override", "roughness"]
            else:
                assert (off, note) == ([], "")
    assert pictures[0].max() > 0.1
    np.testing.assert_array_equal(*pictures)


def test_phone_and_dark(made, serve, viewer) -> None:
    with serve(made("cabinet")) as url:
        page = viewer.open(url, viewport={"width": 320, "height": 480}, color_scheme="dark")
        assert page.evaluate("document.documentElement.scrollWidth") <= 320
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(18, 22, 28)"
        page.screenshot(path=SCREENSHOTS / "phone_dark.png")


def test_the_reference_lies_over_the_same_picture(serve, viewer, tmp_path) -> None:
    """The reference is the evaluator's own picture here, so both sides of the slider look alike wherever it is."""
    folder = packages.write_package(tmp_path / "package", packages.cabinet_scene())
    camera = packages.camera("cabinet")
    package = ShadePackage.read(folder, torch.device("cpu"))
    picture = shade(package, render_gbuffer(package.scene, camera, 480, 270, 2, "cpu"))
    white = colour.white_point(picture)
    (folder / "gates").mkdir()
    (folder / "gates" / "front_reference.png").write_bytes(png.encode(colour.tone_map(picture, white)))
    manifest = Manifest.model_validate_json((folder / conventions.MANIFEST_JSON).read_text())
    views = {"front": ReferenceView(camera=camera, white=white)}
    (folder / conventions.MANIFEST_JSON).write_text(manifest.model_copy(update={"views": views}).model_dump_json())
    with serve(folder) as url:
        page = viewer.open(url, viewport={"width": 730, "height": 320})
        seen = []
        for split in ("100", "0", "50"):
            change(page, "view", "front")
            change(page, "split", split)
            page.wait_for_function("document.querySelector('#reference img').complete")
            path = SCREENSHOTS / f"compared_{split}.png"
            page.locator(".stage").screenshot(path=path)
            seen.append(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)[..., :3].astype(np.float64))
    assert seen[0].shape[0] > 200
    assert seen[0].std() > 0.1
    for other in seen[1:]:
        assert np.any(seen[0] != other)
        assert 10.0 * np.log10(1.0 / np.mean(np.square(seen[0] - other))) > 28.0
    # A reference from elsewhere would be noticed.
    assert 10.0 * np.log10(1.0 / np.mean(np.square(seen[0] - np.roll(seen[1], 8, axis=1)))) < 28.0
