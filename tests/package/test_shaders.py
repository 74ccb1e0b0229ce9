"""The shaders compile and link as GLSL ES 3.00 with Khronos' reference compiler."""

from pathlib import Path

import pytest

from kiln_workers.package import shaders


@pytest.mark.parametrize("environment", [False, True])
def test_the_example_program_compiles_and_links(environment: bool, node_tools, tmp_path: Path) -> None:
    vertex, fragment = tmp_path / "surface.vert", tmp_path / "surface.frag"
    vertex.write_text(shaders.vertex_program())
    fragment.write_text(shaders.fragment_program(environment=environment))
    done = node_tools.glslang("-l", vertex, fragment)
    assert done.returncode == 0, done.stdout
    assert "WARNING" not in done.stdout


@pytest.mark.parametrize("name", shaders.INCLUDES)
def test_each_include_needs_only_those_before_it(name: str, node_tools, tmp_path: Path) -> None:
    before = shaders.INCLUDES[: shaders.INCLUDES.index(name) + 1]
    head = shaders.vertex_program().partition("\n//")[0]
    assert head.startswith("#version 300 es\n")
    body = "".join(shaders.source(part) for part in before)
    path = tmp_path / "include.frag"
    path.write_text(f"{head}\n{body}\nout vec4 c;\nvoid main() {{ c = vec4(1.0); }}\n")
    done = node_tools.glslang(path)
    assert done.returncode == 0, done.stdout


def test_the_compiler_would_notice_a_mistake(node_tools, tmp_path: Path) -> None:
    path = tmp_path / "broken.frag"
    program = shaders.fragment_program(environment=True)
    assert "lkMeanUnder(lkFetchLobe" in program
    path.write_text(program.replace("lkMeanUnder(lkFetchLobe", "lkMeanUnder(nothing"))
    assert node_tools.glslang(path).returncode != 0
