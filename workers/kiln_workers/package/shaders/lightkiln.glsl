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

// Fresnel reflectance (Schlick 1994).
vec3 lkFresnel(vec3 f0, float cosine) {
  float x = clamp(1.0 - cosine, 0.0, 1.0);
  float x2 = x * x;
  return f0 + (1.0 - f0) * (x2 * x2 * x);
}

// Smith's masking and shadowing for GGX with correlated heights (Heitz 2014, eq. 99), at equal elevations of both
// directions, as the specular direction has: 1 / (1 + 2 Lambda).
float lkMasking(float alpha, float cosine) {
  float c2 = cosine * cosine;
  return 1.0 / sqrt(1.0 + alpha * alpha * (1.0 - c2) / max(c2, 1e-8));
}

// Reflectance at normal incidence of a glTF metallic-roughness surface.
vec3 lkF0(LkSurface surface) {
  return mix(vec3(0.04), surface.baseColor, surface.metallic);
}

// F G / (4 |o.n|): the rest of the microfacet model, taken at the specular direction (eq. 4, step 5 of section 6); its
// |r.n| cancels against the cosine of the rendering equation.
vec3 lkSpecularFactor(LkSurface surface, vec3 o) {
  float cosine = max(dot(surface.normal, o), 1e-4);
  float alpha = surface.roughness * surface.roughness;
  return lkFresnel(lkF0(surface), cosine) * lkMasking(alpha, cosine) / (4.0 * cosine);
}

// Glossy reflection of the scene: each lobe of the light field convolved with D (steps 3 to 6 of section 6).
vec3 lkInterreflection(sampler2DArray lightField, int count, vec2 uv, LkSurface surface, vec3 o) {
  LkAnisotropicLobe kernel = lkReflectionLobe(surface.normal, o, surface.roughness * surface.roughness);
  vec3 sum = vec3(0.0);
  for (int k = 0; k < count; k++) sum += lkConvolve(lkFetchLobe(lightField, uv, k), kernel);
  return sum * lkSpecularFactor(surface, o);
}

// Glossy reflection of the environment: U times its visibility times the rest (eq. 8). u is lkEnvironmentU at the
// specular direction.
vec3 lkEnvironmentReflection(sampler2DArray visibility, int count, vec2 uv, LkSurface surface, vec3 o, vec3 u) {
  vec3 specular = reflect(-o, surface.normal);
  return u * lkLobeSum(visibility, count, uv, specular) * lkSpecularFactor(surface, o);
}

// The same from the GGX cube map, whose mips are normalised means: split sum with Karis' fit of the second factor
// (Karis 2014, "Physically Based Shading on Mobile"). mean is lkEnvironmentGgx at the specular direction.
vec3 lkEnvironmentSplitSum(sampler2DArray visibility, int count, vec2 uv, LkSurface surface, vec3 o, vec3 mean) {
  float cosine = clamp(dot(surface.normal, o), 0.0, 1.0);
  vec4 r = surface.roughness * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
  float a = min(r.x * r.x, exp2(-9.28 * cosine)) * r.x + r.y;
  vec2 scaleBias = vec2(-1.04, 1.04) * a + r.zw;
  vec3 specular = reflect(-o, surface.normal);
  return mean * lkLobeSum(visibility, count, uv, specular) * (lkF0(surface) * scaleBias.x + scaleBias.y);
}

// Diffuse reflection of the baked irradiance (W/m^2), without what the specular layer reflects.
vec3 lkDiffuse(sampler2D irradiance, vec2 uv, LkSurface surface, vec3 o) {
  vec3 transmitted = 1.0 - lkFresnel(vec3(0.04), max(dot(surface.normal, o), 0.0));
  return texture(irradiance, uv).rgb * surface.baseColor * (1.0 - surface.metallic) * transmitted / LK_PI;
}
