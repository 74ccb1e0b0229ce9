// Lookups in the preconvolved environment. WGSL; concatenate after sg.wgsl.
//
// environment_u.ktx2 is a 2D array of octahedral maps of U(o, alpha) = integral of D(h) L_E(i) di (Currius et al. 2020,
// eq. 6), one layer for each alpha that manifest.json lists under textures.environment_u.ktx2.alphas; the integral is
// not normalised. environment_ggx.ktx2 is a cube map whose mips hold n.l-weighted means of the environment under GGX
// (Karis 2013), the mip of a perceptual roughness r being (mips - 1) r (2 - r).

const LK_MAX_U_LAYERS = 16;

// Texture coordinates in [0, 1] of a direction in an octahedral map (Meyer et al. 2010): world space, lower half z < 0
// folded outwards.
fn lkOctahedral(direction: vec3f) -> vec2f {
  let p = direction / (abs(direction.x) + abs(direction.y) + abs(direction.z));
  let fold = (1.0 - abs(p.yx)) * select(vec2f(1.0), vec2f(-1.0), p.xy < vec2f(0.0));
  return 0.5 + 0.5 * select(p.xy, fold, p.z < 0.0);
}

// U(direction, alpha) between the two layers whose alphas (ascending) enclose it: linear in the logarithms of both,
// because near a small light U falls as a power of alpha, and away from it rises as one.
fn lkEnvironmentU(
  u: texture_2d_array<f32>, uSampler: sampler, alphas: array<f32, LK_MAX_U_LAYERS>, count: i32, direction: vec3f,
  alpha: f32,
) -> vec3f {
  let at = lkOctahedral(direction);
  var upper = 0;
  while (upper < count - 1 && alphas[upper] < alpha) {
    upper++;
  }
  let lower = max(upper - 1, 0);
  let span = log2(alphas[upper] / alphas[lower]);
  var t = 0.0;
  if (span > 0.0) {
    t = saturate(log2(max(alpha, 1e-6) / alphas[lower]) / span);
  }
  let below = textureSampleLevel(u, uSampler, at, lower, 0.0).rgb;
  let above = textureSampleLevel(u, uSampler, at, upper, 0.0).rgb;
  return exp2(mix(log2(max(below, vec3f(1e-6))), log2(max(above, vec3f(1e-6))), t));
}

// The mean of the environment under the GGX lobe about `direction`, for perceptual roughness.
fn lkEnvironmentGgx(ggx: texture_cube<f32>, ggxSampler: sampler, mips: f32, direction: vec3f, roughness: f32) -> vec3f {
  return textureSampleLevel(ggx, ggxSampler, direction, (mips - 1.0) * roughness * (2.0 - roughness)).rgb;
}
