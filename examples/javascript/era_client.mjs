// A client of the daemon's API (docs/reference/api.md) for Node.js: JSON-RPC 2.0, one JSON object
// per line, over the daemon's Unix socket. It uses nothing but Node.js itself, 18 or newer.

import { EventEmitter } from "node:events";
import { connect } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

const API_MAJOR = "1";
const PATIENCE_MS = 5000;

/** The socket of this user's daemon, as `era status` finds it. */
export function defaultSocket(environment = process.env) {
  if (environment.ERA_HAPTICS_SOCKET) return environment.ERA_HAPTICS_SOCKET;
  const folder = environment.XDG_RUNTIME_DIR ?? `/run/user/${process.getuid()}`;
  return join(folder, "era-haptics", "daemon.sock");
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
 * "lost" with an Error when the connection or the lease ends unasked.
 */
export class EraClient extends EventEmitter {
  #socket;
  #name;
  #waiting = new Map(); // by id: [resolve, reject, timer]
  #id = 0;
  #lease = null;
  #renewal = null;
  #repeat = null;
  #isClosed = false;

  constructor(socket, name) {
    super();
    this.#socket = socket;
    this.#name = name;
    createInterface({ input: socket }).on("line", (line) => this.#received(JSON.parse(line)));
    socket.on("error", () => {}); // "close" follows
    socket.on("close", () => this.#ended());
  }

  /** Connect and introduce the client by a name; rejects if the daemon speaks another API. */
  static async connect(path = defaultSocket(), name = "javascript") {
    const socket = connect(path);
    await new Promise((resolve, reject) => socket.once("connect", resolve).once("error", reject));
    const client = new EraClient(socket, name);
    client.hello = await client.call("hello", { client: name });
    if (client.hello.api_version.split(".")[0] !== API_MAJOR) {
      client.close();
      throw new Error(`api_version must be ${API_MAJOR}.x, got ${client.hello.api_version}`);
    }
    return client;
  }

  /** Send a request and return its result; rejects with Refused, or without a reply in 5 s. */
  call(method, params = {}) {
    return new Promise((resolve, reject) => {
      if (this.#isClosed) return reject(new Error("the connection to the daemon is closed"));
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

  subscribe(...topics) {
    return this.call("subscribe", { topics });
  }

  /** Switch the high voltage on and renew the lease until `disarm`, `stop` or "lost". */
  async arm(lease_s = 5) {
    const { lease } = await this.call("arm", { owner: this.#name, lease_s });
    this.#lease = lease;
    this.#renewal = setInterval(() => {
      this.call("renew", { lease }).catch((error) => this.#leaseLost(error));
    }, lease_s * 500);
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

  /** Report all fingers, [[x, y], ...] in metres, the newest last; repeated until the next call. */
  touch(places, source = this.#name) {
    clearInterval(this.#repeat);
    const touches = places.map(([x_m, y_m], index) => ({ id: index + 1, x_m, y_m }));
    const report = () => this.call("touch", { source, touches });
    if (touches.length) this.#repeat = setInterval(() => report().catch(() => {}), 50);
    return report();
  }

  /** Close the connection; fingers are lifted, and a lease runs out. */
  close() {
    this.#isClosed = true;
    this.#socket.destroy();
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

  #ended() {
    const wasAsked = this.#isClosed;
    this.#isClosed = true;
    this.#forgetLease();
    clearInterval(this.#repeat);
    const error = new Error("the connection to the daemon is closed");
    for (const [, reject, timer] of this.#waiting.values()) {
      clearTimeout(timer);
      reject(error);
    }
    this.#waiting.clear();
    if (!wasAsked) this.emit("lost", error);
  }

  #leaseLost(error) {
    if (this.#lease === null || this.#isClosed) return;
    this.#forgetLease();
    this.emit("lost", error);
  }

  #forgetLease() {
    clearInterval(this.#renewal);
    this.#lease = null;
  }
}
