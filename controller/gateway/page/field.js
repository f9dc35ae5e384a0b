// Draws the plate's vibration: amplitude, or motion slowed down.

const AMPLITUDE = ["#0b1026", "#27306b", "#4b3f8f", "#8a4f8d", "#c8637a", "#f08c5a", "#fbc557", "#fdf3a7"];
const MOTION = ["#053061", "#2f79b5", "#a7cfe4", "#f4f4f4", "#f9b98e", "#c8493a", "#67001f"];
const SLOW_DOWN = 100;  // factor
const SCALE_DECAY = 0.85;  // per frame, towards a lower scale

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

const RAMPS = { amplitude: ramp(AMPLITUDE), motion: ramp(MOTION) };

// Decode what controller/gateway/fields.py encodes.
export function decodeField(buffer) {
  const view = new DataView(buffer);
  const [columns, rows, count] = [0, 2, 4].map((at) => view.getUint16(at, true));
  const scale = view.getFloat32(8, true);
  const frequencies = [];
  for (let k = 0; k < count; k++) frequencies.push(view.getFloat32(12 + 4 * k, true));
  const start = 12 + 4 * count;
  const parts = new Float32Array(2 * count * rows * columns);
  for (let i = 0; i < parts.length; i++) {
    parts[i] = (view.getInt16(start + 2 * i, true) / 32767) * scale;
  }
  return { columns, rows, frequencies, parts };
}

export class FieldView {
  constructor(canvas, scaleCanvas, onScale) {
    this.canvas = canvas;
    this.scaleCanvas = scaleCanvas;
    this.onScale = onScale;
    this.inMotion = false;
    this.scale = 0;
    this.frames = 0;
    this.clear();
    requestAnimationFrame((now) => this.draw(now));
  }

  clear() {
    this.show({ columns: 2, rows: 2, frequencies: [], parts: new Float32Array(0) });
  }

  show(field) {
    const { columns, rows, frequencies, parts } = field;
    const points = Math.max(columns, 2) * Math.max(rows, 2);
    const amplitude = new Float32Array(points);
    for (let k = 0; k < frequencies.length; k++) {
      for (let p = 0; p < points; p++) {
        const at = 2 * (k * points + p);
        amplitude[p] += Math.hypot(parts[at], parts[at + 1]);
      }
    }
    this.field = field;
    this.amplitude = amplitude;
    this.peak = amplitude.reduce((max, value) => Math.max(max, value), 0);
    this.canvas.width = Math.max(columns, 2);
    this.canvas.height = Math.max(rows, 2);
    this.context = this.canvas.getContext("2d");
    this.image = this.context.createImageData(this.canvas.width, this.canvas.height);
    this.pixels = new Uint32Array(this.image.data.buffer);
    this.isStale = true;
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
    const scale = target >= this.scale ? target : Math.max(target, this.scale * SCALE_DECAY);
    if (scale !== this.scale) {
      this.scale = scale;
      this.drawScale();
      this.isStale = true;
    }
    if (!this.isStale && !(this.inMotion && this.peak > 0)) return;
    this.isStale = false;
    if (this.inMotion) this.paintMotion(now / 1000);
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

  paintMotion(time) {
    const { width, height } = this.canvas;
    const { frequencies, parts } = this.field;
    const points = width * height;
    const phaseFactors = frequencies.map((f) => {
      const angle = (2 * Math.PI * f * time) / SLOW_DOWN;
      return [Math.cos(angle), Math.sin(angle)];
    });
    for (let row = 0; row < height; row++) {
      const offset = (height - 1 - row) * width;
      for (let column = 0; column < width; column++) {
        let value = 0;
        for (let k = 0; k < frequencies.length; k++) {
          const at = 2 * (k * points + offset + column);
          value += parts[at] * phaseFactors[k][0] - parts[at + 1] * phaseFactors[k][1];
        }
        const index = Math.round(127.5 * (1 + value / this.scale));
        this.pixels[row * width + column] = RAMPS.motion[Math.max(0, Math.min(255, index))];
      }
    }
  }

  drawScale() {
    const context = this.scaleCanvas.getContext("2d");
    const image = context.createImageData(256, 1);
    new Uint32Array(image.data.buffer).set(this.inMotion ? RAMPS.motion : RAMPS.amplitude);
    context.putImageData(image, 0, 0);
    this.onScale(this.inMotion ? -this.scale : 0, this.scale);
  }
}

// The next of 1, 2, 5, 10, ... above a value; at least 1 m/s².
function roundUp(value) {
  for (let power = 1; ; power *= 10) {
    for (const step of [1, 2, 5]) if (value <= step * power) return step * power;
  }
}
