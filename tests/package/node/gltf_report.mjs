// Prints the Khronos glTF validator's report of a GLB as JSON: node gltf_report.mjs FILE
import { readFile } from "node:fs/promises";
import validator from "gltf-validator";

const bytes = new Uint8Array(await readFile(process.argv[2]));
const report = await validator.validateBytes(bytes, { maxIssues: 100 });
console.log(JSON.stringify({ issues: report.issues, info: report.info }));
