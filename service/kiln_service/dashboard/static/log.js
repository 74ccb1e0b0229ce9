// Follow a task's log while the task is not over: read it again every two seconds, and stay at its end unless the reader
// has scrolled up.
const OVER = new Set(["completed", "failed", "canceled"]);
const log = document.getElementById("log");
const follow = document.getElementById("follow");
const task = () => document.getElementById("task").dataset;

function toEnd() {
  if (follow.checked) log.scrollTop = log.scrollHeight;
}

async function read() {
  const reply = await fetch(`/v1/tasks/${task().task}/log`, { headers: { Accept: "text/plain" } });
  if (!reply.ok) return;
  const text = await reply.text();
  if (text === log.textContent) return;
  if (text.startsWith(log.textContent)) log.append(text.slice(log.textContent.length));
  else log.textContent = text;
  toEnd();
}

log.addEventListener("scroll", () => {
  const atEnd = log.scrollHeight - log.scrollTop - log.clientHeight < 24;
  if (!atEnd) follow.checked = false;
});
follow.addEventListener("change", toEnd);
toEnd();

let last = "";
setInterval(() => {
  const state = task().state;
  if (document.hidden || (OVER.has(state) && OVER.has(last))) return;
  last = state;
  read().catch(() => {});
}, 2000);
