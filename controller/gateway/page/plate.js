// Overlay on the plate: ERAs, regions, and fingers with their predicted sensations.

import { colourOf } from "./field.js";

const SVG = "http://www.w3.org/2000/svg";
const FINGERTIP_M = 0.0065;  // radius
const SMALL_PX = 480;  // below it labels are shorter
const TEXT_PX = 12;
const ERA_PX = 12;

function element(name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

const textWidth = (text) => 0.62 * TEXT_PX * text.length;  // approximate, in pixels

export const fixed = (value, digits = 0) => (value === null || value === undefined ? "–" : value.toFixed(digits));

// A promise is rounded down.
export const atLeast = (value) => fixed(value === null ? null : Math.floor(value));

const isKnown = (value) => value !== null && value !== undefined;

// Level of a finger's vibration, null without one: a lower bound if it is promised.
export const levelOf = ({ level_db_sl: level, promised_level_db_sl: promised }) => {
  if (isKnown(promised)) return `≥ ${fixed(promised)} dB SL`;
  return isKnown(level) ? `${fixed(level)} dB SL` : null;
};

// Verdict of a finger, with a note if other contents are also felt.
export const felt = ({ verdict, is_foreign_felt }) => (verdict === "own" && is_foreign_felt ? "own, others faintly felt" : verdict);

export class PlateOverlay {
  constructor(plate, svg) {
    this.plate = plate;
    this.svg = svg;
    this.layers = ["regions", "eras", "contacts", "cursor"].map((name) => element("g", { id: `layer-${name}` }));
    svg.replaceChildren(...this.layers);
    this.contacts = [];
    this.drives = new Map();  // by layer, by ERA
    new ResizeObserver(() => this.redraw()).observe(plate);
  }

  // Set rig and layout from `hello`.
  setUp({ rig, layout }) {
    this.rig = rig;
    this.regions = layout?.regions ?? [];
    this.plate.style.setProperty("--ratio", rig.length_m / rig.width_m);
    this.svg.setAttribute("viewBox", `0 0 ${rig.length_m} ${rig.width_m}`);
    this.redraw();
  }

  show({ contacts, layers }) {
    if (contacts) this.contacts = contacts;
    if (layers) this.drives = new Map(Object.entries(layers).map(([layer, drive]) => [Number(layer), drive]));
    this.redraw();
  }

  // Frequencies of each layer [Hz].
  get contents() {
    return [...this.drives].map(([layer, drive]) =>
      ({ layer, frequencies: [...new Set(Object.values(drive).map((tone) => tone.frequency_hz))] }));
  }

  // Layer of a contact's content; undefined for a single content or a contact without its own.
  layerOf({ role, frequency_hz }) {
    if (role !== "target" || this.drives.size < 2) return undefined;
    return this.contents.find(({ frequencies }) => frequencies.includes(frequency_hz))?.layer;
  }

  showCursor(cursor) {
    this.cursor = cursor;
    this.redraw();
  }

  // Position of a pointer [m], from the south-west corner of the plate.
  position(event) {
    const box = this.plate.getBoundingClientRect();
    const clamp = (value) => Math.min(1, Math.max(0, value));
    return {
      x_m: clamp((event.clientX - box.left) / box.width) * this.rig.length_m,
      y_m: (1 - clamp((event.clientY - box.top) / box.height)) * this.rig.width_m,
    };
  }

  redraw() {
    if (!this.rig || !this.plate.clientWidth) return;
    this.px = this.rig.length_m / this.plate.clientWidth;  // metres per pixel
    this.isSmall = this.plate.clientWidth < SMALL_PX;
    const [regions, eras, contacts, cursor] = this.layers;
    this.occupied = [];  // boxes that text must not cover
    eras.replaceChildren(...this.rig.eras.flatMap((era) => this.era(era)));
    this.occupied.push(...this.contacts.map((contact) => this.ringBox(contact)));
    contacts.replaceChildren(...this.contacts.flatMap((contact) => this.contact(contact)));
    regions.replaceChildren(...this.regions.flatMap((region) => this.region(region)));
    cursor.replaceChildren(...(this.cursor ? [this.circle(this.cursor, "cursor", FINGERTIP_M)] : []));
  }

  flip(y) {
    return this.rig.width_m - y;
  }

  circle({ x_m, y_m }, name, radius) {
    return element("circle", { class: name, cx: x_m, cy: this.flip(y_m), r: radius });
  }

  // Left edge of a text centred at x, moved so that the text lies within the plate.
  textLeft(x, text) {
    const width = textWidth(text) * this.px;
    return Math.max(0, Math.min(this.rig.length_m - width, x - width / 2));
  }

  label([x, y], text, name = "label") {
    const size = TEXT_PX * this.px;
    const width = textWidth(text) * this.px;
    const left = this.textLeft(x, text);
    const right = left + width;
    // The width is an estimate: a text at an edge of the plate starts or ends exactly there.
    let [anchorX, anchor] = [x, "middle"];
    if (left === 0) [anchorX, anchor] = [0, "start"];
    else if (left < x - width / 2) [anchorX, anchor] = [right, "end"];
    const height = Math.min(this.rig.width_m - size / 2, Math.max(size, y));
    const top = name === "label" ? height - size : height;  // names are aligned at their top
    if (text) this.occupied.push([left, top, right, top + 1.2 * size]);
    return element("text", { class: name, x: anchorX, y: height, "font-size": size, "text-anchor": anchor }, text);
  }

  // First of several positions where a text covers nothing.
  firstFree(positions, text, isTopAligned = false) {
    const [room, size] = [textWidth(text) * this.px, TEXT_PX * this.px];
    return positions.find(([x, y]) => {
      const left = this.textLeft(x, text);
      const top = isTopAligned ? y : y - size;
      const isInside = top >= 0 && top + size <= this.rig.width_m;
      return isInside && this.occupied.every((box) => left >= box[2] || left + room <= box[0] || top >= box[3] || top + size <= box[1]);
    });
  }

  region({ name, shape, x_m, y_m, width_m, height_m, radius_m, points_m }) {
    let outline;
    let bounds;  // left, top, right, bottom
    let middle;  // of its upper edge
    if (shape === "circle") {
      outline = this.circle({ x_m, y_m }, "region", radius_m);
      bounds = [x_m - radius_m, this.flip(y_m + radius_m), x_m + radius_m, this.flip(y_m - radius_m)];
    } else if (shape === "polygon") {
      const corners = points_m.map(([x, y]) => [x, this.flip(y)]);
      outline = element("polygon", { class: "region", points: corners.map((corner) => corner.join(",")).join(" ") });
      const [xs, ys] = [0, 1].map((axis) => corners.map((corner) => corner[axis]));
      bounds = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
      const upper = xs.filter((_, index) => ys[index] === bounds[1]);
      middle = (Math.min(...upper) + Math.max(...upper)) / 2;
    } else {
      outline = element("rect", { class: "region", x: x_m, y: this.flip(y_m + height_m), width: width_m, height: height_m });
      bounds = [x_m, this.flip(y_m + height_m), x_m + width_m, this.flip(y_m)];
    }
    const position = this.namePosition(bounds, middle ?? (bounds[0] + bounds[2]) / 2, name);
    return position ? [outline, this.label(position, name, "label name")] : [outline];
  }

  // Position of a region's name: at its upper edge, where fingers hide it least; otherwise at its lower
  // edge, anywhere inside, or just outside.
  namePosition([left, top, right, bottom], middle, name) {
    const [width, height, gap] = [textWidth(name) * this.px, TEXT_PX * this.px, 4 * this.px];
    const xs = [middle, left + gap + width / 2, right - gap - width / 2];
    const rows = [top + gap, bottom - gap - height];
    for (let y = top + gap + height; y < bottom - gap - height; y += height / 2) rows.push(y);
    rows.push(top - gap - height, bottom + gap);
    return this.firstFree(rows.flatMap((y) => xs.map((x) => [x, y])), name, true);
  }

  // Centre of an ERA's square, moved inside the plate.
  eraCentre({ x_m, y_m }) {
    const half = (ERA_PX * this.px) / 2;
    const inset = (value, max) => Math.min(max - half, Math.max(half, value));
    return [inset(x_m, this.rig.length_m), inset(this.flip(y_m), this.rig.width_m)];
  }

  era(era) {
    const { name } = era;
    const isDriven = [...this.drives.values()].some((drive) => drive[name]);
    const side = ERA_PX * this.px;
    const [x, y] = this.eraCentre(era);
    const square = element("rect", {
      class: isDriven ? "era driven" : "era", x: x - side / 2, y: y - side / 2, width: side, height: side, "data-era": name,
    });
    const gap = 4 * this.px;
    this.occupied.push([x - side / 2 - gap, y - side / 2 - gap, x + side / 2 + gap, y + side / 2 + gap]);
    const below = y < this.rig.width_m / 2;
    return [square, this.label([x, below ? y + 2 * side : y - side], name)];
  }

  get ringRadius() {
    return Math.max(FINGERTIP_M, 10 * this.px);
  }

  ringBox({ x_m, y_m }) {
    const radius = this.ringRadius;
    return [x_m - radius, this.flip(y_m) - radius, x_m + radius, this.flip(y_m) + radius];
  }

  contact(contact) {
    const { role, frequency_hz, held_back, verdict, promised_contrast_db: promised } = contact;
    const ring = this.circle(contact, `contact ${role ?? ""}`, this.ringRadius);
    ring.setAttribute("data-role", role ?? "");
    const layer = this.layerOf(contact);
    const rings = layer === undefined ? [ring] : [this.circle(contact, "halo", this.ringRadius), ring];
    if (layer !== undefined) ring.style.stroke = colourOf(layer);
    const above = levelOf(contact) ?? (["quiet", "hand", "surplus"].includes(role) ? role : "");
    let below = role === "target" && isKnown(promised) ? `≥ ${atLeast(promised)} dB above others` : "";
    if (layer !== undefined) below = `${fixed(frequency_hz)} Hz, ${felt(contact)}${isKnown(promised) ? `, ≥ ${atLeast(promised)} dB` : ""}`;
    if (held_back && verdict) below = verdict;
    return [...rings, this.besideRing(contact, above, 0), this.besideRing(contact, below, 1)];
  }

  // Place a text above (0) or below (1) a finger; if occupied, on the other side, left or right.
  besideRing({ x_m, y_m }, text, first) {
    const [away, line] = [this.ringRadius + 4 * this.px, 1.25 * TEXT_PX * this.px];
    const [x, y, aside] = [x_m, this.flip(y_m), away + (textWidth(text) * this.px) / 2];
    const above = [0, 1, 2].map((row) => [x, y - away - row * line]);
    const below = [0, 1, 2].map((row) => [x, y + away + 0.75 * TEXT_PX * this.px + row * line]);
    const besides = [0, 1, -1].flatMap((row) => [[x - aside, y + row * line], [x + aside, y + row * line]]);
    const positions = first ? [...below, ...above, ...besides] : [...above, ...below, ...besides];
    return this.label(this.firstFree(positions, text) ?? positions[0], text);
  }
}
