// Follow a task's log as it is written, and stay at its end unless the reader has scrolled up.
const log = document.getElementById("log");
const follow = document.getElementById("follow");
const task = () => document.getElementById("task").dataset;

function toEnd() {
  if (follow.checked) log.scrollTop = log.scrollHeight;
}

// One stream: the last lines so far, then what comes, until the task is over or the tab is left.
async function read(signal) {
  const { task: id, lines } = task();
  const reply = await fetch(`/v1/tasks/${id}/log?follow=true&tail=${lines}`, { signal });
  if (!reply.ok) return;
  const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
  let first = true;
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    if (first) log.textContent = part.value;
    else log.append(part.value);
    first = false;
    toEnd();
  }
}

log.addEventListener("scroll", () => {
  if (log.scrollHeight - log.scrollTop - log.clientHeight >= 24) follow.checked = false;
});
follow.addEventListener("change", toEnd);
toEnd();

// A browser has six connections to a host in all its tabs: only the tab that is looked at keeps one.
let stream = null;

async function keepReading() {
  if (stream || document.hidden || task().over === "true") return;
  stream = new AbortController();
  try {
    await read(stream.signal);
  } catch {
    // The coordinator went away, or the tab was left: begin anew below.
  }
  stream = null;
}

document.addEventListener("visibilitychange", () => document.hidden && stream?.abort());
setInterval(keepReading, 2000);
keepReading();
