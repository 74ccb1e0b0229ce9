"""Every function of the shaders, called in three languages on the same points and textures.

A probe is an expression of four numbers over the inputs of a point, written once in GLSL's spelling; `program` spells
all of them for a language and puts them into one program, which writes probe `row` of point `index`. GLSL runs as a
fragment shader (WebGL2 has no other), a pixel for each result; HLSL and WGSL as compute shaders.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from kiln_workers.package import shaders

POINTS: Final = 512
COLUMNS: Final = 16
LOBES: Final = 4
ALPHAS: Final = (0.01, 0.16, 0.49, 1.0)
MIPS: Final = 4
TEXTURES: Final = ("tLightField", "tVisibility", "tEnvironmentU", "tIrradiance", "tGgx")


def _lobe(name: str) -> list[str]:
    """All numbers of an anisotropic lobe."""
    axes = [f"vec4({name}.{axis}, 0.0)" for axis in "xyz"]
    return [*axes, f"vec4({name}.sharpness, {name}.amplitude, 0.0)"]


_PROBES: Final = {
    "lkEvaluate": ["vec4(lkEvaluate(a, v), 0.0)"],
    "lkEvaluateAnisotropic": ["vec4(lkEvaluateAnisotropic(wide, v), 0.0, 0.0, 0.0)"],
    "lkIntegral": ["vec4(lkIntegral(m), 0.0, 0.0, 0.0)"],
    "lkProductIntegral": ["vec4(lkProductIntegral(a, b), 0.0)"],
    "lkSaturated": ["vec4(lkSaturated(m), 0.0, 0.0, 0.0)"],
    "lkCap": ["vec4(lkCap(sharpness), 0.0, 0.0, 0.0)"],
    "lkReflectionLobe": _lobe("made"),
    "lkAlbedoTerms": ["vec4(lkAlbedoTerms(clamp(dot(n, o), 1e-4, 1.0), alpha), 0.0, 0.0)"],
    "lkReflection": [*_lobe("reflection.peak"), *_lobe("reflection.tail"), "vec4(reflection.tailShare, 0.0, 0.0, 0.0)"],
    "lkConvolve": ["vec4(lkConvolve(a, wide), 0.0)"],
    "lkMeanUnder": ["vec4(lkMeanUnder(a, reflection), 0.0)"],
    "lkOctahedral": ["vec4(lkOctahedral(v), 0.0, 0.0)"],
    "lkEnvironmentU": ["vec4(lkEnvironmentU(tEnvironmentU, alphas, layers, v, alpha), 0.0)"],
    "lkEnvironmentGgx": ["vec4(lkEnvironmentGgx(tGgx, mips, v, roughness), 0.0)"],
    "lkFetchLobe": [
        "vec4(fetched.axis, 0.0)",
        "vec4(fetched.sharpness, 0.0, 0.0, 0.0)",
        "vec4(fetched.amplitude, 0.0)",
    ],
    "lkLobeSum": ["vec4(lkLobeSum(tLightField, lobes, uv, v), 0.0)"],
    "lkMappedNormal": ["vec4(lkMappedNormal(n, vec4(x, handedness), texel, dielectric.y, o), 0.0)"],
    "lkF0": ["vec4(lkF0(surface), 0.0)"],
    "lkF90": ["vec4(lkF90(surface), 0.0, 0.0, 0.0)"],
    "lkDielectric": ["lkDielectric(ior, dielectric.w, tint, dielectric.x)"],
    "lkReflectance": ["vec4(lkReflectance(surface, o), 0.0)"],
    "lkSurfaceReflection": ["vec4(lkSurfaceReflection(surface, o).peak.z, 0.0)"],
    "lkInterreflection": ["vec4(lkInterreflection(tLightField, lobes, uv, surface, o), 0.0)"],
    "lkGlossyDirection": ["vec4(lkGlossyDirection(surface, o), 0.0)"],
    "lkEnvironmentUnoccluded": ["vec4(lkEnvironmentUnoccluded(surface, o, light), 0.0)"],
    "lkEnvironmentReflection": ["vec4(lkEnvironmentReflection(tVisibility, lobes, uv, surface, o, light), 0.0)"],
    "lkEnvironmentSplitSum": ["vec4(lkEnvironmentSplitSum(tVisibility, lobes, uv, surface, o, light), 0.0)"],
    "lkDiffuse": ["vec4(lkDiffuse(tIrradiance, uv, surface, o), 0.0)"],
}

ROWS: Final = [(function, expression) for function, expressions in _PROBES.items() for expression in expressions]
FUNCTIONS: Final = tuple(_PROBES)

_INPUTS: Final = f"""
int lobes = {LOBES};
int layers = {len(ALPHAS)};
float mips = {float(MIPS)};
vec3 n = given(index, 0).xyz;
float alpha = given(index, 0).w;
vec3 o = given(index, 1).xyz;
float roughness = given(index, 1).w;
vec3 v = given(index, 2).xyz;
float m = given(index, 2).w;
LkLobe a = LkLobe(given(index, 3).xyz, given(index, 3).w, given(index, 4).xyz);
LkLobe b = LkLobe(given(index, 5).xyz, given(index, 5).w, given(index, 6).xyz);
int k = int(given(index, 4).w);
vec2 uv = given(index, 7).xy;
vec2 sharpness = given(index, 7).zw;
vec3 x = given(index, 8).xyz;
vec3 y = given(index, 9).xyz;
vec3 z = given(index, 10).xyz;
LkAnisotropicLobe wide = LkAnisotropicLobe(x, y, z, sharpness, given(index, 6).w);
vec4 dielectric = given(index, 13);
LkSurface surface = LkSurface(n, given(index, 11).xyz, given(index, 11).w, roughness, dielectric);
vec3 tint = given(index, 14).xyz;
float ior = given(index, 14).w;
vec3 texel = given(index, 15).xyz;
float handedness = given(index, 15).w;
vec3 light = given(index, 12).xyz;
LkAnisotropicLobe made = lkReflectionLobe(n, x, y, z, alpha, 1.0);
float f0 = max(lkF0(surface).x, max(lkF0(surface).y, lkF0(surface).z));
LkReflection reflection = lkReflection(n, o, alpha, f0, lkF90(surface));
LkLobe fetched = lkFetchLobe(tLightField, uv, k);
"""

_ALPHAS: Final = ", ".join(map(str, ALPHAS + (1.0,) * (16 - len(ALPHAS))))

_GLSL: Final = """#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
precision highp samplerCube;
{includes}
uniform sampler2D tInputs;
uniform sampler2DArray tLightField;
uniform sampler2DArray tVisibility;
uniform sampler2DArray tEnvironmentU;
uniform sampler2D tIrradiance;
uniform samplerCube tGgx;
out vec4 result;

vec4 given(int index, int column) {{
  return texelFetch(tInputs, ivec2(column, index), 0);
}}

void main() {{
  int index = int(gl_FragCoord.x);
  int row = int(gl_FragCoord.y);
  float alphas[16] = float[16]({alphas});
{body}
}}
"""

_HLSL: Final = """{includes}
[[vk::binding(0, 0)]] StructuredBuffer<float4> inputs;
[[vk::binding(1, 0)]] RWStructuredBuffer<float4> results;
[[vk::binding(2, 0)]] SamplerState tSampler;
[[vk::binding(3, 0)]] Texture2DArray tLightField;
[[vk::binding(4, 0)]] Texture2DArray tVisibility;
[[vk::binding(5, 0)]] Texture2DArray tEnvironmentU;
[[vk::binding(6, 0)]] Texture2D tIrradiance;
[[vk::binding(7, 0)]] TextureCube tGgx;

LkLobe makeLobe(float3 axis, float sharpness, float3 amplitude) {{
  LkLobe made = {{ axis, sharpness, amplitude }};
  return made;
}}

LkAnisotropicLobe makeAnisotropicLobe(float3 x, float3 y, float3 z, float2 sharpness, float amplitude) {{
  LkAnisotropicLobe made = {{ x, y, z, sharpness, amplitude }};
  return made;
}}

LkSurface makeSurface(float3 normal, float3 baseColor, float metallic, float roughness, float4 dielectric) {{
  LkSurface made = {{ normal, baseColor, metallic, roughness, dielectric }};
  return made;
}}

float4 given(int index, int column) {{
  return inputs[index * {columns} + column];
}}

[numthreads(64, 1, 1)] void main(uint3 id : SV_DispatchThreadID) {{
  int index = id.x;
  int row = id.y;
  float alphas[16] = {{ {alphas} }};
  float4 result;
{body}
  results[row * {points} + index] = result;
}}
"""

_WGSL: Final = """{includes}
@group(0) @binding(0) var<storage, read> inputs: array<vec4f>;
@group(0) @binding(1) var<storage, read_write> results: array<vec4f>;
@group(0) @binding(2) var tSampler: sampler;
@group(0) @binding(3) var tLightField: texture_2d_array<f32>;
@group(0) @binding(4) var tVisibility: texture_2d_array<f32>;
@group(0) @binding(5) var tEnvironmentU: texture_2d_array<f32>;
@group(0) @binding(6) var tIrradiance: texture_2d<f32>;
@group(0) @binding(7) var tGgx: texture_cube<f32>;

fn given(index: i32, column: i32) -> vec4f {{
  return inputs[index * {columns} + column];
}}

@compute @workgroup_size(64) fn main(@builtin(global_invocation_id) id: vec3u) {{
  let index = i32(id.x);
  let row = i32(id.y);
  let alphas = array<f32, 16>({alphas});
  var result: vec4f;
{body}
  results[row * {points} + index] = result;
}}
"""

_TEMPLATES: Final = {"glsl": _GLSL, "hlsl": _HLSL, "wgsl": _WGSL}


def joined(texts: Iterable[str]) -> str:
    """Shader files in one, those that HLSL would include standing before."""
    return re.sub(r"^#include .*$", "", "".join(texts), flags=re.M)


def program(language: str, sources: Mapping[str, str]) -> str:
    """The probe program of one language over these shader files."""
    rows = [f"if (row == {row}) {{ result = {expression}; }}" for row, (_, expression) in enumerate(ROWS)]
    body = _spelled(language, "\n".join([*_INPUTS.strip().splitlines(), *rows]))
    return _TEMPLATES[language].format(
        includes=joined(sources[name] for name in shaders.includes(language)),
        body=body,
        alphas=_ALPHAS,
        columns=COLUMNS,
        points=POINTS,
    )


def _spelled(language: str, text: str) -> str:
    """Statements in GLSL's spelling as another language has them; textures go with their sampler there."""
    if language == "glsl":
        return text
    text = re.sub(rf"\b({'|'.join(TEXTURES)})\b", r"\1, tSampler", text)
    if language == "hlsl":
        return re.sub(r"\bLk(\w+)\(", r"make\1(", re.sub(r"\bvec([234])\b", r"float\1", text))
    text = re.sub(r"^(?:vec[234]|float|int|Lk\w+) (\w+) =", r"let \1 =", text, flags=re.M)
    return re.sub(r"\bint\(", "i32(", re.sub(r"\bvec([234])\(", r"vec\1f(", text))


@dataclass(frozen=True)
class Image:
    """A texture of halves: a plane, an array or a cube, its levels [layers, H, W, 4]."""

    dimension: str
    levels: tuple[np.ndarray, ...]


def textures() -> dict[str, Image]:
    """Small textures with texels of every kind: lobes whose axes vary, lobes without an axis, a cube map with mips."""
    random = np.random.default_rng(7)

    def array(layers: np.ndarray) -> Image:
        return Image("2d-array", (layers.astype(np.float16),))

    def colours(*shape: int) -> np.ndarray:
        return np.exp(random.normal(0.0, 1.5, (*shape, 4)))

    cube = tuple(colours(6, 16 >> mip, 16 >> mip).astype(np.float16) for mip in range(MIPS))
    made = [array(_lobes(random)), array(_lobes(random)), array(colours(len(ALPHAS), 16, 16))]
    made += [Image("2d", (colours(1, 8, 8).astype(np.float16),)), Image("cube", cube)]
    return dict(zip(TEXTURES, made, strict=True))


def _lobes(random: np.random.Generator) -> np.ndarray:
    """Lobe layers [2N, 8, 8, 4]; axes of one lobe lie within a hemisphere, those of a corner have no length."""
    layers = np.exp(random.normal(0.0, 1.0, (2 * LOBES, 8, 8, 4)))
    axes = random.normal(size=(LOBES, 1, 1, 3)) + 0.3 * random.normal(size=(LOBES, 8, 8, 3))
    layers[0::2, ..., :3] = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    layers[0::2, ..., 3] = 10.0 ** random.uniform(-2.0, 4.0, (LOBES, 8, 8))
    layers[0, :, :, 3] = 0.5  # so wide that there is some light from everywhere
    layers[2, :3, :3, :3] = 0.0
    return layers


def inputs() -> dict[str, np.ndarray]:
    """What the points of all probes are given, by the names of `_INPUTS`: float32 [P] or [P, 2 or 3]."""
    random = np.random.default_rng(11)

    def unit(*shape: int) -> np.ndarray:
        vectors = random.normal(size=(*shape, 3))
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    def logarithmic(low: float, high: float, *shape: int) -> np.ndarray:
        return np.exp(random.uniform(np.log(low), np.log(high), (POINTS, *shape)))

    def now_and_then(values: np.ndarray, every: int, value: object) -> np.ndarray:
        values[::every] = value
        return values

    n, other = unit(POINTS), unit(POINTS)
    across = np.cross(n, other)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    # From straight above to grazing, some from below; the cosine down to 1e-5.
    cosine = np.where(np.arange(POINTS) % 2, random.uniform(0.0, 1.0, POINTS), logarithmic(1e-5, 1.0))
    cosine[5::40] *= -1.0
    o = cosine[:, None] * n + np.sqrt(1.0 - cosine**2)[:, None] * across
    n[:3], o[:3] = np.eye(3), np.eye(3)
    n[3:6], o[3:6] = np.eye(3), np.eye(3)[[1, 2, 0]]
    x = np.cross(other, unit(POINTS))
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    v = unit(POINTS)
    v[:6] = [*np.eye(3), *-np.eye(3)]
    alpha = np.clip(logarithmic(0.015, 1.2), 0.02, 1.0)
    m = now_and_then(logarithmic(1e-4, 1e4), 20, 0.0)
    m[1:9] = 0.01 + np.linspace(-1e-4, 1e-4, 8)
    given = {
        "n": n,
        "o": o,
        "v": v,
        "roughness": np.sqrt(alpha),
        "m": m,
        "a_axis": now_and_then(unit(POINTS), 16, 0.0),
        "a_sharpness": now_and_then(logarithmic(1e-3, 1e4), 17, 0.0),
        "a_amplitude": logarithmic(0.01, 100.0, 3),
        "b_axis": now_and_then(unit(POINTS), 48, 0.0),
        "b_sharpness": now_and_then(logarithmic(1e-3, 1e4), 51, 0.0),
        "b_amplitude": logarithmic(0.01, 100.0, 3),
        "k": random.integers(0, LOBES, POINTS),
        "uv": random.uniform(-0.1, 1.1, (POINTS, 2)),
        "sharpness": now_and_then(logarithmic(1e-3, 1e4, 2), 19, 0.0),
        "x": x,
        "y": np.cross(other, x),
        "z": other,
        "integral": logarithmic(0.01, 100.0),
        "base_color": random.uniform(0.0, 1.0, (POINTS, 3)),
        "metallic": np.clip(random.uniform(-0.3, 1.3, POINTS), 0.0, 1.0),
        "light": logarithmic(0.001, 100.0, 3),
        # Half of them as glTF's core has it; else any, some without a specular layer.
        "dielectric": now_and_then(random.uniform(0.0, 0.9, (POINTS, 4)), 2, (0.04, 0.04, 0.04, 1.0)),
        "tint": logarithmic(0.1, 10.0, 3),
        "texel": now_and_then(random.uniform(0.0, 1.0, (POINTS, 3)), 30, 0.5),
        "handedness": np.where(np.arange(POINTS) % 3, 1.0, -1.0),
        "ior": now_and_then(random.uniform(1.0, 3.0, POINTS), 10, 1e9),
    }
    given["dielectric"][1::20] = 0.0
    # Lobes that look where the point looks, or nearly all would have no light to compare there.
    near = np.arange(POINTS) % 3 > 0
    for name, towards in (("a_axis", v), ("b_axis", given["a_axis"])):
        axis = towards + given["a_sharpness"][:, None].clip(1.0) ** -0.5 * unit(POINTS)
        axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
        given[name] = np.where((near & given[name].any(axis=-1))[:, None], axis, given[name])
    # Of two Gaussians whose product is integrated one falls off.
    endless = ~given["sharpness"].all(axis=-1)
    given["a_sharpness"][endless] = given["a_sharpness"][endless].clip(1.0)
    given["alpha"] = given["roughness"].astype(np.float32) ** 2
    return {name: values.astype(np.float32) for name, values in given.items()}


def packed(given: Mapping[str, np.ndarray]) -> np.ndarray:
    """The inputs as the programs read them: float32 [P, COLUMNS, 4]."""
    columns = [
        ("n", "alpha"),
        ("o", "roughness"),
        ("v", "m"),
        ("a_axis", "a_sharpness"),
        ("a_amplitude", "k"),
        ("b_axis", "b_sharpness"),
        ("b_amplitude", "integral"),
        ("uv", "sharpness"),
        ("x", None),
        ("y", None),
        ("z", None),
        ("base_color", "metallic"),
        ("light", None),
        ("dielectric", None),
        ("tint", "ior"),
        ("texel", "handedness"),
    ]
    out = np.zeros((POINTS, COLUMNS, 4), np.float32)
    for column, names in enumerate(columns):
        parts = [given[name].reshape(POINTS, -1) for name in names if name is not None]
        together = np.concatenate(parts, axis=1)
        out[:, column, : together.shape[1]] = together
    return out
