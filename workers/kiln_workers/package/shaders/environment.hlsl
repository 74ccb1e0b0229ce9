// Lookups in the preconvolved environment. HLSL for shader model 4 and newer.
//
// environment_u.ktx2 is a 2D array of octahedral maps of U(o, alpha) = integral of D(h) L_E(i) di (Currius et al. 2020,
// eq. 6), one layer for each alpha that manifest.json lists under textures.environment_u.ktx2.alphas; the integral is
// not normalised. environment_ggx.ktx2 is a cube map whose mips hold n.l-weighted means of the environment under GGX
// (Karis 2013), the mip of a perceptual roughness r being (mips - 1) r (2 - r).

#ifndef LK_ENVIRONMENT_HLSL
#define LK_ENVIRONMENT_HLSL

static const int LK_MAX_U_LAYERS = 16;

// Texture coordinates in [0, 1] of a direction in an octahedral map (Meyer et al. 2010): world space, lower half z < 0
// folded outwards.
float2 lkOctahedral(float3 direction) {
  float3 p = direction / (abs(direction.x) + abs(direction.y) + abs(direction.z));
  float2 fold = (1.0 - abs(p.yx)) * float2(p.x < 0.0 ? -1.0 : 1.0, p.y < 0.0 ? -1.0 : 1.0);
  return 0.5 + 0.5 * (p.z < 0.0 ? fold : p.xy);
}

// U(direction, alpha) between the two layers whose alphas (ascending) enclose it: linear in the logarithms of both,
// because near a small light U falls as a power of alpha, and away from it rises as one.
float3 lkEnvironmentU(Texture2DArray u, SamplerState uSampler, float alphas[LK_MAX_U_LAYERS], int count,
                      float3 direction, float alpha) {
  float2 at = lkOctahedral(direction);
  int upper = 0;
  while (upper < count - 1 && alphas[upper] < alpha) upper++;
  int lower = max(upper - 1, 0);
  float span = log2(alphas[upper] / alphas[lower]);
  float t = span > 0.0 ? saturate(log2(max(alpha, 1e-6) / alphas[lower]) / span) : 0.0;
  float3 below = u.SampleLevel(uSampler, float3(at, float(lower)), 0.0).rgb;
  float3 above = u.SampleLevel(uSampler, float3(at, float(upper)), 0.0).rgb;
  return exp2(lerp(log2(max(below, 1e-6)), log2(max(above, 1e-6)), t));
}

// The mean of the environment under the GGX lobe about `direction`, for perceptual roughness.
float3 lkEnvironmentGgx(TextureCube ggx, SamplerState ggxSampler, float mips, float3 direction, float roughness) {
  return ggx.SampleLevel(ggxSampler, direction, (mips - 1.0) * roughness * (2.0 - roughness)).rgb;
}

#endif
