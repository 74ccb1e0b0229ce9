// Fragment stage of an example program, which lightkiln's viewer runs as it is. GLSL ES 3.00; concatenate after sg.glsl,
// environment.glsl and lightkiln.glsl. Define LK_ENVIRONMENT where the package has an environment, and
// LK_BASE_COLOR_MAP, LK_METALLIC_ROUGHNESS_MAP, LK_NORMAL_MAP and LK_EMISSION_MAP where the material has these textures
// (colours are sampled linear; transforms are those of KHR_texture_transform); LK_BASE_COLOR_UV and its like where one is
// looked up by another set than vTexCoord; LK_VERTEX_COLOR and LK_MORE_TEX_COORDS as in surface.vert.glsl; LK_BLEND where a part of the
// light behind is seen (BLEND, KHR_materials_transmission): then the colour comes multiplied by its alpha.

uniform vec3 uEye;
uniform vec4 uBaseColor;
uniform float uMetallic;
uniform float uRoughness;
uniform float uRoughnessBias;  // added after the texture; 0 but to override
uniform vec3 uEmission;
uniform float uAlphaCutoff;
uniform bool uDoubleSided;
uniform float uIor;  // KHR_materials_ior: 1.5 without it
uniform float uSpecular;  // KHR_materials_specular: 1
uniform vec3 uSpecularColor;  // and 1, 1, 1
uniform float uClearcoat;  // KHR_materials_clearcoat: 0
#ifdef LK_BLEND
uniform float uTransmission;
#endif
#ifndef LK_BASE_COLOR_UV
#define LK_BASE_COLOR_UV vTexCoord
#endif
#ifndef LK_METALLIC_ROUGHNESS_UV
#define LK_METALLIC_ROUGHNESS_UV vTexCoord
#endif
#ifndef LK_NORMAL_UV
#define LK_NORMAL_UV vTexCoord
#endif
#ifndef LK_EMISSION_UV
#define LK_EMISSION_UV vTexCoord
#endif
#ifdef LK_BASE_COLOR_MAP
uniform sampler2D uBaseColorMap;
uniform mat3 uBaseColorTransform;
#endif
#ifdef LK_METALLIC_ROUGHNESS_MAP
uniform sampler2D uMetallicRoughnessMap;
uniform mat3 uMetallicRoughnessTransform;
#endif
#ifdef LK_NORMAL_MAP
uniform sampler2D uNormalMap;
uniform mat3 uNormalTransform;
uniform float uNormalScale;
#endif
#ifdef LK_EMISSION_MAP
uniform sampler2D uEmissionMap;
uniform mat3 uEmissionTransform;
#endif

// Weights of the terms, 1 in the whole picture: emission, diffuse, interreflection, environment.
uniform vec4 uTerms;
uniform sampler2DArray uLightField;
uniform int uLightFieldLobes;
uniform sampler2D uIrradiance;
#ifdef LK_ENVIRONMENT
uniform bool uOcclusion;  // false: the environment without visibility (eq. 4), for comparison
uniform sampler2DArray uVisibility;
uniform int uVisibilityLobes;
uniform sampler2DArray uEnvironmentU;
uniform float uEnvironmentAlphas[LK_MAX_U_LAYERS];
uniform int uEnvironmentLayers;
#endif

in vec3 vPosition;
in vec3 vNormal;
in vec2 vTexCoord;
in vec2 vLightmap;
#ifdef LK_NORMAL_MAP
in vec4 vTangent;
#endif
#ifdef LK_VERTEX_COLOR
in vec4 vColor;
#endif
#ifdef LK_MORE_TEX_COORDS
in vec2 vTexCoord2;
in vec2 vTexCoord3;
#endif

out vec4 fragmentRadiance;

// The shading normal on the side of the eye; the triangle's own where the interpolated one faces away.
vec3 seenNormal(vec3 o) {
  vec3 face = normalize(cross(dFdx(vPosition), dFdy(vPosition)));
  vec3 normal = normalize(vNormal) * (gl_FrontFacing ? 1.0 : -1.0);
  if (dot(normal, o) > 0.0) return normal;
  return dot(face, o) < 0.0 ? -face : face;
}

void main() {
  vec4 base = uBaseColor;
  float metallic = uMetallic;
  float roughness = uRoughness;
  vec3 emission = uEmission;
#ifdef LK_BASE_COLOR_MAP
  base *= texture(uBaseColorMap, (uBaseColorTransform * vec3(LK_BASE_COLOR_UV, 1.0)).xy);
#endif
#ifdef LK_VERTEX_COLOR
  base *= vColor;
#endif
#ifdef LK_METALLIC_ROUGHNESS_MAP
  vec4 glossy = texture(uMetallicRoughnessMap, (uMetallicRoughnessTransform * vec3(LK_METALLIC_ROUGHNESS_UV, 1.0)).xy);
  metallic *= glossy.b;
  roughness *= glossy.g;
#endif
#ifdef LK_EMISSION_MAP
  emission *= texture(uEmissionMap, (uEmissionTransform * vec3(LK_EMISSION_UV, 1.0)).xy).rgb;
#endif
  vec3 o = normalize(uEye - vPosition);
  vec3 side = seenNormal(o);
  vec3 normal = side;
#ifdef LK_NORMAL_MAP
  vec3 texel = texture(uNormalMap, (uNormalTransform * vec3(LK_NORMAL_UV, 1.0)).xy).rgb;
  normal = lkMappedNormal(side, gl_FrontFacing ? vTangent : -vTangent, texel, uNormalScale, o);
#endif
  roughness = clamp(roughness + uRoughnessBias, 0.0, 1.0);
  vec4 dielectric = lkDielectric(uIor, uSpecular, uSpecularColor, uClearcoat);
  LkSurface surface = LkSurface(normal, clamp(base.rgb, 0.0, 1.0), clamp(metallic, 0.0, 1.0), roughness, dielectric);
  vec3 radiance = uTerms.x * emission;
#ifdef LK_BLEND
  // What is not reflected diffusely goes through, less Fresnel's share and tinted by the base colour; one alpha stands for
  // the three colours.
  float kept = uTransmission * (1.0 - surface.metallic);
  float away = 1.0 - clamp(dot(side, o), 0.0, 1.0);
  float f0 = max(dielectric.x, max(dielectric.y, dielectric.z));
  float reflectedShare = f0 + (dielectric.w - f0) * away * away * away * away * away;
  float through = kept * (1.0 - reflectedShare) * dot(surface.baseColor, vec3(1.0 / 3.0));
  radiance += uTerms.y * (1.0 - kept) * lkDiffuse(uIrradiance, vLightmap, surface, o);
#else
  radiance += uTerms.y * lkDiffuse(uIrradiance, vLightmap, surface, o);
#endif
  radiance += uTerms.z * lkInterreflection(uLightField, uLightFieldLobes, vLightmap, surface, o);
#ifdef LK_ENVIRONMENT
  vec3 towards = lkGlossyDirection(surface, o);
  vec3 u = lkEnvironmentU(uEnvironmentU, uEnvironmentAlphas, uEnvironmentLayers, towards, roughness * roughness);
  vec3 reflected = lkEnvironmentUnoccluded(surface, o, u);
  if (uOcclusion) reflected *= lkLobeSum(uVisibility, uVisibilityLobes, vLightmap, towards);
  radiance += uTerms.w * reflected;
#endif
  if (base.a < uAlphaCutoff) discard;
  if (!gl_FrontFacing && !uDoubleSided) radiance = vec3(0.0);
  // Linear radiance: expose, tone-map and encode in a later pass.
#ifdef LK_BLEND
  fragmentRadiance = clamp(base.a, 0.0, 1.0) * vec4(radiance, 1.0 - through);
#else
  fragmentRadiance = vec4(radiance, 1.0);
#endif
}
