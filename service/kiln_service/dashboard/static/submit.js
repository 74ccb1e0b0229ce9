// Upload the files one by one, then submit the job that they make.
const form = document.getElementById("submit");
const field = (id) => document.getElementById(id);
const SCENES = [".glb", ".gltf", ".obj", ".ply", ".xml"];
const words = (text) => text.split(/\s+/).filter(Boolean);

field("files").addEventListener("change", () => {
  const scenes = [...field("files").files].map((file) => file.name).filter((name) => SCENES.some((end) => name.toLowerCase().endsWith(end)));
  field("entry").replaceChildren(...scenes.map((name) => new Option(name, name)));
  field("entry-row").hidden = scenes.length < 2;
  if (scenes.length && !field("name").value) field("name").value = scenes[0].replace(/\.\w+$/, "").slice(0, 128);
  say(scenes.length ? "" : `None of these is a scene (${SCENES.join(", ")}).`, !scenes.length);
});

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  if (!field("entry").value) return;
  const button = form.querySelector("button.main");
  button.disabled = true;
  try {
    location.href = await submit();
  } catch (error) {
    say(error.message, true);
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
    bundle: { entry: field("entry").value, files: hashes, environment: environment ? { file: environment.name } : null },
  };
  return (await send("POST", "/submit", JSON.stringify(request))).location;
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
      reject(new Error([problem.detail ?? `Answer ${request.status}`, problem.where, problem.remedy].filter(Boolean).join(". ")));
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
