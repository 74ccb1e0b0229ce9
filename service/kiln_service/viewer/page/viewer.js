// The page: opens the package, draws it, and obeys its controls.

import { PackageError, openPackage } from "./package.js";
import { Picture } from "./picture.js";

const status = document.getElementById("status");
const canvas = document.getElementById("picture");

export async function start() {
  if (!document.createElement("canvas").getContext("webgl2")) {
    throw new PackageError("This browser has no WebGL2, which the viewer draws with. Update it, or turn on hardware acceleration.");
  }
  const opened = await openPackage(document.body.dataset.package, (share) => {
    status.textContent = `Loading the package … ${Math.round(100 * share)} %`;
  });
  const picture = new Picture(canvas, opened);
  status.textContent = "";
  return picture;
}

// For whoever drives the page from outside: a promise of the Picture.
globalThis.viewer = start();
globalThis.viewer.catch((error) => {
  status.textContent = error instanceof PackageError ? error.message : `The viewer has a defect: ${error.message}`;
  status.dataset.failed = "";
});
