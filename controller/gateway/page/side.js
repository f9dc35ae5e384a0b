// What stands beside the plate: amplifiers, latencies, effects, events.

import { shown } from "./plate.js";

const SVG = "http://www.w3.org/2000/svg";
const MOST_EVENTS = 200;
const OLD_REPLY_S = 0.5;  // ten heartbeats

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

// eras: those of the rig, for the names of what its channels move.
function tile(amplifier, eras) {
  const { name, state, fault, levels, temperature_c, high_voltage, high_voltage_v, reply_age_s, lost } = amplifier;
  const faulty = lost || (fault && fault !== "NONE");
  const made = element("article", undefined, faulty ? "tile bad" : "tile");
  const title = element("h3");
  title.append(element("span", name), element("span", lost ? "lost" : faulty ? fault : (state ?? "unknown")));
  made.append(title);
  const channels = element("div", undefined, "channels");
  levels.forEach((level, channel) => {
    const era = eras.find((each) => each.amplifier === name && each.channel === channel);
    const meter = element("meter");
    const percent = `${(100 * level).toFixed(0)} %`;
    meter.max = 1;
    meter.value = level;
    meter.ariaLabel = `channel ${channel}${era ? `, ERA ${era.name}` : ""}: ${percent}`;
    channels.append(element("span", era?.name ?? `${channel}`), meter, element("span", percent));
  });
  made.append(channels);
  const list = element("dl");
  const voltage = high_voltage_v === null ? (high_voltage === null ? "–" : high_voltage ? "on" : "off") : `${shown(high_voltage_v)} V`;
  const age = reply_age_s === null ? "–" : reply_age_s > OLD_REPLY_S ? `${shown(reply_age_s, 1)} s ago, old` : `${shown(1000 * reply_age_s)} ms ago`;
  for (const [key, value] of [["Temperature", `${shown(temperature_c)} °C`], ["High voltage", voltage], ["Last reply", age]]) {
    list.append(element("dt", key), element("dd", value));
  }
  made.append(list);
  return made;
}

export function showAmplifiers(into, amplifiers, eras) {
  into.replaceChildren(...amplifiers.map((amplifier) => tile(amplifier, eras)));
}

export function showLatency(numbers, svg, { count, median, p99, p999, histogram }) {
  numbers.textContent = count
    ? `median ${shown(median, 2)} ms, 99 % within ${shown(p99, 2)} ms, 99.9 % within ${shown(p999, 2)} ms, of ${count}`
    : "no touch has led to a command yet";
  const most = Math.max(1, ...histogram.map(([, number]) => number));
  const width = 320 / Math.max(1, histogram.length);
  const parts = [];  // bars end below the line of text at the top
  const add = (name, attributes, text) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    parts.push(made);
  };
  histogram.forEach(([upper, number], index) => {
    const height = number ? Math.max(2, 64 * Math.log1p(number) / Math.log1p(most)) : 0;
    add("rect", { x: index * width + 1, y: 80 - height, width: Math.max(1, width - 2), height });
    if (index % Math.ceil(histogram.length / 6) === 0) {
      add("text", { x: (index + 1) * width, y: 96, "text-anchor": "middle" }, `${upper}`);
    }
  });
  add("line", { x1: 0, x2: 320, y1: 80, y2: 80 });
  add("text", { x: 320, y: 10, "text-anchor": "end" }, "ms, logarithmic count");
  svg.replaceChildren(...parts);
}

export function showEffects(section, into, effects, play) {
  section.hidden = !effects.length;
  into.replaceChildren(...effects.map(({ name, description }) => {
    const button = element("button", name);
    button.type = "button";
    button.title = description;
    button.addEventListener("click", () => play(name));
    return button;
  }));
}

// An event of the log, the newest first; all of it as text. One that is told again takes no other's place.
export function addEvent(log, level, message, remedy) {
  const newest = log.firstElementChild;
  const times = newest?.dataset.message === message ? Number(newest.dataset.times) + 1 : 1;
  if (times > 1) newest.remove();
  const item = element("li");
  Object.assign(item.dataset, { message, times });
  const time = element("time", new Date().toLocaleTimeString());
  item.append(time, element("span", times > 1 ? `${message} (${times} times)` : message, level));
  if (remedy) item.append(element("span", remedy, "remedy"));
  log.prepend(item);
  while (log.children.length > MOST_EVENTS) log.lastElementChild.remove();
}
