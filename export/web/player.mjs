// A recording played through the stream: as time goes by, faster, or as fast as it can.

import { History, Latencies } from "./history.mjs";

const BUDGET_MS = 9; // of a frame's 16.7 that pushes may take
const PUSH_ROWS = 200; // where no clock says how many

/** Plays one recording at a time through a `StreamGraph`. */
export class Player {
  speed = 1;
  isPlaying = false;
  latencies = new Latencies();
  recording = null; // { name, volts, rows }
  history = new History(0);
  fed = 0; // samples that the stream has seen
  #due = 0; // samples that should have been fed by now, with a fraction
  #again = 0; // up to where decisions are made anew
  #era = 0; // counts rewinds: what an earlier push still brings is of no use

  constructor(stream) {
    this.stream = stream;
  }

  /** The position shown, in samples. */
  get position() {
    return Math.max(this.fed, this.#again);
  }

  get isAtEnd() {
    return this.recording !== null && this.position >= this.recording.rows;
  }

  /** Whether decisions up to the position are still being made anew. */
  get isCatchingUp() {
    return this.fed < this.#again;
  }

  /** Take another recording, from its start. */
  async load(recording) {
    this.recording = recording;
    const { facts } = this.stream;
    const hop = facts.onset_hop_samples ?? facts.hop_samples;
    this.history = new History(Math.ceil(recording.rows / hop) + 1, facts);
    await this.restart();
  }

  /** Back to the start; whether it plays is as it was. */
  async restart() {
    await this.#rewind(0);
    this.latencies.clear();
  }

  /** Score again all that was played, at the stream's threshold as it is now. */
  async scoreAgain() {
    await this.#rewind(this.position);
  }

  #rewind(again) {
    this.#era += 1;
    const done = this.stream.reset(); // before any push that follows
    this.history.clear();
    this.fed = 0;
    this.#again = again;
    this.#due = again;
    return done;
  }

  /** Feed what is due after so many seconds, within the budget of a frame. */
  async advance(seconds) {
    if (this.recording === null) return;
    const { rows } = this.recording;
    const isLate = this.isCatchingUp;
    if (this.isPlaying && !isLate && seconds > 0) {
      this.#due = Math.min(
        rows,
        this.#due + seconds * this.speed * this.stream.facts.sample_rate_hz,
      );
    }
    const goal = isLate ? this.#again : Math.floor(this.#due);
    const era = this.#era;
    const stop = performance.now() + BUDGET_MS;
    while (this.fed < goal && performance.now() < stop) {
      await this.#push(goal);
      if (this.#era !== era) return;
    }
    if (!isLate && this.fed < goal) this.#due = this.fed; // too fast for this machine: no debt
    if (this.isAtEnd && !this.isCatchingUp) this.isPlaying = false;
  }

  async #push(goal) {
    const { recording, stream } = this;
    const era = this.#era;
    const width = stream.facts.channels.length;
    const end = Math.min(goal, this.fed + PUSH_ROWS);
    const volts = recording.volts.subarray(this.fed * width, end * width);
    const start = performance.now();
    const decisions = await stream.push(volts);
    if (this.#era !== era) return;
    this.latencies.add(performance.now() - start);
    this.history.add(decisions);
    this.fed = end;
  }
}
