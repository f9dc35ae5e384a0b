// What lies on the picture of the plate: ERAs, regions, and fingers with what each feels.

const SVG = "http://www.w3.org/2000/svg";
const FINGERTIP_M = 0.0065;  // radius

function element(name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

export const shown = (value, digits = 0) => (value === null || value === undefined ? "–" : value.toFixed(digits));

export class PlateOverlay {
  constructor(plate, svg) {
    this.plate = plate;
    this.svg = svg;
    this.layers = ["regions", "eras", "contacts", "cursor"].map((name) => element("g", { id: `layer-${name}` }));
    svg.replaceChildren(...this.layers);
    this.contacts = [];
    this.drive = {};
    new ResizeObserver(() => this.redraw()).observe(plate);
  }

  // The rig and layout, as hello tells them.
  setUp({ rig, layout }) {
    this.rig = rig;
    this.regions = layout?.regions ?? [];
    this.plate.style.aspectRatio = `${rig.length_m} / ${rig.width_m}`;
    this.svg.setAttribute("viewBox", `0 0 ${rig.length_m} ${rig.width_m}`);
    this.redraw();
  }

  show({ contacts, drive }) {
    if (contacts) this.contacts = contacts;
    if (drive) this.drive = drive;
    this.redraw();
  }

  showCursor(cursor) {
    this.cursor = cursor;
    this.redraw();
  }

  // Where a pointer is on the plate [m], from its south-west corner.
  place(event) {
    const box = this.plate.getBoundingClientRect();
    const share = (value) => Math.min(1, Math.max(0, value));
    return {
      x_m: share((event.clientX - box.left) / box.width) * this.rig.length_m,
      y_m: (1 - share((event.clientY - box.top) / box.height)) * this.rig.width_m,
    };
  }

  redraw() {
    if (!this.rig || !this.plate.clientWidth) return;
    this.px = this.rig.length_m / this.plate.clientWidth;  // metres of one pixel
    const [regions, eras, contacts, cursor] = this.layers;
    regions.replaceChildren(...this.regions.flatMap((region) => this.region(region)));
    eras.replaceChildren(...this.rig.eras.flatMap((era) => this.era(era)));
    contacts.replaceChildren(...this.contacts.flatMap((contact) => this.contact(contact)));
    cursor.replaceChildren(...(this.cursor ? [this.circle(this.cursor, "cursor", FINGERTIP_M)] : []));
  }

  up(y) {
    return this.rig.width_m - y;
  }

  circle({ x_m, y_m }, name, radius) {
    return element("circle", { class: name, cx: x_m, cy: this.up(y_m), r: radius });
  }

  label(x, y, text) {
    const size = 12 * this.px;
    const room = 0.62 * size * text.length;  // about as wide as the text
    const anchor = x < room / 2 ? "start" : x > this.rig.length_m - room / 2 ? "end" : "middle";
    const height = Math.min(this.rig.width_m - size / 2, Math.max(size, y));
    return element("text", { class: "label", x, y: height, "font-size": size, "text-anchor": anchor }, text);
  }

  region({ name, shape, x_m, y_m, width_m, height_m, radius_m, points_m }) {
    let outline;
    let at;
    if (shape === "circle") {
      outline = this.circle({ x_m, y_m }, "region", radius_m);
      at = [x_m, this.up(y_m)];
    } else if (shape === "polygon") {
      const corners = points_m.map(([x, y]) => [x, this.up(y)]);
      outline = element("polygon", { class: "region", points: corners.map((corner) => corner.join(",")).join(" ") });
      at = [0, 1].map((axis) => corners.reduce((sum, corner) => sum + corner[axis], 0) / corners.length);
    } else {
      outline = element("rect", { class: "region", x: x_m, y: this.up(y_m + height_m), width: width_m, height: height_m });
      at = [x_m + width_m / 2, this.up(y_m + height_m / 2)];
    }
    return [outline, this.label(...at, name)];
  }

  era({ name, x_m, y_m }) {
    const tone = this.drive[name];
    const side = 12 * this.px;
    const inset = (value, most) => Math.min(most - side / 2, Math.max(side / 2, value));
    const [x, y] = [inset(x_m, this.rig.length_m), inset(this.up(y_m), this.rig.width_m)];
    const square = element("rect", {
      class: tone ? "era driven" : "era", x: x - side / 2, y: y - side / 2, width: side, height: side, "data-era": name,
    });
    const text = tone ? `${name} ${tone.frequency_hz.toFixed(0)} Hz ${(100 * tone.level).toFixed(0)} %` : name;
    const below = y < this.rig.width_m / 2;
    return [square, this.label(x, below ? y + 2 * side : y - side, text)];
  }

  contact(contact) {
    const { x_m, y_m, role, level_db_sl, contrast_db } = contact;
    const ring = this.circle(contact, `contact ${role ?? ""}`, Math.max(FINGERTIP_M, 10 * this.px));
    ring.setAttribute("data-role", role ?? "");
    const parts = [];
    if (level_db_sl !== null && level_db_sl !== undefined) parts.push(`${shown(level_db_sl)} dB SL`);
    if (role === "target" && contrast_db !== null && contrast_db !== undefined) parts.push(`${shown(contrast_db)} dB over others`);
    if (role === "quiet" && !parts.length) parts.push("quiet");
    return [ring, this.label(x_m, this.up(y_m) - Math.max(FINGERTIP_M, 10 * this.px) - 4 * this.px, parts.join(", "))];
  }
}
