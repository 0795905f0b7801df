// Samples and decisions of a server (`tactslip stream serve=true`), as they come. Nothing is computed here.

import { History, Samples } from "./history.mjs";

const KEPT_S = 300;
const MOST_BYTES = 256 * 2 ** 20; // of samples that are kept
const VIEW_S = 4;
const LAG_S = 0.5; // how long the picture waits for decisions
const WAIT_MS = [250, 5000]; // before the first try to connect again, and at most
const SAMPLES = 1; // how a message of samples begins
const HEAD_BYTES = 16;

/** Follows the newest sample that is decided, or stands where it was sought. */
export class Live {
  isLive = true;
  isPlaying = true; // follows
  latencies = [];
  progress = 1;
  status = { state: "waiting", received: 0, dropped: 0, dropped_to_page: 0, text: "" };
  facts = null;
  #sought = 0;
  #wait = WAIT_MS[0];
  #address;
  #onHello;
  #say;

  /**
   * Connect; the promise is kept once the server has said what it sends.
   *
   * @param {string} socket its path
   * @param {(text: string) => void} say what hinders that
   */
  static open(socket, say) {
    return new Promise((onHello) => new this(socket, onHello, say));
  }

  constructor(socket, onHello, say) {
    this.#say = say;
    this.#address = new URL(socket, location.href);
    this.#address.protocol = location.protocol.replace("http", "ws");
    const token = new URL(location.href).searchParams.get("token");
    if (token !== null) this.#address.searchParams.set("token", token);
    this.#onHello = onHello;
    this.#connect();
  }

  get threshold() {
    return this.facts.threshold ?? Infinity;
  }

  get viewS() {
    return VIEW_S;
  }

  get position() {
    const { samples, history, facts } = this;
    const rate = facts.sample_rate_hz;
    if (!this.isPlaying) return Math.max(samples.first, Math.min(samples.end, this.#sought));
    if (history.count === 0) return samples.end;
    const hop = facts.onset_hop_samples ?? facts.hop_samples;
    const decided = Math.round(history.get("time_s", history.count - 1) * rate) + hop;
    return Math.min(samples.end, Math.max(decided, samples.end - LAG_S * rate));
  }

  toggle() {
    this.#sought = this.position;
    this.isPlaying = !this.isPlaying;
  }

  seek(sample) {
    this.isPlaying = sample >= this.samples.end;
    this.#sought = sample;
  }

  advance() {}

  #connect() {
    const socket = new WebSocket(this.#address);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      if (data instanceof ArrayBuffer) this.#samples(data);
      else this.#told(JSON.parse(data));
    };
    socket.onclose = () => {
      const text = "no connection to tactslip stream; trying again";
      if (this.status.state !== "ended") this.status = { ...this.status, state: "lost", text };
      if (!this.facts) this.#say(`${text} (is it the address that it printed, with its token?)`);
      setTimeout(() => this.#connect(), this.#wait);
      this.#wait = Math.min(2 * this.#wait, WAIT_MS[1]);
    };
  }

  #told({ type, ...told }) {
    if (type === "hello") this.#hello(told);
    else if (type === "status") this.status = told;
    else if (type === "decisions") this.#decisions(told.columns);
  }

  #hello({ facts, simulated, source }) {
    this.#wait = WAIT_MS[0];
    if (this.facts && JSON.stringify(facts) !== JSON.stringify(this.facts)) location.reload();
    this.facts = facts;
    this.recording = { name: source, isSimulated: simulated, onsetsS: [] };
    this.status = { ...this.status, state: "waiting", text: "" };
    if (!this.samples) this.#clear();
    this.#onHello(this); // heeded once
  }

  #clear() {
    const {
      channels,
      sample_rate_hz: rate,
      onset_hop_samples: fast,
      hop_samples: hop,
    } = this.facts;
    const most = Math.floor(MOST_BYTES / 4 / channels.length);
    const rows = Math.min(Math.ceil(KEPT_S * rate), most);
    this.samples = new Samples(channels.length, rows);
    this.history = new History(Math.ceil(rows / (fast ?? hop)) + 1, this.facts);
  }

  #samples(message) {
    const head = new DataView(message);
    if (head.getUint32(0, true) !== SAMPLES) return; // of a later protocol
    const index = head.getFloat64(8, true);
    const num = head.getUint32(4, true) * this.samples.width;
    if (index < this.samples.end) this.#clear(); // the stream began anew
    this.samples.add(index, new Float32Array(message, HEAD_BYTES, num));
  }

  #decisions(columns) {
    const names = Object.keys(columns);
    const rows = columns.time_s.map((_, i) =>
      Object.fromEntries(names.map((name) => [name, columns[name][i]])),
    );
    const { history } = this;
    const isNew = history.count > 0 && rows[0]?.time_s <= history.get("time_s", history.count - 1);
    if (isNew) this.#clear();
    this.history.add(rows);
  }
}
