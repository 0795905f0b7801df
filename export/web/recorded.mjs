// A recording and the detector in this browser: scored as fast as it can be, played as time goes by.

import * as ort from "./ort/ort.mjs";

import { StreamGraph } from "../node/graph.mjs";
import { readRecording } from "./files.mjs";
import { History, Samples } from "./history.mjs";

const BUDGET_MS = 9; // of a frame's 16.7 that scoring may take
const PUSH_S = 0.1;
const VIEW_S = 4;
const PUSHES = 512; // whose latencies are remembered

/** Something on this page's server. */
export async function fetched(path, what) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`the server cannot read ${what}: is it still there?`);
  return response;
}

/** Decisions are made ahead of the position and are the same as if they were made there. */
export class Recorded {
  isLive = false;
  isPlaying = false;
  speed = 1;
  recording = null; // as `readRecording` gives it
  latencies = []; // milliseconds of the last pushes
  position = 0; // in samples, with a fraction
  #stream;
  #fed = 0; // samples that the detector has had
  #next; // a history that is made anew, until it has come to the position
  #era = 0; // counts new starts: what an earlier push still brings is of no use

  constructor(stream) {
    this.#stream = stream;
    this.facts = stream.facts;
    this.history = this.#next = new History(1, this.facts);
    this.samples = new Samples(this.facts.channels.length, 1);
  }

  /** Load the detector that the server was given. */
  static async open({ model }) {
    ort.env.wasm.numThreads = 1;
    ort.env.wasm.wasmPaths = { wasm: new URL("./ort/ort.wasm", import.meta.url).href };
    const content = await (await fetched("model", model)).arrayBuffer();
    const sidecar = await (await fetched("model.json", `${model}.json`)).text();
    const stream = await StreamGraph.load(ort, new Uint8Array(content), sidecar, model);
    await stream.push(new Float32Array(stream.facts.channels.length * 400)); // warm
    return new this(stream);
  }

  /** Play another recording from its start; where it is none, the one before stays. */
  async take(content, name) {
    const recording = await readRecording(content, name, this.facts);
    this.recording = recording;
    this.samples = new Samples(this.facts.channels.length, recording.rows, recording.volts);
    this.latencies = [];
    this.position = 0;
    await this.#score();
    this.history = this.#next;
    this.isPlaying = true;
  }

  get viewS() {
    return Math.min(VIEW_S, this.samples.end / this.facts.sample_rate_hz);
  }

  get threshold() {
    return this.#stream.threshold ?? this.facts.threshold ?? Infinity;
  }

  /** Decide all again by another threshold, null for the file's own. */
  setThreshold(threshold) {
    this.#stream.threshold = threshold;
    return this.#score();
  }

  get isAtEnd() {
    return this.recording !== null && this.position >= this.samples.end;
  }

  /** How much of the recording is scored, 0 to 1. */
  get progress() {
    return this.recording ? this.#fed / this.samples.end : 1;
  }

  toggle() {
    if (this.recording === null) return;
    if (!this.isPlaying && this.isAtEnd) this.position = 0;
    this.isPlaying = !this.isPlaying;
  }

  seek(sample) {
    this.position = Math.min(this.samples.end, Math.max(0, sample));
  }

  #score() {
    const hop = this.facts.onset_hop_samples ?? this.facts.hop_samples;
    this.#era += 1;
    this.#fed = 0;
    this.#next = new History(Math.ceil(this.samples.end / hop) + 1, this.facts);
    return this.#stream.reset(); // before any push that follows
  }

  /** Score for a part of a frame, and play on by so many seconds. */
  async advance(seconds) {
    if (this.recording === null) return;
    const era = this.#era;
    const stop = performance.now() + BUDGET_MS;
    while (this.#fed < this.samples.end && performance.now() < stop) {
      await this.#push();
      if (this.#era !== era) return;
    }
    if (this.#fed >= this.position) this.history = this.#next;
    if (!this.isPlaying || this.history !== this.#next) return;
    const next = this.position + seconds * this.speed * this.facts.sample_rate_hz;
    this.position = Math.min(this.#fed, next);
    if (this.isAtEnd) this.isPlaying = false;
  }

  async #push() {
    const era = this.#era;
    const { width, values, end } = this.samples;
    const rows = Math.ceil(PUSH_S * this.facts.sample_rate_hz);
    const stop = Math.min(end, this.#fed + rows);
    const start = performance.now();
    const decisions = await this.#stream.push(values.subarray(this.#fed * width, stop * width));
    if (this.#era !== era) return;
    this.latencies.push(performance.now() - start);
    if (this.latencies.length > PUSHES) this.latencies.shift();
    this.#next.add(decisions);
    this.#fed = stop;
  }
}
