// Fragment stage of an example program. GLSL ES 3.00; concatenate after sg.glsl, environment.glsl and lightkiln.glsl.
// Textures of the material are left out. Define LK_ENVIRONMENT where the package has an environment.

uniform vec3 uEye;
uniform vec4 uBaseColor;
uniform float uMetallic;
uniform float uRoughness;
uniform vec3 uEmission;

uniform sampler2DArray uLightField;
uniform int uLightFieldLobes;
uniform sampler2D uIrradiance;
#ifdef LK_ENVIRONMENT
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

out vec4 fragmentRadiance;

void main() {
  vec3 o = normalize(uEye - vPosition);
  LkSurface surface = LkSurface(normalize(vNormal), uBaseColor.rgb, uMetallic, uRoughness);
  vec3 radiance = uEmission + lkDiffuse(uIrradiance, vLightmap, surface, o);
  radiance += lkInterreflection(uLightField, uLightFieldLobes, vLightmap, surface, o);
#ifdef LK_ENVIRONMENT
  vec3 towards = lkGlossyDirection(surface, o);
  float alpha = uRoughness * uRoughness;
  vec3 u = lkEnvironmentU(uEnvironmentU, uEnvironmentAlphas, uEnvironmentLayers, towards, alpha);
  radiance += lkEnvironmentReflection(uVisibility, uVisibilityLobes, vLightmap, surface, o, u);
#endif
  // Linear radiance: expose, tone-map and encode in a later pass.
  fragmentRadiance = vec4(radiance, uBaseColor.a);
}
