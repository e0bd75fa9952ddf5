// The line to the server: questions with answers, and news as events. See link.py for the messages.

export class Link extends EventTarget {
  #socket;
  #waiting = new Map();
  #last = 0;

  constructor() {
    super();
    this.#open();
  }

  // The answer's value and, of binary answers, its numbers; rejects with the server's sentence.
  ask(what, given = {}) {
    return new Promise((resolve, reject) => {
      if (this.#socket.readyState !== WebSocket.OPEN) return reject(new Error("torch-ecc is not running any more."));
      this.#waiting.set(++this.#last, { resolve, reject });
      this.#socket.send(JSON.stringify({ id: this.#last, do: what, with: given }));
    });
  }

  // All that was sent is drawn: what is new may come, with pictures of so many px at most.
  shown(side) {
    if (this.#socket.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify({ do: "shown", with: { side } }));
  }

  #open() {
    const url = new URL("link", location.href);
    url.protocol = "ws:";
    this.#socket = new WebSocket(url);
    this.#socket.binaryType = "arraybuffer";
    this.#socket.onopen = () => this.#tell("up");
    this.#socket.onmessage = ({ data }) => (typeof data === "string" ? this.#read(JSON.parse(data)) : this.#unpack(data));
    this.#socket.onclose = () => {
      for (const { reject } of this.#waiting.values()) reject(new Error("torch-ecc is not running any more."));
      this.#waiting.clear();
      this.#tell("down");
      setTimeout(() => this.#open(), 1000);
    };
  }

  #unpack(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const message = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const start = 4 + length;
    if (message.is === "picture") message.data = new Blob([new Uint8Array(buffer, start)], { type: "image/jpeg" });
    else message.data = new Float64Array(buffer, start);
    this.#read(message);
  }

  #read(message) {
    if (message.is !== "answer") return this.#tell(message.is, message);
    const { resolve, reject } = this.#waiting.get(message.id) ?? {};
    this.#waiting.delete(message.id);
    if (message.error !== undefined) reject?.(new Error(message.error));
    else resolve?.(message.data ? { ...message.value, data: message.data } : message.value);
  }

  #tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}
