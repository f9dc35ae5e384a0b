// A client of the daemon's API (docs/reference/api.md) for Node.js: JSON-RPC 2.0, one JSON object
// per line, over the daemon's Unix socket. It uses nothing but Node.js itself, 18 or newer.

import { EventEmitter } from "node:events";
import { existsSync } from "node:fs";
import { connect } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

const API_MAJOR = "1";
const PATIENCE_MS = 5000;
const RETRY_MS = 200; // between attempts to connect again, for PATIENCE_MS
const RENEWAL_MS = 500;
const BUSY = 1005; // code of the API

/** Throws a TypeError that names the first value that is no finite number: JSON would make it null. */
function requireFinite(values) {
  for (const [key, value] of Object.entries(values)) {
    if (!Number.isFinite(value)) throw new TypeError(`${key} must be a finite number, got ${value}`);
  }
}

/** The socket of this user's daemon, as `era status` finds it. */
export function defaultSocket(environment = process.env) {
  if (environment.ERA_HAPTICS_SOCKET) return environment.ERA_HAPTICS_SOCKET;
  const user = process.getuid();
  const folder = environment.XDG_RUNTIME_DIR || `/run/user/${user}`;
  if (environment.XDG_RUNTIME_DIR || existsSync(folder)) return join(folder, "era-haptics", "daemon.sock");
  return join(tmpdir(), `era-haptics-${user}`, "daemon.sock");
}

/** A request that the daemon refused; code: see "errors" on the page of the API. */
export class Refused extends Error {
  constructor({ code, message, data }) {
    super(message);
    this.code = code;
    this.data = data;
  }
}

/**
 * A connection to the daemon. Emits an event named after each subscribed topic, with its data, and
 * "lost" with an Error when the connection or the lease ends unasked. A connection that the daemon
 * closes is made again, with its subscriptions and its lease, and "opened" emitted with the new hello:
 * choose the layout again, as a restarted daemon begins with the first. What was pending is rejected and
 * not sent again, and nothing arms again.
 */
export class EraClient extends EventEmitter {
  #path;
  #socket = null;
  #name;
  #topics = new Set();
  #waiting = new Map(); // by id: [resolve, reject, timer]
  #id = 0;
  #lease = null;
  #leaseEnds = 0; // ms
  #renewal = null;
  #repeat = null;
  #isClosed = false;

  constructor(path, name) {
    super();
    this.#path = path;
    this.#name = name;
  }

  /** Connect and introduce the client by a name; rejects if the daemon speaks another API. */
  static async connect(path = defaultSocket(), name = "javascript") {
    const client = new EraClient(path, name);
    try {
      await client.#open();
    } catch (error) {
      client.close();
      throw error;
    }
    client.#socket.on("close", () => client.#ended());
    return client;
  }

  /** Send a request and return its result; rejects with Refused, or without a reply in 5 s. */
  call(method, params = {}) {
    return new Promise((resolve, reject) => {
      if (!this.#socket?.writable) return reject(new Error("the connection to the daemon is closed"));
      const id = ++this.#id;
      const late = () => {
        this.#waiting.delete(id);
        reject(new Error(`no reply to ${method} within ${PATIENCE_MS} ms`));
      };
      this.#waiting.set(id, [resolve, reject, setTimeout(late, PATIENCE_MS)]);
      this.#socket.write(JSON.stringify({ jsonrpc: "2.0", id, method, params }) + "\n");
    });
  }

  status() {
    return this.call("status");
  }

  async subscribe(...topics) {
    await this.call("subscribe", { topics });
    for (const topic of topics) this.#topics.add(topic);
  }

  /** Switch the high voltage on and renew the lease until `disarm`, `stop` or "lost". */
  async arm(lease_s = 5) {
    const { lease } = await this.call("arm", { owner: this.#name, lease_s });
    this.#lease = lease;
    this.#leaseEnds = performance.now() + 1000 * lease_s;
    this.#renewal = setInterval(() => this.#renew(lease, lease_s), RENEWAL_MS);
  }

  /** Ramp to silence and switch the high voltage off. */
  async disarm() {
    const lease = this.#lease;
    this.#forgetLease();
    await this.call("disarm", { lease });
  }

  /** Stop all amplifiers at once; rejects unless each of them is confirmed silent. */
  stop() {
    this.#forgetLease();
    return this.call("stop", { client: this.#name });
  }

  /** Set the strength of a touch source, client or region, by its name: -40 to 0 dB. */
  async strength(name, gain_db) {
    if (gain_db != null) requireFinite({ gain_db });
    return this.call("strength", { name, gain_db });
  }

  /** Use one of the daemon's layouts. */
  layout(name) {
    return this.call("layout", { name });
  }

  /** Report all fingers, [[x, y], ...] in metres, the newest last; repeated until the next call. */
  async touch(places, source = this.#name) {
    const touches = places.map(([x_m, y_m], index) => ({ id: index + 1, x_m, y_m }));
    for (const { x_m, y_m } of touches) requireFinite({ x_m, y_m });
    clearInterval(this.#repeat);
    const report = () => this.call("touch", { source, touches });
    if (touches.length) this.#repeat = setInterval(() => report().catch(() => {}), 50);
    return report();
  }

  /** Close the connection; fingers are lifted, and a lease runs out. */
  close() {
    this.#isClosed = true;
    this.#forgetLease();
    clearInterval(this.#repeat);
    this.#socket?.destroy();
    this.#rejectPending();
  }

  async #open() {
    const socket = connect(this.#path);
    await new Promise((resolve, reject) => socket.once("connect", resolve).once("error", reject));
    this.#socket = socket;
    createInterface({ input: socket })
      .on("line", (line) => this.#received(JSON.parse(line)))
      .on("error", () => {}); // those of the socket are its own, too
    socket.on("error", () => {}); // "close" follows
    socket.on("close", () => this.#rejectPending());
    this.hello = await this.call("hello", { client: this.#name });
    if (this.hello.api_version.split(".")[0] !== API_MAJOR) {
      throw new Error(`api_version must be ${API_MAJOR}.x, got ${this.hello.api_version}`);
    }
    if (this.#topics.size) await this.call("subscribe", { topics: [...this.#topics] });
  }

  #received(message) {
    if (message.method === "event") {
      this.emit(message.params.topic, message.params.data, message.params);
      return;
    }
    const waiting = this.#waiting.get(message.id);
    if (!waiting) return; // too late
    const [resolve, reject, timer] = waiting;
    this.#waiting.delete(message.id);
    clearTimeout(timer);
    if (message.error) reject(new Refused(message.error));
    else resolve(message.result);
  }

  /** Connect again after a loss; give up after a while, or with the lease. */
  async #ended() {
    const end = performance.now() + PATIENCE_MS;
    while (!this.#isClosed && performance.now() < end) {
      try {
        await this.#open();
        this.#socket.on("close", () => this.#ended());
        this.emit("opened", this.hello);
        return;
      } catch {
        this.#socket.destroy();
        await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
      }
    }
    if (this.#isClosed) return;
    this.close();
    this.emit("lost", new Error("the connection to the daemon is closed"));
  }

  #rejectPending() {
    for (const [, reject, timer] of this.#waiting.values()) {
      clearTimeout(timer);
      reject(new Error("the connection to the daemon is closed"));
    }
    this.#waiting.clear();
  }

  #renew(lease, lease_s) {
    const sent = performance.now();
    const lost = (error) => {
      if (lease !== this.#lease) return;
      this.#forgetLease();
      this.emit("lost", error);
    };
    if (sent >= this.#leaseEnds) lost(new Error("the lease was not renewed in time"));
    else this.call("renew", { lease }).then(
      () => { this.#leaseEnds = sent + 1000 * lease_s; },
      (error) => { // without a response it is tried again
        if (error instanceof Refused && error.code !== BUSY) lost(error);
      },
    );
  }

  #forgetLease() {
    clearInterval(this.#renewal);
    this.#lease = null;
  }
}
