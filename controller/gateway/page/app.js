// The dashboard: what the daemon says on the page, and what fingers and buttons say to the daemon.

import { decodeField, FieldPicture } from "./field.js";
import { Fingers } from "./fingers.js";
import { Link } from "./link.js";
import { PlateOverlay, shown } from "./plate.js";
import { addEvent, showAmplifiers, showEffects, showLatency } from "./side.js";

const TOPICS = ["hello", "state", "contacts", "pattern", "silence", "amplifiers", "latency", "log", "link", "field"];
const LEASE_S = 5;
const TOKEN_KEY = "era-haptics-token";
const STATES = {
  NOT_READY: "not ready", SWITCH_ON_DISABLED: "disarmed", READY_TO_SWITCH_ON: "disarmed",
  SWITCHED_ON: "switched on", OPERATION_ENABLED: "armed", QUICK_STOP_ACTIVE: "stopped",
  FAULT_REACTION_ACTIVE: "fault", FAULT: "fault", COMM_LOST: "link lost",
};

const LINK_NEWS = /^link (lost|retry|reopened): /;

const at = (id) => document.getElementById(id);
const log = at("log");
let link;
let lease = null;  // ends with a refusal to renew: states may be told later than the answer to arm
let state = null;
let daemon;  // undefined until it is told; null while it is away
let isRefused = false;  // the gateway answers, but not to this token

const overlay = new PlateOverlay(at("plate"), at("overlay"));
const picture = new FieldPicture(at("field"), at("scale"), (low, high) => {
  at("scale-low").textContent = `${low}`;
  at("scale-high").textContent = `${high} m/s²`;
});
new Fingers(at("plate"), overlay, (touches) => link?.say("touch", { source: "page", touches }));
window.eraHaptics = { get frames() { return picture.frames; } };  // for whoever measures the frame rate

function complain(error) {
  const remedy = error.remedy ?? null;
  at("problem").textContent = error.message;
  addEvent(log, "error", error.message, remedy && !error.message.includes(remedy) ? remedy : null);
}

async function ask(method, params) {
  at("problem").textContent = "";
  try {
    return await link.call(method, params);
  } catch (error) {
    complain(error);
    return null;
  }
}

async function stop() {
  lease = null;
  try {
    if (!link) throw new Error("no token");
    await link.stop();
  } catch {
    complain(new Error("The stop was not delivered. Switch the amplifiers off by hand."));
  }
}

async function arm() {
  const given = await ask("arm", { owner: "dashboard", lease_s: LEASE_S });
  lease = given?.lease ?? null;
  showButtons();
}

setInterval(() => {
  if (!lease || !link?.isOpen) return;
  link.call("renew", { lease }).catch((error) => {
    if (error.code === 1002) {
      lease = null;
      showButtons();
    }
  });
}, (1000 * LEASE_S) / 3);

function showButtons() {
  const isArmed = state === "OPERATION_ENABLED";
  const isThere = state !== null && link?.isOpen;
  at("arm").disabled = !isThere || isArmed || !["SWITCH_ON_DISABLED", "READY_TO_SWITCH_ON"].includes(state);
  at("disarm").disabled = !isThere || !isArmed;
  at("clear").disabled = !isThere || !["QUICK_STOP_ACTIVE", "FAULT"].includes(state);
}

// What everybody should know before they look at anything else.
function showBanner() {
  let text = "";
  if (isRefused) text = "The gateway refuses the token of this page. Amplifiers may still be energised.";
  else if (!link?.isOpen) text = "The gateway does not answer. Amplifiers may still be energised.";
  else if (daemon === null) text = "The daemon does not answer. Amplifiers may still be energised.";
  else if (state === "COMM_LOST") text = "The link to an amplifier is lost. It may still be energised.";
  else if (daemon?.rig.simulated) text = "Simulated amplifiers: nothing vibrates but numbers.";
  at("banner").hidden = !text;
  at("banner").textContent = text;
  at("banner").classList.toggle("grave", !text.startsWith("Simulated"));
}

function showState(next, cause) {
  state = next;
  showBanner();
  at("state").textContent = STATES[state] ?? "daemon away";
  at("state").dataset.state = state ?? "away";
  at("state").title = state ?? "";
  at("cause").textContent = cause ?? "";
  showButtons();
}

function summarise({ contacts, predicted_contrast_db, robust_contrast_db, predicted_level_db_sl, latency_ms }) {
  const parts = [];
  if (predicted_level_db_sl !== null) parts.push(`target feels ${shown(predicted_level_db_sl)} dB SL`);
  if (predicted_contrast_db !== null) parts.push(`${shown(predicted_contrast_db)} dB over the others`);
  if (robust_contrast_db !== null) parts.push(`${shown(robust_contrast_db)} dB nine times in ten`);
  parts.push(`${shown(latency_ms, 1)} ms from touch to wire`);
  at("summary").textContent = `${contacts.length} ${contacts.length === 1 ? "finger" : "fingers"}: ${parts.join(", ")}`;
}

const HANDLERS = {
  hello(said) {
    daemon = said;
    showBanner();
    if (daemon === null) {
      showState(null, "the gateway looks for it");
      overlay.show({ contacts: [], drive: {} });
      return;
    }
    overlay.setUp(daemon);
    link.call("status").then((status) => showState(status.state, status.cause)).catch(complain);
    link.call("effects").then(({ effects }) => showEffects(at("effects-section"), at("effects"), effects, play)).catch(() => {});
  },
  state({ old, new: next, cause, remedy }) {
    const previous = state;
    showState(next, cause);
    if (previous !== null && old !== next) {
      const level = ["FAULT", "COMM_LOST"].includes(next) ? "error" : "info";
      addEvent(log, level, `${STATES[next] ?? next}: ${cause}`, remedy);
    }
  },
  contacts({ contacts }) {
    overlay.show({ contacts });
    if (!contacts.length) at("summary").textContent = "";
    else if (["SWITCH_ON_DISABLED", "READY_TO_SWITCH_ON"].includes(state)) at("summary").textContent = "silent: arm, and touches are felt";
  },
  pattern(pattern) {
    overlay.show(pattern);
    summarise(pattern);
  },
  silence({ contacts, reason }) {
    overlay.show({ contacts, drive: {} });
    at("summary").textContent = contacts.length ? `silent: ${reason}` : "";
  },
  amplifiers({ amplifiers }) {
    showAmplifiers(at("amplifiers"), amplifiers, overlay.rig?.eras ?? []);
  },
  latency({ latency_ms }) {
    showLatency(at("latency-numbers"), at("latency"), latency_ms);
  },
  log({ level, message, cause, remedy }) {
    if (isTransition(message) || LINK_NEWS.test(message)) return;  // told by state and link, in words
    addEvent(log, level, cause ? `${message}: ${cause}` : message, remedy);
  },
  link({ event, amplifier, message, remedy }) {
    addEvent(log, event === "reopened" ? "info" : "error", amplifier ? `${amplifier}: ${message}` : message, remedy);
  },
};

// Whether a line of the daemon's log is its change of state, such as "SWITCHED_ON -> FAULT".
function isTransition(message) {
  const parts = message.split(" -> ");
  return parts.length === 2 && parts.every((part) => part in STATES);
}

function play(effect) {
  const { rig, cursor } = overlay;
  const place = cursor ?? { x_m: rig.length_m / 2, y_m: rig.width_m / 2 };
  ask("play", { effect, ...place });
}

function connected(isConnected) {
  if (isConnected) {
    isRefused = false;
    at("door").hidden = true;
    at("main").hidden = false;
    addEvent(log, "info", "connected to the gateway");
    return;
  }
  lease = null;
  daemon = undefined;
  showState(null, isRefused ? "the gateway has another token" : "the gateway does not answer; it is tried again");
  if (!link?.wasOpen) showDoor("The gateway cannot be reached. It is tried again.");
}

function showDoor(problem) {
  at("door").hidden = false;
  at("door-problem").textContent = problem;
}

function refused() {
  isRefused = true;
  showState(null, "the gateway has another token");
  showDoor("The gateway has another token: open the URL that it printed when it started.");
}

function enter(token) {
  link = new Link(token, TOPICS, {
    connected,
    refused,
    event: ({ topic, data }) => HANDLERS[topic]?.(data),
    field: (buffer) => picture.show(decodeField(buffer)),
  });
}

// Whoever leaves the page cannot stop any more.
window.addEventListener("pagehide", () => lease && link.post("disarm").catch(() => {}));

at("arm").addEventListener("click", arm);
at("disarm").addEventListener("click", () => {
  lease = null;
  ask("disarm");
});
at("clear").addEventListener("click", () => ask("clear"));
at("stop").addEventListener("click", stop);
at("motion").addEventListener("change", ({ target }) => picture.setMotion(target.checked));
at("door").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem(TOKEN_KEY, at("token").value.trim());
  location.reload();
});
// The space bar stops, wherever the focus is, and does nothing else.
window.addEventListener("keydown", (event) => {
  if (event.code !== "Space" || event.target.id === "token") return;
  event.preventDefault();
  event.stopPropagation();
  if (!event.repeat) stop();
}, { capture: true });
window.addEventListener("keyup", (event) => event.code === "Space" && event.target.id !== "token" && event.preventDefault(), { capture: true });

// The URL's token is kept by the tab alone, where nobody looks over a shoulder.
function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!given) return false;
  history.replaceState(null, "", location.pathname);
  sessionStorage.setItem(TOKEN_KEY, given);
  return true;
}

window.addEventListener("hashchange", () => takeToken() && location.reload());
takeToken();
const token = sessionStorage.getItem(TOKEN_KEY);
if (token) enter(token);
else showDoor("");
