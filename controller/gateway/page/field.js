// The plate's vibration as a picture: strength, or slowed-down motion.

const STRENGTH = ["#0b1026", "#27306b", "#4b3f8f", "#8a4f8d", "#c8637a", "#f08c5a", "#fbc557", "#fdf3a7"];
const MOTION = ["#053061", "#2f79b5", "#a7cfe4", "#f4f4f4", "#f9b98e", "#c8493a", "#67001f"];
const SLOWER = 100;  // times, so that eyes can follow
const FADE = 0.85;   // of the old scale kept a frame when the new one is lower

const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));

function ramp(stops) {
  const colours = stops.map(rgb);
  const table = new Uint32Array(256);
  for (let i = 0; i < 256; i++) {
    const place = (i / 255) * (colours.length - 1);
    const at = Math.min(Math.floor(place), colours.length - 2);
    const [r, g, b] = [0, 1, 2].map((c) =>
      Math.round(colours[at][c] + (place - at) * (colours[at + 1][c] - colours[at][c])));
    table[i] = (255 << 24) | (b << 16) | (g << 8) | r;
  }
  return table;
}

const RAMPS = { strength: ramp(STRENGTH), motion: ramp(MOTION) };

// As controller/gateway/fields.py encodes it.
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

export class FieldPicture {
  constructor(canvas, scaleCanvas, onScale) {
    this.canvas = canvas;
    this.scaleCanvas = scaleCanvas;
    this.onScale = onScale;
    this.inMotion = false;
    this.top = 0;
    this.frames = 0;
    this.clear();
    requestAnimationFrame((now) => this.draw(now));
  }

  // Nothing is to be seen.
  clear() {
    this.show({ columns: 2, rows: 2, frequencies: [], parts: new Float32Array(0) });
  }

  // Set what is to be seen.
  show(field) {
    const { columns, rows, frequencies, parts } = field;
    const points = Math.max(columns, 2) * Math.max(rows, 2);
    const strength = new Float32Array(points);
    for (let k = 0; k < frequencies.length; k++) {
      for (let p = 0; p < points; p++) {
        const at = 2 * (k * points + p);
        strength[p] += Math.hypot(parts[at], parts[at + 1]);
      }
    }
    this.field = field;
    this.strength = strength;
    this.peak = strength.reduce((most, value) => Math.max(most, value), 0);
    this.canvas.width = Math.max(columns, 2);
    this.canvas.height = Math.max(rows, 2);
    this.context = this.canvas.getContext("2d");
    this.image = this.context.createImageData(this.canvas.width, this.canvas.height);
    this.pixels = new Uint32Array(this.image.data.buffer);
    this.stale = true;
  }

  setMotion(inMotion) {
    this.inMotion = inMotion;
    this.stale = true;
    this.drawScale();
  }

  draw(now) {
    requestAnimationFrame((next) => this.draw(next));
    this.frames++;
    const wanted = niceAbove(this.peak);
    const top = wanted >= this.top ? wanted : Math.max(wanted, this.top * FADE);
    if (top !== this.top) {
      this.top = top;
      this.drawScale();
      this.stale = true;
    }
    if (!this.stale && !(this.inMotion && this.peak > 0)) return;
    this.stale = false;
    if (this.inMotion) this.paintMotion(now / 1000);
    else this.paintStrength();
    this.context.putImageData(this.image, 0, 0);
  }

  paintStrength() {
    const { width, height } = this.canvas;
    for (let row = 0; row < height; row++) {
      const from = (height - 1 - row) * width;  // the field counts rows from the south
      for (let column = 0; column < width; column++) {
        const share = this.strength[from + column] / this.top;
        this.pixels[row * width + column] = RAMPS.strength[Math.min(255, Math.round(255 * share))];
      }
    }
  }

  paintMotion(time) {
    const { width, height } = this.canvas;
    const { frequencies, parts } = this.field;
    const points = width * height;
    const turns = frequencies.map((f) => {
      const angle = (2 * Math.PI * f * time) / SLOWER;
      return [Math.cos(angle), Math.sin(angle)];
    });
    for (let row = 0; row < height; row++) {
      const from = (height - 1 - row) * width;
      for (let column = 0; column < width; column++) {
        let value = 0;
        for (let k = 0; k < frequencies.length; k++) {
          const at = 2 * (k * points + from + column);
          value += parts[at] * turns[k][0] - parts[at + 1] * turns[k][1];
        }
        const place = Math.round(127.5 * (1 + value / this.top));
        this.pixels[row * width + column] = RAMPS.motion[Math.max(0, Math.min(255, place))];
      }
    }
  }

  drawScale() {
    const context = this.scaleCanvas.getContext("2d");
    const image = context.createImageData(256, 1);
    new Uint32Array(image.data.buffer).set(this.inMotion ? RAMPS.motion : RAMPS.strength);
    context.putImageData(image, 0, 0);
    this.onScale(this.inMotion ? -this.top : 0, this.top);
  }
}

// The next of 1, 2, 5, 10, ... above a value; 1 m/s² at least.
function niceAbove(value) {
  for (let power = 1; ; power *= 10) {
    for (const step of [1, 2, 5]) if (value <= step * power) return step * power;
  }
}
