// Shading from lightkiln's textures. HLSL for shader model 4 and newer.
//
// Source: Currius et al. 2020, section 6. Bind lightfield.ktx2 and visibility.ktx2 as Texture2DArray, irradiance.ktx2 as
// Texture2D, each with a sampler that filters linearly and clamps; look all three up with TEXCOORD_1 of scene.glb. All
// radiance is linear Rec.709 in the scene's units. Directions are unit vectors in world space, as glTF has it: n the
// shading normal, o to the eye. alpha = roughness * roughness. Textures are sampled at level 0, so that every stage may.

#ifndef LK_LIGHTKILN_HLSL
#define LK_LIGHTKILN_HLSL

#include "sg.hlsl"
#include "environment.hlsl"

struct LkSurface {
  float3 normal;
  float3 baseColor;
  float metallic;
  float roughness;
  float4 dielectric;  // F0 of the dielectric, then its F90: 0.04, 0.04, 0.04, 1 unless extensions say otherwise
};

// Fetch lobe `index`, bilinearly interpolated between texels: layer 2k holds axis and sharpness, 2k + 1 the amplitude.
// An interpolated axis is shorter than 1 and is normalised again.
LkLobe lkFetchLobe(Texture2DArray lobes, SamplerState lobesSampler, float2 uv, int index) {
  float4 shape = lobes.SampleLevel(lobesSampler, float3(uv, float(2 * index)), 0.0);
  float3 amplitude = lobes.SampleLevel(lobesSampler, float3(uv, float(2 * index + 1)), 0.0).rgb;
  float norm = length(shape.xyz);
  LkLobe lobe;
  lobe.axis = norm > 1e-6 ? shape.xyz / norm : float3(0.0, 1.0, 0.0);
  lobe.sharpness = max(shape.w, 0.0);
  lobe.amplitude = max(amplitude, 0.0);
  return lobe;
}

// Sum of all lobes at uv in a direction: incident radiance, or visibility of the environment.
float3 lkLobeSum(Texture2DArray lobes, SamplerState lobesSampler, int count, float2 uv, float3 direction) {
  float3 sum = 0.0;
  for (int k = 0; k < count; k++) sum += lkEvaluate(lkFetchLobe(lobes, lobesSampler, uv, k), direction);
  return sum;
}

// The shading normal that a texel (0 to 1) of a glTF normal map stands for, seen from o. n is the surface's normal on the
// side of the eye; tangent is TANGENT, whose w is its handedness, and times -1 where the back is seen. The bitangent
// points up in the image. A normal that would face away is bent towards the eye.
float3 lkMappedNormal(float3 n, float4 tangent, float3 texel, float scale, float3 o) {
  float3 t = tangent.xyz - dot(tangent.xyz, n) * n;
  t *= rsqrt(max(dot(t, t), 1e-12));
  float3 b = tangent.w * cross(n, t);
  float3 m = (2.0 * texel - 1.0) * float3(scale, scale, 1.0);
  float3 mapped = normalize(m.x * t + m.y * b + max(m.z, 1e-3) * n);
  return normalize(mapped + max(0.05 - dot(mapped, o), 0.0) * o);
}

// Reflectance at normal incidence of a glTF metallic-roughness surface.
float3 lkF0(LkSurface surface) {
  return lerp(surface.dielectric.rgb, surface.baseColor, surface.metallic);
}

// Reflectance at grazing incidence.
float lkF90(LkSurface surface) {
  return lerp(surface.dielectric.a, 1.0, surface.metallic);
}

// F0 and F90 of a dielectric (KHR_materials_ior and _specular); a coat's reflectance (_clearcoat) is added to them.
float4 lkDielectric(float ior, float specular, float3 specularColor, float clearcoat) {
  float ratio = (ior - 1.0) / (ior + 1.0);
  float3 f0 = min(ratio * ratio * specularColor, 1.0) * specular;
  float coat = 0.04 * clearcoat;
  return float4(f0 + (1.0 - f0) * coat, specular + (1.0 - specular) * clearcoat);
}

// The single-scattering albedo. The paper takes F and G at the specular direction instead (step 5 of section 6), which
// loses up to half of the light.
float3 lkReflectance(LkSurface surface, float3 o) {
  float x = clamp(dot(surface.normal, o), 1e-4, 1.0);
  float2 ab = lkAlbedoTerms(x, surface.roughness * surface.roughness);
  return lkF0(surface) * ab.x + lkF90(surface) * ab.y;
}

// What a surface gathers light with.
LkReflection lkSurfaceReflection(LkSurface surface, float3 o) {
  float3 f0 = lkF0(surface);
  float alpha = surface.roughness * surface.roughness;
  return lkReflection(surface.normal, o, alpha, max(f0.x, max(f0.y, f0.z)), lkF90(surface));
}

// Glossy reflection of the scene: the mean of each lobe of the light field under D G F (n.i) (steps 3 to 6 of section 6).
float3 lkInterreflection(Texture2DArray lightField, SamplerState lightFieldSampler, int count, float2 uv,
                         LkSurface surface, float3 o) {
  LkReflection reflection = lkSurfaceReflection(surface, o);
  float3 sum = 0.0;
  for (int k = 0; k < count; k++) sum += lkMeanUnder(lkFetchLobe(lightField, lightFieldSampler, uv, k), reflection);
  return sum * lkReflectance(surface, o);
}

// Where a glossy surface gathers most of its light from: the specular direction of a mirror, nearer to the normal for a
// rough surface seen from the side (Lagarde and de Rousiers 2014 call it the dominant direction).
float3 lkGlossyDirection(LkSurface surface, float3 o) {
  LkReflection reflection = lkSurfaceReflection(surface, o);
  return normalize(lerp(reflection.peak.z, reflection.tail.z, reflection.tailShare));
}

// Glossy reflection of the environment as if nothing were before it: U over the integral of D, 4 / (1 + alpha^2), times
// the albedo (eq. 4). u is lkEnvironmentU in lkGlossyDirection.
float3 lkEnvironmentUnoccluded(LkSurface surface, float3 o, float3 u) {
  float alpha = surface.roughness * surface.roughness;
  return u * (0.25 * (1.0 + alpha * alpha)) * lkReflectance(surface, o);
}

// The same times visibility (eq. 8).
float3 lkEnvironmentReflection(Texture2DArray visibility, SamplerState visibilitySampler, int count, float2 uv,
                               LkSurface surface, float3 o, float3 u) {
  float3 direction = lkGlossyDirection(surface, o);
  return lkEnvironmentUnoccluded(surface, o, u) * lkLobeSum(visibility, visibilitySampler, count, uv, direction);
}

// The same from the GGX cube map, whose mips are means. mean is lkEnvironmentGgx in lkGlossyDirection.
float3 lkEnvironmentSplitSum(Texture2DArray visibility, SamplerState visibilitySampler, int count, float2 uv,
                             LkSurface surface, float3 o, float3 mean) {
  float3 direction = lkGlossyDirection(surface, o);
  return mean * lkLobeSum(visibility, visibilitySampler, count, uv, direction) * lkReflectance(surface, o);
}

// Diffuse reflection of the baked irradiance (W/m^2), without what the specular layer reflects: (1 - o.h)^5 averaged over
// the hemisphere is (0.00097 + 0.02659 (1 - o.n)^3) / 0.96 within 0.001.
float3 lkDiffuse(Texture2D irradiance, SamplerState irradianceSampler, float2 uv, LkSurface surface, float3 o) {
  float away = 1.0 - saturate(dot(surface.normal, o));
  float mean = (0.00097 + 0.02659 * away * away * away) / 0.96;
  float f0 = max(surface.dielectric.x, max(surface.dielectric.y, surface.dielectric.z));
  float transmitted = 1.0 - f0 - (surface.dielectric.w - f0) * mean;
  float3 arriving = irradiance.SampleLevel(irradianceSampler, uv, 0.0).rgb;
  return arriving * surface.baseColor * (1.0 - surface.metallic) * transmitted / LK_PI;
}

#endif
