// What the stream has decided so far, and how long its pushes took.

const PUSHES = 512; // of which latencies are remembered

/** Decisions of one recording, in typed arrays that are as long as it can make them. */
export class History {
  /**
   * @param {number} capacity most decisions there can be
   * @param {object} facts of the sidecar
   */
  constructor(capacity, facts = {}) {
    this.hasOnset = facts.onset_hop_samples !== undefined;
    const first = Math.max(facts.first_samples, facts.frame_samples);
    this.firstBinS = first / facts.sample_rate_hz; // nothing is known before
    const numbers = () => new Float64Array(capacity);
    this.columns = {
      time_s: numbers(),
      onset_s: numbers(),
      score: numbers(),
      probability: numbers(),
      statistic: numbers(),
      ...(this.hasOnset && { onset_score: numbers() }),
    };
    this.flags = new Uint8Array(capacity); // 1 valid, 2 alarm, 4 on, 8 raised by the onset score
    this.clear();
  }

  /** Forget all; `take` is another one from now on. */
  clear() {
    this.take = {};
    this.count = 0;
    this.numInvalid = 0;
    this.alarms = []; // which decisions raised one
  }

  /** @param {object[]} decisions as `StreamGraph.push` gives them */
  add(decisions) {
    for (const decision of decisions) {
      const i = this.count;
      for (const name in this.columns) this.columns[name][i] = decision[name];
      this.flags[i] = decision.valid + 2 * decision.alarm + 4 * decision.on;
      if (decision.raised_by === "onset") this.flags[i] += 8;
      if (this.isDoubtful(i)) this.numInvalid += 1;
      if (decision.alarm) this.alarms.push(i);
      this.count += 1;
    }
  }

  /** The last decision made by then; -1 before the first. */
  before(timeS) {
    const times = this.columns.time_s;
    let low = 0;
    let high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle] <= timeS) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  /** Whether it speaks of a bin that is not valid. */
  isDoubtful(i) {
    return (this.flags[i] & 1) === 0 && !(this.columns.time_s[i] < this.firstBinS);
  }

  isOn(i) {
    return (this.flags[i] & 4) !== 0;
  }

  /** A decision as `StreamGraph.push` gave it. */
  decision(i) {
    const has = (flag) => (this.flags[i] & flag) !== 0;
    const decision = { valid: has(1), alarm: has(2), on: has(4) };
    for (const name in this.columns) decision[name] = this.columns[name][i];
    if (!this.hasOnset) return decision;
    return { ...decision, raised_by: has(2) ? (has(8) ? "onset" : "status") : null };
  }
}

/** Milliseconds of the last pushes. */
export class Latencies {
  #ring = new Float64Array(PUSHES);
  #count = 0;

  add(ms) {
    this.#ring[this.#count % PUSHES] = ms;
    this.#count += 1;
  }

  clear() {
    this.#count = 0;
  }

  /** Last, median and 99th percentile; null before the first. */
  summary() {
    const held = Math.min(this.#count, PUSHES);
    if (held === 0) return null;
    const sorted = this.#ring.slice(0, held).sort();
    const at = (share) => sorted[Math.min(held - 1, Math.floor(share * held))];
    return { last: this.#ring[(this.#count - 1) % PUSHES], median: at(0.5), p99: at(0.99), held };
  }
}
