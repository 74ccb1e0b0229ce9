"""The HLSL and WGSL examples draw what `lightkiln shade` computes, from the files of a package as an engine reads them.

The GLSL example is the viewer's, whose pictures tests/viewer holds against the same.
"""

import re
import struct
from collections.abc import Sequence
from pathlib import Path

import dxc
import native_shaders
import numpy as np
import packages
import pytest
import shader_probes
from same_picture import FINER, HEIGHT, LEAST_PSNR, WIDTH, Reference

from kiln_schemas.camera import Camera, read_camera
from kiln_workers.package import ktx2, shaders
from kiln_workers.scene.images import linear_pixels
from kiln_workers.scene.lookup import uv_matrix
from kiln_workers.scene.model import Material, Mesh, Scene, TextureRef
from kiln_workers.shade.camera import camera_frame
from kiln_workers.shade.term import WHOLE, Term

SCENES = {name: packages.SCENES[name] for name in ("cabinet", "veils", "bumps")}
WRAPS = {"repeat": "repeat", "clamp": "clamp-to-edge", "mirror": "mirror-repeat"}
LIGHT = {2: "lightfield", 3: "irradiance", 4: "visibility", 5: "environment_u"}
WHITE = shader_probes.Image("2d", (np.ones((1, 1, 1, 4), np.float16),))
MAPS = ("BASE_COLOR", "METALLIC_ROUGHNESS", "EMISSION", "NORMAL")


@pytest.fixture(scope="module", params=SCENES)
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Reference]:
    """A package and its picture by the evaluator."""
    name = request.param
    folder = packages.write_package(tmp_path_factory.mktemp("examples") / name, SCENES[name]())
    return folder, Reference.of(folder, read_camera(packages.CAMERAS[name]))


def program(language: str, defines: Sequence[str] = ()) -> str:
    """The example in one piece, with its resources where `native_shaders.draw` binds them."""
    text = shader_probes.joined(map(shaders.source, (*shaders.includes(language), *shaders.EXAMPLES[language])))
    if language == "wgsl":
        return text
    places = {"b0": (0, 0), "b1": (0, 1), "s0": (6, 0), "s1": (4, 1)}
    places |= {f"t{k}": (k + 2, 0) if k < 4 else (k - 3, 1) for k in range(7)} | {"t7": (5, 1)}
    text = re.sub(
        r"^\w+ \w+ : register\((\w+)\)",
        lambda found: "[[vk::binding({}, {})]] {}".format(*places[found[1]], found[0]),
        text,
        flags=re.M,
    )
    semantics = ["POSITION", "NORMAL", "TEXCOORD0", "TEXCOORD1", "COLOR0", "TEXCOORD2", "TEXCOORD3", "TANGENT"]
    text = re.sub(
        rf"^  (float\d \w+ : ({'|'.join(semantics)});)",
        lambda found: f"  [[vk::location({semantics.index(found[2])})]] {found[1]}",
        text,
        flags=re.M,
    )
    return "".join(f"#define {define}\n" for define in defines) + text


def view(camera: Camera, lobes: int, layers: int) -> bytes:
    """The uniforms of a view, matrices column by column, depth from 0 to 1."""
    right, up, forward = camera_frame(camera)
    rotation = np.stack([right, up, -forward])
    eye = np.asarray(camera.position)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation, -rotation @ eye
    near, far, slope = 0.01, 100.0, 1.0 / np.tan(np.radians(camera.fov_deg) / 2.0)
    projection = np.diag([slope * HEIGHT / WIDTH, slope, far / (near - far), 0.0])
    projection[2, 3], projection[3, 2] = near * far / (near - far), -1.0
    matrix = (projection @ world).T.astype(np.float32).tobytes()
    return matrix + struct.pack("<3f3i8x", *eye, lobes, lobes, layers)


def textures_of(material: Material) -> tuple[TextureRef | None, ...]:
    """Its look-ups in the order of MAPS."""
    return (
        material.base_color_texture, material.metallic_roughness_texture, material.emission_texture,
        material.normal_texture,
    )  # fmt: skip


def defines(material: Material, mesh: Mesh) -> tuple[str, ...]:
    """What an engine defines for a surface in HLSL."""
    out = ["LK_ENVIRONMENT"]
    for name, texture in zip(MAPS, textures_of(material), strict=True):
        if texture is not None:
            out.append(f"LK_{name}_MAP")
        if texture is not None and texture.uv_set > 0:
            out.append(f"LK_{name}_UV texCoord{texture.uv_set + 1}")
    out += ["LK_VERTEX_COLOR"] if mesh.colors is not None else []
    out += ["LK_MORE_TEX_COORDS"] if mesh.more_uv else []
    return (*out, "LK_BLEND") if material.is_veil else tuple(out)


def vertices(mesh: Mesh) -> np.ndarray:
    """All attributes [V, 22]; what the mesh lacks is white or 0."""
    count = len(mesh.positions)
    sets = [*mesh.uv_sets, *[np.zeros((count, 2))] * 3][:3]
    colors = np.ones((count, 4)) if mesh.colors is None else mesh.colors
    tangents = np.zeros((count, 4)) if mesh.tangents is None else mesh.tangents
    parts = (mesh.positions, mesh.normals, sets[0], mesh.lightmap_uv, colors, *sets[1:], tangents)
    return np.concatenate(parts, axis=1).astype(np.float32)


def uniforms(language: str, material: Material) -> bytes:
    """A material as the example's programs lay it out."""
    textures = textures_of(material)
    scale = 0.0 if material.normal_texture is None else material.normal_scale
    base = struct.pack("<4f4f2fI", *material.base_color, *material.emission, material.metallic, material.roughness,
                       material.alpha_cutoff or 0.0, material.double_sided)  # fmt: skip
    layers = struct.pack("<4f2f", *material.specular_color, material.specular, material.ior, material.clearcoat)
    if language == "hlsl":
        out = base + struct.pack("<f", material.transmission) + layers + struct.pack("<f4x", scale)
    else:
        sets = [0 if texture is None else texture.uv_set for texture in textures]
        out = base + struct.pack("<I", material.is_veil) + layers
        out += struct.pack("<2f4I", material.transmission, scale, *sets)
    return out + b"".join(columns(texture) for texture in textures)


def drawn(
    scene: Scene, mesh: Mesh, language: str, stages: tuple[native_shaders.Stage, native_shaders.Stage]
) -> native_shaders.Drawn:
    material = scene.materials[mesh.material]
    textures = textures_of(material)
    used = [texture for texture in textures if texture is not None]
    absent = None if language == "hlsl" else WHITE
    return native_shaders.Drawn(
        vertices(mesh),
        mesh.faces.astype(np.uint32),
        uniforms(language, material),
        tuple(absent if texture is None else image(scene, texture) for texture in textures),
        tuple(WRAPS[wrap] for wrap in (used[0].wrap if used else ("repeat", "repeat"))),
        stages,
        material.is_veil,
    )


def columns(texture: TextureRef | None) -> bytes:
    """A 3 x 3 matrix, its columns padded to 16 bytes."""
    matrix = uv_matrix(texture or TextureRef(0))
    return np.pad(matrix.T, ((0, 0), (0, 1))).astype(np.float32).tobytes()


def image(scene: Scene, texture: TextureRef) -> shader_probes.Image:
    return shader_probes.Image("2d", (linear_pixels(scene.images[texture.image])[None].astype(np.float16),))


@pytest.mark.parametrize("language", ["hlsl", "wgsl"])
def test_the_example_draws_the_evaluator_s_picture(language: str, reference: tuple[Path, Reference], native) -> None:
    folder, expected = reference
    light = {at: ktx2.read(folder / f"{name}.ktx2") for at, name in LIGHT.items()}
    alphas = np.ones(16, np.float32)
    alphas[: len(packages.ALPHAS)] = packages.ALPHAS
    shared = {0: view(expected.camera, light[2].layers // 2, len(packages.ALPHAS))}
    if language == "hlsl":
        shared[0] = shared[0] + np.pad(alphas[:, None], ((0, 0), (0, 3))).tobytes()
    else:
        shared[1] = alphas.tobytes()
    images = {
        at: shader_probes.Image("2d-array" if texture.is_array else "2d", (texture.levels[0][:, 0],))
        for at, texture in light.items()
    }
    scene = expected.package.scene
    compiled: dict[tuple[str, ...], tuple[native_shaders.Stage, native_shaders.Stage]] = {}

    def stages(mesh: Mesh) -> tuple[native_shaders.Stage, native_shaders.Stage]:
        wanted = defines(scene.materials[mesh.material], mesh) if language == "hlsl" else ()
        if wanted not in compiled:
            compiled[wanted] = _stages(language, program(language, wanted), native)
        return compiled[wanted]

    meshes = [drawn(scene, mesh, language, stages(mesh)) for mesh in scene.meshes]
    fine = native(native_shaders.draw, shared, images, meshes, (WIDTH * FINER, HEIGHT * FINER))
    picture = fine[FINER // 2 :: FINER, FINER // 2 :: FINER]
    terms = [term for term in WHOLE if term != Term.BACKGROUND]
    psnr = expected.psnr(picture, terms)
    assert psnr >= LEAST_PSNR
    # The measure notices as little as a pixel to the side.
    assert expected.psnr(np.roll(picture, 1, axis=1), terms) < LEAST_PSNR
    print(f"{language}: {psnr:.1f} dB")


def _stages(language: str, text: str, native) -> tuple[native_shaders.Stage, native_shaders.Stage]:
    if language == "wgsl":
        return native_shaders.Stage(text, "vertexMain"), native_shaders.Stage(text, "fragmentMain")
    vertex, pixel = (
        native_shaders.Stage(native(dxc.compile_hlsl, text, entry, target, *dxc.SPIRV), entry)
        for entry, target in (("vertexMain", "vs_6_0"), ("pixelMain", "ps_6_0"))
    )
    return vertex, pixel
