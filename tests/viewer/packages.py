"""Packages with known light over real scenes: the packager's own writers, no rendering, so each is made in a moment.

The light is not that of the scene, which does not matter for what is compared here: two programs over the same files.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from kiln_schemas import conventions
from kiln_schemas.camera import Camera, read_camera
from kiln_schemas.manifest import Manifest, ManifestMetrics
from kiln_schemas.settings import make_settings
from kiln_schemas.tasks import FitMetrics
from kiln_workers.package import exr, ktx2, shaders
from kiln_workers.package.glb import encode_glb
from kiln_workers.package.half import lobes_to_layers, to_half
from kiln_workers.render.environment import environment_u, ggx_prefilter, panorama
from kiln_workers.scene.examples import courtyard_scene, gallery_scene
from kiln_workers.scene.model import Environment, Image, Material, Mesh, Scene, TextureRef
from kiln_workers.scene.tangents import with_tangents

SCREENSHOTS = Path("test-artifacts/viewer")
ALPHAS = (0.01, 0.16, 0.49, 1.0)


def write_package(
    folder: Path, scene: Scene, *, size: int = 32, lobes: int = 8, supercompress: bool = False, tiles: int = 1
) -> Path:
    """A package of `size`^2 texels, its lobes repeated `tiles` times in both directions."""
    (folder / "shaders").mkdir(parents=True)
    for name, text in shaders.sources().items():
        (folder / "shaders" / name).write_text(text)
    (folder / conventions.SCENE_GLB).write_bytes(encode_glb(scene))
    textures = {}

    def write(name: str, texture: ktx2.Texture, **more: object) -> None:
        ktx2.write(folder / name, texture, supercompress=supercompress and "lobes" in more)
        layers, faces, height, width = texture.levels[0].shape[:4]
        textures[name] = {"width": width, "height": height, "layers": layers, "faces": faces, **more}

    names = [conventions.LIGHT_FIELD_KTX2]
    if scene.environment is not None:
        names.append(conventions.VISIBILITY_KTX2)
    for name in names:
        layers, _ = lobes_to_layers(smooth_lobes(size, lobes, 2.0 if name == names[0] else 1.0))
        write(name, ktx2.texture_array(np.tile(layers, (1, tiles, tiles, 1)), {}), lobes=lobes)
    rows, columns = np.indices((size * tiles,) * 2) / size
    irradiance = np.stack([3.0 * columns + 0.1, 2.0 * rows + 0.1, 1.5 - np.sin(columns)], axis=-1).astype(np.float32)
    exr.write_rgb(folder / conventions.IRRADIANCE_EXR, irradiance)
    write(conventions.IRRADIANCE_KTX2, ktx2.texture_2d(opaque(irradiance), {}))
    if scene.environment is not None:
        u, integrals = environment_u(scene.environment, np.array(ALPHAS), 32, "cpu")
        about = {"alphas": list(ALPHAS), "lobe_integrals": integrals.tolist(), "normalised": False}
        write(conventions.ENVIRONMENT_U_KTX2, ktx2.texture_array(opaque(u), {}), **about)
        mips = [opaque(mip) for mip in ggx_prefilter(scene.environment, 32, 4, "cpu")]
        write(conventions.ENVIRONMENT_GGX_KTX2, ktx2.texture_cube(mips, {}))
        itself = opaque(panorama(scene.environment))[..., :3]
        exr.write_rgb(folder / conventions.ENVIRONMENT_EXR, itself)
        textures[conventions.ENVIRONMENT_EXR] = {"width": itself.shape[1], "height": itself.shape[0]}
    (folder / conventions.MANIFEST_JSON).write_text(_manifest(textures, size * tiles, lobes).model_dump_json())
    return folder


def opaque(rgb: np.ndarray) -> np.ndarray:
    """Halves [..., 4] of colours [..., 3]."""
    values, overflows = to_half(np.concatenate([rgb, np.ones((*rgb.shape[:-1], 1))], axis=-1))
    assert overflows == 0
    return values


def smooth_lobes(size: int, count: int, scale: float) -> np.ndarray:
    """Lobes [H, W, N, 7] that drift over the map and look everywhere; two maps of different scale differ in all."""
    random = np.random.default_rng(round(100 * scale))
    rows, columns = np.indices((size, size))[..., None] / size
    start = random.normal(size=(count, 3))
    turn = 2.0 * np.stack([np.sin(3.0 * rows + scale), np.cos(2.0 * columns), np.sin(2.0 * rows * columns)], axis=-1)
    lobes = np.zeros((size, size, count, 7), np.float32)
    axes = start + 0.3 * turn
    lobes[..., :3] = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    # The first is so wide that there is some light from everywhere.
    lobes[..., 3] = np.array([0.5, *random.uniform(2.0, 40.0, count - 1)]) * (1.0 + 0.3 * columns)
    lobes[..., 4:] = scale * random.uniform(size=(count, 3)) * (0.6 + 0.4 * np.cos(2.0 * rows + columns)[..., None])
    return lobes


def _manifest(textures: dict[str, dict[str, object]], resolution: int, lobes: int) -> Manifest:
    fitted = FitMetrics(log_mse=0.1, log_mse_zero=1.0, log_mse_rel=0.1, texels=1024, signal=True)
    return Manifest(
        format_version=conventions.FORMAT_VERSION,
        generator="test",
        job_id="1",
        job_name="scene",
        settings=make_settings("draft", [f"lightmap.resolution={resolution}", f"fit.lobes={lobes}"]),
        scene_hash="a" * 64,
        inputs={},
        environment=None,
        seeds={},
        exposure={},
        metrics=ManifestMetrics(
            light_field=fitted, visibility=fitted if conventions.VISIBILITY_KTX2 in textures else None
        ),
        textures=textures,
        lightmap={},
        stage_seconds={},
        overflows=0,
        versions={},
        notes=(),
        files=(),
    )


def cabinet_scene() -> Scene:
    """What the examples lack: textures of every kind and wrap, a transform, and cards seen from behind."""
    random = np.random.default_rng(5)
    smooth = np.add.outer(np.linspace(40, 220, 16), np.linspace(0, 30, 16))
    images = (
        Image("colour", np.stack([smooth, smooth.T, 255 - smooth], axis=-1).astype(np.uint8), True),
        Image("glossy", np.stack([smooth, smooth, smooth.T], axis=-1).astype(np.uint8), False),
        Image("glow", random.integers(60, 256, (4, 4, 3), dtype=np.uint8), True),
    )
    materials = (
        Material(
            "tiles",
            metallic=0.7,
            roughness=0.4,
            base_color_texture=TextureRef(0, ("repeat", "mirror"), (0.1, 0.2), (2.0, 1.5), 0.4),
        ),
        Material("worn", base_color=(0.8, 0.7, 0.6, 1.0), metallic_roughness_texture=TextureRef(1), double_sided=True),
        Material("sign", emission=(3.0, 2.0, 1.0), emission_texture=TextureRef(2, ("clamp", "clamp"))),
        Material("card", base_color=(0.2, 0.5, 0.9, 1.0), roughness=0.4),
        Material("foil", base_color=(0.9, 0.5, 0.2, 1.0), metallic=1.0, roughness=0.5, double_sided=True),
    )
    meshes = (
        _quad("floor", 0, (-2, 0, 1.5), (4, 0, 0), (0, 0, -3), (0.05, 0.05, 0.4)),
        _quad("wall", 1, (-2, 0, -1.5), (4, 0, 0), (0, 2, 0), (0.55, 0.05, 0.4)),
        _quad("sign", 2, (-1.6, 1.1, -1.2), (1, 0, 0), (0, 0.5, 0.1), (0.05, 0.55, 0.2)),
        _quad("card", 3, (0.2, 0.1, -0.4), (0.8, 0, 0.2), (0, 0.9, 0), (0.3, 0.55, 0.2)),
        _quad("back of a card", 3, (-0.5, 0.1, 0.2), (-0.8, 0, 0.2), (0, 0.7, 0), (0.55, 0.55, 0.2)),
        _quad("back of foil", 4, (1.7, 0.1, 0.4), (-0.7, 0, 0.4), (0, 0.9, 0.2), (0.05, 0.78, 0.18)),
    )
    pixels = np.linspace(0.2, 2.0, 16 * 32 * 3, dtype=np.float32).reshape(16, 32, 3)
    return Scene(meshes, materials, images, environment=Environment(pixels, 1.0, 70.0))


def veils_scene() -> Scene:
    """Vertex colours, a texture of another UV set, and panes of which two stand behind each other."""
    smooth = np.add.outer(np.linspace(40, 220, 16), np.linspace(0, 30, 16))
    images = (Image("colour", np.stack([smooth, smooth.T, 255 - smooth], axis=-1).astype(np.uint8), True),)
    materials = (
        Material("painted", base_color=(0.9, 0.8, 0.9, 1.0), metallic=0.6, roughness=0.4),
        Material("tiles", base_color_texture=TextureRef(0, uv_set=1), roughness=0.5),
        Material("tinted", base_color=(0.9, 0.3, 0.2, 0.4), roughness=0.4, blend=True, double_sided=True),
        Material("glass", base_color=(1.0, 1.0, 1.0, 1.0), roughness=0.4, transmission=0.8),
    )
    floor = _quad("floor", 0, (-2, 0, 1.5), (4, 0, 0), (0, 0, -3), (0.05, 0.05, 0.4))
    wall = _quad("wall", 1, (-2, 0, -1.5), (4, 0, 0), (0, 2, 0), (0.55, 0.05, 0.4))
    colours = np.float32([[1, 0.2, 0.2, 1], [0.2, 1, 0.2, 1], [0.2, 0.2, 1, 1], [1, 1, 1, 1]])
    square = np.float32([[0, 2], [3, 2], [3, 0], [0, 0]])
    meshes = (
        replace(floor, colors=colours),
        replace(wall, more_uv=(square,)),
        _quad("far pane", 2, (-1.2, 0.1, -0.6), (1.6, 0, 0.1), (0, 1.2, 0), (0.05, 0.55, 0.2)),
        _quad("near pane", 2, (-0.6, 0.2, 0.5), (1.4, 0, -0.1), (0, 0.9, 0), (0.3, 0.55, 0.2)),
        _quad("glass", 3, (0.9, 0.1, 0.2), (0.8, 0, 0.2), (0, 1.1, 0), (0.55, 0.55, 0.2)),
    )
    pixels = np.linspace(0.2, 2.0, 16 * 32 * 3, dtype=np.float32).reshape(16, 32, 3)
    return Scene(meshes, materials, images, environment=Environment(pixels, 1.0, 70.0))


def bumps_scene() -> Scene:
    """Normal maps (repeated, of another UV set, mirrored, on a curved surface, from behind) and dielectric layers."""
    slopes = np.sin(np.indices((16, 16)) * (2.0 * np.pi / 16.0))
    vectors = np.stack([0.6 * slopes[1], 0.6 * slopes[0], np.ones((16, 16))], axis=-1)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    images = (Image("bumps", np.round(255.0 * (0.5 + 0.5 * vectors)).astype(np.uint8), False),)
    turned = TextureRef(0, ("mirror", "mirror"), (0.1, 0.3), (2.0, -1.5), 0.4, 1)
    materials = (
        Material("cobbles", roughness=0.4, normal_texture=TextureRef(0, scale=(3.0, 2.0))),
        Material("hammered", metallic=0.8, roughness=0.4, normal_texture=turned, normal_scale=0.7),
        Material("foil", (0.9, 0.5, 0.2, 1.0), metallic=1.0, roughness=0.5, double_sided=True,
                 normal_texture=TextureRef(0)),
        Material("lacquer", (0.5, 0.05, 0.05, 1.0), roughness=0.4, clearcoat=0.9, specular=0.2),
        Material("gem", (0.1, 0.4, 0.2, 1.0), roughness=0.4, ior=2.2, specular_color=(0.6, 1.0, 1.4)),
        Material("pillar", (0.7, 0.7, 0.8, 1.0), roughness=0.5, normal_texture=TextureRef(0, scale=(2.0, 2.0))),
    )  # fmt: skip
    wall = _quad("wall", 1, (-2, 0, -1.5), (4, 0, 0), (0, 2, 0), (0.55, 0.05, 0.4))
    wall = replace(wall, more_uv=(np.float32([[0, 2], [3, 2], [3, 0], [0, 0]]),))
    meshes = (
        _quad("floor", 0, (-2, 0, 1.5), (4, 0, 0), (0, 0, -3), (0.05, 0.05, 0.4)),
        wall,
        _quad("back of foil", 2, (1.7, 0.1, 0.4), (-0.7, 0, 0.4), (0, 0.9, 0.2), (0.05, 0.78, 0.18)),
        _quad("lacquer", 3, (0.0, 0.1, -0.4), (0.8, 0, 0.2), (0, 0.9, 0), (0.3, 0.55, 0.2)),
        _quad("gem", 4, (-1.6, 0.2, -0.6), (0.7, 0, 0.2), (0, 0.8, 0), (0.05, 0.55, 0.2)),
        _pillar("pillar", 5, (-0.5, 0.0, 0.3), 0.3, 1.2, (0.55, 0.55, 0.3)),
    )
    pixels = np.linspace(0.2, 2.0, 16 * 32 * 3, dtype=np.float32).reshape(16, 32, 3)
    return with_tangents(Scene(meshes, materials, images, environment=Environment(pixels, 1.0, 70.0)))


def _pillar(name: str, material: int, foot, radius: float, height: float, cell) -> Mesh:
    """The front half of a round pillar, its normals smooth and its coordinates mirrored at the middle."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 17)
    normals = np.stack([np.sin(angle), np.zeros(17), np.cos(angle)], axis=1)
    positions = np.concatenate([foot + radius * normals, foot + radius * normals + (0, height, 0)])
    pair = np.array([[0, 1, 18], [0, 18, 17]], np.int32)
    faces = (np.arange(16, dtype=np.int32)[:, None, None] + pair).reshape(-1, 3)
    along = np.linspace(0.0, 1.0, 17)
    uv = np.stack([np.tile(2.0 * np.abs(along - 0.5), 2), np.repeat([1.0, 0.0], 17)], axis=1)
    lightmap = np.array(cell[:2]) + cell[2] * np.stack([np.tile(along, 2), np.repeat([0.0, 1.0], 17)], axis=1)
    arrays = (positions, np.tile(normals, (2, 1)))
    return Mesh(
        name, *(x.astype(np.float32) for x in arrays), faces, material, *(np.float32(x) for x in (uv, lightmap))
    )


def room_scene() -> Scene:
    """A closed room of 4 x 2.5 x 6 m with a solid block in its middle; its walls are seen from inside only."""
    walls = (
        ("floor", (0, 0, 6), (4, 0, 0), (0, 0, -6)),
        ("ceiling", (0, 2.5, 0), (4, 0, 0), (0, 0, 6)),
        ("back", (0, 0, 0), (4, 0, 0), (0, 2.5, 0)),
        ("front", (4, 0, 6), (-4, 0, 0), (0, 2.5, 0)),
        ("left", (0, 0, 6), (0, 0, -6), (0, 2.5, 0)),
        ("right", (4, 0, 0), (0, 0, 6), (0, 2.5, 0)),
    )
    return Scene(_placed((*walls, *block((1.6, 0, 2.6), (0.8, 1.2, 0.8)))), _three_materials())


def block_scene() -> Scene:
    """A solid block and nothing else."""
    return Scene(_placed(block((-1, 3, 5), (2, 1, 1))), _three_materials())


def block(corner, size) -> tuple[tuple[str, tuple, tuple, tuple], ...]:
    """The six sides of a solid block, each as name, corner, u and v."""
    (x, y, z), (w, h, d) = corner, size
    return (
        ("block front", (x, y, z + d), (w, 0, 0), (0, h, 0)),
        ("block back", (x + w, y, z), (-w, 0, 0), (0, h, 0)),
        ("block right", (x + w, y, z + d), (0, 0, -d), (0, h, 0)),
        ("block left", (x, y, z), (0, 0, d), (0, h, 0)),
        ("block top", (x, y + h, z + d), (w, 0, 0), (0, 0, -d)),
        ("block bottom", (x, y, z), (w, 0, 0), (0, 0, d)),
    )


def _placed(quads) -> tuple[Mesh, ...]:
    """Quads with a cell of the light map each."""
    return tuple(
        _quad(name, k % 3, corner, u, v, (0.02 + 0.25 * (k % 4), 0.02 + 0.33 * (k // 4), 0.2))
        for k, (name, corner, u, v) in enumerate(quads)
    )


def _three_materials() -> tuple[Material, ...]:
    colours = ((0.8, 0.75, 0.7), (0.5, 0.6, 0.8), (0.7, 0.4, 0.3))
    return tuple(Material(f"paint {k}", base_color=(*colour, 1.0), roughness=0.6) for k, colour in enumerate(colours))


def _quad(name: str, material: int, corner, u, v, cell) -> Mesh:
    """A quad corner, corner + u, corner + u + v, corner + v, seen from the side of u x v; `cell` is (u, v, side)."""
    corner, u, v = (np.asarray(x, np.float64) for x in (corner, u, v))
    positions = np.stack([corner, corner + u, corner + u + v, corner + v]).astype(np.float32)
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    lightmap_uv = (np.array(cell[:2]) + cell[2] * square).astype(np.float32)
    return Mesh(name, positions, np.tile(normal, (4, 1)).astype(np.float32), faces, material, square, lightmap_uv)


def courtyard() -> Scene:
    """With a sky whose sun fits a half."""
    scene = courtyard_scene()
    assert scene.environment is not None
    return replace(scene, environment=Environment(np.minimum(scene.environment.pixels, 50.0)[::8, ::8].copy()))


SCENES = {
    "gallery": gallery_scene,
    "courtyard": courtyard,
    "cabinet": cabinet_scene,
    "veils": veils_scene,
    "bumps": bumps_scene,
}
CAMERAS = {
    "gallery": "0.5,2.6,8.5:0,1,-1:42",
    "courtyard": "3,4,9:0,1,0:45",
    "cabinet": "0.4,1.6,4.2:0,0.7,-0.5:45",
    "veils": "0.4,1.6,4.2:0,0.7,-0.5:45",
    "bumps": "0.4,1.6,4.2:0,0.7,-0.5:45",
}


def camera(name: str) -> Camera:
    return read_camera(CAMERAS[name])
