// Fingers on the picture: pointers of every kind, and one that the keyboard moves.

const REPEAT_MS = 50;  // the daemon lifts what it has not heard of for 150 ms
const STEP_M = 0.005;
const KEYBOARD = -1;   // an id that no pointer has

export class Fingers {
  // say(touches) is called with all fingers whenever they change, and every 50 ms while any is down.
  constructor(plate, overlay, say) {
    this.overlay = overlay;
    this.say = say;
    this.down = new Map();
    this.changed = false;
    plate.addEventListener("pointerdown", (event) => this.press(event, plate));
    plate.addEventListener("pointermove", (event) => this.move(event));
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
      plate.addEventListener(kind, (event) => this.lift(event.pointerId));
    }
    plate.addEventListener("contextmenu", (event) => event.preventDefault());
    plate.addEventListener("keydown", (event) => this.key(event));
    plate.addEventListener("blur", () => this.leave());
    window.addEventListener("blur", () => this.liftAll());
    document.addEventListener("visibilitychange", () => document.hidden && this.liftAll());
    setInterval(() => this.down.size && this.tell(), REPEAT_MS);
  }

  press(event, plate) {
    if (!this.overlay.rig || (event.pointerType === "mouse" && event.button !== 0)) return;
    event.preventDefault();
    plate.focus({ preventScroll: true });
    plate.setPointerCapture(event.pointerId);
    this.down.set(event.pointerId, this.overlay.place(event));
    this.tell();
  }

  move(event) {
    if (!this.down.has(event.pointerId)) return;
    this.down.set(event.pointerId, this.overlay.place(event));
    if (this.changed) return;
    this.changed = true;
    requestAnimationFrame(() => {
      this.changed = false;
      if (this.down.size) this.tell();
    });
  }

  lift(id) {
    if (this.down.delete(id)) this.tell();
  }

  liftAll() {
    if (!this.down.size) return;
    this.down.clear();
    this.tell();
  }

  key(event) {
    const { rig } = this.overlay;
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const step = steps[event.key];
    if (!rig || (!step && event.key !== "Enter" && event.key !== "Escape")) return;
    event.preventDefault();
    this.cursor ??= { x_m: rig.length_m / 2, y_m: rig.width_m / 2 };
    if (step) {
      const within = (value, most) => Math.min(most, Math.max(0, value));
      this.cursor = {
        x_m: within(this.cursor.x_m + step[0] * STEP_M, rig.length_m),
        y_m: within(this.cursor.y_m + step[1] * STEP_M, rig.width_m),
      };
      if (this.down.has(KEYBOARD)) {
        this.down.set(KEYBOARD, this.cursor);
        this.tell();
      }
    } else if (event.key === "Enter" && !this.down.has(KEYBOARD)) {
      this.down.set(KEYBOARD, this.cursor);
      this.tell();
    } else {
      this.lift(KEYBOARD);
    }
    this.overlay.showCursor(this.cursor);
  }

  leave() {
    this.lift(KEYBOARD);
    this.cursor = undefined;
    this.overlay.showCursor(undefined);
  }

  tell() {
    this.say([...this.down].map(([id, place]) => ({ id, ...place })));
  }
}
