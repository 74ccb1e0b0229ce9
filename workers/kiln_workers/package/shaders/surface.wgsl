// An example program: scene.glb in world space, stages vertexMain and fragmentMain. WGSL; concatenate after sg.wgsl,
// environment.wgsl and lightkiln.wgsl.
//
// WGSL has no preprocessor: bind a white texel where the material has no texture (colours are sampled linear; transforms
// are those of KHR_texture_transform), and where the package has no environment any texel with visibilityLobes = 0.
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
  baseColorTransform: mat3x3f,
  metallicRoughnessTransform: mat3x3f,
  emissionTransform: mat3x3f,
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

struct Vertex {
  @location(0) position: vec3f,
  @location(1) normal: vec3f,
  @location(2) texCoord: vec2f,
  @location(3) lightmap: vec2f,
}

struct Fragment {
  @builtin(position) clip: vec4f,
  @location(0) position: vec3f,
  @location(1) normal: vec3f,
  @location(2) texCoord: vec2f,
  @location(3) lightmap: vec2f,
}

@vertex fn vertexMain(vertex: Vertex) -> Fragment {
  let clip = view.viewProjection * vec4f(vertex.position, 1.0);
  return Fragment(clip, vertex.position, vertex.normal, vertex.texCoord, vertex.lightmap);
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

@fragment fn fragmentMain(fragment: Fragment, @builtin(front_facing) front: bool) -> @location(0) vec4f {
  let uv = vec3f(fragment.texCoord, 1.0);
  let base = material.baseColor
    * textureSample(baseColorMap, materialSampler, (material.baseColorTransform * uv).xy);
  let glossy = vec2f(material.roughness, material.metallic)
    * textureSample(metallicRoughnessMap, materialSampler, (material.metallicRoughnessTransform * uv).xy).gb;
  var radiance = material.emission
    * textureSample(emissionMap, materialSampler, (material.emissionTransform * uv).xy).rgb;
  let o = normalize(view.eye - fragment.position);
  let surface = LkSurface(
    seenNormal(fragment, front, o), saturate(base.rgb), saturate(glossy.y), saturate(glossy.x),
  );
  radiance += lkDiffuse(irradiance, lightSampler, fragment.lightmap, surface, o);
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
  return vec4f(radiance, 1.0);
}
