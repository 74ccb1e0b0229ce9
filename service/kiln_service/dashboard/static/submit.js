// Upload the files one by one, then submit the job that they make. What is wrong is said at the field that it is about.
const form = document.getElementById("submit");
const field = (id) => document.getElementById(id);
const SCENES = [".glb", ".gltf", ".fbx", ".dae", ".obj", ".ply", ".stl", ".off", ".xml"];
const FIELDS = {
  "gates.log_mse_rel": "log_mse_rel",
  "gates.visibility_log_mse_rel": "visibility_log_mse_rel",
  "bundle.environment": "environment",
  bundle: "files",
  name: "name",
  preset: "preset",
  priority: "rank",
  labels: "labels",
  ...Object.fromEntries(["--set", "set", "lightmap", "render", "fit", "package", "seed"].map((name) => [name, "set"])),
};
let faults = 0;
const words = (text) => text.split(/\s+/).filter(Boolean);

field("files").addEventListener("change", () => {
  const scenes = [...field("files").files].map((file) => file.name).filter((name) => SCENES.some((end) => name.toLowerCase().endsWith(end)));
  field("entry").replaceChildren(...scenes.map((name) => new Option(name, name)));
  field("entry-row").hidden = scenes.length < 2;
  if (scenes.length && !field("name").value) field("name").value = scenes[0].replace(/\.\w+$/, "").slice(0, 128);
  say(scenes.length ? "" : `None of these is a scene (${SCENES.join(", ")}).`, !scenes.length);
});

field("add-view").addEventListener("click", () => {
  const view = field("view").content.cloneNode(true).firstElementChild;
  view.querySelector("button").addEventListener("click", () => {
    view.remove();
    field("add-view").focus();
  });
  field("views").append(view);
  view.querySelector("input").focus();
});

form.addEventListener("input", ({ target }) => mend(target));

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  [...form.querySelectorAll("[aria-invalid]")].forEach(mend);
  const names = views().map(({ name }) => name.value);
  views().forEach(({ name }, place) => name.setCustomValidity(names.indexOf(name.value) < place ? "Another camera has this name." : ""));
  const wrong = [...form.elements].filter((input) => input.willValidate && !input.checkValidity());
  for (const input of wrong.reverse()) fault(input, [input.validationMessage, input.validity.patternMismatch ? input.title : ""].filter(Boolean).join(" "));
  if (wrong.length) return say("Nothing was uploaded yet: see the marked fields.", true);
  if (!field("entry").value) return fault(field("files"), `None of these is a scene (${SCENES.join(", ")}).`);
  const button = form.querySelector("button.main");
  button.disabled = true;
  try {
    location.href = await submit();
  } catch (error) {
    say(error.message, true);
    const input = fieldOf(error.where ?? "");
    if (input) fault(input, error.message);
    field("uploaded").hidden = true;
  } finally {
    button.disabled = false;
  }
});

async function submit() {
  const environment = field("environment").files[0];
  const files = [...field("files").files, ...(environment ? [environment] : [])];
  const total = files.reduce((sum, file) => sum + file.size, 0) || 1;
  const hashes = {};
  let sent = 0;
  for (const file of files) {
    say(`Uploading ${file.name} …`);
    hashes[file.name] = (await send("PUT", "/submit/files", file, (bytes) => tell((sent + bytes) / total))).sha256;
    sent += file.size;
  }
  say("Submitting …");
  const labels = Object.fromEntries(words(field("labels").value).map((word) => [word.split("=")[0], word.split("=").slice(1).join("=")]));
  const request = {
    name: field("name").value,
    preset: field("preset").value,
    priority: Number(field("rank").value),
    labels,
    set: words(field("set").value),
    ...gates(),
    bundle: { entry: field("entry").value, files: hashes, environment: environment ? { file: environment.name } : null },
  };
  return (await send("POST", "/submit", JSON.stringify(request))).location;
}

// The stated gates, and the cameras that they look from.
function gates() {
  const errors = ["log_mse_rel", "visibility_log_mse_rel"].filter((name) => field(name).value);
  const [flip, cameras] = [{}, {}];
  for (const view of views()) {
    const [position, target, [fov_deg]] = view.camera.value.split(":").map((part) => part.split(",").map(Number));
    flip[view.name.value] = Number(view.flip.value);
    cameras[view.name.value] = { position, target, fov_deg };
  }
  return { gates: { ...Object.fromEntries(errors.map((name) => [name, Number(field(name).value)])), flip }, cameras };
}

function views() {
  const inputs = (view) => Object.fromEntries(["name", "camera", "flip"].map((part) => [part, view.querySelector(`.${part}`)]));
  return [...form.querySelectorAll(".view")].map(inputs);
}

// The field that a problem's `where` is about; null where it is about none.
function fieldOf(where) {
  const under = (prefix, name) => `${where}.`.startsWith(`${prefix}${name}.`);
  for (const view of views()) {
    if (under("gates.flip.", view.name.value)) return view.flip;
    if (under("cameras.", view.name.value)) return view.camera;
  }
  return field(Object.keys(FIELDS).filter((name) => under("", name)).map((name) => FIELDS[name])[0] ?? "");
}

// Say what is wrong with a field, beside it, and go there.
function fault(input, text) {
  mend(input);
  faults += 1;
  const said = Object.assign(document.createElement("p"), { className: "wrong", id: `fault-${faults}`, textContent: text });
  (input.closest("label") ?? input).after(said);
  input.setAttribute("aria-invalid", "true");
  input.dataset.described = input.getAttribute("aria-describedby") ?? "";
  input.setAttribute("aria-describedby", `${said.id} ${input.dataset.described}`.trim());
  for (let fold = input.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
  input.focus();
}

function mend(input) {
  if (!input.hasAttribute("aria-invalid")) return;
  document.getElementById(input.getAttribute("aria-describedby").split(" ")[0]).remove();
  input.removeAttribute("aria-invalid");
  if (input.dataset.described) input.setAttribute("aria-describedby", input.dataset.described);
  else input.removeAttribute("aria-describedby");
}

function send(method, path, body, onProgress = () => {}) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open(method, path);
    request.responseType = "json";
    request.setRequestHeader("X-CSRF-Token", form.dataset.csrf);
    request.setRequestHeader("Accept", "application/json");
    request.setRequestHeader("Content-Type", typeof body === "string" ? "application/json" : "application/octet-stream");
    request.upload.addEventListener("progress", (event) => onProgress(event.loaded));
    request.addEventListener("error", () => reject(new Error("The coordinator does not answer.")));
    request.addEventListener("load", () => {
      if (request.status < 300) return resolve(request.response);
      const problem = request.response ?? {};
      const told = [problem.detail ?? `Answer ${request.status}`, problem.where, problem.remedy].filter(Boolean).join(". ");
      reject(Object.assign(new Error(told), { where: problem.where }));
    });
    request.send(body);
  });
}

function tell(share) {
  field("uploaded").hidden = false;
  field("uploaded").value = share;
}

function say(text, wrong = false) {
  field("submit-note").textContent = text;
  field("submit-note").classList.toggle("wrong", wrong);
}
