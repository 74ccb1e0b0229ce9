// An example program: scene.glb in world space, stages vertexMain and fragmentMain. WGSL; concatenate after sg.wgsl,
// environment.wgsl and lightkiln.wgsl.
//
// WGSL has no preprocessor: bind a white texel where the material has no texture (colours are sampled linear; transforms
// are those of KHR_texture_transform), a white vertex where the mesh has no COLOR_0, any set where it lacks a further one,
// normalScale = 0 where it has no normal map, and where the package has no environment any texel with visibilityLobes = 0. Where `blend` is set, for BLEND and
// KHR_materials_transmission, a part of the light behind is seen: then the colour comes multiplied by its alpha.
// Matrices multiply columns; front faces are counter-clockwise, as in glTF.

struct View {
  viewProjection: mat4x4f,
  eye: vec3f,
  lightFieldLobes: i32,
  visibilityLobes: i32,
  environmentLayers: i32,
}

struct Material {
  baseColor: vec4f,
  emission: vec3f,
  metallic: f32,
  roughness: f32,
  alphaCutoff: f32,
  doubleSided: u32,
  blend: u32,
  specularColor: vec3f,  // KHR_materials_specular: 1, 1, 1 without it
  specular: f32,  // and 1
  ior: f32,  // KHR_materials_ior: 1.5
  clearcoat: f32,  // KHR_materials_clearcoat: 0
  transmission: f32,
  normalScale: f32,
  uvSets: vec4u,  // of base colour, metallic and roughness, emission, normal: 0 is TEXCOORD_0, 1 TEXCOORD_2, 2 TEXCOORD_3
  baseColorTransform: mat3x3f,
  metallicRoughnessTransform: mat3x3f,
  emissionTransform: mat3x3f,
  normalTransform: mat3x3f,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> environmentAlphas: array<f32, LK_MAX_U_LAYERS>;
@group(0) @binding(2) var lightField: texture_2d_array<f32>;
@group(0) @binding(3) var irradiance: texture_2d<f32>;
@group(0) @binding(4) var visibility: texture_2d_array<f32>;
@group(0) @binding(5) var environmentU: texture_2d_array<f32>;
@group(0) @binding(6) var lightSampler: sampler;  // linear, clamped
@group(1) @binding(0) var<uniform> material: Material;
@group(1) @binding(1) var baseColorMap: texture_2d<f32>;
@group(1) @binding(2) var metallicRoughnessMap: texture_2d<f32>;
@group(1) @binding(3) var emissionMap: texture_2d<f32>;
@group(1) @binding(4) var materialSampler: sampler;
@group(1) @binding(5) var normalMap: texture_2d<f32>;

struct Vertex {
  @location(0) position: vec3f,
  @location(1) normal: vec3f,
  @location(2) texCoord: vec2f,
  @location(3) lightmap: vec2f,
  @location(4) color: vec4f,
  @location(5) texCoord2: vec2f,
  @location(6) texCoord3: vec2f,
  @location(7) tangent: vec4f,
}

struct Fragment {
  @builtin(position) clip: vec4f,
  @location(0) position: vec3f,
  @location(1) normal: vec3f,
  @location(2) texCoord: vec2f,
  @location(3) lightmap: vec2f,
  @location(4) color: vec4f,
  @location(5) texCoord2: vec2f,
  @location(6) texCoord3: vec2f,
  @location(7) tangent: vec4f,
}

@vertex fn vertexMain(vertex: Vertex) -> Fragment {
  let clip = view.viewProjection * vec4f(vertex.position, 1.0);
  return Fragment(
    clip, vertex.position, vertex.normal, vertex.texCoord, vertex.lightmap, vertex.color, vertex.texCoord2,
    vertex.texCoord3, vertex.tangent,
  );
}

// The shading normal on the side of the eye; the triangle's own where the interpolated one faces away.
fn seenNormal(fragment: Fragment, front: bool, o: vec3f) -> vec3f {
  let face = normalize(cross(dpdx(fragment.position), dpdy(fragment.position)));
  let normal = normalize(fragment.normal) * select(-1.0, 1.0, front);
  if (dot(normal, o) > 0.0) {
    return normal;
  }
  return select(face, -face, dot(face, o) < 0.0);
}

// Where a texture is looked up whose coordinates are those of a set.
fn placeIn(fragment: Fragment, uvSet: u32, transform: mat3x3f) -> vec2f {
  let uv = select(select(fragment.texCoord3, fragment.texCoord2, uvSet == 1), fragment.texCoord, uvSet == 0);
  return (transform * vec3f(uv, 1.0)).xy;
}

@fragment fn fragmentMain(fragment: Fragment, @builtin(front_facing) front: bool) -> @location(0) vec4f {
  let baseAt = placeIn(fragment, material.uvSets.x, material.baseColorTransform);
  let glossyAt = placeIn(fragment, material.uvSets.y, material.metallicRoughnessTransform);
  let emissionAt = placeIn(fragment, material.uvSets.z, material.emissionTransform);
  let base = material.baseColor * fragment.color * textureSample(baseColorMap, materialSampler, baseAt);
  let glossy = vec2f(material.roughness, material.metallic)
    * textureSample(metallicRoughnessMap, materialSampler, glossyAt).gb;
  var radiance = material.emission * textureSample(emissionMap, materialSampler, emissionAt).rgb;
  let bumpAt = placeIn(fragment, material.uvSets.w, material.normalTransform);
  let texel = textureSample(normalMap, materialSampler, bumpAt).rgb;
  let o = normalize(view.eye - fragment.position);
  let side = seenNormal(fragment, front, o);
  var normal = side;
  if (material.normalScale != 0.0) {
    normal = lkMappedNormal(side, fragment.tangent * select(-1.0, 1.0, front), texel, material.normalScale, o);
  }
  let surface = LkSurface(
    normal, saturate(base.rgb), saturate(glossy.y), saturate(glossy.x),
    lkDielectric(material.ior, material.specular, material.specularColor, material.clearcoat),
  );
  // What is not reflected diffusely goes through, less Fresnel's share and tinted by the base colour; one alpha stands for
  // the three colours.
  let kept = material.transmission * (1.0 - surface.metallic);
  let away = 1.0 - saturate(dot(side, o));
  let f0 = max(surface.dielectric.x, max(surface.dielectric.y, surface.dielectric.z));
  let reflectedShare = f0 + (surface.dielectric.w - f0) * away * away * away * away * away;
  let through = kept * (1.0 - reflectedShare) * dot(surface.baseColor, vec3f(1.0 / 3.0));
  radiance += (1.0 - kept) * lkDiffuse(irradiance, lightSampler, fragment.lightmap, surface, o);
  radiance += lkInterreflection(lightField, lightSampler, view.lightFieldLobes, fragment.lightmap, surface, o);
  let towards = lkGlossyDirection(surface, o);
  let alpha = surface.roughness * surface.roughness;
  let u = lkEnvironmentU(environmentU, lightSampler, environmentAlphas, view.environmentLayers, towards, alpha);
  radiance += lkEnvironmentReflection(
    visibility, lightSampler, view.visibilityLobes, fragment.lightmap, surface, o, u,
  );
  if (base.a < material.alphaCutoff) {
    discard;
  }
  if (!front && material.doubleSided == 0) {
    radiance = vec3f(0.0);
  }
  // Linear radiance: expose, tone-map and encode in a later pass.
  if (material.blend == 0) {
    return vec4f(radiance, 1.0);
  }
  return saturate(base.a) * vec4f(radiance, 1.0 - through);
}
