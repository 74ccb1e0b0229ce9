// The page: opens the package, draws it when something has changed, and obeys its controls.

import { firstCamera } from "./first_camera.js";
import { lackingSwitches } from "./material.js";
import { Navigation, localCamera, readCamera } from "./navigation.js";
import { PackageError, openPackage } from "./package.js";
import { Picture } from "./picture.js";
import { Reference } from "./reference.js";

const status = document.getElementById("status");
const canvas = document.getElementById("picture");
const form = document.getElementById("controls");

export async function start() {
  if (!document.createElement("canvas").getContext("webgl2")) {
    throw new PackageError("This browser has no WebGL2, which the viewer draws with. Update it, or turn on hardware acceleration.");
  }
  const began = performance.now();
  const opened = await openPackage(document.body.dataset.package, (share) => {
    // What is still on its way when one file fails must not cover the sentence about it.
    if (!("failed" in status.dataset)) status.textContent = `Loading the package … ${Math.round(100 * share)} %`;
  });
  performance.mark("package read");
  const picture = new Picture(canvas, opened);
  const [stated] = Object.values(opened.manifest.views ?? {});
  const first = () => firstCamera(opened.meshes, picture.bounds, canvas.clientWidth / Math.max(canvas.clientHeight, 1));
  const given = readCamera(location.hash) ?? stated?.camera;
  picture.setCamera(given ? localCamera(given, opened.origin) : first());
  form.hidden = false;
  offerControls(picture);
  const reference = new Reference(picture, form);
  const redraw = drawWhenAsked(picture);
  const navigation = new Navigation(picture, canvas, redraw);
  form.addEventListener("input", ({ target }) => {
    if (target.name === "view" && reference.choose()) navigation.follow();
    obey(picture, navigation, reference);
    redraw();
  });
  form.addEventListener("submit", (event) => event.preventDefault());
  document.getElementById("save").addEventListener("click", () => save(picture));
  canvas.addEventListener("pointermove", ({ offsetX, offsetY }) => {
    if (!form.elements.sphere.checked) return;
    picture.pointAt((2 * offsetX) / canvas.clientWidth - 1, 1 - (2 * offsetY) / canvas.clientHeight);
    redraw();
  });
  new ResizeObserver(redraw).observe(canvas);
  obey(picture, navigation, reference);
  drawNow(picture);
  picture.firstFrame = { milliseconds: performance.now() - began, bytes: opened.bytes };
  status.textContent = `${(opened.bytes / 2 ** 20).toFixed(1)} MiB, drawn after ${(picture.firstFrame.milliseconds / 1000).toFixed(1)} s`;
  return picture;
}

function offerControls(picture) {
  const { lobes } = form.elements;
  lobes.max = picture.lobes;
  lobes.value = picture.lobes;
  for (const label of form.querySelectorAll("[data-environment]")) label.hidden = !picture.hasEnvironment;
  const lacking = lackingSwitches(picture.opened.shaders);
  if (!lacking.length) return;
  for (const [name] of lacking) {
    for (const control of form.querySelectorAll(`[data-switch=${name}]`)) control.disabled = true;
  }
  const note = document.getElementById("lacking");
  note.hidden = false;
  note.textContent = `The shaders of this package are older than this viewer and have no switches for: ${lacking.map(([, what]) => what).join(", ")}.`;
}

// What the controls say, put into the picture.
function obey(picture, navigation, reference) {
  const { exposure, tone, lobes, override, roughness, grid, sphere, walk, occlusion, stops, count, rough } = form.elements;
  const terms = [...form.querySelectorAll("[name=term]:checked")].map((input) => input.value);
  picture.setTerms(terms.map((term) => (term === "environment" && !occlusion.checked ? "unoccluded" : term)));
  picture.exposure = reference.exposure * 2 ** Number(exposure.value);
  reference.split();
  picture.toneMap = tone.value;
  picture.setLobes(Number(lobes.value));
  picture.setRoughness(override.checked ? Number(roughness.value) : null);
  picture.setTexelGrid(grid.checked);
  if (!sphere.checked) picture.at = null;
  navigation.setWalking(walk.value === "walk");
  stops.value = exposure.value;
  count.value = lobes.value;
  rough.value = roughness.value;
}

function drawNow(picture) {
  const ratio = Math.min(devicePixelRatio, 2);
  picture.draw(Math.max(1, Math.round(canvas.clientWidth * ratio)), Math.max(1, Math.round(canvas.clientHeight * ratio)));
  picture.finish();
}

// A function that asks for a frame, and tells how long it took.
function drawWhenAsked(picture) {
  let asked = false;
  return () => {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      const began = performance.now();
      drawNow(picture);
      status.textContent = `${(performance.now() - began).toFixed(1)} ms a frame`;
    });
  };
}

function save(picture) {
  drawNow(picture);
  canvas.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${document.querySelector("h1").textContent}.png`;
    link.click();
    URL.revokeObjectURL(link.href);
  });
}

// For whoever drives the page from outside: a promise of the Picture.
globalThis.viewer = start();
globalThis.viewer.catch((error) => {
  status.textContent = error instanceof PackageError ? error.message : `The viewer has a defect: ${error.message}`;
  status.dataset.failed = "";
});
