// Client of the gateway's WebSocket (JSON-RPC 2.0), for the dashboard and for your own pages, which
// import it from the gateway or copy it: docs/how-to/your-own-application.md.
//
// It reconnects and renews its subscriptions automatically. Calls pending when the connection is lost
// are rejected and never repeated: the caller decides whether to arm, play or clear again.

const RETRY_MS = [200, 500, 1000, 2000];
const RESPONSE_TIMEOUT_MS = 6000;
const CHECK_MS = 1000;
const QUIET_CHECKS = 2;  // after this many checks without a message, request one from the gateway
const SILENT_CHECKS = { open: 4, opening: 8 };  // then reconnect: a lost network does not close the socket
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


// Throws a TypeError naming the first value that is not a finite number: JSON would turn it into null.
function requireFinite(values) {
  for (const [key, value] of Object.entries(values)) {
    if (!Number.isFinite(value)) throw new TypeError(`${key} must be a finite number, got ${value}`);
  }
}

const noResponse = () => new RpcError({ code: 0, message: "the gateway does not respond" });

export class Connection {
  // topics: topics to subscribe to.
  // handlers, all optional:
  //   opened(hello, name): the daemon has responded, also after a loss; name: of this page in the daemon's log
  //   closed(): the connection was lost
  //   failed(why): after each loss or failed attempt to connect; why: "daemon" (does not respond), "refused"
  //     (wrong token), "full" (the gateway responds but accepts no WebSocket) or "unreachable"
  //   event({ topic, data, lost })
  //   disarmed(): the lease was lost, because the daemon rejected it or it was not renewed in time
  //   stopped(result): after each stop
  //   lifted(): all fingers were lifted because the page lost the focus or is hidden; forget them
  //   field(ArrayBuffer)
  // gateway: its URL. source: name under which the daemon stores the strength of this page's fingers and effects.
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
    this.lease = null;  // while armed by `arm`; it survives a shorter loss of connection
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
      this.wasOpen = false;  // the daemon has too many clients: reconnect later
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
    if (!this.wasOpen) {  // the first message is the response to the gateway's hello
      this.opened(message);
      return;
    }
    const call = this.pending.get(message.id);
    if (!call) return;
    this.pending.delete(message.id);
    if (message.error) call.reject(new RpcError(message.error));
    else call.resolve(message.result);
  }

  // Request a message from a silent gateway; reconnect if none comes.
  check() {
    this.silentChecks += 1;
    if (this.silentChecks > SILENT_CHECKS[this.isOpen ? "open" : "opening"]) {
      this.socket.onmessage = this.socket.onclose = null;
      this.socket.close();
      this.closed();
    } else if (this.silentChecks > QUIET_CHECKS && this.isOpen) this.call("status").catch(() => {});
  }

  // Call a method; returns a promise of its result.
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

  // Switch the high voltage on, and renew the lease until `disarm`, `stop` or its loss.
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

  // Renew the lease, also after a reconnection; nothing arms again automatically.
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

  // Ramp to silence and switch the high voltage off; over HTTP if the WebSocket is closed.
  disarm() {
    this.lease = null;
    return this.isOpen ? this.call("disarm") : this.callOverHttp("disarm");
  }

  // Lift all fingers of this page, because its user may no longer see it.
  lift() {
    if (!this.touches.length) return;
    this.touch([]);
    this.handlers.lifted?.();
  }

  // The user leaves the page, and can no longer stop: lift all fingers, and disarm if this page armed or is
  // arming. Only once, over HTTP, which outlives the page: a second disarm could arrive after others armed.
  leave() {
    this.lift();
    if (!this.lease && !this.isArming) return;
    this.lease = null;
    this.post("disarm").catch(() => {});
  }

  // Lift all fingers, disarm if this page armed, and close the connection permanently.
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

  // Switch to another of the daemon's layouts; returns a promise of { layout, layouts }. A restarted daemon
  // starts with the first layout: choose again in `opened`.
  layout(name) {
    return this.call("layout", { name });
  }

  // Report all fingers on the plate, [{ id, x_m, y_m }, ...], newest last. The report is repeated until
  // the next call, also after a reconnection.
  touch(touches) {
    for (const { id, x_m, y_m } of touches) requireFinite({ id, x_m, y_m });
    this.touches = touches;
    if (!this.isOpen) return;
    const params = { source: this.source ?? "page", touches };
    this.socket.send(JSON.stringify({ jsonrpc: "2.0", method: "touch", params }));
  }

  // Set the strength of a touch source, client or region, -40 to 0 dB; without a gain, only read it. Returns
  // a promise of the strength.
  async strength(name, gain_db = null) {
    if (gain_db !== null) requireFinite({ gain_db });
    return (await this.call("strength", { name, gain_db })).strengths[name];
  }

  // Stop over both WebSocket and HTTP; the promise resolves once all amplifiers are confirmed silent.
  stop() {
    this.lease = null;
    const overWebSocket = this.call("stop");  // first, because it needs no feature that a browser can lack
    const stops = [overWebSocket, this.callOverHttp("stop")];
    for (const each of stops) each.then(this.handlers.stopped, () => {});
    return Promise.any(stops);
  }

  // Call a method without parameters over HTTP; returns a promise of its result.
  async callOverHttp(method) {
    const response = await this.post(method).catch(() => { throw noResponse(); });
    const result = await response.json();
    const { error, code, data } = result;
    if (!response.ok) throw new RpcError({ message: error, code, data });
    return result;
  }

  // Find out why the WebSocket was rejected: browsers do not report the reason.
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
