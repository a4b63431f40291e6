// WebSocket to the console: receives texts and binary frames, sends requests, and reconnects automatically.

const PROTOCOL = "sextant.1";
const AGAIN_MS = 1000;
const STOPPED = 1012; // close code of a console that ends

export class Link {
  /**
   * @param {{text: (message: object) => void, frame: (header: object, body: DataView) => void, up: () => void, down: (why: string) => void}} hear
   * @param {string} path path of the socket, relative to this page
   */
  constructor(hear, path = "socket") {
    this.hear = hear;
    this.address = new URL(path, location.href);
    this.address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    this.address.hash = "";
    this.socket = null;
    this.stopped = false; // whether the console has ended itself
    this.connect();
  }

  connect() {
    const token = location.hash.slice(1);
    const socket = new WebSocket(this.address, token ? [PROTOCOL, `token.${token}`] : [PROTOCOL]);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.stopped = false;
      this.hear.up();
    };
    socket.onmessage = (event) => this.take(event.data);
    socket.onclose = (event) => {
      this.socket = null;
      this.stopped ||= event.code === STOPPED;
      this.hear.down(event.reason || (this.stopped ? "the run is over, or its services were stopped" : "the console does not answer"));
      setTimeout(() => this.connect(), AGAIN_MS);
    };
    this.socket = socket;
  }

  get open() {
    return this.socket !== null && this.socket.readyState === WebSocket.OPEN;
  }

  /** Send a request; returns false without a connection. */
  ask(type, fields = {}) {
    if (!this.open) return false;
    this.socket.send(JSON.stringify({ type, ...fields }));
    return true;
  }

  take(data) {
    if (typeof data === "string") {
      this.hear.text(JSON.parse(data));
      return;
    }
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    this.hear.frame(header, data, 4 + length);
  }
}
