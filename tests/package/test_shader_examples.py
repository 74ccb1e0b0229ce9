"""The HLSL and WGSL examples draw what `lightkiln shade` computes, from the files of a package as an engine reads them.

The GLSL example is the viewer's, whose pictures tests/viewer holds against the same.
"""

import re
import struct
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
from kiln_workers.scene.model import Mesh, Scene, TextureRef
from kiln_workers.shade.camera import camera_frame
from kiln_workers.shade.term import WHOLE, Term

CAMERA = read_camera(packages.CAMERAS["cabinet"])
WRAPS = {"repeat": "repeat", "clamp": "clamp-to-edge", "mirror": "mirror-repeat"}
LIGHT = {2: "lightfield", 3: "irradiance", 4: "visibility", 5: "environment_u"}
WHITE = shader_probes.Image("2d", (np.ones((1, 1, 1, 4), np.float16),))
DEFINES = ("LK_ENVIRONMENT", "LK_BASE_COLOR_MAP", "LK_METALLIC_ROUGHNESS_MAP", "LK_EMISSION_MAP")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packages.write_package(tmp_path_factory.mktemp("examples") / "cabinet", packages.cabinet_scene())


@pytest.fixture(scope="module")
def reference(folder: Path) -> Reference:
    return Reference.of(folder, CAMERA)


def program(language: str) -> str:
    """The example in one piece, with its resources where `native_shaders.draw` binds them."""
    text = shader_probes.joined(map(shaders.source, (*shaders.includes(language), *shaders.EXAMPLES[language])))
    if language == "wgsl":
        return text
    places = {"b0": (0, 0), "b1": (0, 1), "s0": (6, 0), "s1": (4, 1)}
    places |= {f"t{k}": (k + 2, 0) if k < 4 else (k - 3, 1) for k in range(7)}
    return "".join(f"#define {define}\n" for define in DEFINES) + re.sub(
        r"^\w+ \w+ : register\((\w+)\)",
        lambda found: "[[vk::binding({}, {})]] {}".format(*places[found[1]], found[0]),
        text,
        flags=re.M,
    )


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


def drawn(scene: Scene, mesh: Mesh) -> native_shaders.Drawn:
    material = scene.materials[mesh.material]
    textures = (material.base_color_texture, material.metallic_roughness_texture, material.emission_texture)
    used = [texture for texture in textures if texture is not None]
    numbers = (*material.emission, material.metallic, material.roughness, material.alpha_cutoff or 0.0)
    uv = np.zeros_like(mesh.lightmap_uv) if mesh.uv is None else mesh.uv
    return native_shaders.Drawn(
        np.concatenate([mesh.positions, mesh.normals, uv, mesh.lightmap_uv], axis=1).astype(np.float32),
        mesh.faces.astype(np.uint32),
        struct.pack("<4f6fI4x", *material.base_color, *numbers, material.double_sided)
        + b"".join(columns(texture) for texture in textures),
        tuple(WHITE if texture is None else image(scene, texture) for texture in textures),
        tuple(WRAPS[wrap] for wrap in (used[0].wrap if used else ("repeat", "repeat"))),
    )


def columns(texture: TextureRef | None) -> bytes:
    """A 3 x 3 matrix, its columns padded to 16 bytes."""
    matrix = uv_matrix(texture or TextureRef(0))
    return np.pad(matrix.T, ((0, 0), (0, 1))).astype(np.float32).tobytes()


def image(scene: Scene, texture: TextureRef) -> shader_probes.Image:
    return shader_probes.Image("2d", (linear_pixels(scene.images[texture.image])[None].astype(np.float16),))


@pytest.mark.parametrize("language", ["hlsl", "wgsl"])
def test_the_example_draws_the_evaluator_s_picture(language: str, folder: Path, reference: Reference, native) -> None:
    text = program(language)
    if language == "hlsl":
        entries = (("vertexMain", "vs_6_0"), ("pixelMain", "ps_6_0"))
        stages = tuple(native_shaders.Stage(native(dxc.compile_hlsl, text, *of, *dxc.SPIRV), of[0]) for of in entries)
    else:
        stages = tuple(native_shaders.Stage(text, entry) for entry in ("vertexMain", "fragmentMain"))
    light = {at: ktx2.read(folder / f"{name}.ktx2") for at, name in LIGHT.items()}
    alphas = np.ones(16, np.float32)
    alphas[: len(packages.ALPHAS)] = packages.ALPHAS
    uniforms = {0: view(CAMERA, light[2].layers // 2, len(packages.ALPHAS))}
    if language == "hlsl":
        uniforms[0] = uniforms[0] + np.pad(alphas[:, None], ((0, 0), (0, 3))).tobytes()
    else:
        uniforms[1] = alphas.tobytes()
    scene = reference.package.scene
    images = {
        at: shader_probes.Image("2d-array" if texture.is_array else "2d", (texture.levels[0][:, 0],))
        for at, texture in light.items()
    }
    meshes = [drawn(scene, mesh) for mesh in scene.meshes]
    fine = native(native_shaders.draw, stages, uniforms, images, meshes, (WIDTH * FINER, HEIGHT * FINER))
    picture = fine[FINER // 2 :: FINER, FINER // 2 :: FINER]
    terms = [term for term in WHOLE if term != Term.BACKGROUND]
    psnr = reference.psnr(picture, terms)
    assert psnr >= LEAST_PSNR
    # The measure notices as little as a pixel to the side.
    assert reference.psnr(np.roll(picture, 1, axis=1), terms) < LEAST_PSNR
    print(f"{language}: {psnr:.1f} dB")
