// One texel's light field as it was rendered, as its lobes give it back, and the difference, each over the sphere.
import { bytesOf, directionOf, halvesOf, quantile, refusal, shown } from "./halves.js";

let asked = 0;

export async function showTexel(job, atlas, row, column) {
  const note = document.getElementById("texel-note");
  const mine = (asked += 1);
  note.textContent = `Reading texel ${row}, ${column} …`;
  const reply = await fetch(`/jobs/${job}/texels/${row}/${column}`);
  const texel = reply.ok ? await reply.json() : null;
  if (mine !== asked) return; // another texel was chosen meanwhile
  document.querySelector(".spheres").hidden = !texel;
  if (!texel) {
    note.textContent = await refusal(reply);
    return;
  }
  const side = texel.image_size;
  const original = texel.image ? halvesOf(bytesOf(texel.image)) : null;
  const predicted = texel.lobes ? evaluate(texel.lobes, texel.normal, side) : null;
  const scale = 1.5 / (quantile(Array.from(original ?? predicted ?? []), 0.95) || 1);
  paint("original", original, side, scale);
  paint("predicted", predicted, side, scale);
  const both = original && predicted;
  paint("difference", both ? original.map((value, place) => Math.abs(value - predicted[place])) : null, side, scale);
  note.textContent = Object.values(texel.missing).join(" ") || "Over the whole sphere, octahedral, world space.";
  tell(job, atlas, texel, original, predicted);
}

// Radiance of the lobes in every pixel above the horizon, RGB.
function evaluate(lobes, normal, side) {
  const out = new Float32Array(3 * side * side);
  for (let j = 0; j < side; j += 1) {
    for (let i = 0; i < side; i += 1) {
      const v = directionOf(i, j, side);
      if (v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2] <= 0) continue;
      for (const [x, y, z, sharpness, ...amplitude] of lobes) {
        const gaussian = Math.exp(sharpness * (v[0] * x + v[1] * y + v[2] * z - 1));
        for (let channel = 0; channel < 3; channel += 1) out[3 * (j * side + i) + channel] += amplitude[channel] * gaussian;
      }
    }
  }
  return out;
}

function paint(id, values, side, scale) {
  const canvas = document.getElementById(id), pen = canvas.getContext("2d");
  canvas.parentElement.hidden = !values;
  if (!values) return;
  canvas.width = canvas.height = side;
  const pixels = pen.createImageData(side, side);
  for (let place = 0; place < side * side; place += 1) {
    for (let channel = 0; channel < 3; channel += 1) pixels.data[4 * place + channel] = shown(scale * values[3 * place + channel]);
    pixels.data[4 * place + 3] = 255;
  }
  pen.putImageData(pixels, 0, 0);
}

function tell(job, atlas, texel, original, predicted) {
  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const tile = atlas.tileAt(texel.row, texel.column);
  const error = atlas.errorAt(texel.row, texel.column);
  const facts = [
    ["Texel", `row ${texel.row}, column ${texel.column}`],
    ["Normal", texel.normal.map((value) => value.toFixed(2)).join(", ")],
    original && ["Mean radiance", mean(original).toPrecision(3)],
    predicted && ["Of the lobes", `${mean(predicted).toPrecision(3)}, ${texel.lobes.length} lobes`],
    error !== null && ["Error (log MSE)", error.toPrecision(3)],
    tile && ["Tile", link(`/jobs/${job}/tiles/${tile[0]}/${tile[1]}`, `${tile[0]}, ${tile[1]} (${atlas.states[tile[3]]})`)],
  ];
  document.getElementById("texel-facts").replaceChildren(
    ...facts.filter(Boolean).map(([name, value]) => {
      const row = document.createElement("div");
      const term = document.createElement("dt"), text = document.createElement("dd");
      term.textContent = name;
      text.append(value);
      row.append(term, text);
      return row;
    }),
  );
}

function link(href, text) {
  const a = document.createElement("a");
  [a.href, a.textContent] = [href, text];
  return a;
}
