// An example program: scene.glb in world space, stages vertexMain and pixelMain. HLSL for shader model 5 and newer.
//
// Define LK_ENVIRONMENT where the package has an environment, and LK_BASE_COLOR_MAP, LK_METALLIC_ROUGHNESS_MAP and
// LK_EMISSION_MAP where the material has these textures (colours are sampled linear; transforms are those of
// KHR_texture_transform). Matrices multiply columns and lie in memory column by column, as in OpenGL, which is what HLSL
// does unless it is told otherwise. Front faces are counter-clockwise, as in glTF, which Direct3D has to be told.

#include "lightkiln.hlsl"

cbuffer View : register(b0) {
  float4x4 viewProjection;
  float3 eye;
  int lightFieldLobes;
  int visibilityLobes;
  int environmentLayers;
  float environmentAlphas[LK_MAX_U_LAYERS];  // each takes 16 bytes
};

cbuffer Material : register(b1) {
  float4 baseColor;
  float3 emission;
  float metallic;
  float roughness;
  float alphaCutoff;
  bool doubleSided;
  float3x3 baseColorTransform;
  float3x3 metallicRoughnessTransform;
  float3x3 emissionTransform;
};

Texture2DArray lightField : register(t0);
Texture2D irradiance : register(t1);
Texture2DArray visibility : register(t2);
Texture2DArray environmentU : register(t3);
Texture2D baseColorMap : register(t4);
Texture2D metallicRoughnessMap : register(t5);
Texture2D emissionMap : register(t6);
SamplerState lightSampler : register(s0);  // linear, clamped
SamplerState materialSampler : register(s1);

struct Vertex {
  float3 position : POSITION;
  float3 normal : NORMAL;
  float2 texCoord : TEXCOORD0;
  float2 lightmap : TEXCOORD1;
};

struct Pixel {
  float4 clip : SV_Position;
  float3 position : POSITION;
  float3 normal : NORMAL;
  float2 texCoord : TEXCOORD0;
  float2 lightmap : TEXCOORD1;
};

Pixel vertexMain(Vertex vertex) {
  Pixel pixel;
  pixel.clip = mul(viewProjection, float4(vertex.position, 1.0));
  pixel.position = vertex.position;
  pixel.normal = vertex.normal;
  pixel.texCoord = vertex.texCoord;
  pixel.lightmap = vertex.lightmap;
  return pixel;
}

// The shading normal on the side of the eye; the triangle's own where the interpolated one faces away.
float3 seenNormal(Pixel pixel, bool front, float3 o) {
  float3 face = normalize(cross(ddx(pixel.position), ddy(pixel.position)));
  float3 normal = normalize(pixel.normal) * (front ? 1.0 : -1.0);
  if (dot(normal, o) > 0.0) return normal;
  return dot(face, o) < 0.0 ? -face : face;
}

float4 pixelMain(Pixel pixel, bool front : SV_IsFrontFace) : SV_Target {
  float4 base = baseColor;
  float2 glossy = float2(roughness, metallic);
  float3 radiance = emission;
#ifdef LK_BASE_COLOR_MAP
  base *= baseColorMap.Sample(materialSampler, mul(baseColorTransform, float3(pixel.texCoord, 1.0)).xy);
#endif
#ifdef LK_METALLIC_ROUGHNESS_MAP
  float2 at = mul(metallicRoughnessTransform, float3(pixel.texCoord, 1.0)).xy;
  glossy *= metallicRoughnessMap.Sample(materialSampler, at).gb;
#endif
#ifdef LK_EMISSION_MAP
  radiance *= emissionMap.Sample(materialSampler, mul(emissionTransform, float3(pixel.texCoord, 1.0)).xy).rgb;
#endif
  float3 o = normalize(eye - pixel.position);
  LkSurface surface;
  surface.normal = seenNormal(pixel, front, o);
  surface.baseColor = saturate(base.rgb);
  surface.metallic = saturate(glossy.y);
  surface.roughness = saturate(glossy.x);
  radiance += lkDiffuse(irradiance, lightSampler, pixel.lightmap, surface, o);
  radiance += lkInterreflection(lightField, lightSampler, lightFieldLobes, pixel.lightmap, surface, o);
#ifdef LK_ENVIRONMENT
  float3 towards = lkGlossyDirection(surface, o);
  float alpha = surface.roughness * surface.roughness;
  float3 u = lkEnvironmentU(environmentU, lightSampler, environmentAlphas, environmentLayers, towards, alpha);
  radiance += lkEnvironmentReflection(visibility, lightSampler, visibilityLobes, pixel.lightmap, surface, o, u);
#endif
  if (base.a < alphaCutoff) discard;
  if (!front && !doubleSided) radiance = 0.0;
  // Linear radiance: expose, tone-map and encode in a later pass.
  return float4(radiance, 1.0);
}
