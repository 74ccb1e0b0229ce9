"""Pictures of a package: the terms of section 6 over a G-buffer, averaged over each pixel's samples."""

from collections.abc import Collection
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kiln_workers.scene.model import Float32
from kiln_workers.shade import algorithm, textures
from kiln_workers.shade.gbuffer import GBuffer
from kiln_workers.shade.package import Incident, ShadePackage
from kiln_workers.shade.term import COMPARED, WHOLE, Term

POINTS_AT_ONCE: Final = 1 << 16


def shade(
    package: ShadePackage,
    buffer: GBuffer,
    terms: Collection[Term] = WHOLE,
    incident: Incident | None = None,
    paper: bool = False,
) -> Float32:
    """Radiance [H, W, 3], the sum of `terms`; glossy light from `incident`, by default the package's lobes.

    `paper`: D, F and G as the paper has them, instead of fitted kernels and the albedo of GGX.
    """
    height, width, samples = buffer.hit.shape
    out = _shade_samples(package, buffer, terms, incident, paper)
    return np.asarray(out.reshape(height, width, samples, 3).mean(axis=2), np.float32)


def _shade_samples(
    package: ShadePackage, buffer: GBuffer, terms: Collection[Term], incident: Incident | None, paper: bool
) -> Float32:
    """Radiance [H * W * S, 3] of a G-buffer's samples, with what is seen through its surfaces."""
    height, width, samples = buffer.hit.shape
    out = np.zeros((height * width * samples, 3), np.float32)
    hit = buffer.hit.ravel()
    surfaces = np.zeros((len(buffer), 3), np.float32)
    # Points of one part of the light map are shaded together: a store is then read once.
    at_once = POINTS_AT_ONCE if incident is None else max(len(buffer), 1)
    for start in range(0, len(buffer), at_once):
        part = slice(start, start + at_once)
        surfaces[part] = _shade_points(package, buffer, part, terms, incident or package.lobes, paper)
    out[hit] = surfaces
    if Term.BACKGROUND in terms and package.environment is not None and not hit.all():
        directions = _tensor(buffer.directions.reshape(-1, 3)[~hit], package.irradiance)
        out[~hit] = package.environment.seen(directions).cpu().numpy()
    if buffer.behind is not None:
        out[hit] += buffer.through * _shade_samples(package, buffer.behind, terms, incident, paper)[hit]
    return out


def _shade_points(
    package: ShadePackage, buffer: GBuffer, part: slice, terms: Collection[Term], incident: Incident, paper: bool
) -> Float32:
    """Radiance [P, 3] of some of the G-buffer's points."""
    like = package.irradiance
    uv = _tensor(buffer.lightmap_uv[part], like)
    surface = algorithm.Surface(
        normal=_tensor(buffer.normal[part], like),
        view=_tensor(buffer.view[part], like),
        base_color=_tensor(buffer.base_color[part], like),
        metallic=_tensor(buffer.metallic[part], like),
        alpha=_tensor(buffer.alpha[part], like),
        dielectric=_tensor(buffer.dielectric[part], like),
        transmission=_tensor(buffer.transmission[part], like),
    )
    factor = algorithm.paper_factor(surface) if paper else algorithm.reflectance(surface)
    radiance = torch.zeros_like(surface.normal)
    if Term.INTERREFLECTION in terms:
        radiance += incident.reflected(uv, surface, paper) * factor
    reflected = {Term.ENVIRONMENT, *COMPARED} & set(terms)
    if package.environment is not None and reflected:
        towards = surface.specular if paper else algorithm.glossy_direction(surface)
        u = package.environment.convolved(towards, surface.alpha)
        seen: Tensor | float = 1.0
        if Term.ENVIRONMENT in reflected:
            seen = incident.visibility(uv, towards)
        elif Term.MIRROR_VISIBILITY in reflected:
            seen = _tensor(buffer.specular_escapes[part].astype(np.float32), like)[:, None]
        radiance += u * seen * (1.0 if paper else algorithm.mean_scale(surface)) * factor
    if Term.DIFFUSE in terms:
        radiance += algorithm.diffuse(surface, textures.bilinear(package.irradiance, uv))
    radiance *= _tensor(buffer.reflects[part].astype(np.float32), like)[:, None]
    if Term.EMISSION in terms:
        radiance += _tensor(buffer.emission[part], like)
    radiance *= _tensor(buffer.opacity[part], like)[:, None]
    return np.asarray(radiance.cpu().numpy(), np.float32)


def _tensor(values: npt.NDArray[np.float32], like: Tensor) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).to(like)
