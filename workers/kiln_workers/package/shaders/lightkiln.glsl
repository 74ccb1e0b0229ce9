// Shading from lightkiln's textures. GLSL ES 3.00; include after sg.glsl and environment.glsl.
//
// Source: Currius et al. 2020, section 6. Bind lightfield.ktx2 and visibility.ktx2 as sampler2DArray with linear
// filtering and clamped edges, irradiance.ktx2 as sampler2D; look all three up with TEXCOORD_1 of scene.glb. All
// radiance is linear Rec.709 in the scene's units. Directions are unit vectors in world space: n the shading normal, o to
// the eye. alpha = roughness * roughness.

struct LkSurface {
  vec3 normal;
  vec3 baseColor;
  float metallic;
  float roughness;
  vec4 dielectric;  // F0 of the dielectric, then its F90: 0.04, 0.04, 0.04, 1 unless extensions say otherwise
};

// Fetch lobe `index`, bilinearly interpolated between texels: layer 2k holds axis and sharpness, 2k + 1 the amplitude.
// An interpolated axis is shorter than 1 and is normalised again.
LkLobe lkFetchLobe(sampler2DArray lobes, vec2 uv, int index) {
  vec4 shape = texture(lobes, vec3(uv, float(2 * index)));
  vec3 amplitude = texture(lobes, vec3(uv, float(2 * index + 1))).rgb;
  float norm = length(shape.xyz);
  return LkLobe(norm > 1e-6 ? shape.xyz / norm : vec3(0.0, 1.0, 0.0), max(shape.w, 0.0), max(amplitude, 0.0));
}

// Sum of all lobes at uv in a direction: incident radiance, or visibility of the environment.
vec3 lkLobeSum(sampler2DArray lobes, int count, vec2 uv, vec3 direction) {
  vec3 sum = vec3(0.0);
  for (int k = 0; k < count; k++) sum += lkEvaluate(lkFetchLobe(lobes, uv, k), direction);
  return sum;
}

// The shading normal that a texel (0 to 1) of a glTF normal map stands for, seen from o. n is the surface's normal on the
// side of the eye; tangent is TANGENT, whose w is its handedness, and times -1 where the back is seen. The bitangent
// points up in the image. A normal that would face away is bent towards the eye.
vec3 lkMappedNormal(vec3 n, vec4 tangent, vec3 texel, float scale, vec3 o) {
  vec3 t = tangent.xyz - dot(tangent.xyz, n) * n;
  t *= inversesqrt(max(dot(t, t), 1e-12));
  vec3 b = tangent.w * cross(n, t);
  vec3 m = (2.0 * texel - 1.0) * vec3(scale, scale, 1.0);
  vec3 mapped = normalize(m.x * t + m.y * b + max(m.z, 1e-3) * n);
  return normalize(mapped + max(0.05 - dot(mapped, o), 0.0) * o);
}

// Reflectance at normal incidence of a glTF metallic-roughness surface.
vec3 lkF0(LkSurface surface) {
  return mix(surface.dielectric.rgb, surface.baseColor, surface.metallic);
}

// Reflectance at grazing incidence.
float lkF90(LkSurface surface) {
  return mix(surface.dielectric.a, 1.0, surface.metallic);
}

// F0 and F90 of a dielectric (KHR_materials_ior and _specular); a coat's reflectance (_clearcoat) is added to them.
vec4 lkDielectric(float ior, float specular, vec3 specularColor, float clearcoat) {
  float ratio = (ior - 1.0) / (ior + 1.0);
  vec3 f0 = min(ratio * ratio * specularColor, 1.0) * specular;
  float coat = 0.04 * clearcoat;
  return vec4(f0 + (1.0 - f0) * coat, specular + (1.0 - specular) * clearcoat);
}

// The single-scattering albedo. The paper takes F and G at the specular direction instead (step 5 of section 6), which
// loses up to half of the light.
vec3 lkReflectance(LkSurface surface, vec3 o) {
  float x = clamp(dot(surface.normal, o), 1e-4, 1.0);
  vec2 ab = lkAlbedoTerms(x, surface.roughness * surface.roughness);
  return lkF0(surface) * ab.x + lkF90(surface) * ab.y;
}

// What a surface gathers light with.
LkReflection lkSurfaceReflection(LkSurface surface, vec3 o) {
  vec3 f0 = lkF0(surface);
  float alpha = surface.roughness * surface.roughness;
  return lkReflection(surface.normal, o, alpha, max(f0.x, max(f0.y, f0.z)), lkF90(surface));
}

// Glossy reflection of the scene: the mean of each lobe of the light field under D G F (n.i) (steps 3 to 6 of section 6).
vec3 lkInterreflection(sampler2DArray lightField, int count, vec2 uv, LkSurface surface, vec3 o) {
  LkReflection reflection = lkSurfaceReflection(surface, o);
  vec3 sum = vec3(0.0);
  for (int k = 0; k < count; k++) sum += lkMeanUnder(lkFetchLobe(lightField, uv, k), reflection);
  return sum * lkReflectance(surface, o);
}

// Where a glossy surface gathers most of its light from: the specular direction of a mirror, nearer to the normal for a
// rough surface seen from the side (Lagarde and de Rousiers 2014 call it the dominant direction).
vec3 lkGlossyDirection(LkSurface surface, vec3 o) {
  LkReflection reflection = lkSurfaceReflection(surface, o);
  return normalize(mix(reflection.peak.z, reflection.tail.z, reflection.tailShare));
}

// Glossy reflection of the environment as if nothing were before it: U over the integral of D, 4 / (1 + alpha^2), times
// the albedo (eq. 4). u is lkEnvironmentU in lkGlossyDirection.
vec3 lkEnvironmentUnoccluded(LkSurface surface, vec3 o, vec3 u) {
  float alpha = surface.roughness * surface.roughness;
  return u * (0.25 * (1.0 + alpha * alpha)) * lkReflectance(surface, o);
}

// The same times visibility (eq. 8).
vec3 lkEnvironmentReflection(sampler2DArray visibility, int count, vec2 uv, LkSurface surface, vec3 o, vec3 u) {
  return lkEnvironmentUnoccluded(surface, o, u) * lkLobeSum(visibility, count, uv, lkGlossyDirection(surface, o));
}

// The same from the GGX cube map, whose mips are means. mean is lkEnvironmentGgx in lkGlossyDirection.
vec3 lkEnvironmentSplitSum(sampler2DArray visibility, int count, vec2 uv, LkSurface surface, vec3 o, vec3 mean) {
  return mean * lkLobeSum(visibility, count, uv, lkGlossyDirection(surface, o)) * lkReflectance(surface, o);
}

// Diffuse reflection of the baked irradiance (W/m^2), without what the specular layer reflects: (1 - o.h)^5 averaged over
// the hemisphere is (0.00097 + 0.02659 (1 - o.n)^3) / 0.96 within 0.001.
vec3 lkDiffuse(sampler2D irradiance, vec2 uv, LkSurface surface, vec3 o) {
  float away = 1.0 - clamp(dot(surface.normal, o), 0.0, 1.0);
  float mean = (0.00097 + 0.02659 * away * away * away) / 0.96;
  float f0 = max(surface.dielectric.x, max(surface.dielectric.y, surface.dielectric.z));
  float transmitted = 1.0 - f0 - (surface.dielectric.w - f0) * mean;
  return texture(irradiance, uv).rgb * surface.baseColor * (1.0 - surface.metallic) * transmitted / LK_PI;
}
