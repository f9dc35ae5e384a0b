// The dashboard: what the daemon says on the page, and what fingers and buttons say to the daemon.

import { decodeField, FieldPicture } from "./field.js";
import { Fingers } from "./fingers.js";
import { Link } from "./link.js";
import { PlateOverlay, shown } from "./plate.js";
import { addEvent, follow, showAmplifiers, showEffects, showLatency, STATES, timeOfDay } from "./side.js";

const TOPICS = ["hello", "state", "contacts", "pattern", "silence", "amplifiers", "latency", "log", "link", "field"];
const LEASE_S = 5;
const TOKEN_KEY = "era-haptics-token";
const DISARMED = ["SWITCH_ON_DISABLED", "READY_TO_SWITCH_ON"];
const LATCHED = ["QUICK_STOP_ACTIVE", "FAULT"];
// States that are left at once: what led to them, or what follows, is told.
const PASSING = ["SWITCHED_ON", "FAULT_REACTION_ACTIVE", "READY_TO_SWITCH_ON"];
// Why there is no connection to the gateway, and what is done about it.
const SHUT = {
  refused: ["The gateway refuses the token of this page", "open the URL that it printed when it started"],
  full: ["The gateway answers, but does not let this page in", "it is tried again"],
  away: ["The gateway does not answer", "it is tried again"],
};

const at = (id) => document.getElementById(id);
const log = at("log");
let link;
let lease = null;  // ends with a refusal to renew: states may be told later than the answer to arm
let state = null;
let daemon;  // undefined until it is told; null while it is away
let shutBecause = "away";
let since = null;  // when the gateway, the daemon or a link to an amplifier was lost
let watchdog;  // s; how long an amplifier plays on that hears nothing
let gap = null;  // the event of a gateway or daemon that does not answer, until one does
let loss = null;  // the event of a lost link, and how often it was tried again

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
    at("problem").textContent = "";
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
  at("arm").disabled = !isThere || isArmed || !DISARMED.includes(state);
  at("disarm").disabled = !isThere || !isArmed;
  at("clear").disabled = !isThere || !LATCHED.includes(state);
  at("effects").disabled = !isThere || !isArmed;
}

// What everybody should know before they look at anything else.
function showBanner() {
  const from = since ? ` (since ${timeOfDay(since)})` : "";
  const unseen = "Amplifiers may still be energised.";
  let text = "";
  if (!link?.isOpen) text = `${SHUT[shutBecause][0]}${shutBecause === "away" ? from : ""}. ${unseen}`;
  else if (daemon === null) text = `The daemon does not answer${from}. ${unseen}`;
  else if (state === "COMM_LOST") {
    text = `The link to an amplifier is lost${from}. `;
    text += watchdog ? `Its watchdog silences it after ${watchdog}\u00a0s, which nothing confirms: it` : "It";
    text += " may still be energised.";
  } else if (daemon?.rig.simulated) text = "Simulated amplifiers: nothing vibrates but numbers.";
  at("banner").hidden = !text;
  at("banner").textContent = text;
  at("banner").classList.toggle("grave", !text.startsWith("Simulated"));
}

function showState(next, cause) {
  if (next !== null) since = next === "COMM_LOST" ? since ?? new Date() : null;
  state = next;
  showBanner();
  at("state").textContent = STATES[state] ?? "not connected";
  at("state").dataset.state = state ?? "away";
  at("state").title = state ?? "";
  at("cause").textContent = at("cause").title = cause ?? "";
  at("plate").classList.toggle("unknown", state === null || state === "COMM_LOST");
  showButtons();
}

// As the daemon tells it when it is asked.
function showStatus(status) {
  showState(status.state, status.cause);
  watchdog = status.watchdog_s;
  if (status.lost_for_s !== null) {
    since = new Date(Date.now() - 1000 * status.lost_for_s);
    tellLoss(status.cause, status.remedy);
  }
  showBanner();
}

function loseContact(what) {
  since = new Date();
  gap ??= addEvent(log, "error", what);
}

// Nobody tells any more what is on the plate and how the amplifiers are.
function forget(cause) {
  showState(null, cause);
  overlay.show({ contacts: [], drive: {} });
  picture.clear();
  at("summary").textContent = "";
  showAmplifiers(at("amplifiers"), null, []);
  loss = null;
}

function tellLoss(cause, remedy) {
  loss ??= { item: addEvent(log, "error", `link lost: ${cause}`, remedy), remedy, tries: 0 };
}

function summarise({ contacts, predicted_contrast_db, robust_contrast_db, predicted_level_db_sl, latency_ms }) {
  const parts = [];
  if (predicted_level_db_sl !== null) parts.push(`target feels ${shown(predicted_level_db_sl)} dB SL`);
  if (predicted_contrast_db !== null) parts.push(`${shown(predicted_contrast_db)} dB over the others`);
  if (robust_contrast_db !== null) parts.push(`${shown(robust_contrast_db)} dB nine times in ten`);
  parts.push(`${shown(latency_ms, 1)} ms from touch to wire`);
  at("summary").textContent = `${contacts.length} ${contacts.length === 1 ? "finger" : "fingers"}: ${parts.join(", ")}`;
}

// Why fingers feel nothing, where that is for the state alone.
function summariseSilence() {
  if (!overlay.contacts.length) at("summary").textContent = "";
  else if (DISARMED.includes(state)) at("summary").textContent = "silent: arm, and touches are felt";
  else if (LATCHED.includes(state)) at("summary").textContent = "silent: clear and arm, and touches are felt";
}

const HANDLERS = {
  hello(said) {
    if (daemon && !said) loseContact("the daemon does not answer");
    daemon = said;
    if (daemon === null) {
      forget("the gateway looks for the daemon");
      return;
    }
    if (gap) follow(gap, `${timeOfDay(new Date())} connected again`);
    gap = null;
    showBanner();
    overlay.setUp(daemon);
    link.call("status").then(showStatus).catch(complain);
    link.call("effects").then(({ effects }) => showEffects(at("effects-section"), at("effects"), effects, play)).catch(() => {});
  },
  state({ old, new: next, cause, remedy }) {
    const isNews = state !== null && old !== next && !PASSING.includes(next);
    showState(next, cause);
    summariseSilence();
    if (next === "COMM_LOST") {
      tellLoss(cause, remedy);
      return;
    }
    if (loss && next !== "NOT_READY") {
      follow(loss.item, `${timeOfDay(new Date())} all amplifiers answer again, and are disarmed`, remedy);
    } else if (isNews) {
      const what = STATES[next] ?? next;
      addEvent(log, next === "FAULT" ? "error" : "info", cause.startsWith(what) ? cause : `${what}: ${cause}`, remedy);
    }
    loss = null;
  },
  contacts({ contacts }) {
    overlay.show({ contacts });
    summariseSilence();
  },
  pattern(pattern) {
    overlay.show(pattern);
    summarise(pattern);
  },
  silence({ contacts, reason }) {
    overlay.show({ contacts, drive: {} });
    at("summary").textContent = `silent: ${reason}`;
    summariseSilence();
  },
  amplifiers({ amplifiers }) {
    showAmplifiers(at("amplifiers"), amplifiers, overlay.rig?.eras ?? []);
  },
  latency({ latency_ms, plain_because }) {
    showLatency(at("latency-numbers"), at("latency"), latency_ms);
    at("plain").textContent = plain_because ? `Plain ramps in place of shaped onsets: ${plain_because}` : "";
  },
  log({ level, message, cause, remedy }) {
    addEvent(log, level, cause ? `${message}: ${cause}` : message, remedy);
  },
  link({ event, message }) {
    if (event !== "retry" || !loss) return;  // of the others the state tells
    const times = ++loss.tries === 1 ? "once" : `${loss.tries} times`;
    follow(loss.item, `tried again ${times}: ${message}`, loss.remedy);
  },
};

// At the keyboard's finger or the newest of all.
function play(effect) {
  const { rig, cursor, contacts } = overlay;
  const { x_m, y_m } = cursor ?? contacts.at(-1) ?? { x_m: rig.length_m / 2, y_m: rig.width_m / 2 };
  ask("play", { effect, x_m, y_m });
}

function connected(isConnected) {
  if (isConnected) {
    shutBecause = "away";  // if it is lost again
    since = null;
    at("door").hidden = true;
    at("main").hidden = false;
    if (!gap) addEvent(log, "info", "connected to the gateway");
    return;
  }
  if (link?.isHeard) loseContact("the gateway does not answer");
  lease = null;
  daemon = undefined;
  forget(SHUT[shutBecause][1]);
}

// There is a gateway that lets this page not in, or none.
function shut(why) {
  shutBecause = why;
  forget(SHUT[why][1]);
  if (why === "refused" || !link.wasOpen) showDoor(`${SHUT[why][0]}.`);
  else at("door").hidden = true;
}

function showDoor(problem) {
  at("door").hidden = false;
  at("door-problem").textContent = problem;
}

function enter(token) {
  link = new Link(token, TOPICS, {
    connected,
    shut,
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
