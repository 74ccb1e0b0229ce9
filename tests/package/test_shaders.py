"""The shaders compile: GLSL ES 3.00 with Khronos' compiler, HLSL with Microsoft's and Khronos', WGSL with naga.

Tint's opinion of the WGSL is in `test_shader_twins`, beside the browser that it comes with.
"""

from pathlib import Path

import dxc
import native_shaders
import pytest
import shader_probes

from kiln_workers.package import shaders


@pytest.mark.parametrize("environment", [False, True])
def test_the_example_program_compiles_and_links(environment: bool, node_tools, tmp_path: Path) -> None:
    vertex, fragment = tmp_path / "surface.vert", tmp_path / "surface.frag"
    vertex.write_text(shaders.vertex_program())
    fragment.write_text(shaders.fragment_program(environment=environment))
    done = node_tools.glslang("-l", vertex, fragment)
    assert done.returncode == 0, done.stdout
    assert "WARNING" not in done.stdout


@pytest.mark.parametrize("name", shaders.includes("glsl"))
def test_each_include_needs_only_those_before_it(name: str, node_tools, tmp_path: Path) -> None:
    names = shaders.includes("glsl")
    before = names[: names.index(name) + 1]
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


ALL = ("LK_ENVIRONMENT", "LK_BASE_COLOR_MAP", "LK_METALLIC_ROUGHNESS_MAP", "LK_EMISSION_MAP")


@pytest.fixture
def hlsl(tmp_path: Path) -> Path:
    """A folder as a package's shaders/."""
    for name, text in shaders.sources().items():
        (tmp_path / name).write_text(text)
    return tmp_path


def hlsl_example(defines: tuple[str, ...]) -> str:
    names = (*shaders.includes("hlsl"), *shaders.EXAMPLES["hlsl"])
    return "".join(f"#define {define}\n" for define in defines) + shader_probes.joined(map(shaders.source, names))


@pytest.mark.parametrize("defines", [(), ALL])
@pytest.mark.parametrize(("stage", "entry", "target"), [("vert", "vertexMain", "vs"), ("frag", "pixelMain", "ps")])
def test_the_hlsl_example_compiles(
    defines: tuple[str, ...], stage: str, entry: str, target: str, native, node_tools, hlsl: Path
) -> None:
    for model in ("6_0", "6_6"):
        assert native(dxc.compile_hlsl, hlsl_example(defines), entry, f"{target}_{model}").startswith(b"DXBC")
    options = ["-D", "-V", *(f"-D{define}" for define in defines), f"-I{hlsl}", "-S", stage, "-e", entry]
    done = node_tools.glslang(*options, "-o", hlsl / "stage.spv", hlsl / "surface.hlsl")
    assert done.returncode == 0, done.stdout
    assert "WARNING" not in done.stdout


@pytest.mark.parametrize("name", shaders.includes("hlsl"))
def test_each_hlsl_file_includes_what_it_needs(name: str, node_tools, hlsl: Path) -> None:
    stage = hlsl / "stage.frag"
    stage.write_text(f'#include "{name}"\n#include "{name}"\nfloat4 main() : SV_Target {{ return 1.0; }}\n')
    done = node_tools.glslang("-D", "-V", f"-I{hlsl}", "-S", "frag", "-e", "main", "-o", hlsl / "stage.spv", stage)
    assert done.returncode == 0, done.stdout


def test_the_wgsl_example_compiles(native) -> None:
    native(native_shaders.check, wgsl_example())


def wgsl_example() -> str:
    return "".join(map(shaders.source, (*shaders.includes("wgsl"), *shaders.EXAMPLES["wgsl"])))


def test_the_other_compilers_would_notice_a_mistake(native) -> None:
    right, wrong = "lkMeanUnder(lkFetchLobe", "lkMeanUnder(nothing"
    for program in (hlsl_example(ALL), wgsl_example()):
        assert right in program
    with pytest.raises(ValueError, match="undeclared identifier 'nothing'"):
        native(dxc.compile_hlsl, hlsl_example(ALL).replace(right, wrong), "pixelMain", "ps_6_0")
    with pytest.raises(ValueError, match="no definition in scope for identifier: `nothing`"):
        native(native_shaders.check, wgsl_example().replace(right, wrong))
