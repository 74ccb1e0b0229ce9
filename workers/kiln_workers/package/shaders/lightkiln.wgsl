// Shading from lightkiln's textures. WGSL; concatenate after sg.wgsl and environment.wgsl.
//
// Source: Currius et al. 2020, section 6. Bind lightfield.ktx2 and visibility.ktx2 as texture_2d_array<f32>,
// irradiance.ktx2 as texture_2d<f32>, each with a sampler that filters linearly and clamps; look all three up with
// TEXCOORD_1 of scene.glb. All radiance is linear Rec.709 in the scene's units. Directions are unit vectors in world
// space, as glTF has it: n the shading normal, o to the eye. alpha = roughness * roughness. Textures are sampled at level
// 0, so that every stage may, in any control flow.

struct LkSurface {
  normal: vec3f,
  baseColor: vec3f,
  metallic: f32,
  roughness: f32,
  dielectric: vec4f,  // F0 of the dielectric, then its F90: 0.04, 0.04, 0.04, 1 unless extensions say otherwise
}

// Fetch lobe `index`, bilinearly interpolated between texels: layer 2k holds axis and sharpness, 2k + 1 the amplitude.
// An interpolated axis is shorter than 1 and is normalised again.
fn lkFetchLobe(lobes: texture_2d_array<f32>, lobesSampler: sampler, uv: vec2f, index: i32) -> LkLobe {
  let shape = textureSampleLevel(lobes, lobesSampler, uv, 2 * index, 0.0);
  let amplitude = textureSampleLevel(lobes, lobesSampler, uv, 2 * index + 1, 0.0).rgb;
  let norm = length(shape.xyz);
  var axis = vec3f(0.0, 1.0, 0.0);
  if (norm > 1e-6) {
    axis = shape.xyz / norm;
  }
  return LkLobe(axis, max(shape.w, 0.0), max(amplitude, vec3f(0.0)));
}

// Sum of all lobes at uv in a direction: incident radiance, or visibility of the environment.
fn lkLobeSum(
  lobes: texture_2d_array<f32>, lobesSampler: sampler, count: i32, uv: vec2f, direction: vec3f,
) -> vec3f {
  var sum = vec3f(0.0);
  for (var k = 0; k < count; k++) {
    sum += lkEvaluate(lkFetchLobe(lobes, lobesSampler, uv, k), direction);
  }
  return sum;
}

// The shading normal that a texel (0 to 1) of a glTF normal map stands for, seen from o. n is the surface's normal on the
// side of the eye; tangent is TANGENT, whose w is its handedness, and times -1 where the back is seen. The bitangent
// points up in the image. A normal that would face away is bent towards the eye.
fn lkMappedNormal(n: vec3f, tangent: vec4f, texel: vec3f, scale: f32, o: vec3f) -> vec3f {
  var t = tangent.xyz - dot(tangent.xyz, n) * n;
  t *= inverseSqrt(max(dot(t, t), 1e-12));
  let b = tangent.w * cross(n, t);
  let m = (2.0 * texel - 1.0) * vec3f(scale, scale, 1.0);
  let mapped = normalize(m.x * t + m.y * b + max(m.z, 1e-3) * n);
  return normalize(mapped + max(0.05 - dot(mapped, o), 0.0) * o);
}

// Reflectance at normal incidence of a glTF metallic-roughness surface.
fn lkF0(surface: LkSurface) -> vec3f {
  return mix(surface.dielectric.rgb, surface.baseColor, surface.metallic);
}

// Reflectance at grazing incidence.
fn lkF90(surface: LkSurface) -> f32 {
  return mix(surface.dielectric.a, 1.0, surface.metallic);
}

// F0 and F90 of a dielectric (KHR_materials_ior and _specular); a coat's reflectance (_clearcoat) is added to them.
fn lkDielectric(ior: f32, specular: f32, specularColor: vec3f, clearcoat: f32) -> vec4f {
  let ratio = (ior - 1.0) / (ior + 1.0);
  let f0 = min(ratio * ratio * specularColor, vec3f(1.0)) * specular;
  let coat = 0.04 * clearcoat;
  return vec4f(f0 + (vec3f(1.0) - f0) * coat, specular + (1.0 - specular) * clearcoat);
}

// The single-scattering albedo. The paper takes F and G at the specular direction instead (step 5 of section 6), which
// loses up to half of the light.
fn lkReflectance(surface: LkSurface, o: vec3f) -> vec3f {
  let x = clamp(dot(surface.normal, o), 1e-4, 1.0);
  let ab = lkAlbedoTerms(x, surface.roughness * surface.roughness);
  return lkF0(surface) * ab.x + lkF90(surface) * ab.y;
}

// What a surface gathers light with.
fn lkSurfaceReflection(surface: LkSurface, o: vec3f) -> LkReflection {
  let f0 = lkF0(surface);
  let alpha = surface.roughness * surface.roughness;
  return lkReflection(surface.normal, o, alpha, max(f0.x, max(f0.y, f0.z)), lkF90(surface));
}

// Glossy reflection of the scene: the mean of each lobe of the light field under D G F (n.i) (steps 3 to 6 of section 6).
fn lkInterreflection(
  lightField: texture_2d_array<f32>, lightFieldSampler: sampler, count: i32, uv: vec2f, surface: LkSurface, o: vec3f,
) -> vec3f {
  let reflection = lkSurfaceReflection(surface, o);
  var sum = vec3f(0.0);
  for (var k = 0; k < count; k++) {
    sum += lkMeanUnder(lkFetchLobe(lightField, lightFieldSampler, uv, k), reflection);
  }
  return sum * lkReflectance(surface, o);
}

// Where a glossy surface gathers most of its light from: the specular direction of a mirror, nearer to the normal for a
// rough surface seen from the side (Lagarde and de Rousiers 2014 call it the dominant direction).
fn lkGlossyDirection(surface: LkSurface, o: vec3f) -> vec3f {
  let reflection = lkSurfaceReflection(surface, o);
  return normalize(mix(reflection.peak.z, reflection.tail.z, reflection.tailShare));
}

// Glossy reflection of the environment as if nothing were before it: U over the integral of D, 4 / (1 + alpha^2), times
// the albedo (eq. 4). u is lkEnvironmentU in lkGlossyDirection.
fn lkEnvironmentUnoccluded(surface: LkSurface, o: vec3f, u: vec3f) -> vec3f {
  let alpha = surface.roughness * surface.roughness;
  return u * (0.25 * (1.0 + alpha * alpha)) * lkReflectance(surface, o);
}

// The same times visibility (eq. 8).
fn lkEnvironmentReflection(
  visibility: texture_2d_array<f32>, visibilitySampler: sampler, count: i32, uv: vec2f, surface: LkSurface, o: vec3f,
  u: vec3f,
) -> vec3f {
  let direction = lkGlossyDirection(surface, o);
  return lkEnvironmentUnoccluded(surface, o, u) * lkLobeSum(visibility, visibilitySampler, count, uv, direction);
}

// The same from the GGX cube map, whose mips are means. mean is lkEnvironmentGgx in lkGlossyDirection.
fn lkEnvironmentSplitSum(
  visibility: texture_2d_array<f32>, visibilitySampler: sampler, count: i32, uv: vec2f, surface: LkSurface, o: vec3f,
  mean: vec3f,
) -> vec3f {
  let direction = lkGlossyDirection(surface, o);
  return mean * lkLobeSum(visibility, visibilitySampler, count, uv, direction) * lkReflectance(surface, o);
}

// Diffuse reflection of the baked irradiance (W/m^2), without what the specular layer reflects: (1 - o.h)^5 averaged over
// the hemisphere is (0.00097 + 0.02659 (1 - o.n)^3) / 0.96 within 0.001.
fn lkDiffuse(
  irradiance: texture_2d<f32>, irradianceSampler: sampler, uv: vec2f, surface: LkSurface, o: vec3f,
) -> vec3f {
  let away = 1.0 - saturate(dot(surface.normal, o));
  let mean = (0.00097 + 0.02659 * away * away * away) / 0.96;
  let f0 = max(surface.dielectric.x, max(surface.dielectric.y, surface.dielectric.z));
  let transmitted = 1.0 - f0 - (surface.dielectric.w - f0) * mean;
  let arriving = textureSampleLevel(irradiance, irradianceSampler, uv, 0.0).rgb;
  return arriving * surface.baseColor * (1.0 - surface.metallic) * transmitted / LK_PI;
}
