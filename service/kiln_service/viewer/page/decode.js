// The worker that turns KTX2 files into the halves that WebGL uploads, so that the page stays responsive meanwhile.
//
// three.js' own KTX2 loader takes an uncompressed fp16 array for a single 2D texture; this one takes what lightkiln
// writes (RGBA16F: planes, arrays, cubes with mips; plain or Zstandard) and refuses everything else in a sentence.

import { KHR_SUPERCOMPRESSION_NONE, KHR_SUPERCOMPRESSION_ZSTD, read } from "../vendor/ktx-parse/ktx-parse.js";

const RGBA16F = 97; // VK_FORMAT_R16G16B16A16_SFLOAT
const TEXEL_BYTES = 8;

self.onmessage = async ({ data: { name, url, described } }) => {
  try {
    const response = await fetch(url);
    if (!response.ok) throw new Error(`the server answered ${response.status}`);
    const bytes = new Uint8Array(await response.arrayBuffer());
    const texture = await decode(bytes, described);
    self.postMessage({ name, texture: { ...texture, fileBytes: bytes.length } }, texture.levels.map((level) => level.buffer));
  } catch (error) {
    self.postMessage({ name, error: error.message });
  }
};

// Levels are Uint16Array, [layer][face][row][column][RGBA], row 0 at the top.
// Nothing is inflated of a file that declares another size than the manifest does.
async function decode(bytes, described) {
  const file = read(bytes);
  if (file.vkFormat !== RGBA16F) throw new Error(`its format is ${file.vkFormat}, not RGBA16F`);
  const { pixelWidth: width, pixelHeight: height, faceCount: faces } = file;
  const layers = Math.max(1, file.layerCount);
  const declared = { width, height, layers, faces };
  for (const [key, value] of Object.entries(declared)) {
    if (value !== described[key]) throw new Error(`it has ${value} as its ${key}; the manifest says ${described[key]}`);
  }
  if (file.levels.length > 1 + Math.log2(Math.max(width, height))) throw new Error(`it has ${file.levels.length} levels`);
  const levels = [];
  for (const [number, level] of file.levels.entries()) {
    const size = Math.max(1, width >> number) * Math.max(1, height >> number) * layers * faces * TEXEL_BYTES;
    const data = await inflate(file.supercompressionScheme, level, size);
    if (data.byteLength !== size) throw new Error(`level ${number} has ${data.byteLength} bytes instead of ${size}`);
    levels.push(new Uint16Array(data.slice().buffer));
  }
  return { width, height, layers, faces, levels };
}

let zstd = null; // a promise, so that textures that arrive together wait for the same decoder

async function inflate(scheme, level, size) {
  if (scheme === KHR_SUPERCOMPRESSION_NONE) return level.levelData;
  if (scheme !== KHR_SUPERCOMPRESSION_ZSTD) throw new Error(`its supercompression scheme is ${scheme}`);
  zstd ??= loadZstd();
  return (await zstd).decode(level.levelData, size);
}

async function loadZstd() {
  const { ZSTDDecoder } = await import("../vendor/zstddec/zstddec.js");
  const decoder = new ZSTDDecoder();
  await decoder.init();
  return decoder;
}
