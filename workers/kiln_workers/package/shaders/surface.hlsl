// An example program: scene.glb in world space, stages vertexMain and pixelMain. HLSL for shader model 5 and newer.
//
// Define LK_ENVIRONMENT where the package has an environment, and LK_BASE_COLOR_MAP, LK_METALLIC_ROUGHNESS_MAP,
// LK_NORMAL_MAP and LK_EMISSION_MAP where the material has these textures (colours are sampled linear; transforms are
// those of KHR_texture_transform); LK_BASE_COLOR_UV and its like where one is looked up by another set than texCoord;
// LK_VERTEX_COLOR where the mesh has COLOR_0; LK_MORE_TEX_COORDS where textures use TEXCOORD_2 or TEXCOORD_3; LK_BLEND
// where a part of the light behind is seen (BLEND, KHR_materials_transmission): then the colour comes multiplied by its
// alpha. Matrices multiply columns and lie in memory column by column, as in OpenGL, which is what HLSL
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
  float transmission;
  float3 specularColor;  // KHR_materials_specular: 1, 1, 1 without it
  float specular;  // and 1
  float ior;  // KHR_materials_ior: 1.5
  float clearcoat;  // KHR_materials_clearcoat: 0
  float normalScale;
  float3x3 baseColorTransform;
  float3x3 metallicRoughnessTransform;
  float3x3 emissionTransform;
  float3x3 normalTransform;
};

Texture2DArray lightField : register(t0);
Texture2D irradiance : register(t1);
Texture2DArray visibility : register(t2);
Texture2DArray environmentU : register(t3);
Texture2D baseColorMap : register(t4);
Texture2D metallicRoughnessMap : register(t5);
Texture2D emissionMap : register(t6);
Texture2D normalMap : register(t7);
SamplerState lightSampler : register(s0);  // linear, clamped
SamplerState materialSampler : register(s1);

#ifndef LK_BASE_COLOR_UV
#define LK_BASE_COLOR_UV texCoord
#endif
#ifndef LK_METALLIC_ROUGHNESS_UV
#define LK_METALLIC_ROUGHNESS_UV texCoord
#endif
#ifndef LK_NORMAL_UV
#define LK_NORMAL_UV texCoord
#endif
#ifndef LK_EMISSION_UV
#define LK_EMISSION_UV texCoord
#endif

struct Vertex {
  float3 position : POSITION;
  float3 normal : NORMAL;
  float2 texCoord : TEXCOORD0;
  float2 lightmap : TEXCOORD1;
#ifdef LK_NORMAL_MAP
  float4 tangent : TANGENT;
#endif
#ifdef LK_VERTEX_COLOR
  float4 color : COLOR0;
#endif
#ifdef LK_MORE_TEX_COORDS
  float2 texCoord2 : TEXCOORD2;
  float2 texCoord3 : TEXCOORD3;
#endif
};

struct Pixel {
  float4 clip : SV_Position;
  float3 position : POSITION;
  float3 normal : NORMAL;
  float2 texCoord : TEXCOORD0;
  float2 lightmap : TEXCOORD1;
#ifdef LK_NORMAL_MAP
  float4 tangent : TANGENT;
#endif
#ifdef LK_VERTEX_COLOR
  float4 color : COLOR0;
#endif
#ifdef LK_MORE_TEX_COORDS
  float2 texCoord2 : TEXCOORD2;
  float2 texCoord3 : TEXCOORD3;
#endif
};

Pixel vertexMain(Vertex vertex) {
  Pixel pixel;
  pixel.clip = mul(viewProjection, float4(vertex.position, 1.0));
  pixel.position = vertex.position;
  pixel.normal = vertex.normal;
  pixel.texCoord = vertex.texCoord;
  pixel.lightmap = vertex.lightmap;
#ifdef LK_NORMAL_MAP
  pixel.tangent = vertex.tangent;
#endif
#ifdef LK_VERTEX_COLOR
  pixel.color = vertex.color;
#endif
#ifdef LK_MORE_TEX_COORDS
  pixel.texCoord2 = vertex.texCoord2;
  pixel.texCoord3 = vertex.texCoord3;
#endif
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
  base *= baseColorMap.Sample(materialSampler, mul(baseColorTransform, float3(pixel.LK_BASE_COLOR_UV, 1.0)).xy);
#endif
#ifdef LK_VERTEX_COLOR
  base *= pixel.color;
#endif
#ifdef LK_METALLIC_ROUGHNESS_MAP
  float2 at = mul(metallicRoughnessTransform, float3(pixel.LK_METALLIC_ROUGHNESS_UV, 1.0)).xy;
  glossy *= metallicRoughnessMap.Sample(materialSampler, at).gb;
#endif
#ifdef LK_EMISSION_MAP
  radiance *= emissionMap.Sample(materialSampler, mul(emissionTransform, float3(pixel.LK_EMISSION_UV, 1.0)).xy).rgb;
#endif
  float3 o = normalize(eye - pixel.position);
  LkSurface surface;
  float3 side = seenNormal(pixel, front, o);
  surface.normal = side;
#ifdef LK_NORMAL_MAP
  float2 bumpAt = mul(normalTransform, float3(pixel.LK_NORMAL_UV, 1.0)).xy;
  float3 texel = normalMap.Sample(materialSampler, bumpAt).rgb;
  surface.normal = lkMappedNormal(side, pixel.tangent * (front ? 1.0 : -1.0), texel, normalScale, o);
#endif
  surface.baseColor = saturate(base.rgb);
  surface.metallic = saturate(glossy.y);
  surface.roughness = saturate(glossy.x);
  surface.dielectric = lkDielectric(ior, specular, specularColor, clearcoat);
  float3 diffuse = lkDiffuse(irradiance, lightSampler, pixel.lightmap, surface, o);
#ifdef LK_BLEND
  // What is not reflected diffusely goes through, less Fresnel's share and tinted by the base colour; one alpha stands
  // for the three colours.
  float kept = transmission * (1.0 - surface.metallic);
  float away = 1.0 - saturate(dot(side, o));
  float f0 = max(surface.dielectric.x, max(surface.dielectric.y, surface.dielectric.z));
  float reflectedShare = f0 + (surface.dielectric.w - f0) * away * away * away * away * away;
  float through = kept * (1.0 - reflectedShare) * dot(surface.baseColor, 1.0 / 3.0);
  radiance += (1.0 - kept) * diffuse;
#else
  radiance += diffuse;
#endif
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
#ifdef LK_BLEND
  return saturate(base.a) * float4(radiance, 1.0 - through);
#else
  return float4(radiance, 1.0);
#endif
}
