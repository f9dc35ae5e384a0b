// Fingers on the plate's picture: pointers of every kind, and one moved by the keyboard.

const STEP_M = 0.005;
const KEYBOARD = -1;   // an id that no pointer has

export class Fingers {
  // send(touches) is called with all fingers at every change.
  constructor(plate, overlay, send) {
    this.overlay = overlay;
    this.send = send;
    this.positions = new Map();  // by id, of the fingers that are down
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
    plate.setPointerCapture(event.pointerId);
    this.put(event.pointerId, this.overlay.position(event));
  }

  move(event) {
    if (!this.positions.has(event.pointerId)) return;
    this.positions.set(event.pointerId, this.overlay.position(event));
    if (this.isMoveScheduled) return;
    this.isMoveScheduled = true;
    requestAnimationFrame(() => {
      this.isMoveScheduled = false;
      if (this.positions.size) this.report();
    });
  }

  put(id, position) {
    this.positions.set(id, position);
    this.report();
  }

  lift(id) {
    if (this.positions.delete(id)) this.report();
  }

  // The connection has lifted all.
  clear() {
    this.positions.clear();
  }

  key(event) {
    const { rig } = this.overlay;
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const step = steps[event.key];
    if (!rig || (!step && event.key !== "Enter" && event.key !== "Escape")) return;
    event.preventDefault();
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
