// The package's own GLSL as a three.js material. Nothing is computed here that the package's shaders do not compute; the
// viewer's `main` runs theirs, then may draw the texel grid over it.

import * as THREE from "../vendor/three/three.module.min.js";

export const INCLUDES = ["sg.glsl", "environment.glsl", "lightkiln.glsl"];
const MAX_U_LAYERS = 16; // LK_MAX_U_LAYERS

// Uniforms by which the example shader leaves things out or overrides them, and what for; older packages' have not all.
const SWITCHES = { uTerms: "single terms", uOcclusion: "visibility", uRoughnessBias: "one roughness" };

// Those that a package's shaders lack.
export function lackingSwitches(shaders) {
  const has = (name) => new RegExp(`uniform\\s+\\w+\\s+${name}\\b`).test(shaders["surface.frag.glsl"]);
  return Object.entries(SWITCHES).filter(([name]) => !has(name));
}

export const PRECISION = `precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
precision highp samplerCube;
`;

const GRID = `
#undef main
uniform bool uTexelGrid;
void main() {
  lkExampleMain();
  if (!uTexelGrid) return;
  vec2 at = vLightmap * vec2(textureSize(uIrradiance, 0));
  vec2 line = 1.0 - smoothstep(0.0, 1.5, (0.5 - abs(fract(at) - 0.5)) / fwidth(at));
  fragmentRadiance.rgb = mix(fragmentRadiance.rgb, vec3(0.9, 0.45, 0.05), 0.7 * max(line.x, line.y));
}
`;

// Uniforms that all materials share: what lights, and what is shown.
export function makeShared({ manifest, textures }) {
  const lobes = (name) => (name in textures ? textures[name].image.depth / 2 : 0);
  const u = manifest.textures["environment_u.ktx2"];
  const alphas = new Float32Array(MAX_U_LAYERS).fill(1);
  alphas.set(u?.alphas ?? []);
  return {
    uEye: { value: new THREE.Vector3() },
    uViewProjection: { value: new THREE.Matrix4() },
    uTerms: { value: new THREE.Vector4(1, 1, 1, 1) },
    uOcclusion: { value: true },
    uTexelGrid: { value: false },
    uLightField: { value: textures["lightfield.ktx2"] },
    uLightFieldLobes: { value: lobes("lightfield.ktx2") },
    uIrradiance: { value: textures["irradiance.ktx2"] },
    uVisibility: { value: textures["visibility.ktx2"] ?? null },
    uVisibilityLobes: { value: lobes("visibility.ktx2") },
    uEnvironmentU: { value: textures["environment_u.ktx2"] ?? null },
    uEnvironmentAlphas: { value: alphas },
    uEnvironmentLayers: { value: u?.layers ?? 0 },
  };
}

// The material of a mesh of `geometry` that glTF describes by `described`, a MeshStandardMaterial.
export function makeMaterial(described, geometry, shaders, shared, environment) {
  const defines = {};
  const veil = described.transparent || described.transmission > 0;
  if (veil) defines.LK_BLEND = "";
  if (geometry.attributes.color) defines.LK_VERTEX_COLOR = "";
  if (geometry.attributes.uv2) defines.LK_MORE_TEX_COORDS = "";
  if (environment) defines.LK_ENVIRONMENT = "";
  const own = {
    uBaseColor: { value: new THREE.Vector4(...described.color.toArray(), described.opacity) },
    uMetallic: { value: described.metalness },
    uRoughness: { value: described.roughness },
    uRoughnessBias: { value: 0 },
    uEmission: { value: described.emissive.clone().multiplyScalar(described.emissiveIntensity) },
    uAlphaCutoff: { value: described.alphaTest },
    uDoubleSided: { value: described.side === THREE.DoubleSide },
    uTransmission: { value: described.transmission ?? 0 },
    uIor: { value: described.ior ?? 1.5 },
    uSpecular: { value: described.specularIntensity ?? 1 },
    uSpecularColor: { value: described.specularColor ?? new THREE.Color(1, 1, 1) },
    uNormalScale: { value: described.normalScale?.x ?? 1 },
    uClearcoat: { value: described.clearcoat ?? 0 },
  };
  // scene.glb has tangents wherever it has a normal map.
  const normalMap = geometry.attributes.tangent ? "normalMap" : null;
  const maps = {
    BASE_COLOR: ["map", "uBaseColor"],
    METALLIC_ROUGHNESS: ["roughnessMap", "uMetallicRoughness"],
    NORMAL: [normalMap, "uNormal"],
    EMISSION: ["emissiveMap", "uEmission"],
  };
  for (const [define, [key, name]] of Object.entries(maps)) {
    const texture = described[key];
    if (!texture) continue;
    defines[`LK_${define}_MAP`] = "";
    if (texture.channel > 1) defines[`LK_${define}_UV`] = `vTexCoord${texture.channel}`;
    own[`${name}Map`] = { value: texture };
    own[`${name}Transform`] = { value: textureTransform(texture) };
  }
  const fragment = [...INCLUDES, "surface.frag.glsl"].map((name) => shaders[name]).join("\n");
  return new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    defines,
    uniforms: { ...shared, ...own },
    vertexShader: PRECISION + shaders["surface.vert.glsl"],
    fragmentShader: `${PRECISION}#define main lkExampleMain\n${fragment}${GRID}`,
    side: THREE.DoubleSide,
    // Veils are drawn after all else, from back to front; their colour comes multiplied by alpha.
    transparent: veil,
    premultipliedAlpha: veil,
    depthWrite: !veil,
    userData: { roughness: described.roughness },
  });
}

// KHR_texture_transform as it is specified: scaled, then rotated, then moved. three.js' own matrix rotates first, which is
// another one where the two scales differ.
function textureTransform({ offset, repeat, rotation }) {
  const [c, s] = [Math.cos(rotation), Math.sin(rotation)];
  return new THREE.Matrix3().set(c * repeat.x, s * repeat.y, offset.x, -s * repeat.x, c * repeat.y, offset.y, 0, 0, 1);
}

// The attributes under the names that the package's vertex shader reads.
export function nameAttributes(geometry) {
  const { position, normal, tangent, uv, uv1, uv2, uv3, color } = geometry.attributes;
  const named = { aPosition: position, aNormal: normal, aTexCoord0: uv, aTexCoord1: uv1, aColor: color };
  Object.assign(named, { aTangent: tangent, aTexCoord2: uv2, aTexCoord3: uv3 ?? uv2 });
  for (const [name, attribute] of Object.entries(named)) if (attribute) geometry.setAttribute(name, attribute);
}
