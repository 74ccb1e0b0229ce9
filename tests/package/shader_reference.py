"""What the shaders should compute: the evaluator of `lightkiln shade`, in 64 bits, on the inputs of `shader_probes`."""

import numpy as np
import shader_probes
import torch

from kiln_workers.package.half import layers_to_lobes
from kiln_workers.scene import normal_maps
from kiln_workers.scene.model import Material
from kiln_workers.shade import algorithm, textures
from kiln_workers.shade.package import EnvironmentLookup, LobeTextures
from kiln_workers.sphere import gaussian


def reference(given: dict[str, np.ndarray], images: dict[str, shader_probes.Image]) -> dict[str, list[np.ndarray]]:
    """By function what its probes should give: [P] or [P, C]."""
    given = {name: values.astype(np.float64) for name, values in given.items()}
    at = {name: torch.from_numpy(values) for name, values in given.items()}
    levels = {name: [torch.from_numpy(level).double() for level in image.levels] for name, image in images.items()}
    lobe_maps = [layers_to_lobes(images[name].levels[0]) for name in ("tLightField", "tVisibility")]
    light = LobeTextures(*(torch.from_numpy(lobes).double() for lobes in lobe_maps))
    surface = algorithm.Surface(
        at["n"], at["o"], at["base_color"], at["metallic"], at["roughness"] ** 2, at["dielectric"]
    )
    kernels = algorithm.reflection_kernels(surface)
    towards = algorithm.glossy_direction(surface)
    albedo = algorithm.reflectance(surface)
    unoccluded = at["light"] * algorithm.mean_scale(surface) * albedo
    seen = light.visibility(at["uv"], towards)
    a = torch.cat([at["a_axis"], at["a_sharpness"][:, None], at["a_amplitude"]], dim=-1)[:, None]
    wide = algorithm.Kernel(at["x"], at["y"], at["z"], *at["sharpness"].unbind(-1), at["integral"])
    across = [(at["v"] * axis).sum(-1) for axis in (wide.x, wide.y, wide.z)]
    fetched = algorithm.unit_lobes(textures.bilinear(light.light_field, at["uv"]))
    fetched = fetched[torch.arange(len(fetched)), at["k"].long()]
    environment = EnvironmentLookup(
        levels["tEnvironmentU"][0][..., :3], torch.tensor(shader_probes.ALPHAS, dtype=torch.float64), levels["tGgx"][0]
    )
    lod = (shader_probes.MIPS - 1) * at["roughness"] * (2.0 - at["roughness"])
    mips = torch.stack([textures.cube(level, at["v"])[:, :3] for level in levels["tGgx"]])
    below = lod.long().clamp(max=shader_probes.MIPS - 2)
    points = torch.arange(len(lod))
    product = gaussian.product_integral(*(given[name] for name in ("a_axis", "a_sharpness", "b_axis", "b_sharpness")))
    parts = [
        part
        for kernel in kernels
        for part in (kernel.x, kernel.y, kernel.z, torch.stack([kernel.lx, kernel.ly, kernel.amplitude], dim=-1))
    ]
    return {
        "lkEvaluate": [algorithm.lobe_sum(a, at["v"])],
        "lkEvaluateAnisotropic": [
            wide.amplitude * across[2].clamp(min=0.0) * torch.exp(-wide.lx * across[0] ** 2 - wide.ly * across[1] ** 2)
        ],
        "lkIntegral": [gaussian.integral(given["m"])],
        "lkProductIntegral": [given["a_amplitude"] * given["b_amplitude"] * product[:, None]],
        "lkSaturated": [gaussian.integral(0.5 * given["m"]) / (4.0 * np.pi)],
        "lkCap": [wide.integral / wide.amplitude],
        "lkAlbedoTerms": [torch.stack(algorithm.albedo_terms(surface), dim=-1)],
        "lkReflection": [*parts, kernels[1].integral],
        "lkConvolve": [algorithm.mean_under(a, [wide])],
        "lkMeanUnder": [algorithm.mean_under(a, kernels)],
        "lkOctahedral": [textures.octahedral_uv(at["v"])],
        "lkEnvironmentU": [environment.convolved(at["v"], surface.alpha)],
        "lkEnvironmentGgx": [torch.lerp(mips[below, points], mips[below + 1, points], (lod - below)[:, None])],
        "lkFetchLobe": [fetched[:, :3], fetched[:, 3], fetched[:, 4:]],
        "lkLobeSum": [LobeTextures(light.light_field, light.light_field).visibility(at["uv"], at["v"])],
        "lkMappedNormal": [_mapped_normals(given)],
        "lkF0": [algorithm.specular_f0(surface)],
        "lkF90": [algorithm.specular_f90(surface)],
        "lkDielectric": [np.array([_dielectric(given, point) for point in range(len(lod))])],
        "lkReflectance": [albedo],
        "lkSurfaceReflection": [kernels[0].z],
        "lkInterreflection": [light.reflected(at["uv"], surface) * albedo],
        "lkGlossyDirection": [towards],
        "lkEnvironmentUnoccluded": [unoccluded],
        "lkEnvironmentReflection": [unoccluded * seen],
        "lkEnvironmentSplitSum": [at["light"] * seen * albedo],
        "lkDiffuse": [algorithm.diffuse(surface, textures.bilinear(levels["tIrradiance"][0][0, ..., :3], at["uv"]))],
    }


def _mapped_normals(given: dict[str, np.ndarray]) -> np.ndarray:
    tangent = np.concatenate([given["x"], given["handedness"][:, None]], axis=-1)
    mapped = normal_maps.mapped(given["n"], tangent, given["texel"], given["dielectric"][:, 1:2])
    return normal_maps.facing(mapped, given["o"])


def _dielectric(given: dict[str, np.ndarray], point: int) -> tuple[float, ...]:
    """F0 and F90 of a point's material."""
    coat, _, _, specular = given["dielectric"][point]
    material = Material(
        "", ior=given["ior"][point], specular=specular, specular_color=tuple(given["tint"][point]), clearcoat=coat
    )
    return (*material.dielectric_f0, material.dielectric_f90)


def rounding(given: dict[str, np.ndarray], function: str) -> np.ndarray:
    """What a cosine's rounding in 32 bits does to a lobe [P]: its sharpness times two units in the last place of 1."""
    sharpest = {"lkEvaluate": ("a_sharpness",), "lkProductIntegral": ("a_sharpness", "b_sharpness")}
    return sum((given[name] for name in sharpest.get(function, ())), np.zeros(shader_probes.POINTS)) * 2.0**-22
