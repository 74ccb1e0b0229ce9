// Keep what is marked with data-refresh (seconds) fresh while the page is looked at. htmx morphs the new HTML into the
// old, so focus, scroll position, open menus and selected text stay.
"use strict";

const due = new WeakMap();

setInterval(() => {
  if (document.hidden) return;
  const now = performance.now();
  for (const part of document.querySelectorAll("[data-refresh]")) {
    if (!due.has(part)) due.set(part, now + 1000 * part.dataset.refresh);
    if (now < due.get(part) || part.querySelector(":popover-open")) continue;
    due.set(part, now + 1000 * part.dataset.refresh);
    htmx.trigger(part, "refresh");
  }
}, 250);

// A search as one types: the address tells it, so that a reload or a bookmark does not lose it.
document.addEventListener("htmx:after:request", (event) => {
  const form = event.target.closest?.("form.search");
  if (form) history.replaceState(null, "", `${form.action}?${new URLSearchParams(new FormData(form))}`);
});

// Nothing is put in place of the page when the coordinator is away or refuses (see htmx-config); say so instead.
document.addEventListener("htmx:after:request", (event) => {
  const status = event.detail?.ctx?.response?.raw?.status ?? 0;
  document.body.classList.toggle("stale", status === 0 || status >= 400);
});
document.addEventListener("htmx:error", () => document.body.classList.add("stale"));
