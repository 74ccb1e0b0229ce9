"""A package read back from its own files, as an engine loads it: scene, textures, environment.

Nothing comes from the store, the network or the bundle: what is wrong here is wrong for whoever downloads the package.
`Incident` is the seam to `stored`, which answers the same questions from the light-field store instead.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, Self

import numpy as np
import numpy.typing as npt
import OpenEXR
import torch
from pydantic import ValidationError
from torch import Tensor

from kiln_schemas.conventions import (
    ENVIRONMENT_EXR,
    ENVIRONMENT_GGX_KTX2,
    ENVIRONMENT_U_KTX2,
    FORMAT_VERSION,
    IRRADIANCE_EXR,
    LAYERS_PER_LOBE,
    LIGHT_FIELD_KTX2,
    MANIFEST_JSON,
    SCENE_GLB,
    VISIBILITY_KTX2,
)
from kiln_schemas.errors import InputError, NotFound, TooLarge
from kiln_schemas.files import open_regular, read_small
from kiln_schemas.manifest import Manifest
from kiln_schemas.settings import AUTO, LARGEST_SIDE
from kiln_workers.package import ktx2
from kiln_workers.package.half import layers_to_lobes
from kiln_workers.scene.gltf import read_gltf
from kiln_workers.scene.model import Scene
from kiln_workers.scene.origin import about_own_centre
from kiln_workers.shade import algorithm, textures
from kiln_workers.shade.lobe_file import LobeFile

Float32 = npt.NDArray[np.float32]

DENOISED: Final = "lightkiln.denoised"
"""Attribute of a picture's file that says: the picture is denoised."""
MOST_PIXELS: Final = 2**27
MOST_CHANNELS: Final = 16
MOST_U_LAYERS: Final = 64
MOST_ENVIRONMENT_PIXELS: Final = 2**23
CUBE_SIDES: Final = 8
"""Six, and all their mips."""


class Incident(Protocol):
    """The light that arrives at P points of the light map: uv [P, 2]."""

    def reflected(self, uv: Tensor, surface: algorithm.Surface, paper: bool = False) -> Tensor:
        """Mean of the light field under the surface's kernels [P, 3]; `paper`: its integral times D."""
        ...

    def visibility(self, uv: Tensor, directions: Tensor) -> Tensor:
        """W_E in one direction a point [P, 3]: [P, 3]."""
        ...


@dataclass(frozen=True)
class LobeTextures:
    """Incident light from the lobe textures."""

    light_field: Tensor | LobeFile  # [H, W, N, 7]
    visibility_lobes: Tensor | LobeFile | None  # [H, W, N, 7]; None without an environment

    def reflected(self, uv: Tensor, surface: algorithm.Surface, paper: bool = False) -> Tensor:
        lobes = algorithm.unit_lobes(textures.bilinear(self.light_field, uv))
        if paper:
            return algorithm.convolved(lobes, algorithm.paper_kernel(surface))
        return algorithm.mean_under(lobes, algorithm.reflection_kernels(surface))

    def visibility(self, uv: Tensor, directions: Tensor) -> Tensor:
        if self.visibility_lobes is None:
            return torch.ones_like(directions)
        lobes = algorithm.unit_lobes(textures.bilinear(self.visibility_lobes, uv))
        return algorithm.lobe_sum(lobes, directions)


@dataclass(frozen=True)
class EnvironmentLookup:
    """The preconvolved environment."""

    u: Tensor  # [A, R, R, 3] octahedral maps of U, not normalised
    alphas: Tensor  # [A] ascending
    itself: Tensor  # [H, W, 3] equirectangular

    def convolved(self, directions: Tensor, alpha: Tensor) -> Tensor:
        """U(direction, alpha) [P, 3]: linear in the logarithms of U and alpha between the layers that enclose it."""
        upper = torch.searchsorted(self.alphas, alpha.contiguous()).clamp(max=len(self.alphas) - 1)
        lower = (upper - 1).clamp(min=0)
        span = torch.log2(self.alphas[upper] / self.alphas[lower]).clamp(min=1e-12)
        share = (torch.log2(alpha.clamp(min=1e-6) / self.alphas[lower]) / span).clamp(0.0, 1.0)[:, None]
        uv = textures.octahedral_uv(directions)
        ends = []
        for layer in (lower, upper):
            found = torch.zeros_like(directions)
            for number in torch.unique(layer).tolist():
                at = layer == number
                found[at] = textures.bilinear(self.u[number], uv[at])
            ends.append(torch.log2(found.clamp(min=1e-6)))
        return torch.exp2(torch.lerp(ends[0], ends[1], share))

    def seen(self, directions: Tensor) -> Tensor:
        """The environment itself [P, 3] in directions [P, 3]."""
        return textures.equirectangular(self.itself, directions)


@dataclass(frozen=True)
class ShadePackage:
    """A package, ready to shade from."""

    manifest: Manifest
    scene: Scene
    irradiance: Tensor  # [H, W, 3]
    lobes: LobeTextures
    environment: EnvironmentLookup | None

    @classmethod
    def read(cls, folder: Path, device: torch.device) -> Self:
        """Read the package in `folder`; NotFound where there is none, InputError where it is damaged or too new."""
        return cls.of(folder, read_manifest(folder), device)

    @classmethod
    def of(cls, folder: Path, manifest: Manifest, device: torch.device, *, lobes_in_files: bool = False) -> Self:
        """The same of a package whose manifest is not written yet. Lobes may stay in their files."""
        scene = about_own_centre(read_gltf(folder, SCENE_GLB))
        for mesh in scene.meshes:
            if mesh.lightmap_uv is None:
                raise InputError("has no TEXCOORD_1", where=f"{folder / SCENE_GLB}: {mesh.name}")
        lobes = _lobes_in_file if lobes_in_files else _lobes
        visible = lobes(folder, VISIBILITY_KTX2, manifest, device) if VISIBILITY_KTX2 in manifest.textures else None
        return cls(
            manifest=manifest,
            scene=scene,
            irradiance=torch.from_numpy(read_exr(folder / IRRADIANCE_EXR, _irradiance_texels(manifest))).to(device),
            lobes=LobeTextures(lobes(folder, LIGHT_FIELD_KTX2, manifest, device), visible),
            environment=_environment(folder, manifest, device),
        )


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a package."""
    path = folder / MANIFEST_JSON
    try:
        manifest = Manifest.model_validate_json(read_small(path))
    except FileNotFoundError:
        raise NotFound("there is no package", where=str(folder), remedy="Name a folder with a manifest.json.") from None
    except NotADirectoryError:
        raise NotFound("there is no package", where=str(folder), remedy="Name a folder with a manifest.json.") from None
    except (OSError, ValidationError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a manifest"
        raise InputError(f"cannot be read: {reason}", where=str(path), remedy="Bake it again.") from None
    if manifest.format_version > FORMAT_VERSION:
        raise InputError(
            f"has format version {manifest.format_version}, this program reads up to {FORMAT_VERSION}",
            where=str(path),
            remedy="Update lightkiln.",
        )
    return manifest


def read_exr(path: Path, most_texels: int = MOST_PIXELS) -> Float32:
    """Linear RGB [H, W, 3] of an EXR; InputError where it cannot be read, TooLarge where it declares more texels."""
    try:
        # By its descriptor: the library opens by name, and would wait for a pipe.
        with open_regular(path) as regular:
            name = f"/dev/fd/{regular.fileno()}"
            with OpenEXR.File(name, header_only=True) as file:
                _refuse_larger(file.header(), path, most_texels)
                _refuse_denoised(file.header(), path)
            with OpenEXR.File(name) as file:
                channels = file.channels()
                if "RGB" not in channels:
                    raise InputError(f"has the channels {', '.join(channels)} instead of R, G, B", where=str(path))
                return np.array(channels["RGB"].pixels, dtype=np.float32)
    except (RuntimeError, OSError, ValueError) as error:
        raise InputError(f"cannot be read as OpenEXR: {error}", where=str(path)) from None


def _refuse_denoised(header: Mapping[str, Any], path: Path) -> None:
    """InputError where a picture is marked as denoised: whatever is read here is measured, or measured against."""
    if DENOISED in header:
        raise InputError(
            "is a denoised picture, which is for looking only: the denoiser's errors would be measured as light",
            where=str(path),
            remedy="Path-trace it again without --denoise.",
        )


def _refuse_larger(header: Mapping[str, Any], path: Path, most_texels: int) -> None:
    """TooLarge where an EXR's header declares more than may be read."""
    (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    texels, channels = (right - left + 1) * (bottom - top + 1), len(header["channels"])
    if texels > most_texels or channels > MOST_CHANNELS:
        raise TooLarge(
            f"it declares {texels} texels of {channels} channels; {most_texels} of {MOST_CHANNELS} are allowed",
            where=str(path),
        )


def _texels(manifest: Manifest) -> int:
    """Texels of the light map, at most."""
    lightmap, width = manifest.settings.lightmap, manifest.lightmap.get("width")
    if lightmap.resolution == AUTO and not isinstance(width, int):
        raise InputError("does not say how wide the light map is", where=MANIFEST_JSON, remedy="Bake it again.")
    return min(lightmap.side(width), LARGEST_SIDE) ** 2


def _irradiance_texels(manifest: Manifest) -> int:
    """Texels of the irradiance map, at most."""
    return min(_texels(manifest) * manifest.settings.lightmap.irradiance_scale**2, LARGEST_SIDE**2)


def _lobes(folder: Path, name: str, manifest: Manifest, device: torch.device) -> Tensor:
    texture = ktx2.read(folder / name, _most_bytes(manifest))
    return torch.from_numpy(layers_to_lobes(texture.levels[0][:, 0])).to(device)


def _lobes_in_file(folder: Path, name: str, manifest: Manifest, device: torch.device) -> LobeFile:
    layers, shape = ktx2.map_layers(folder / name, _most_bytes(manifest))
    return LobeFile(layers, shape.height, shape.width, device)


def _most_bytes(manifest: Manifest) -> int:
    """Of a lobe texture's texels."""
    return ktx2.TEXEL_BYTES * LAYERS_PER_LOBE * manifest.settings.fit.lobes * _texels(manifest)


def _environment(folder: Path, manifest: Manifest, device: torch.device) -> EnvironmentLookup | None:
    described = manifest.textures.get(ENVIRONMENT_U_KTX2)
    if described is None:
        return None
    size = ktx2.TEXEL_BYTES * manifest.settings.package.environment_size**2
    layers = ktx2.read(folder / ENVIRONMENT_U_KTX2, MOST_U_LAYERS * size).levels[0][:, 0, ..., :3].astype(np.float32)
    if described["normalised"]:
        layers = layers * np.asarray(described["lobe_integrals"], np.float32)[:, None, None, None]
    if ENVIRONMENT_EXR in manifest.textures:
        itself = torch.from_numpy(read_exr(folder / ENVIRONMENT_EXR, MOST_ENVIRONMENT_PIXELS))
    else:
        cube = ktx2.read(folder / ENVIRONMENT_GGX_KTX2, CUBE_SIDES * size).levels[0][0, ..., :3].astype(np.float32)
        itself = textures.unrolled(torch.from_numpy(cube))
    return EnvironmentLookup(
        torch.from_numpy(layers).to(device),
        torch.tensor(described["alphas"], dtype=torch.float32, device=device),
        itself.to(device),
    )
