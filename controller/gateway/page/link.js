// The WebSocket to the gateway: JSON-RPC 2.0 both ways, connected again by itself.

const PAUSES_MS = [200, 500, 1000, 2000];
const PATIENCE_MS = 6000;

export class RpcError extends Error {
  constructor({ code, message, data }) {
    super(message);
    this.code = code;
    this.remedy = data?.remedy ?? null;
  }
}

export class Link {
  // token: the gateway's; topics: what to be told of; handlers: connected(isConnected), after each
  // attempt in vain shut(why), event(params), field(ArrayBuffer). why: "refused" for the sake of the
  // token, "full" where it answers but lets nobody in, or "away".
  constructor(token, topics, handlers) {
    this.token = token;
    this.topics = topics;
    this.handlers = handlers;
    this.waiting = new Map();
    this.lastId = 0;
    this.attempt = 0;
    this.wasOpen = false;
    this.isHeard = false;  // since the last attempt to connect
    this.connect();
  }

  get isOpen() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  connect() {
    const url = new URL("api/v1/ws", location.href);
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    url.hash = "";
    this.socket = new WebSocket(url, ["era-haptics.v1", `era-haptics.token.${this.token}`]);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.opened();
    this.socket.onmessage = ({ data }) => this.take(data);
    this.socket.onclose = () => this.closed();
  }

  opened() {
    this.attempt = 0;
    this.isHeard = this.wasOpen = true;
    this.call("subscribe", { topics: this.topics, rate_hz: 10 }).catch(() => {});
    this.handlers.connected(true);
  }

  closed() {
    for (const { reject } of this.waiting.values()) {
      reject(new RpcError({ code: 0, message: "the gateway does not answer" }));
    }
    this.waiting.clear();
    this.handlers.connected(false);
    if (!this.isHeard) this.ask();
    this.isHeard = false;
    const pause = PAUSES_MS[Math.min(this.attempt++, PAUSES_MS.length - 1)];
    setTimeout(() => this.connect(), pause);
  }

  take(data) {
    if (data instanceof ArrayBuffer) {
      this.handlers.field(data);
      return;
    }
    const said = JSON.parse(data);
    if (said.method === "event") {
      this.handlers.event(said.params);
      return;
    }
    const asked = this.waiting.get(said.id);
    if (!asked) return;
    this.waiting.delete(said.id);
    if (said.error) asked.reject(new RpcError(said.error));
    else asked.resolve(said.result);
  }

  // Ask for a method; a promise of its result.
  call(method, params = {}) {
    if (!this.isOpen) {
      return Promise.reject(new RpcError({ code: 0, message: "not connected to the gateway" }));
    }
    const id = ++this.lastId;
    this.socket.send(JSON.stringify({ jsonrpc: "2.0", id, method, params }));
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      setTimeout(() => {
        if (this.waiting.delete(id)) {
          reject(new RpcError({ code: 0, message: `no answer to ${method}` }));
        }
      }, PATIENCE_MS);
    });
  }

  // Say something that needs no answer, such as where fingers are now.
  say(method, params) {
    if (this.isOpen) this.socket.send(JSON.stringify({ jsonrpc: "2.0", method, params }));
  }

  // Stop by every way there is; a promise that one of them was answered.
  stop() {
    const overHttp = this.post("stop").then((answer) => {
      if (!answer.ok) throw new Error("the stop was not carried out");
    });
    return Promise.any([this.call("stop"), overHttp]);
  }

  // Why no WebSocket was let in: browsers do not tell.
  ask() {
    this.post("effects")
      .then(({ status }) => (status === 401 ? "refused" : "full"), () => "away")
      .then((why) => this.isOpen || this.handlers.shut(why));
  }

  post(method) {
    const headers = { Authorization: `Bearer ${this.token}`, "Content-Type": "application/json" };
    const url = new URL(`api/v1/${method}`, location.href);
    url.hash = "";
    return fetch(url, { method: "POST", headers, body: "{}", keepalive: true });
  }
}
