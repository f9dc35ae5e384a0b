// Fingers on the plate's picture: pointers of every kind, a finger moved by the keyboard, and resting fingers.
// Shift-click places a resting finger; shift-click on it, or Escape, lifts it. If no finger is down, an effect
// button places one at the last position, for two seconds.

const STEP_M = 0.005;
const KEYBOARD = -1;  // an id no pointer has
const BUTTON = -2;  // the finger that an effect button places
const RESTING = -3;  // id of the first resting finger; further ids count down
const BUTTON_MS = 2000;  // time until the finger of an effect button is lifted
const NEAR_PX = 24;  // distance within which a press hits a resting finger
const PX_M = 0.0254 / 96;  // size of a CSS pixel: fingers keep their size at any size of the picture
const LEAST_M = 0.001;  // smallest radius; a pointer of unknown size reports one or two pixels

export class Fingers {
  // send(touches) is called with all fingers after every change.
  constructor(plate, overlay, send) {
    this.overlay = overlay;
    this.send = send;
    this.positions = new Map();  // positions of the fingers on the plate, by id
    this.last = null;  // position of the finger that moved last, even after its lift
    this.buttonTimer = null;  // lifts the finger of an effect button
    this.isMoveScheduled = false;
    plate.addEventListener("pointerdown", (event) => this.press(event, plate));
    plate.addEventListener("pointermove", (event) => this.move(event));
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) {
      plate.addEventListener(type, (event) => this.lift(event.pointerId));
    }
    plate.addEventListener("contextmenu", (event) => event.preventDefault());
    plate.addEventListener("keydown", (event) => this.key(event));
    plate.addEventListener("blur", () => this.removeCursor());
  }

  press(event, plate) {
    if (!this.overlay.rig || (event.pointerType === "mouse" && event.button !== 0)) return;
    event.preventDefault();
    plate.focus({ preventScroll: true });
    if (event.shiftKey) {
      this.rest(this.overlay.position(event));
      return;
    }
    plate.setPointerCapture(event.pointerId);
    this.put(event.pointerId, this.contact(event));
  }

  // Position of a pointer, and the radius of a touch if its size is known.
  contact(event) {
    const place = this.overlay.position(event);
    const radius_m = (Math.max(event.width, event.height) / 2) * PX_M;
    return event.pointerType === "touch" && radius_m > LEAST_M ? { ...place, radius_m } : place;
  }

  move(event) {
    if (!this.positions.has(event.pointerId)) return;
    this.positions.set(event.pointerId, this.contact(event));
    this.last = this.positions.get(event.pointerId);
    if (this.isMoveScheduled) return;
    this.isMoveScheduled = true;
    requestAnimationFrame(() => {
      this.isMoveScheduled = false;
      if (this.positions.size) this.report();
    });
  }

  // Lift the resting finger at this position, or place one.
  rest(position) {
    const ids = [...this.positions.keys()].filter((id) => id <= RESTING);
    const isNear = ({ x_m, y_m }) =>
      Math.hypot(x_m - position.x_m, y_m - position.y_m) < NEAR_PX * this.overlay.px;
    const there = ids.find((id) => isNear(this.positions.get(id)));
    if (there !== undefined) this.lift(there);
    else this.put(Math.min(RESTING + 1, ...ids) - 1, position);
  }

  put(id, position) {
    this.positions.set(id, position);
    this.last = position;
    this.report();
  }

  // Position for an effect button: that of the newest finger, or of a new finger at the last position.
  forButton() {
    const newest = [...this.positions.keys()].filter((id) => id !== BUTTON).at(-1);
    if (newest !== undefined) return this.positions.get(newest);
    const { rig } = this.overlay;
    this.put(BUTTON, this.last ?? { x_m: rig.length_m / 2, y_m: rig.width_m / 2 });
    clearTimeout(this.buttonTimer);
    this.buttonTimer = setTimeout(() => this.lift(BUTTON), BUTTON_MS);
    return this.last;
  }

  lift(id) {
    if (this.positions.delete(id)) this.report();
  }

  // The connection has lifted all fingers.
  clear() {
    this.positions.clear();
  }

  key(event) {
    const { rig } = this.overlay;
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const step = steps[event.key];
    if (!rig || (!step && event.key !== "Enter" && event.key !== "Escape")) return;
    event.preventDefault();
    if (event.key === "Escape") {
      for (const id of [...this.positions.keys()]) if (id <= RESTING) this.lift(id);
    }
    this.cursor ??= { x_m: rig.length_m / 2, y_m: rig.width_m / 2 };
    if (step) {
      const clamp = (value, max) => Math.min(max, Math.max(0, value));
      this.cursor = {
        x_m: clamp(this.cursor.x_m + step[0] * STEP_M, rig.length_m),
        y_m: clamp(this.cursor.y_m + step[1] * STEP_M, rig.width_m),
      };
      if (this.positions.has(KEYBOARD)) this.put(KEYBOARD, this.cursor);
    } else if (event.key === "Enter" && !this.positions.has(KEYBOARD)) {
      this.put(KEYBOARD, this.cursor);
    } else {
      this.lift(KEYBOARD);
    }
    this.overlay.showCursor(this.cursor);
  }

  removeCursor() {
    this.lift(KEYBOARD);
    this.cursor = undefined;
    this.overlay.showCursor(undefined);
  }

  report() {
    this.send([...this.positions].map(([id, position]) => ({ id, ...position })));
  }
}
