"""One quad with everything that the scene model has for a surface."""

import numpy as np

from kiln_workers.scene.model import Image, Material, Mesh, Scene, TextureRef

SQUARE = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def rich_scene() -> Scene:
    """One quad with everything that the scene model has for a surface."""
    random = np.random.default_rng(3)
    pixels = random.integers(0, 256, (4, 4, 4), dtype=np.uint8)
    images = (Image("colour", pixels, True), Image("data", pixels, False))
    material = Material(
        "rich",
        base_color=(0.5, 0.25, 1.0, 0.75),
        base_color_texture=TextureRef(0, uv_set=1),
        metallic_roughness_texture=TextureRef(1, ("clamp", "mirror"), (0.5, 0.25), (2.0, 3.0), 0.5, 2),
        emission=(1.0, 0.5, 0.25),
        emission_texture=TextureRef(0),
        double_sided=True,
        blend=True,
        transmission=0.5,
        transmission_texture=TextureRef(1, uv_set=1),
        ior=1.25,
        specular=0.5,
        specular_color=(0.5, 2.0, 1.0),
        clearcoat=0.25,
        normal_texture=TextureRef(1, uv_set=2),
        normal_scale=0.5,
        occlusion_texture=TextureRef(1),
        occlusion_strength=0.5,
    )
    uv = [random.uniform(size=(4, 2)).astype(np.float32) for _ in range(3)]
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    colors = random.uniform(size=(4, 4)).astype(np.float32)
    # Tangents that nobody would make from the coordinates.
    tangents = np.float32([[1, 0, 0, -1], [0, 1, 0, -1], [0.6, 0.8, 0, -1], [-1, 0, 0, -1]])
    mesh = Mesh("quad", SQUARE, normals, faces, 0, uv[0], SQUARE[:, :2].copy(), tuple(uv[1:]), colors, tangents)
    return Scene((mesh,), (material,), images)
