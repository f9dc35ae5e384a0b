// Draws the plate's vibration: its amplitude, the content felt at each point, or its motion in slow motion.

const AMPLITUDE = ["#0b1026", "#27306b", "#4b3f8f", "#8a4f8d", "#c8637a", "#f08c5a", "#fbc557", "#fdf3a7"];
const MOTION = ["#053061", "#2f79b5", "#a7cfe4", "#f4f4f4", "#f9b98e", "#c8493a", "#67001f"];
// In the order of the contents; the first two are as different as possible for colour-blind people.
const CONTENTS = ["#ffa62b", "#4f9dff", "#35e07a", "#ff5fa2", "#c58bff", "#e8e34f", "#59e0e8", "#ff7d66"];
const GREY = 0.62;  // for mixed contents
const OWN_DB = 12;  // a content this far above all others is felt as a finger's own
const BRIGHTEST_DB = 30;  // above the detection threshold
const SLOW_DOWN = 100;  // factor
const SCALE_HELD_MS = 10000;  // time before a scale that is too large shrinks

const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));

function ramp(stops) {
  const colours = stops.map(rgb);
  const table = new Uint32Array(256);
  for (let i = 0; i < 256; i++) {
    const position = (i / 255) * (colours.length - 1);
    const at = Math.min(Math.floor(position), colours.length - 2);
    const [r, g, b] = [0, 1, 2].map((c) =>
      Math.round(colours[at][c] + (position - at) * (colours[at + 1][c] - colours[at][c])));
    table[i] = (255 << 24) | (b << 16) | (g << 8) | r;
  }
  return table;
}

const RAMPS = { amplitude: ramp(AMPLITUDE), motion: ramp(MOTION), felt: ramp(["#000000", "#9e9e9e"]) };

// Colour of a layer's content, for its finger and its field.
export const colourOf = (layer) => CONTENTS[layer % CONTENTS.length];

// Decode a field as encoded by controller/gateway/field.py.
export function decodeField(buffer) {
  const view = new DataView(buffer);
  const [columns, rows, count] = [0, 2, 4].map((at) => view.getUint16(at, true));
  const scale = view.getFloat32(8, true);
  const numbers = (start) => Array.from({ length: count }, (_, k) => view.getFloat32(start + 4 * k, true));
  const [frequencies, thresholds] = [numbers(12), numbers(12 + 4 * count)];
  const layers = Array.from({ length: count }, (_, k) => view.getUint16(12 + 8 * count + 2 * k, true));
  const start = 12 + 10 * count;
  const parts = new Float32Array(2 * count * rows * columns);
  for (let i = 0; i < parts.length; i++) {
    parts[i] = (view.getInt16(start + 2 * i, true) / 32767) * scale;
  }
  return { columns, rows, frequencies, thresholds, layers, parts };
}

export class FieldView {
  constructor(canvas, scaleCanvas, onScale) {
    this.canvas = canvas;
    this.scaleCanvas = scaleCanvas;
    this.onScale = onScale;
    this.inMotion = false;
    this.layer = null;  // the only layer to draw; null for all
    this.scale = this.neededAt = 0;  // neededAt: last time the plate's vibration needed this scale
    this.frames = 0;
    this.clear();
    requestAnimationFrame((now) => this.draw(now));
  }

  clear() {
    this.show({ columns: 2, rows: 2, frequencies: [], thresholds: [], layers: [], parts: new Float32Array(0) });
  }

  // Draw only one layer, or all for null.
  select(layer) {
    this.layer = layer;
    this.show(this.field);
    this.drawScale();
  }

  // Indices of the fields drawn.
  get drawn() {
    return this.field.layers.flatMap((layer, k) => (this.layer === null || layer === this.layer ? [k] : []));
  }

  get isOfContents() {
    return !this.inMotion && new Set(this.drawn.map((k) => this.field.layers[k])).size > 1;
  }

  show(field) {
    const { columns, rows, parts } = field;
    const wasOfContents = this.field && this.isOfContents;
    const points = Math.max(columns, 2) * Math.max(rows, 2);
    const amplitude = new Float32Array(points);
    this.field = field;
    for (const k of this.drawn) {
      for (let p = 0; p < points; p++) {
        const at = 2 * (k * points + p);
        amplitude[p] += Math.hypot(parts[at], parts[at + 1]);
      }
    }
    this.amplitude = amplitude;
    this.peak = amplitude.reduce((max, value) => Math.max(max, value), 0);
    this.canvas.width = Math.max(columns, 2);
    this.canvas.height = Math.max(rows, 2);
    this.context = this.canvas.getContext("2d");
    this.image = this.context.createImageData(this.canvas.width, this.canvas.height);
    this.pixels = new Uint32Array(this.image.data.buffer);
    this.isStale = true;
    if (this.isOfContents !== wasOfContents) this.drawScale();
  }

  setMotion(inMotion) {
    this.inMotion = inMotion;
    this.isStale = true;
    this.drawScale();
  }

  draw(now) {
    requestAnimationFrame((next) => this.draw(next));
    this.frames++;
    const target = roundUp(this.peak);
    // At rest the scale stays; otherwise it drops in one step.
    if (target >= this.scale || this.peak === 0) this.neededAt = now;
    if (target > this.scale || now - this.neededAt > SCALE_HELD_MS) {
      this.scale = target;
      this.neededAt = now;
      this.drawScale();
      this.isStale = true;
    }
    if (!this.isStale && !(this.inMotion && this.peak > 0)) return;
    this.isStale = false;
    if (this.inMotion) this.paintMotion(now / 1000);
    else if (this.isOfContents) this.paintContents();
    else this.paintStrength();
    this.context.putImageData(this.image, 0, 0);
  }

  paintStrength() {
    const { width, height } = this.canvas;
    for (let row = 0; row < height; row++) {
      const offset = (height - 1 - row) * width;  // the field counts rows from the south
      for (let column = 0; column < width; column++) {
        const ratio = this.amplitude[offset + column] / this.scale;
        this.pixels[row * width + column] = RAMPS.amplitude[Math.min(255, Math.round(255 * ratio))];
      }
    }
  }

  // Draw the strongest content in its colour, by its level above the detection threshold. The smaller its
  // margin over all others, the paler the colour, down to grey.
  paintContents() {
    const { width, height } = this.canvas;
    const { layers, thresholds, parts } = this.field;
    const points = width * height;
    const numbers = [...new Set(layers)];
    const colours = numbers.map((layer) => rgb(colourOf(layer)));
    const fields = layers.map((layer, k) => [numbers.indexOf(layer), k * points, thresholds[k]]);
    const powers = new Float32Array(numbers.length);
    const share = (value) => Math.min(1, Math.max(0, value));
    for (let row = 0; row < height; row++) {
      const offset = (height - 1 - row) * width;
      for (let column = 0; column < width; column++) {
        powers.fill(0);
        for (const [number, start, threshold] of fields) {
          const at = 2 * (start + offset + column);
          powers[number] += (parts[at] ** 2 + parts[at + 1] ** 2) / threshold ** 2;
        }
        const own = Math.max(...powers);
        const others = powers.reduce((sum, power) => sum + power, 0) - own;
        const purity = share((10 * Math.log10(own / others)) / OWN_DB);
        const light = share((10 * Math.log10(own)) / BRIGHTEST_DB);
        const [r, g, b] = colours[powers.indexOf(own)].map((value) =>
          Math.round(light * (purity * value + (1 - purity) * 255 * GREY)));
        this.pixels[row * width + column] = (255 << 24) | (b << 16) | (g << 8) | r;
      }
    }
  }

  paintMotion(time) {
    const { width, height } = this.canvas;
    const { frequencies, parts } = this.field;
    const points = width * height;
    const drawn = this.drawn.map((k) => {
      const angle = (2 * Math.PI * frequencies[k] * time) / SLOW_DOWN;
      return [k * points, Math.cos(angle), Math.sin(angle)];
    });
    for (let row = 0; row < height; row++) {
      const offset = (height - 1 - row) * width;
      for (let column = 0; column < width; column++) {
        let value = 0;
        for (const [start, cosine, sine] of drawn) {
          const at = 2 * (start + offset + column);
          value += parts[at] * cosine - parts[at + 1] * sine;
        }
        const index = Math.round(127.5 * (1 + value / this.scale));
        this.pixels[row * width + column] = RAMPS.motion[Math.max(0, Math.min(255, index))];
      }
    }
  }

  drawScale() {
    const context = this.scaleCanvas.getContext("2d");
    const image = context.createImageData(256, 1);
    const name = this.inMotion ? "motion" : this.isOfContents ? "felt" : "amplitude";
    new Uint32Array(image.data.buffer).set(RAMPS[name]);
    context.putImageData(image, 0, 0);
    if (name === "felt") this.onScale(0, `${BRIGHTEST_DB} dB SL`);
    else {
      this.onScale(this.inMotion ? -this.scale : 0, `${this.scale} m/s²`);
    }
  }
}

// Round a value up to the next of 1, 2, 5, 10, ...; at least 1 m/s².
function roundUp(value) {
  for (let power = 1; ; power *= 10) {
    for (const step of [1, 2, 5]) if (value <= step * power) return step * power;
  }
}
