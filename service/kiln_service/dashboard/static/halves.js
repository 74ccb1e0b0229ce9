// Half floats, KTX2 headers, the octahedral map and colours: what the drawings share. Conventions: docs/mathematics.md.

export function halvesOf(bytes) {
  const bits = new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.byteLength >> 1);
  return Float32Array.from(bits, (half) => {
    const exponent = (half >> 10) & 31, fraction = half & 1023, sign = half & 0x8000 ? -1 : 1;
    if (exponent === 0) return sign * fraction * 2 ** -24;
    if (exponent === 31) return fraction ? NaN : sign * Infinity;
    return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  });
}

export function bytesOf(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

// Width, height and the first level's RGBA of a plain RGBA16F KTX2 file.
export function readKtx2(buffer) {
  const view = new DataView(buffer);
  const offset = Number(view.getBigUint64(80, true)), length = Number(view.getBigUint64(88, true));
  if (view.getUint32(44, true) !== 0) throw new Error("the texture is compressed");
  return {
    width: view.getUint32(20, true),
    height: view.getUint32(24, true),
    rgba: halvesOf(new Uint8Array(buffer.slice(offset, offset + length))),
  };
}

// Direction of pixel (column i, row j) of an octahedral image with R pixels along each side.
export function directionOf(i, j, R) {
  const x = (2 * (i + 0.5)) / R - 1, y = (2 * (j + 0.5)) / R - 1, z = 1 - Math.abs(x) - Math.abs(y);
  const fold = Math.max(-z, 0);
  const p = [x - Math.sign(x) * fold, y - Math.sign(y) * fold, z];
  const length = Math.hypot(...p);
  return p.map((value) => value / length);
}

// Linear radiance to a display byte: Reinhard's curve, then sRGB's.
export function shown(value) {
  const light = Math.max(value, 0) / (1 + Math.max(value, 0));
  return 255 * (light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055);
}

// The value below which a share of the positive ones lies.
export function quantile(values, share) {
  const positive = values.filter((value) => value > 0 && Number.isFinite(value)).sort((a, b) => a - b);
  return positive.length ? positive[Math.min(positive.length - 1, Math.floor(share * positive.length))] : 0;
}

const VIRIDIS = [
  [68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50],
  [253, 231, 37],
];

export function viridis(share) {
  const at = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1), low = Math.min(Math.floor(at), VIRIDIS.length - 2);
  return VIRIDIS[low].map((value, channel) => value + (at - low) * (VIRIDIS[low + 1][channel] - value));
}

// A colour of the style sheet as the scheme of the moment has it: of a custom property, or of a state.
export function colourOf(name, owner = "") {
  const probe = document.createElement("span");
  probe.className = owner;
  probe.style.color = `var(--${name})`;
  document.body.append(probe);
  const colour = getComputedStyle(probe).color;
  probe.remove();
  return colour;
}

export function colourOfState(state) {
  return colourOf("s", `s-${state}`).match(/[\d.]+/g).slice(0, 3).map(Number);
}

// A sentence for what went wrong: the coordinator's own where there is one.
export async function refusal(reply) {
  try {
    const problem = await reply.json();
    return [problem.detail, problem.remedy].filter(Boolean).join(". ");
  } catch {
    return `the coordinator answered ${reply.status}`;
  }
}
