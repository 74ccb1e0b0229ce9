"""The shaders that a package carries in GLSL, HLSL and WGSL, and how the GLSL goes together into a program.

HLSL files include each other; the others are concatenated in the order of `includes`, GLSL after a version line and
default precisions (sampler2DArray has none of its own in ES 3.00). The three languages are kept in step by tests that
evaluate them on the same inputs.
"""

from importlib.resources import files
from typing import Final

EXAMPLES: Final = {
    "glsl": ("surface.vert.glsl", "surface.frag.glsl"),
    "hlsl": ("surface.hlsl",),
    "wgsl": ("surface.wgsl",),
}
"""By language the files of a whole program that shades a package."""

_HEAD: Final = """#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
precision highp samplerCube;
"""


def includes(language: str) -> tuple[str, ...]:
    """The files to include, each after those that it needs."""
    return tuple(f"{stem}.{language}" for stem in ("sg", "environment", "lightkiln"))


def source(name: str) -> str:
    """The text of one shader file."""
    return (files("kiln_workers.package") / "shaders" / name).read_text(encoding="utf-8")


def sources() -> dict[str, str]:
    """Every shader file of a package by its name."""
    return {name: source(name) for language in EXAMPLES for name in (*includes(language), *EXAMPLES[language])}


def vertex_program() -> str:
    """The example's vertex stage in GLSL, complete."""
    return _HEAD + source("surface.vert.glsl")


def fragment_program(*, environment: bool) -> str:
    """The example's fragment stage in GLSL, complete; `environment` adds the reflections of the environment."""
    define = "#define LK_ENVIRONMENT\n" if environment else ""
    return _HEAD + define + "".join(source(name) for name in (*includes("glsl"), "surface.frag.glsl"))
