// Reads a KTX2 file with ktx-parse, prints what it found as JSON and writes the container back:
// node ktx_round_trip.mjs INPUT OUTPUT
import { readFile, writeFile } from "node:fs/promises";
import { createHash } from "node:crypto";
import { read, write } from "ktx-parse";

const [, , input, output] = process.argv;
const container = read(new Uint8Array(await readFile(input)));
await writeFile(output, write(container, { keepWriter: true }));
const decoder = new TextDecoder();
console.log(
  JSON.stringify({
    vkFormat: container.vkFormat,
    typeSize: container.typeSize,
    pixelWidth: container.pixelWidth,
    pixelHeight: container.pixelHeight,
    pixelDepth: container.pixelDepth,
    layerCount: container.layerCount,
    faceCount: container.faceCount,
    supercompressionScheme: container.supercompressionScheme,
    descriptor: container.dataFormatDescriptor,
    levels: container.levels.map((level) => ({
      bytes: level.levelData.byteLength,
      uncompressed: level.uncompressedByteLength,
      sha256: createHash("sha256").update(level.levelData).digest("hex"),
    })),
    keyValue: Object.fromEntries(
      Object.entries(container.keyValue).map(([key, value]) => [
        key,
        typeof value === "string" ? value : decoder.decode(value),
      ]),
    ),
  }),
);
