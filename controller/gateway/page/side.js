// Side panel: amplifiers, latencies, effects, events.

import { fixed } from "./plate.js";

const SVG = "http://www.w3.org/2000/svg";
const MAX_EVENTS = 200;
const OLD_REPLY_S = 1;  // twice the interval of status reads while disarmed

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

const rounded = (value, decimals = 1) => fixed(value, Math.abs(value) < 10 ? decimals : 0);

export const timeOfDay = (date) => date.toLocaleTimeString();

function ageText(seconds) {
  if (seconds === null) return "none";
  if (seconds < OLD_REPLY_S) return "just now";
  return seconds < 120 ? `${fixed(seconds)} s ago` : `${fixed(seconds / 60)} min ago`;
}

function silenceText({ silence, may_play_for_s }) {
  if (silence !== "may_play") return "unconfirmed; its watchdog has elapsed";
  return may_play_for_s === null ? "can play until it is switched off" : `can play for ${fixed(may_play_for_s, 2)} s more`;
}

// eras: the rig's ERAs, for channel names. readings: from the daemon's hello: the readings to show, and their format.
function tile(amplifier, eras, readings) {
  const { name, word, state, fault, levels, high_voltage, reply_age_s, lost, closed_with_lost, silence, reports = [] } = amplifier;
  const isFaulty = fault && fault !== "NONE";
  const made = element("article", undefined, lost || isFaulty || reports.length ? "tile bad" : "tile");
  const title = element("h3");
  const status = lost ? "no link" : closed_with_lost ? "closed: another amplifier is lost" : isFaulty ? `fault: ${fault.toLowerCase().replaceAll("_", " ")}` : word ?? "unknown";
  title.append(element("span", name), element("span", status));
  title.title = state ?? "";
  made.append(title);
  const channels = element("div", undefined, "channels");
  const eraOf = (channel) => eras.find((each) => each.amplifier === name && each.channel === channel)?.name;
  levels.forEach((level, channel) => {
    const meter = element("meter");
    const percent = `${(100 * level).toFixed(0)} %`;
    meter.max = 1;
    meter.value = level;
    meter.ariaLabel = `channel ${channel}${eraOf(channel) ? `, ERA ${eraOf(channel)}` : ""}: ${percent}`;
    channels.append(element("span", eraOf(channel) ?? `channel ${channel}`), meter, element("span", percent));
  });
  made.append(levels.length ? channels : element("p", "channels: unknown", "quiet"));
  const list = element("dl");
  const add = (key, value) => list.append(element("dt", key), element("dd", value));
  add("Energised", high_voltage === null ? "unknown" : high_voltage ? "yes" : "no");
  for (const [key, [label, unit, decimals]] of Object.entries(readings)) {
    if (typeof amplifier[key] === "number") add(label, `${rounded(amplifier[key], decimals)} ${unit}`);
  }
  add("Last reply", ageText(reply_age_s));
  if (silence) add("Silence", silenceText(silence));
  made.append(list);
  reports.forEach(({ cause, remedy }) => made.append(element("p", `${cause}; ${remedy}`)));
  return made;
}

// amplifiers: null if unknown.
export function showAmplifiers(container, amplifiers, eras, readings = {}) {
  const tiles = amplifiers?.map((amplifier) => tile(amplifier, eras, readings));
  container.replaceChildren(...(tiles ?? [element("p", "unknown", "quiet")]));
}


export function showLatency(numbers, svg, { count, median, p99, p999, histogram }) {
  // Percentiles need enough commands.
  const percentiles = [["99 %", p99, 100], ["99.9 %", p999, 1000]].filter(([, , min]) => count >= min);
  numbers.textContent = count
    ? [`median ${rounded(median)} ms`, ...percentiles.map(([share, value]) => `${share} within ${rounded(value)} ms`), `of ${count} ${count === 1 ? "touch" : "touches"}`].join(", ")
    : "no touches yet";
  const max = Math.max(1, ...histogram.map(([, number]) => number));
  const width = 320 / Math.max(1, histogram.length);
  const parts = [];
  const add = (name, attributes, text) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    parts.push(made);
  };
  histogram.forEach(([upper, number], index) => {
    const height = number ? Math.max(2, 64 * Math.log1p(number) / Math.log1p(max)) : 0;
    add("rect", { x: index * width + 1, y: 80 - height, width: Math.max(1, width - 2), height });
    if (index === histogram.length - 1) {  // includes values above its edge
      add("text", { x: 320, y: 96, "text-anchor": "end" }, `> ${histogram.at(-2)?.[0] ?? 0}`);
    } else if (index % Math.ceil(histogram.length / 6) === 0) {
      add("text", { x: (index + 1) * width, y: 96, "text-anchor": "middle" }, `${upper}`);
    }
  });
  add("line", { x1: 0, x2: 320, y1: 80, y2: 80 });
  add("text", { x: 320, y: 10, "text-anchor": "end" }, "latency in ms, counts on a logarithmic scale");
  svg.replaceChildren(...parts);
}

export function showEffects(section, container, effects, play) {
  section.hidden = !effects.length;
  container.replaceChildren(...effects.map(({ name, description }) => {
    const button = element("button", name);
    button.type = "button";
    button.title = description;
    button.addEventListener("click", () => play(name));
    return button;
  }));
}

// Show the current layout, if there are several to choose from.
export function showLayouts(choice, select, names, name) {
  choice.hidden = names.length < 2;
  select.replaceChildren(...names.map((each) => new Option(each, each, false, each === name)));
}

const LOWEST_DB = -40;
const FADE_MS = 100;  // the daemon fades to another strength in this time

// Show a slider for each touch source and client, calling set(name, gain_db); one being moved is not updated.
export function showStrengths(section, container, strengths, set) {
  section.hidden = !strengths.length;
  const before = new Map([...container.children].map((row) => [row.dataset.name, row]));
  const rows = strengths.map(([name]) => before.get(name) ?? strengthRow(name, set));
  if (rows.length !== before.size || rows.some((row) => !before.has(row.dataset.name))) container.replaceChildren(...rows);
  rows.forEach((row, index) => row.show(strengths[index][1]));
}

function strengthRow(name, set) {
  const row = element("label", undefined, "strength");
  const slider = element("input");
  const figure = element("output");
  let waiting = null;
  Object.assign(slider, { type: "range", min: LOWEST_DB, max: 0, step: 1 });
  row.dataset.name = name;
  row.append(element("span", name), slider, figure);
  const say = () => { figure.textContent = `${slider.value} dB`; };
  row.show = (gain) => {
    if (waiting !== null || slider.matches(":active")) return;
    slider.value = gain;
    say();
  };
  slider.addEventListener("input", () => {
    say();
    waiting ??= setTimeout(() => {
      waiting = null;
      set(name, Number(slider.value));
    }, FADE_MS);
  });
  return row;
}

// Add an event to the log, newest first, or count it if it repeats the newest; returns its item, for
// `annotate`.
export function addEvent(log, level, message, remedy) {
  const newest = log.firstElementChild;
  const times = newest?.dataset.message === message ? Number(newest.dataset.times) + 1 : 1;
  if (times > 1) newest.remove();
  const item = element("li");
  Object.assign(item.dataset, { message, times });
  const time = element("time", timeOfDay(new Date()));
  item.append(time, " ", element("span", times > 1 ? `${message} (${times} times)` : message, level));
  annotate(item, "", remedy);
  log.prepend(item);
  while (log.children.length > MAX_EVENTS) log.lastElementChild.remove();
  return item;
}

// Show the outcome of an event and its remedy, replacing earlier ones.
export function annotate(item, outcome, remedy) {
  for (const old of item.querySelectorAll(".note")) old.remove();
  for (const each of [outcome, remedy]) if (each) item.append(element("span", each, "note"));
}
