// A package as three.js objects: scene, textures, shaders, manifest; read from the URL of its folder.

import * as THREE from "../vendor/three/three.module.min.js";
import { EXRLoader } from "../vendor/three/EXRLoader.js";
import { GLTFLoader } from "../vendor/three/GLTFLoader.js";

const SHADERS = ["sg.glsl", "environment.glsl", "lightkiln.glsl", "surface.vert.glsl", "surface.frag.glsl"];
const TEXTURES = ["lightfield.ktx2", "visibility.ktx2", "irradiance.ktx2", "environment_u.ktx2", "environment_ggx.ktx2"];
const ENVIRONMENT = "environment.exr"; // packages made before 2026-11 may lack it
const LARGEST_ENVIRONMENT = 4096; // columns
const FORMAT_VERSION = 1;
const LARGEST_SIDE = 8192; // texels, of kiln_schemas.settings

// What can be wrong with a package, in a sentence for people.
export class PackageError extends Error {}

// { manifest, meshes, environment, textures: {name: THREE.Texture}, shaders: {name: text}, bytes }
export async function openPackage(folder, told = () => {}) {
  const manifest = await (await get(folder, "manifest.json")).json();
  if (manifest.format_version > FORMAT_VERSION) {
    throw new PackageError(`The package has format version ${manifest.format_version}; this viewer reads ${FORMAT_VERSION}. Update lightkiln.`);
  }
  const names = TEXTURES.filter((name) => name in manifest.textures);
  const parts = names.length + SHADERS.length + 2;
  let done = 0;
  const part = async (promise) => {
    const value = await promise;
    told((done += 1) / parts);
    return value;
  };
  const [glb, environment, textures, ...shaders] = await Promise.all([
    part(get(folder, "scene.glb").then((response) => response.arrayBuffer())),
    part(readEnvironment(folder, manifest)),
    readTextures(folder, names, manifest, part),
    ...SHADERS.map((name) => part(get(folder, `shaders/${name}`).then((response) => response.text()))),
  ]);
  const bytes = glb.byteLength + (environment?.fileBytes ?? 0) + Object.values(textures).reduce((sum, texture) => sum + texture.fileBytes, 0);
  return {
    manifest,
    bytes,
    environment,
    ...(await readMeshes(glb)),
    textures: Object.fromEntries(Object.entries(textures).map(([name, texture]) => [name, upload(texture, name)])),
    shaders: Object.fromEntries(SHADERS.map((name, index) => [name, shaders[index]])),
  };
}

async function get(folder, name) {
  const response = await fetch(folder + name);
  if (!response.ok) throw new PackageError(`${name} cannot be read: the server answered ${response.status}.`);
  return response;
}

// The environment as it was given, an equirectangular texture whose middle column is +X; null without one.
async function readEnvironment(folder, { textures }) {
  if (!(ENVIRONMENT in textures)) return null;
  const { width, height } = textures[ENVIRONMENT];
  if (!(width <= LARGEST_ENVIRONMENT && height <= LARGEST_ENVIRONMENT)) {
    throw new PackageError(`${ENVIRONMENT} has ${width} x ${height} pixels; at most ${LARGEST_ENVIRONMENT} columns are read.`);
  }
  const file = await (await get(folder, ENVIRONMENT)).arrayBuffer();
  let image;
  try {
    image = new EXRLoader().parse(file);
  } catch (error) {
    throw new PackageError(`${ENVIRONMENT} cannot be read: ${error.message}.`);
  }
  const texture = half(new THREE.DataTexture(image.data, image.width, image.height));
  texture.wrapS = THREE.RepeatWrapping;
  texture.minFilter = THREE.LinearFilter;
  texture.fileBytes = file.byteLength;
  return texture;
}

// Decoded textures by name, read and decoded in one worker.
async function readTextures(folder, names, manifest, part) {
  const worker = new Worker(new URL("./decode.js", import.meta.url), { type: "module" });
  const waiting = new Map();
  worker.onmessage = ({ data }) => {
    const { resolve, reject } = waiting.get(data.name);
    if (data.error) reject(new PackageError(`${data.name} cannot be read: ${data.error}.`));
    else resolve(data.texture);
  };
  worker.onerror = () => {
    for (const { reject } of waiting.values()) reject(new PackageError("The decoder of textures could not start."));
  };
  try {
    const entries = names.map(async (name) => {
      const texture = new Promise((resolve, reject) => waiting.set(name, { resolve, reject }));
      const described = manifest.textures[name];
      checkSize(name, described, manifest);
      worker.postMessage({ name, url: new URL(folder + name, location.href).href, described });
      return [name, await part(texture)];
    });
    return Object.fromEntries(await Promise.all(entries));
  } finally {
    worker.terminate();
  }
}

// What the manifest says of a texture has to fit the settings of the bake, which bound what is inflated.
function checkSize(name, { width, height, layers, faces }, { settings, lightmap }) {
  const environment = name.startsWith("environment_");
  const side = environment ? settings.package.environment_size : lightMapSide(settings.lightmap, lightmap);
  const most = { width: side, height: side, layers: environment ? 64 : 2 * settings.fit.lobes, faces: 6 };
  for (const [key, value] of Object.entries({ width, height, layers, faces })) {
    if (!Number.isInteger(value) || value < 1 || value > most[key]) {
      throw new PackageError(`${name} has ${value} as its ${key}; the settings of the bake allow 1 to ${most[key]}.`);
    }
  }
}

// Texels along each side of the light map: the number in the settings, or at `auto` what the bake chose.
function lightMapSide({ resolution }, { width }) {
  return resolution === "auto" ? Math.min(width, LARGEST_SIDE) : resolution;
}

function upload({ width, height, layers, faces, levels }, name) {
  let texture;
  if (faces === 6) {
    texture = new THREE.CubeTexture();
    const plane = (level, face) => {
      const side = Math.max(1, width >> level);
      const length = side * side * 4;
      return half(new THREE.DataTexture(levels[level].subarray(face * length, (face + 1) * length), side, side));
    };
    const cube = (level) => Array.from({ length: 6 }, (_, face) => plane(level, face));
    texture.image = cube(0);
    texture.mipmaps = levels.slice(1).map((_, index) => ({ image: cube(index + 1) }));
  } else if (layers > 1) {
    texture = new THREE.DataArrayTexture(levels[0], width, height, layers);
  } else {
    texture = new THREE.DataTexture(levels[0], width, height);
  }
  texture.minFilter = levels.length > 1 ? THREE.LinearMipmapLinearFilter : THREE.LinearFilter;
  texture.name = name;
  return half(texture);
}

function half(texture) {
  texture.format = THREE.RGBAFormat;
  texture.type = THREE.HalfFloatType;
  texture.magFilter = THREE.LinearFilter;
  texture.generateMipmaps = false;
  texture.flipY = false;
  texture.needsUpdate = true;
  return texture;
}

// The meshes of scene.glb as glTF's own materials describe them, and where the file has their (0, 0, 0): a scene far from the
// origin is drawn about a point amid it, because 32 bits do not resolve its own coordinates.
async function readMeshes(glb) {
  const { scene } = await new GLTFLoader().parseAsync(glb, "").catch((error) => {
    throw new PackageError(`scene.glb cannot be read: ${error.message}.`);
  });
  const meshes = [];
  const moved = scene.getObjectByName("origin");
  const origin = moved && !moved.isMesh ? moved.position.toArray() : [0, 0, 0];
  if (moved && !moved.isMesh) moved.position.set(0, 0, 0);
  scene.updateMatrixWorld(true);
  scene.traverse((node) => node.isMesh && meshes.push(node));
  for (const mesh of meshes) {
    if (!mesh.geometry.attributes.uv1) throw new PackageError(`scene.glb: '${mesh.name}' has no light-map coordinates (TEXCOORD_1).`);
  }
  return { meshes, origin };
}
