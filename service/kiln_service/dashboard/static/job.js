// A job's page: events wake it, and the atlas, the curves and a chosen texel are drawn.
import { Atlas } from "./atlas.js";
import { showCurves } from "./curves.js";
import { showTexel } from "./texel.js";

const live = () => document.getElementById("live");
const job = live().dataset.job;
const atlas = new Atlas(job, (row, column) => showTexel(job, atlas, row, column));

const KINDS = [
  ..."created active paused resumed changed completed gate-failed failed cancel-requested canceled archived queued"
    .split(" ").map((kind) => `job.${kind}`),
  ..."queued claimed completed failed soft-failed canceled retried lost released requeued".split(" ").map((kind) => `task.${kind}`),
  ..."planned queued canceled reused reopened requeued".split(" ").map((kind) => `tasks.${kind}`),
  "stage.completed", "worker.blocked",
];

let woken = false;
let lastDrawn = 0;

function wake() {
  woken = true;
}

// One look a second at whether something happened; without events every few seconds, for progress comes without them.
async function tick() {
  const now = performance.now();
  const due = woken || (live().dataset.live === "true" && now - lastDrawn > 2500);
  if (!document.hidden && due && now - lastDrawn > atlas.pauseMs) {
    const happened = woken;
    woken = false;
    lastDrawn = now;
    if (happened && !live().querySelector(":popover-open")) htmx.trigger(live(), "refresh");
    await Promise.allSettled([atlas.update(), showCurves(job)]);
  }
  setTimeout(tick, 500);
}

// A browser has six connections to a host in all its tabs: only the tab that is looked at keeps one.
let events = null;

function follow() {
  events?.close();
  events = null;
  if (document.hidden || live().dataset.live !== "true") return;
  events = new EventSource(`/v1/jobs/${job}/events?after=${live().dataset.event}`);
  for (const kind of KINDS) events.addEventListener(kind, wake);
  wake();
}

document.addEventListener("visibilitychange", follow);
follow();
wake();
tick();
