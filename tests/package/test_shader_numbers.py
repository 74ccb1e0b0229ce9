"""The shaders' fitted numbers are the evaluator's: one is read from the GLSL, the other imported."""

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
        ("lightkiln.glsl", "lkReflectance", "fit", "vec4", algorithm.ALBEDO_FIT),
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
    if function == "lkReflectance":
        assert terms == ["1", "x", "y", "xy", "xx", "yy", "xxy", "xyy", "xxyy"]
    else:
        assert terms == ["1", "y", "x", "yy", "yx", "xx", "yyy", "yyx", "yxx", "xxx"]
