"""Conventions of every file lightkiln writes, in one place.

World space is right-handed, +Y up, metres (glTF 2.0). Radiance is linear Rec.709 RGB.
`roughness` is glTF's perceptual roughness r; `alpha` is the GGX width, alpha = r^2.

A light-field image has R x R pixels over the full sphere, octahedral in *world* space: pixel
(column i, row j) covers the square [i, i+1] x [j, j+1] / R; with x = 2(i + 1/2)/R - 1,
y = 2(j + 1/2)/R - 1 the direction is p / |p|, p = (x, y, 1 - |x| - |y|), the lower half folded
(Meyer et al. 2010). An image array is indexed [row j, column i, channel].

A light map is indexed [row, column] with row 0 at v = 0 and column 0 at u = 0 (glTF's texture origin,
top left): texel (row, column) is centred at u = (column + 1/2)/W, v = (row + 1/2)/H.

A spherical Gaussian is G(v; u, lambda, mu) = mu exp(lambda (v.u - 1)); a lobe is stored as seven
numbers (u.x, u.y, u.z, lambda, mu.r, mu.g, mu.b) and, in textures, as two RGBA16F layers:
layer 2k holds (u.x, u.y, u.z, lambda), layer 2k + 1 holds (mu.r, mu.g, mu.b, 0).
"""

from typing import Final

FORMAT_VERSION: Final = 1
"""Version of the store and package layout; readers refuse a higher one."""

LOBE_PARAMETERS: Final = 7
"""Numbers per lobe: axis (3), sharpness (1), amplitude (3)."""

LAYERS_PER_LOBE: Final = 2

FP16_MAX: Final = 65504.0

REFINE_HALO: Final = 4
"""Texels around a block that are refined with it and then dropped, so that blocks agree where they meet."""

EXPOSURE_KEY: Final = 0.18
"""The mean radiance above the horizon is scaled to this value before log(1 + x) (Reinhard et al. 2002's key)."""

# Arrays of the light-field store (Zarr v3 group), indexed [row, column, ...] by light-map texel.
ARRAY_LIGHT_FIELD: Final = "light_field"
ARRAY_VISIBILITY: Final = "visibility"
ARRAY_IRRADIANCE: Final = "irradiance"
ARRAY_BETWEEN: Final = "between"
ARRAY_FINE_IRRADIANCE: Final = "fine_irradiance"
"""Indexed by texels of the irradiance map, which is finer (`lightmap.irradiance_scale`)."""

# Artifacts of a package.
LIGHT_FIELD_KTX2: Final = "lightfield.ktx2"
VISIBILITY_KTX2: Final = "visibility.ktx2"
IRRADIANCE_EXR: Final = "irradiance.exr"
IRRADIANCE_KTX2: Final = "irradiance.ktx2"
ERRORS_KTX2: Final = "errors.ktx2"
ENVIRONMENT_GGX_KTX2: Final = "environment_ggx.ktx2"
ENVIRONMENT_U_KTX2: Final = "environment_u.ktx2"
ENVIRONMENT_EXR: Final = "environment.exr"
SCENE_GLB: Final = "scene.glb"
ORIGINAL_GLB: Final = "original.glb"
MANIFEST_JSON: Final = "manifest.json"
REPORT_HTML: Final = "report.html"
GATES_XML: Final = "gates.xml"
GATES_FOLDER: Final = "gates"
