// The plate over the gateway's WebSocket (JSON-RPC 2.0), for the dashboard and for pages of your own,
// which import it from the gateway or copy it: docs/how-to/your-own-application.md.
//
// It reconnects by itself and subscribes anew. Calls that are pending at a loss are rejected and never
// sent again: whether to arm, play or clear then is for the caller to decide.

const RETRY_MS = [200, 500, 1000, 2000];
const RESPONSE_TIMEOUT_MS = 6000;
const CHECK_MS = 1000;
const QUIET_CHECKS = 2;  // after as many without a message the gateway is asked for one
const SILENT_CHECKS = { open: 4, opening: 8 };  // after as many it is left: a lost network closes nothing
const LEASE_S = 5;
const REPEAT_MS = 50;  // the daemon lifts fingers that are not repeated within 150 ms
const NO_DAEMON = 4001;  // close code of the gateway
const NO_LEASE = 1002;  // code of the API

export class RpcError extends Error {
  constructor({ code, message, data }) {
    super(message);
    this.code = code;
    this.remedy = data?.remedy ?? null;
  }
}


// Throws a TypeError that names the first value that is no finite number: JSON would make it null.
function requireFinite(values) {
  for (const [key, value] of Object.entries(values)) {
    if (!Number.isFinite(value)) throw new TypeError(`${key} must be a finite number, got ${value}`);
  }
}

const noResponse = () => new RpcError({ code: 0, message: "the gateway does not respond" });

export class Connection {
  // topics: to subscribe to. handlers, all optional: opened(hello, name) once the daemon has responded, after a loss too,
  // closed(), failed(why) after each loss or failed attempt to connect, event({ topic, data, lost }),
  // disarmed() when the lease is lost: refused by the daemon, or not renewed in time, stopped(result) of each stop, lifted() when all fingers were lifted because
  // the page lost the focus or is hidden: forget them; field(ArrayBuffer). name: of this page, in
  // the daemon's log. why: "daemon" if the daemon does not respond, "refused" because of the token,
  // "full" if the gateway responds but accepts no WebSocket, "unreachable". gateway: its URL. source: name of the
  // fingers and of the effects of this page, by which their strength is kept.
  constructor(token, topics, handlers, gateway = import.meta.url, source = null) {
    this.token = token;
    this.topics = topics;
    this.handlers = handlers;
    this.gateway = gateway;
    this.source = source;
    this.pending = new Map();
    this.lastId = 0;
    this.attempts = 0;
    this.wasEverAccepted = false;
    this.wasOpen = false;  // since the last attempt to connect
    this.lease = null;  // while armed by `arm`; it outlives a shorter loss
    this.leaseEnds = 0;  // ms
    this.isArming = false;
    this.touches = [];
    this.connect();
    this.timers = [
      setInterval(() => this.check(), CHECK_MS),
      setInterval(() => this.renew(), (1000 * LEASE_S) / 3),
      setInterval(() => this.touches.length && this.touch(this.touches), REPEAT_MS),
    ];
    this.listening = new AbortController();
    const { signal } = this.listening;
    window.addEventListener("blur", () => this.lift(), { signal });
    document.addEventListener("visibilitychange", () => document.hidden && this.lift(), { signal });
    window.addEventListener("pagehide", () => this.leave(), { signal });
  }

  get isOpen() {
    return this.wasOpen && this.socket.readyState === WebSocket.OPEN;
  }

  connect() {
    const url = new URL(this.handlers.field ? "api/v1/ws?field" : "api/v1/ws", this.gateway);
    url.protocol = url.protocol.replace("http", "ws");
    this.silentChecks = 0;
    this.socket = new WebSocket(url, ["era-haptics.v1", `era-haptics.token.${this.token}`]);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => this.received(data);
    this.socket.onclose = ({ code }) => this.closed(code);
  }

  opened({ id, result }) {
    const { socket } = this;
    this.wasOpen = this.wasEverAccepted = true;
    this.call("subscribe", { topics: this.topics, rate_hz: 10 }).then(() => { this.attempts = 0; }, () => {
      if (socket !== this.socket) return;
      this.wasOpen = false;  // the daemon has too many clients: connected later
      socket.close();
    });
    if (this.source) this.call("hello", { client: this.source }).catch(() => {});
    this.renew();
    this.name = id;
    this.handlers.opened?.(result, id);
  }

  closed(code) {
    this.rejectPending();
    this.handlers.closed?.();
    if (code === NO_DAEMON) {
      this.wasEverAccepted = true;
      this.handlers.failed?.("daemon");
    } else if (this.wasOpen) this.handlers.failed?.("unreachable");
    else this.diagnose();
    this.wasOpen = false;
    this.silentChecks = 0;
    const delay = RETRY_MS[Math.min(this.attempts++, RETRY_MS.length - 1)];
    this.reconnecting = setTimeout(() => this.connect(), delay);
  }

  rejectPending() {
    for (const { reject } of this.pending.values()) reject(noResponse());
    this.pending.clear();
  }

  received(data) {
    this.silentChecks = 0;
    if (data instanceof ArrayBuffer) {
      this.handlers.field(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.method === "event") {
      this.handlers.event?.(message.params);
      return;
    }
    if (!this.wasOpen) {  // the first is the response to the gateway's hello
      this.opened(message);
      return;
    }
    const call = this.pending.get(message.id);
    if (!call) return;
    this.pending.delete(message.id);
    if (message.error) call.reject(new RpcError(message.error));
    else call.resolve(message.result);
  }

  // Ask a silent gateway for a message, and connect again if none comes.
  check() {
    this.silentChecks += 1;
    if (this.silentChecks > SILENT_CHECKS[this.isOpen ? "open" : "opening"]) {
      this.socket.onmessage = this.socket.onclose = null;
      this.socket.close();
      this.closed();
    } else if (this.silentChecks > QUIET_CHECKS && this.isOpen) this.call("status").catch(() => {});
  }

  // Call a method; a promise of its result.
  call(method, params = {}) {
    if (!this.isOpen) {
      return Promise.reject(new RpcError({ code: 0, message: "not connected to the gateway" }));
    }
    const id = ++this.lastId;
    this.socket.send(JSON.stringify({ jsonrpc: "2.0", id, method, params }));
    return new Promise((resolve, reject) => {
      this.pending.set(id, { resolve, reject });
      setTimeout(() => {
        if (this.pending.delete(id)) {
          reject(new RpcError({ code: 0, message: `no response to ${method}` }));
        }
      }, RESPONSE_TIMEOUT_MS);
    });
  }

  // Switch the high voltage on, and renew the lease until `disarm` or `stop`, or until it is lost.
  async arm(owner) {
    this.isArming = true;
    const sent = performance.now();
    try {
      const { lease } = await this.call("arm", { owner, lease_s: LEASE_S });
      this.keepLease(lease, sent);
    } finally {
      this.isArming = false;
    }
  }

  keepLease(lease, sent) {
    this.lease = lease;
    this.leaseEnds = sent + 1000 * LEASE_S;
  }

  // Renew the lease, after a loss too; nothing arms again.
  renew() {
    const { lease } = this;
    const now = performance.now();
    const isHeld = () => lease && lease === this.lease;
    const lose = () => {
      this.lease = null;
      this.handlers.disarmed?.();
    };
    if (!isHeld()) return;
    if (now >= this.leaseEnds) lose();
    else if (this.isOpen) {
      this.call("renew", { lease }).then(
        () => isHeld() && this.keepLease(lease, now),
        ({ code }) => code === NO_LEASE && isHeld() && lose(),
      );
    }
  }

  // Ramp to silence and switch the high voltage off; over HTTP while there is no WebSocket.
  disarm() {
    this.lease = null;
    return this.isOpen ? this.call("disarm") : this.callOverHttp("disarm");
  }

  // Lift all fingers of this page, whose user may not see it any more.
  lift() {
    if (!this.touches.length) return;
    this.touch([]);
    this.handlers.lifted?.();
  }

  // A page that is left cannot stop anything: lift, and disarm if it armed or is arming; once, over HTTP,
  // which outlives the page: a second one might arrive when others have armed.
  leave() {
    this.lift();
    if (!this.lease && !this.isArming) return;
    this.lease = null;
    this.post("disarm").catch(() => {});
  }

  // Lift all fingers, disarm if it armed, and end the connection for good.
  close() {
    this.leave();
    this.handlers = {};
    this.listening.abort();
    for (const timer of this.timers) clearInterval(timer);
    clearTimeout(this.reconnecting);
    this.socket.onmessage = this.socket.onclose = null;
    this.socket.close();
    this.rejectPending();
  }

  // Use one of the daemon's layouts; a promise of { layout, layouts }. A restarted daemon begins with the
  // first: choose again in `opened`.
  layout(name) {
    return this.call("layout", { name });
  }

  // Report all fingers that are down, [{ id, x_m, y_m }, ...], the newest last; repeated until the next
  // call, and reported to the daemon again after a loss.
  touch(touches) {
    for (const { id, x_m, y_m } of touches) requireFinite({ id, x_m, y_m });
    this.touches = touches;
    if (!this.isOpen) return;
    const params = { source: this.source ?? "page", touches };
    this.socket.send(JSON.stringify({ jsonrpc: "2.0", method: "touch", params }));
  }

  // Set the strength of a touch source, client or region, -40 to 0 dB, or ask for it; a promise of it.
  async strength(name, gain_db = null) {
    if (gain_db !== null) requireFinite({ gain_db });
    return (await this.call("strength", { name, gain_db })).strengths[name];
  }

  // Stop over the WebSocket and over HTTP; a promise that all amplifiers are confirmed silent.
  stop() {
    this.lease = null;
    const overWebSocket = this.call("stop");  // first: it needs nothing of what a browser may lack
    const stops = [overWebSocket, this.callOverHttp("stop")];
    for (const each of stops) each.then(this.handlers.stopped, () => {});
    return Promise.any(stops);
  }

  // Call a method without parameters over HTTP; a promise of its result.
  async callOverHttp(method) {
    const response = await this.post(method).catch(() => { throw noResponse(); });
    const result = await response.json();
    const { error, code, data } = result;
    if (!response.ok) throw new RpcError({ message: error, code, data });
    return result;
  }

  // Find out why the WebSocket was refused: browsers do not report it.
  diagnose() {
    this.post("effects")
      .then(({ status }) => (status === 401 ? "refused" : "full"), () => "unreachable")
      .then((why) => this.isOpen || this.handlers.failed?.(why));
  }

  async post(method) {
    const headers = { Authorization: `Bearer ${this.token}`, "Content-Type": "application/json" };
    const given = new AbortController();  // AbortSignal.timeout is missing in browsers before 2022
    setTimeout(() => given.abort(), RESPONSE_TIMEOUT_MS);
    const url = new URL(`api/v1/${method}`, this.gateway);
    return fetch(url, { method: "POST", headers, body: JSON.stringify(this.name ? { client: this.name } : {}), keepalive: true, signal: given.signal });
  }
}
