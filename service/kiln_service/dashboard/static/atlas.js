// The light map: each tile in the colour of its state, its texels' irradiance once it is rendered, the error once the
// package is there. A pixel of the picture is a texel, or every `stride`-th where the light map is large.
import { colourOfState, quantile, readKtx2, refusal, shown, viridis } from "./halves.js";

const FINEST = 1024; // pixels along each side of the picture, at most
const MOST_TILES = 256; // of one request
const BYTES = 2 ** 20; // of one answer, about
const DRAW_MS = 500; // between two pictures while tiles come in
const GUTTER = [0, 0, 0, 0];

export class Atlas {
  pauseMs = 1000;

  constructor(job, onPick) {
    this.job = job;
    this.onPick = onPick;
    this.canvas = document.getElementById("map");
    this.note = document.getElementById("atlas-note");
    this.tiles = [];
    this.light = new Map(); // "row,column" -> Float32Array of the tile
    this.layer = "light";
    this.at = null; // [row, column]
    this.error = null;
    this.listen();
  }

  listen() {
    for (const choice of document.querySelectorAll("input[name=layer]")) {
      choice.addEventListener("change", () => {
        this.layer = choice.value;
        this.draw();
      });
    }
    document.getElementById("ev").addEventListener("input", () => this.draw());
    this.canvas.addEventListener("click", (event) => {
      const box = this.canvas.getBoundingClientRect();
      this.pick(
        Math.floor(((event.clientY - box.top) / box.height) * this.resolution),
        Math.floor(((event.clientX - box.left) / box.width) * this.resolution),
      );
    });
    this.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
      if (!this.resolution || (!step && event.key !== "Enter")) return;
      event.preventDefault();
      const from = this.at ?? [this.resolution >> 1, this.resolution >> 1];
      if (!step) return void this.pick(...from);
      const far = event.shiftKey ? this.tile : 1;
      this.move(from[0] + far * step[0], from[1] + far * step[1]);
    });
    document.getElementById("pick").addEventListener("submit", (event) => {
      event.preventDefault();
      const form = new FormData(event.target);
      this.pick(Number(form.get("row")), Number(form.get("column")));
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  move(row, column) {
    const inside = (value) => Math.min(Math.max(value, 0), this.resolution - 1);
    this.at = [inside(row), inside(column)];
    const form = document.getElementById("pick");
    [form.row.value, form.column.value] = this.at;
    this.draw();
  }

  pick(row, column) {
    if (!this.resolution) return;
    this.move(row, column);
    this.onPick(...this.at);
  }

  tileAt(row, column) {
    return this.tiles.find(([r, c, size]) => row >= r && row < r + size && column >= c && column < c + size);
  }

  errorAt(row, column) {
    if (!this.error) return null;
    const at = 4 * (row * this.error.width + column);
    return this.error.rgba[at + 3] > 0 ? this.error.rgba[at] : null;
  }

  async update() {
    const reply = await fetch(`/v1/jobs/${this.job}/tiles`);
    if (!reply.ok) return;
    const { tile, states } = this.canvas.dataset, resolution = reply.headers.get("X-Texels");
    const side = Number(reply.headers.get("X-Side")), size = Number(tile), tiles = [];
    new Uint8Array(await reply.arrayBuffer()).forEach((code, cell) => {
      if (code) tiles.push([size * Math.floor(cell / side), size * (cell % side), size, code - 1]);
    });
    if (!tiles.length) return;
    Object.assign(this, { resolution: Number(resolution), tile: size, states: states.split(" "), tiles });
    this.stride = 1;
    while (this.stride < this.tile && (this.resolution / this.stride > FINEST || this.tile % this.stride)) this.stride += 1;
    this.pauseMs = this.tiles.length > 4096 ? 6000 : 1000;
    if (!this.texels) await this.readTexels();
    this.draw();
    await this.readLight();
    await this.readError();
  }

  async readTexels() {
    const reply = await fetch(`/jobs/${this.job}/texels?stride=${this.stride}`);
    if (reply.ok) this.texels = new Uint8Array(await reply.arrayBuffer());
  }

  async readLight() {
    const done = this.states.indexOf("completed");
    for (const [r, c, , state] of this.tiles) if (state !== done) this.light.delete(`${r},${c}`); // is done again
    const missing = this.tiles.filter(([r, c, , state]) => state === done && !this.light.has(`${r},${c}`));
    const side = this.tile / this.stride, floats = 3 * side * side;
    const atOnce = Math.min(Math.max(Math.floor(BYTES / (4 * floats)), 16), MOST_TILES);
    let drawn = performance.now();
    for (let start = 0; start < missing.length; start += atOnce) {
      const part = missing.slice(start, start + atOnce);
      const query = part.map(([r, c]) => `tile=${r},${c}`).join("&");
      const reply = await fetch(`/jobs/${this.job}/irradiance?stride=${this.stride}&${query}`);
      if (!reply.ok) {
        this.trouble = await refusal(reply);
        break;
      }
      this.trouble = null;
      const values = new Float32Array(await reply.arrayBuffer());
      part.forEach(([r, c], place) => this.light.set(`${r},${c}`, values.slice(place * floats, (place + 1) * floats)));
      if (performance.now() - drawn < DRAW_MS) continue;
      this.draw();
      drawn = performance.now();
    }
    if (missing.length) this.draw();
  }

  // The package's errors, as long as there is a package: tasks that are done again take it away.
  async readError() {
    const link = document.querySelector('#artifacts a[href$="/errors.ktx2"]');
    const sha256 = link?.closest("tr").querySelector(".hash span").title;
    if (sha256 === this.error?.sha256) return;
    const reply = link ? await fetch(link.href) : null;
    this.error = reply?.ok ? { sha256, ...readKtx2(await reply.arrayBuffer()) } : null;
    document.querySelector("input[name=layer][value=error]").disabled = !this.error;
    if (this.layer === "error") this.draw();
  }

  draw() {
    if (!this.resolution) return;
    const side = Math.ceil(this.resolution / this.stride);
    const picture = new OffscreenCanvas(side, side), pen = picture.getContext("2d");
    const pixels = pen.createImageData(side, side);
    const ends = this.layer === "error" && this.error ? this.errorEnds() : null;
    const exposure = this.exposure();
    const colours = this.states.map(colourOfState);
    for (const [row, column, size, state] of this.tiles) {
      const light = this.layer === "light" ? this.light.get(`${row},${column}`) : null;
      const inside = this.tile / this.stride;
      for (let y = 0; y < size / this.stride; y += 1) {
        for (let x = 0; x < size / this.stride; x += 1) {
          const j = row / this.stride + y, i = column / this.stride + x;
          if (j >= side || i >= side) continue;
          const kind = this.texels ? this.texels[j * side + i] : 1;
          const at = 3 * (y * inside + x);
          let colour = colours[state];
          if (kind === 0) colour = GUTTER;
          else if (ends) colour = this.errorColour(j * this.stride, i * this.stride, ends);
          else if (light) colour = [0, 1, 2].map((channel) => shown(exposure * light[at + channel]));
          else if (kind === 2) colour = colour.map((value) => value * 0.6);
          pixels.data.set([colour[0], colour[1], colour[2], colour[3] ?? 255], 4 * (j * side + i));
        }
      }
    }
    pen.putImageData(pixels, 0, 0);
    this.show(picture, colours);
    this.tell(ends);
  }

  // Scale the picture up, outline tiles that are at work or went wrong, and mark the chosen texel.
  show(picture, colours) {
    const pen = this.canvas.getContext("2d"), scale = this.canvas.width / this.resolution;
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(picture, 0, 0, this.canvas.width, this.canvas.height);
    pen.lineWidth = 2;
    for (const [row, column, size, state] of this.tiles) {
      if (["waiting", "queued", "completed", "canceled"].includes(this.states[state])) continue;
      pen.strokeStyle = `rgb(${colours[state].join(" ")})`;
      pen.strokeRect(column * scale + 1, row * scale + 1, size * scale - 2, size * scale - 2);
    }
    if (!this.at) return;
    const [row, column] = this.at, box = Math.max(scale, 6), x = (column + 0.5) * scale, y = (row + 0.5) * scale;
    for (const [colour, width] of [["#000", 4], ["#fff", 2]]) {
      [pen.strokeStyle, pen.lineWidth] = [colour, width];
      pen.strokeRect(x - box / 2, y - box / 2, box, box);
    }
  }

  exposure() {
    const bright = [];
    for (const values of this.light.values()) for (let i = 1; i < values.length; i += 3 * 7) bright.push(values[i]);
    return (2 ** Number(document.getElementById("ev").value) * 0.8) / (quantile(bright, 0.9) || 1);
  }

  errorEnds() {
    const found = [];
    for (let at = 0; at < this.error.rgba.length; at += 4) if (this.error.rgba[at + 3] > 0) found.push(this.error.rgba[at]);
    const low = quantile(found, 0.02) || 1e-6;
    return [low, Math.max(quantile(found, 0.98), 1.1 * low)];
  }

  errorColour(row, column, [low, high]) {
    const error = this.errorAt(row, column);
    return error === null ? GUTTER : viridis(Math.log(Math.max(error, 1e-30) / low) / Math.log(high / low));
  }

  tell(ends) {
    const counts = this.states.map((state, place) => [state, this.tiles.filter((tile) => tile[3] === place).length]);
    const words = counts.filter(([, count]) => count).map(([state, count]) => `${count} ${state}`).join(", ");
    const shownOf = this.layer === "light" && this.light.size ? ` Irradiance of ${this.light.size} tiles.` : "";
    this.note.textContent = this.trouble ?? `${this.tiles.length} tiles: ${words}.${shownOf}`;
    const legend = document.getElementById("legend");
    if (ends) {
      legend.replaceChildren(`error (log MSE): dark ${ends[0].toPrecision(2)}, bright ${ends[1].toPrecision(2)}`);
      return;
    }
    legend.replaceChildren(
      ...counts.filter(([, count]) => count).map(([state]) => {
        const chip = document.createElement("span");
        chip.className = `chip s-${state}`;
        chip.textContent = state;
        return chip;
      }),
    );
  }
}
