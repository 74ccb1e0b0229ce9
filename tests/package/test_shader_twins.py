"""GLSL, HLSL and WGSL are one algorithm: every function of each, evaluated on the same points and textures.

GLSL runs in WebGL2 and WGSL in WebGPU, both in Debian's chromium, whose WGSL compiler is Tint; WGSL by naga, the other
compiler there is, and HLSL by Microsoft's DXC run on the same software driver without a browser. The yardstick is the
result of GLSL, and for that the evaluator of `lightkiln shade` in 64 bits (`shader_reference`).
"""

import base64
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import dxc
import native_shaders
import numpy as np
import pytest
import shader_probes
import shader_reference
from playwright.sync_api import Error, Page, sync_playwright

from kiln_workers.package import shaders

SOFTWARE_GPU = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SOFTWARE_WEBGPU = ("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader")
WAYS = {"WebGL2": "glsl", "Tint": "wgsl", "naga": "wgsl", "DXC": "hlsl"}
"""What compiles and runs a program, and its language."""

BETWEEN_LANGUAGES = 1e-6
"""Largest difference from GLSL over the largest component of GLSL's result; 0 where all share a driver, as here."""

FROM_EVALUATOR = 4e-5
"""Likewise of GLSL from the evaluator: what 32 bits lose. Sharp lobes lose more (`shader_reference.rounding`)."""

Run = Callable[[str, Mapping[str, str]], np.ndarray]


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """A page of a secure origin, which WebGPU asks for."""
    with sync_playwright() as playwright:
        arguments = ["--no-sandbox", *SOFTWARE_GPU, *SOFTWARE_WEBGPU]
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=arguments)
        page = browser.new_page()
        page.route("**/*", lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"))
        page.goto("http://localhost/")
        page.add_script_tag(path=Path(__file__).parent / "shader_page.js")
        yield page
        browser.close()


@pytest.fixture(scope="module")
def given() -> dict[str, np.ndarray]:
    return shader_probes.inputs()


@pytest.fixture(scope="module")
def images() -> dict[str, shader_probes.Image]:
    return shader_probes.textures()


@pytest.fixture(scope="module")
def run(page: Page, native, given, images) -> Run:
    """What shader files compute, float32 [rows, P, 4]."""
    inputs = shader_probes.packed(given)

    def encoded(values: np.ndarray) -> str:
        return base64.b64encode(values.tobytes()).decode()

    job = {
        "points": shader_probes.POINTS,
        "rows": len(shader_probes.ROWS),
        "columns": shader_probes.COLUMNS,
        "inputs": encoded(inputs),
        "textures": {
            name: described(image) | {"levels": [*map(encoded, image.levels)]} for name, image in images.items()
        },
    }

    def run(way: str, sources: Mapping[str, str]) -> np.ndarray:
        code = shader_probes.program(WAYS[way], sources)
        if way == "DXC":
            code = native(dxc.compile_hlsl, code, "main", "cs_6_0", *dxc.SPIRV)
        if way in ("DXC", "naga"):
            return native(native_shaders.run, code, inputs, images)
        text = page.evaluate("runGlsl" if way == "WebGL2" else "runWgsl", job | {"code": code})
        return np.frombuffer(base64.b64decode(text), np.float32).reshape(job["rows"], job["points"], 4)

    return run


def described(image: shader_probes.Image) -> dict[str, object]:
    layers, height, width, _ = image.levels[0].shape
    return {"dimension": image.dimension, "width": width, "height": height, "layers": layers}


@pytest.fixture(scope="module")
def glsl(run: Run) -> np.ndarray:
    return run("WebGL2", shaders.sources())


def deviation(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Difference of vectors [..., C] over the largest component of the expected one: [...]."""
    assert np.isfinite(found).all()
    return np.abs(found - expected).max(axis=-1) / (np.abs(expected).max(axis=-1) + 1e-30)


def comparable(given: dict[str, np.ndarray], function: str) -> np.ndarray:
    """The points to compare [P]: all, but for cube maps those whose look-up reads one face only.

    The evaluator does not filter over edges; WebGL2 does, but compute shaders read garbage there on chromium's software
    driver.
    """
    if function != "lkEnvironmentGgx":
        return np.full(shader_probes.POINTS, True)
    roughness = given["roughness"].astype(np.float64)
    mip = np.ceil((shader_probes.MIPS - 1) * roughness * (2.0 - roughness))
    by_size = np.sort(np.abs(given["v"]), axis=-1)
    return by_size[:, 1] / by_size[:, 2] < 1.0 - 2.0**mip / 16.0


def differences(found: np.ndarray, glsl: np.ndarray, given: dict[str, np.ndarray]) -> dict[str, float]:
    """The largest deviation of each probe from GLSL."""
    out = {}
    for row, (function, expression) in enumerate(shader_probes.ROWS):
        points = comparable(given, function)
        out[expression] = deviation(found[row, points], glsl[row, points]).max()
    return out


def test_every_function_is_probed_and_there_in_all_languages() -> None:
    for language in shaders.EXAMPLES:
        text = "".join(shaders.source(name) for name in shaders.includes(language))
        defined = re.findall(r"^(?:fn |\w+ )(lk\w+)\(", text, flags=re.M)
        assert tuple(defined) == shader_probes.FUNCTIONS, language


@pytest.mark.parametrize("way", [way for way in WAYS if way != "WebGL2"])
def test_the_languages_agree(way: str, run: Run, glsl: np.ndarray, given) -> None:
    found = differences(run(way, shaders.sources()), glsl, given)
    assert {probe: value for probe, value in found.items() if value > BETWEEN_LANGUAGES} == {}


def test_glsl_agrees_with_the_evaluator(glsl: np.ndarray, given, images) -> None:
    expected = shader_reference.reference(given, images)
    assert set(shader_probes.FUNCTIONS) - set(expected) == {"lkReflectionLobe"}  # a part of lkReflection
    for function, wanted in expected.items():
        rows = [glsl[row] for row, (name, _) in enumerate(shader_probes.ROWS) if name == function]
        compared = comparable(given, function)
        assert compared.mean() > 0.25
        for found, values in zip(rows, wanted, strict=True):
            exact = np.asarray(values).reshape(len(found), -1)
            lost = deviation(found[:, : exact.shape[1]], exact) - shader_reference.rounding(given, function)
            assert lost[compared].max() < FROM_EVALUATOR, function
            assert (np.abs(exact).max(axis=1) > 1e-30).mean() > 0.25, function


@pytest.mark.parametrize("way", [way for way in WAYS if way != "WebGL2"])
@pytest.mark.parametrize(
    ("stem", "right", "wrong"),
    [
        ("sg", "-12.137, -6.0564)", "-12.138, -6.0564)"),
        ("sg", "1.0 - 0.5 * s", "1.0 - 0.51 * s"),
        ("environment", "(2.0 - roughness)", "(2.001 - roughness)"),
        ("environment", "p.yx", "p.xy"),
        ("sg", "28.513", "28.514"),
        ("lightkiln", "2 * index + 1", "2 * index"),
    ],
)
def test_a_mistake_in_one_language_is_noticed(
    way: str, stem: str, right: str, wrong: str, run: Run, glsl: np.ndarray, given
) -> None:
    sources = shaders.sources()
    name = f"{stem}.{WAYS[way]}"
    assert sources[name].count(right) == 1
    sources[name] = sources[name].replace(right, wrong)
    assert max(differences(run(way, sources), glsl, given).values()) > 3 * BETWEEN_LANGUAGES


def test_tint_takes_the_example(page: Page) -> None:
    program = "".join(map(shaders.source, (*shaders.includes("wgsl"), *shaders.EXAMPLES["wgsl"])))
    page.evaluate("checkExample", program)
    with pytest.raises(Error, match="unresolved call target 'lkNothing'"):
        page.evaluate("checkExample", program.replace("lkDiffuse(irradiance, ", "lkNothing(irradiance, "))
