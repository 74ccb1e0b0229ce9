// Losses of a job's fits over their steps, on a logarithmic axis.
import { colourOf } from "./halves.js";

const plots = new Map();

export async function showCurves(job) {
  const reply = await fetch(`/v1/jobs/${job}/curves`);
  if (!reply.ok) return;
  for (const curve of await reply.json()) {
    const points = curve.points.filter(([, loss]) => loss > 0);
    if (points.length < 2) continue;
    const data = [points.map(([step]) => step), points.map(([, loss]) => loss)];
    const known = plots.get(curve.task_id);
    if (known && known.count === points.length && known.last === data[1].at(-1)) continue;
    const plot = known?.plot ?? make(curve, data);
    plot.setData(data);
    plots.set(curve.task_id, { plot, count: points.length, last: data[1].at(-1) });
    const last = document.getElementById(`loss-${curve.task_id}`);
    last.textContent = `${curve.state}, loss ${data[1].at(-1).toPrecision(3)} after ${data[0].at(-1)} steps`;
  }
}

function make(curve, data) {
  const home = document.getElementById("curves");
  if (!plots.size) home.replaceChildren();
  const title = document.createElement("h3"), told = document.createElement("p"), place = document.createElement("div");
  title.textContent = curve.label.replace("_", " ");
  told.id = `loss-${curve.task_id}`;
  told.className = "faint";
  home.append(title, place, told);
  const axis = { stroke: () => colourOf("faint"), grid: { stroke: () => colourOf("line"), width: 1 } };
  const plot = new uPlot(
    {
      width: Math.max(place.clientWidth, 240),
      height: 180,
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, range: (_, low, high) => [0, Math.max(high, curve.steps ?? 0)] }, y: { distr: 3 } },
      axes: [axis, { ...axis, size: 60, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : tick.toPrecision(1))) }],
      series: [{}, { stroke: () => colourOf("accent"), width: 1.5, points: { show: false } }],
    },
    data,
    place,
  );
  place.querySelector("canvas").setAttribute("role", "img");
  place.querySelector("canvas").setAttribute("aria-label", `Loss of the ${title.textContent} over its steps`);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plot.redraw());
  new ResizeObserver(() => plot.setSize({ width: Math.max(home.clientWidth, 240), height: 180 })).observe(home);
  return plot;
}
