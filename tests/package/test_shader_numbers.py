"""The shaders' fitted numbers are the evaluator's: one is read from the GLSL, the other imported.

HLSL and WGSL hold the same numbers as GLSL, function by function; that they do the same with them is for
`test_shader_twins` to say.
"""

import re
from collections.abc import Sequence

import numpy as np
import pytest

from kiln_workers.package import shaders
from kiln_workers.shade import algorithm


@pytest.mark.parametrize(
    ("include", "function", "variable", "vector", "fitted"),
    [
        ("sg.glsl", "lkReflection", "peak", "vec3", [row[:3] for row in algorithm.KERNEL_FIT]),
        ("sg.glsl", "lkReflection", "tail", "vec4", [row[3:] for row in algorithm.KERNEL_FIT]),
        ("sg.glsl", "lkReflection", "dullPeak", "vec3", [row[:3] for row in algorithm.DIELECTRIC_KERNEL_FIT]),
        ("sg.glsl", "lkReflection", "dullTail", "vec4", [row[3:] for row in algorithm.DIELECTRIC_KERNEL_FIT]),
        ("sg.glsl", "lkAlbedoTerms", "fit", "vec4", algorithm.ALBEDO_FIT),
    ],
)
def test_polynomials_agree(
    include: str, function: str, variable: str, vector: str, fitted: Sequence[tuple[float, ...]]
) -> None:
    """Term by term; the order of the terms' names is that of the docstrings."""
    body = re.split(rf"\b{function}\(", shaders.source(include), maxsplit=1)[1].split("\n}")[0]
    rows = re.findall(rf"\b{variable} (?:\+)?= {vector}\(([^)]*)\)(?: \* \(([^)]*)\))?;", body)
    assert len(rows) == len(fitted)
    np.testing.assert_array_equal([[float(x) for x in numbers.split(",")] for numbers, _ in rows], np.array(fitted))
    terms = ["1"] + [term.replace(" * ", "") for _, term in rows[1:]]
    if function == "lkAlbedoTerms":
        assert terms == ["1", "x", "y", "xy", "xx", "yy", "xxy", "xyy", "xxyy"]
    else:
        assert terms == ["1", "y", "x", "yy", "yx", "xx", "yyy", "yyx", "yxx", "xxx"]


NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d*)?(?:e-?\d+)?(?![\w.])")


def numbers(text: str) -> dict[str, list[float]]:
    """The numbers of each function or constant in order, without 0 and 1, of which languages need different ones."""
    code = re.sub(r"//.*", "", text)
    parts = re.findall(r"^(?:fn |\w+ )(lk\w+)(\(.*?^\})", code, flags=re.M | re.S)
    parts += re.findall(r"^[\w ]*const [\w ]*?(LK_\w+) (=.*?;)", code, flags=re.M)
    return {name: [x for x in map(float, NUMBER.findall(part)) if x not in (0.0, 1.0, -1.0)] for name, part in parts}


@pytest.mark.parametrize("language", ["hlsl", "wgsl"])
@pytest.mark.parametrize("index", range(3))
def test_twins_hold_the_same_numbers(index: int, language: str) -> None:
    own, glsl = (shaders.source(shaders.includes(of)[index]) for of in (language, "glsl"))
    expected = numbers(glsl)
    assert numbers(own) == expected and sum(map(len, expected.values())) > 1
    # Any of them, changed by as little as its last digit, would be noticed.
    code = re.sub(r"//.*", lambda comment: " " * len(comment[0]), own)
    changed = 0
    for found in NUMBER.finditer(code):
        digits = found[0]
        other = digits[:-1] + ("8" if digits[-1] == "9" else "9")
        assert numbers(code[: found.start()] + other + code[found.end() :]) != expected, digits
        changed += 1
    assert changed >= sum(map(len, expected.values()))


@pytest.mark.parametrize("language", ["hlsl", "wgsl"])
def test_twins_have_the_same_structures(language: str) -> None:
    def structures(of: str) -> dict[str, list[str]]:
        text = "".join(map(shaders.source, shaders.includes(of)))
        field = r"^  (\w+):" if of == "wgsl" else r"^  \w+ (\w+);"
        found = re.findall(r"^struct (\w+) \{\n(.*?)^\}", text, flags=re.M | re.S)
        return {name: re.findall(field, body, flags=re.M) for name, body in found}

    assert structures(language) == structures("glsl")
    assert structures("glsl")["LkSurface"] == ["normal", "baseColor", "metallic", "roughness", "dielectric"]
