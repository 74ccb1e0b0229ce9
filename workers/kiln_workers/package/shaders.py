"""The GLSL that a package carries: the files, and how they go together into a program.

GLSL ES has no `#include`; the files are concatenated in the order of FRAGMENT_PARTS after a version line and default
precisions (sampler2DArray has none of its own in ES 3.00).
"""

from importlib.resources import files
from typing import Final

INCLUDES: Final = ("sg.glsl", "environment.glsl", "lightkiln.glsl")
VERTEX_PARTS: Final = ("surface.vert.glsl",)
FRAGMENT_PARTS: Final = (*INCLUDES, "surface.frag.glsl")

_HEAD: Final = """#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
precision highp samplerCube;
"""


def source(name: str) -> str:
    """The text of one shader file."""
    return (files("kiln_workers.package") / "shaders" / name).read_text(encoding="utf-8")


def sources() -> dict[str, str]:
    """Every shader file of a package by its name."""
    return {name: source(name) for name in (*FRAGMENT_PARTS, *VERTEX_PARTS)}


def vertex_program() -> str:
    """The example's vertex stage, complete."""
    return _HEAD + "".join(source(name) for name in VERTEX_PARTS)


def fragment_program(*, environment: bool) -> str:
    """The example's fragment stage, complete; `environment` adds the reflections of the environment."""
    define = "#define LK_ENVIRONMENT\n" if environment else ""
    return _HEAD + define + "".join(source(name) for name in FRAGMENT_PARTS)
