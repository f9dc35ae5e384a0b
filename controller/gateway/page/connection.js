// The WebSocket to the gateway: JSON-RPC 2.0 in both directions, reconnecting by itself.

const RETRY_MS = [200, 500, 1000, 2000];
const RESPONSE_TIMEOUT_MS = 6000;
const NO_DAEMON = 4001;  // close code of the gateway

export class RpcError extends Error {
  constructor({ code, message, data }) {
    super(message);
    this.code = code;
    this.remedy = data?.remedy ?? null;
  }
}

export class Connection {
  // topics: to subscribe to. handlers: opened(hello, name) once the daemon has responded, closed(),
  // failed(why) after each loss or failed attempt to connect, event(params), field(ArrayBuffer).
  // name: of this page, in the daemon's log. why: "daemon" if the daemon does not respond, "refused"
  // because of the token, "full" if the gateway responds but accepts no WebSocket, "unreachable".
  constructor(token, topics, handlers) {
    this.token = token;
    this.topics = topics;
    this.handlers = handlers;
    this.pending = new Map();
    this.lastId = 0;
    this.attempts = 0;
    this.wasEverAccepted = false;
    this.wasOpen = false;  // since the last attempt to connect
    this.connect();
  }

  get isOpen() {
    return this.wasOpen && this.socket.readyState === WebSocket.OPEN;
  }

  connect() {
    const url = new URL("api/v1/ws?field", location.href);
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    url.hash = "";
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
    this.handlers.opened(result, id);
  }

  closed(code) {
    for (const { reject } of this.pending.values()) {
      reject(new RpcError({ code: 0, message: "the gateway does not respond" }));
    }
    this.pending.clear();
    this.handlers.closed();
    if (code === NO_DAEMON) {
      this.wasEverAccepted = true;
      this.handlers.failed("daemon");
    } else if (this.wasOpen) this.handlers.failed("unreachable");
    else this.diagnose();
    this.wasOpen = false;
    setTimeout(() => this.connect(), RETRY_MS[Math.min(this.attempts++, RETRY_MS.length - 1)]);
  }

  received(data) {
    if (data instanceof ArrayBuffer) {
      this.handlers.field(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.method === "event") {
      this.handlers.event(message.params);
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

  // Send a request that needs no response, such as touches.
  notify(method, params) {
    if (this.isOpen) this.socket.send(JSON.stringify({ jsonrpc: "2.0", method, params }));
  }

  // Stop over the WebSocket and over HTTP; a promise that all amplifiers are confirmed silent.
  stop() {
    const overHttp = this.post("stop").then(async (response) => {
      const { error, code, data } = await response.json();
      if (!response.ok) throw new RpcError({ message: error, code, data });
    });
    return Promise.any([this.call("stop"), overHttp]);
  }

  // Find out why the WebSocket was refused: browsers do not report it.
  diagnose() {
    this.post("effects")
      .then(({ status }) => (status === 401 ? "refused" : "full"), () => "unreachable")
      .then((why) => this.isOpen || this.handlers.failed(why));
  }

  post(method) {
    const headers = { Authorization: `Bearer ${this.token}`, "Content-Type": "application/json" };
    const url = new URL(`api/v1/${method}`, location.href);
    url.hash = "";
    const signal = AbortSignal.timeout(RESPONSE_TIMEOUT_MS);
    return fetch(url, { method: "POST", headers, body: "{}", keepalive: true, signal });
  }
}
