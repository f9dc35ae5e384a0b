// Dashboard: shows the daemon's events, and sends fingers and button presses to the daemon.

import { Connection } from "./connection.js";
import { colourOf, decodeField, FieldView } from "./field.js";
import { Fingers } from "./fingers.js";
import { atLeast, felt, fixed, levelOf, PlateOverlay } from "./plate.js";
import { addEvent, annotate, showAmplifiers, showEffects, showLatency, showLayouts, showStrengths, timeOfDay } from "./side.js";

const TOPICS = ["state", "contacts", "pattern", "silence", "amplifiers", "latency", "log", "link", "layout", "inputs", "strength"];
const TOKEN_KEY = "era-haptics-token";
const DISARMED = ["SWITCH_ON_DISABLED", "READY_TO_SWITCH_ON"];
const LATCHED = ["QUICK_STOP_ACTIVE", "FAULT"];
// States that last only a moment; the events before or after them are shown instead.
const TRANSIENT = ["SWITCHED_ON", "FAULT_REACTION_ACTIVE", "READY_TO_SWITCH_ON"];
// Why there is no connection to the daemon, and the remedy.
const FAILURES = {
  daemon: ["The daemon does not respond", "the gateway is connecting to the daemon"],
  refused: ["The gateway rejected the token of this page", "open the URL that it printed at startup"],
  full: ["The gateway responds but has too many clients", "retrying"],
  unreachable: ["The gateway does not respond", "retrying"],
};

const at = (id) => document.getElementById(id);
const log = at("log");
let connection;
let state = null;
let epoch = null;  // of the state shown: a clear does not acknowledge later events
let daemon = null;  // result of hello; null while disconnected
let ownName;  // name of this page in the daemon's log
let failure = "unreachable";
let lostSince = null;  // when the gateway, the daemon or a link to an amplifier was lost
let watchdog;  // s; after which an amplifier without commands silences itself
let silences = [];  // of amplifiers that do not reply
let outage = null;  // log entry of a lost gateway or daemon, until reconnected
let layouts = [];  // names of the layouts to choose from
let linkLoss = null;  // log entry of a lost link, and the number of retries

const overlay = new PlateOverlay(at("plate"), at("overlay"));
const fieldView = new FieldView(at("field"), at("scale"), (low, high) => {
  at("scale-low").textContent = `${low}`;
  at("scale-high").textContent = high;
});
const fingers = new Fingers(at("plate"), overlay, (touches) => connection?.touch(touches));
window.eraHaptics = { get frames() { return fieldView.frames; } };  // for measuring the frame rate

function showError(error) {
  const remedy = error.remedy ?? null;
  at("problem").textContent = error.message;
  addEvent(log, "error", error.message, remedy && !error.message.includes(remedy) ? remedy : null);
}

// Await a call and return its result; on an error, show it and return null.
async function attempt(called) {
  at("problem").textContent = "";
  try {
    return await called();
  } catch (error) {
    showError(error);
    return null;
  }
}

const NOT_SILENT = 1006;
const SAME_PLACE_M = 0.01;  // half the radius within which the daemon looks for a finger
const CONTACT_WAIT_MS = 5000;  // enough for a busy machine

async function stop() {
  try {
    if (!connection) throw new Error("no token");
    await connection.stop();
    at("problem").textContent = "";
  } catch ({ errors }) {
    const unconfirmed = errors?.find(({ code }) => code === NOT_SILENT);  // it names the amplifiers
    showError(unconfirmed ?? new Error("The stop was not confirmed. Switch the amplifiers off by hand."));
  }
}

function showButtons() {
  const isArmed = state === "OPERATION_ENABLED";
  const isConnected = state !== null && connection?.isOpen;
  at("arm").disabled = !isConnected || isArmed || !DISARMED.includes(state);
  at("disarm").disabled = isConnected ? !isArmed : !connection?.lease;
  at("clear").disabled = !isConnected || !LATCHED.includes(state);
  at("effects").disabled = !isConnected || !isArmed;
}

function showBanner() {
  const since = lostSince ? ` (since ${timeOfDay(lostSince)})` : "";
  const warning = "Amplifiers may still be energized.";
  let text = "";
  let reason = "";
  if (!connection?.isOpen) {
    reason = failure === "daemon" ? "daemon-unreachable" : `gateway-${failure}`;
    text = `${FAILURES[failure][0]}${["daemon", "unreachable"].includes(failure) ? since : ""}. ${warning}`;
  } else if (state === "COMM_LOST") {
    reason = "link-lost";
    const mayPlay = silences.filter(({ silence }) => silence === "may_play");
    text = `Link to an amplifier lost${since}. `;
    const after = watchdog ? ` after ${watchdog}\u00a0s` : "";
    if (silences.length && !mayPlay.length) text += `Its watchdog should have silenced it${after} (not confirmed).`;
    else if (mayPlay.some(({ may_play_for_s }) => may_play_for_s === null)) text += "It can play until it is switched off.";
    else text += `It may still be energized; its watchdog silences it${after} (not confirmed).`;
  } else if (daemon?.rig.simulated) {
    reason = "simulated";
    text = "Simulated amplifiers: nothing vibrates.";
  }
  at("banner").hidden = !text;
  at("banner").textContent = text;
  at("banner").dataset.reason = reason;
  at("banner").classList.toggle("grave", reason !== "simulated");
}

function showState(next, word, cause, newEpoch = null) {
  epoch = newEpoch;
  if (next !== null) lostSince = next === "COMM_LOST" ? lostSince ?? new Date() : null;
  state = next;
  showBanner();
  at("state").textContent = word ?? "not connected";
  at("state").dataset.state = state ?? "disconnected";
  at("state").title = state ?? "";
  at("cause").textContent = at("cause").title = withThisPage(cause) ?? "";
  at("plate").classList.toggle("unknown", state === null || state === "COMM_LOST");
  showButtons();
  showHint();
}

// Show the first step, on a plate without fingers.
function showHint() {
  const hints = { OPERATION_ENABLED: "Touch the plate", QUICK_STOP_ACTIVE: "Clear and arm, then touch", FAULT: "Clear and arm, then touch" };
  const hint = DISARMED.includes(state) ? "Arm, then touch" : hints[state];
  at("hint").hidden = !hint || overlay.contacts.length > 0;
  at("hint").textContent = hint ?? "";
}

// Replace the name of this page in a text of the daemon by "this page".
function withThisPage(text) {
  for (const name of [`dashboard (${ownName})`, ownName]) text = text?.replaceAll(`by '${name}'`, "from this page");
  return text;
}

function showStatus(status) {
  showState(status.state, status.word, status.cause, status.epoch);
  ({ layouts } = status);
  showThresholdSet(status.threshold);
  showLayouts(at("layout-choice"), at("layouts"), layouts, status.layout);
  watchdog = status.watchdog_s;
  silences = silencesOf(status);
  if (status.lost_for_s !== null) {
    lostSince = new Date(Date.now() - 1000 * status.lost_for_s);
    showLinkLoss(status.cause, status.remedy);
  }
  showBanner();
}

// Show the name of the rig's threshold set; levels in dB SL are relative to it.
function showThresholdSet(name) {
  at("threshold-set").textContent = `thresholds: ${name}`;
  at("threshold-set").hidden = name === null;
}

const silencesOf = ({ amplifiers }) => amplifiers.map(({ silence }) => silence).filter(Boolean);

function showOutage(message) {
  lostSince = new Date();
  outage ??= addEvent(log, "error", message);
}

// Without events, the state of plate and amplifiers is unknown.
function showUnknown(cause) {
  showState(null, null, cause);
  overlay.show({ contacts: [], layers: {} });
  showHint();
  showLayers();
  fieldView.clear();
  at("inputs").textContent = "";
  summarise("");
  showAmplifiers(at("amplifiers"), null, []);
  linkLoss = null;
}

function showLinkLoss(cause, remedy) {
  linkLoss ??= { item: addEvent(log, "error", `link lost: ${cause}`, remedy), remedy, retries: 0 };
}

// Show buttons that select the field of one content or of all, if there are several.
function showLayers() {
  const { contents } = overlay;
  if (!contents.some(({ layer }) => layer === fieldView.layer)) fieldView.select(null);
  const choices = contents.length < 2 ? [] : [{ layer: null, frequencies: [] }, ...contents];
  at("layers").hidden = !choices.length;
  at("layers").replaceChildren(...choices.map(({ layer, frequencies }) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = layer === null ? "all" : `${frequencies.map((each) => fixed(each)).join(", ")} Hz`;
    button.ariaPressed = `${layer === fieldView.layer}`;
    if (layer !== null) button.style.setProperty("--content", colourOf(layer));
    button.addEventListener("click", () => {
      fieldView.select(layer);
      showLayers();
    });
    return button;
  }));
}

// isDrawn: whether the plate shows the same, so that only screen readers need the text.
function summarise(text, isDrawn = false) {
  at("summary").textContent = text;
  at("summary").classList.toggle("drawn", isDrawn);
}

// Summarise what each finger feels, with the figures drawn on the plate; the reason for feeling nothing is not drawn.
function summarisePattern({ contacts }) {
  const targets = contacts.filter(({ role }) => role === "target").map((contact) => {
    const { verdict, frequency_hz, promised_contrast_db, held_back } = contact;
    if (verdict === "held back") return held_back;
    const contrast = promised_contrast_db === null ? "" : `, at least ${atLeast(promised_contrast_db)} dB above the others`;
    return `${fixed(frequency_hz)} Hz ${felt(contact)}, ${levelOf(contact) ?? "– dB SL"}${contrast}`;
  });
  const isDrawn = contacts.every(({ verdict }) => verdict !== "held back");
  summarise(`${contacts.length} ${contacts.length === 1 ? "finger" : "fingers"}: ${targets.join("; ")}`, isDrawn);
}

// Explain why fingers feel nothing, if the state is the reason.
function summariseSilence() {
  if (!overlay.contacts.length) summarise("");
  else if (DISARMED.includes(state)) summarise("silent: arm to feel touches");
  else if (LATCHED.includes(state)) summarise("silent: clear, then arm to feel touches");
}

const HANDLERS = {
  state({ old, new: next, word, cause, remedy, epoch: newEpoch }) {
    const isChange = state !== null && old !== next && !TRANSIENT.includes(next);
    showState(next, word, cause, newEpoch);
    summariseSilence();
    if (next === "COMM_LOST") {
      showLinkLoss(cause, remedy);
      return;
    }
    if (linkLoss && next !== "NOT_READY") {
      annotate(linkLoss.item, `${timeOfDay(new Date())} all amplifiers reconnected, disarmed`, remedy);
    } else if (isChange) {
      addEvent(log, next === "FAULT" ? "error" : "info", withThisPage(cause.startsWith(word) ? cause : `${word}: ${cause}`), remedy);
    }
    linkLoss = null;
  },
  contacts({ contacts }) {
    overlay.show({ contacts });
    showHint();
    summariseSilence();
  },
  pattern(pattern) {
    overlay.show(pattern);
    showHint();
    showLayers();
    summarisePattern(pattern);
  },
  silence({ contacts, reason }) {
    overlay.show({ contacts, layers: {} });
    showHint();
    showLayers();
    summarise(`silent: ${reason}`);
    summariseSilence();
  },
  amplifiers({ amplifiers }) {
    silences = silencesOf({ amplifiers });
    showBanner();
    showAmplifiers(at("amplifiers"), amplifiers, overlay.rig?.eras ?? [], daemon?.readings);
  },
  layout({ name, layout }) {
    showLayouts(at("layout-choice"), at("layouts"), layouts, name);
    if (JSON.stringify(layout) === JSON.stringify(daemon.layout)) return;
    daemon.layout = layout;
    overlay.setUp(daemon);
    updateEffects();
  },
  latency({ latency_ms }) {
    showLatency(at("latency-numbers"), at("latency"), latency_ms);
  },
  inputs({ inputs, rejected_touches }) {
    const lacking = inputs.filter(({ problem }) => problem);
    at("inputs").textContent = lacking.map(({ name, state, problem }) => `Touch ${name}: ${state}: ${problem}`).join(" · ");
    const counts = Object.entries(rejected_touches).map(([reason, count]) => `${reason.replaceAll("_", " ")} ${count}`);
    at("rejected").textContent = counts.length ? `Rejected touches: ${counts.join(", ")}` : "";
  },
  strength({ strengths }) {
    const set = (name, gain) => attempt(() => connection.strength(name, gain));
    showStrengths(at("strengths-section"), at("strengths"), Object.entries(strengths), set);
  },
  log({ level, message, cause, remedy }) {
    addEvent(log, level, withThisPage(cause ? `${message}: ${cause}` : message), remedy);
  },
  link({ event, message }) {
    if (event !== "retry" || !linkLoss) return;  // other link events appear as states
    annotate(linkLoss.item, `retry ${++linkLoss.retries}: ${message}`, linkLoss.remedy);
  },
};

// Wait until the daemon reports a contact at a finger of this page.
async function contactAt({ x_m, y_m }) {
  const isThere = (contact) => Math.hypot(contact.x_m - x_m, contact.y_m - y_m) < SAME_PLACE_M;
  const deadline = performance.now() + CONTACT_WAIT_MS;
  while (!overlay.contacts.some(isThere)) {
    if (performance.now() > deadline) throw new Error("the daemon has not reported the finger; press the button again");
    await new Promise((resolve) => setTimeout(resolve, 10));
  }
}

// Play an effect at a finger of this page.
async function play(effect) {
  await attempt(async () => {
    const finger = fingers.forButton();
    await contactAt(finger);
    await connection.call("play", { effect, x_m: finger.x_m, y_m: finger.y_m });
  });
}

// Events after the state shown are not acknowledged, but shown.
async function clear() {
  await attempt(() => connection.call("clear", { epoch }));
  connection.call("status").then(showStatus, () => {});
}

// If the layout is rejected, the status restores the current one.
async function choose({ target }) {
  if (await attempt(() => connection.layout(target.value)) === null) connection.call("status").then(showStatus, () => {});
}

function updateEffects() {
  connection.call("effects").then(({ effects }) => showEffects(at("effects-section"), at("effects"), effects, play)).catch(() => {});
}

function opened(hello, name) {
  daemon = hello;
  ownName = name;
  lostSince = null;
  at("login").hidden = true;
  at("main").hidden = false;
  if (outage) annotate(outage, `${timeOfDay(new Date())} reconnected`);
  else addEvent(log, "info", "connected to the daemon");
  outage = null;
  showBanner();
  overlay.setUp(daemon);
  connection.call("status").then(showStatus).catch((error) => error.code && showError(error));  // 0: an outage, already shown
  updateEffects();
}

function closed() {
  daemon = null;
}

function failed(why) {
  failure = why;
  const isGateway = why !== "daemon";
  if (connection.wasOpen) showOutage(`the ${isGateway ? "gateway" : "daemon"} does not respond`);
  showUnknown(FAILURES[why][1]);
  if (why === "refused" || (isGateway && !connection.wasEverAccepted)) showLogin(`${FAILURES[why][0]}.`);
  else at("login").hidden = true;
  if (!isGateway) at("main").hidden = false;
}

function showLogin(problem) {
  at("login").hidden = false;
  at("login-problem").textContent = problem;
}

function connect(token) {
  connection = new Connection(token, TOPICS, {
    opened,
    closed,
    failed,
    lifted: () => fingers.clear(),
    disarmed: showButtons,
    stopped: (result) => { epoch = Math.max(epoch, result.epoch); },
    event: ({ topic, data }) => HANDLERS[topic]?.(data),
    field: (buffer) => fieldView.show(decodeField(buffer)),
  });
}

at("arm").addEventListener("click", () => attempt(() => connection.arm(`dashboard (${ownName})`)));
at("disarm").addEventListener("click", () => attempt(() => connection.disarm()).then(showButtons));
at("clear").addEventListener("click", clear);
at("stop").addEventListener("click", stop);
at("layouts").addEventListener("change", choose);
at("motion").addEventListener("change", ({ target }) => fieldView.setMotion(target.checked));
at("login").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem(TOKEN_KEY, at("token").value.trim());
  location.reload();
});
// The space bar stops, regardless of the focus, and does nothing else.
window.addEventListener("keydown", (event) => {
  if (event.code !== "Space" || event.target.id === "token") return;
  event.preventDefault();
  event.stopPropagation();
  if (!event.repeat) stop();
}, { capture: true });
window.addEventListener("keyup", (event) => event.code === "Space" && event.target.id !== "token" && event.preventDefault(), { capture: true });

// Move the token from the URL to the tab's storage, where it is not displayed.
function takeToken() {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!token) return false;
  history.replaceState(null, "", location.pathname);
  sessionStorage.setItem(TOKEN_KEY, token);
  return true;
}

window.addEventListener("hashchange", () => takeToken() && location.reload());
takeToken();
const token = sessionStorage.getItem(TOKEN_KEY);
if (token) connect(token);
else showLogin("");
