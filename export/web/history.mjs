// Samples and decisions, in rings: a stream without an end needs no more memory than its last minutes.

/** Samples row by row, from index `first` to before `end`; row i begins at `i % capacity * width`. */
export class Samples {
  first = 0;
  end = 0;
  numMissing = 0; // rows that never came between others

  /**
   * @param {number} width channels of a row
   * @param {number} capacity rows that are kept
   * @param {Float32Array|Float64Array} values of a recording, all of it; else it begins empty
   */
  constructor(width, capacity, values = null) {
    this.width = width;
    this.capacity = capacity;
    this.values = values ?? new Float32Array(width * capacity);
    if (values) this.end = capacity;
  }

  /** Take rows that begin at an index; what is missing before them is NaN. */
  add(index, rows) {
    const { width, capacity, values } = this;
    if (this.end === 0) this.first = this.end = index;
    this.numMissing += index - this.end;
    for (let i = Math.max(this.end, index - capacity); i < index; i += 1) {
      values.fill(NaN, (i % capacity) * width, ((i % capacity) + 1) * width);
    }
    const num = rows.length / width;
    for (let done = 0; done < num;) {
      const place = (index + done) % capacity;
      const some = Math.min(num - done, capacity - place);
      values.set(rows.subarray(done * width, (done + some) * width), place * width);
      done += some;
    }
    this.end = index + num;
    this.first = Math.max(this.first, this.end - capacity);
  }
}

/** Decisions from index `first` to before `count`. */
export class History {
  first = 0;
  count = 0;
  numAlarms = 0;
  numInvalid = 0;
  alarms = []; // which of the decisions that are kept raised one

  /**
   * @param {number} capacity decisions that are kept
   * @param {object} facts of the detector
   */
  constructor(capacity, facts) {
    this.capacity = capacity;
    this.hasOnset = facts.onset_hop_samples !== undefined;
    const first = Math.max(facts.first_samples ?? 0, facts.frame_samples ?? 0);
    this.firstBinS = first / facts.sample_rate_hz; // nothing is known before
    const names = ["time_s", "onset_s", "score", "probability", "statistic"];
    if (this.hasOnset) names.push("onset_score");
    this.columns = Object.fromEntries(names.map((name) => [name, new Float64Array(capacity)]));
    this.flags = new Uint8Array(capacity); // 1 valid, 2 alarm, 4 on, 8 by onset, 16 in range, 32 hint
    this.channels = facts.channels;
    this.lost = new Uint8Array(capacity * facts.channels.length);
  }

  /** @param {object[]} decisions as `StreamGraph.push` gives them */
  add(decisions) {
    for (const decision of decisions) {
      const i = this.count;
      const place = i % this.capacity;
      for (const name in this.columns) this.columns[name][place] = decision[name] ?? NaN;
      this.flags[place] = decision.valid + 2 * decision.alarm + 4 * decision.on;
      this.flags[place] += 8 * (decision.raised_by === "onset") + 16 * decision.in_range;
      this.flags[place] += 32 * (decision.hint ?? false);
      const names = decision.channels_lost;
      const width = this.channels.length;
      this.channels.forEach((name, c) => (this.lost[place * width + c] = names.includes(name)));
      if (this.isDoubtful(i)) this.numInvalid += 1;
      this.count += 1;
      this.first = Math.max(0, this.count - this.capacity);
      if (!decision.alarm) continue;
      this.numAlarms += 1;
      this.alarms.push(i);
    }
    while (this.alarms[0] < this.first) this.alarms.shift();
  }

  /** A number of a decision: time_s, onset_s, score, probability, statistic or onset_score. */
  get(name, i) {
    return this.columns[name][i % this.capacity];
  }

  /** The last decision made by then; less than `first` if there is none. */
  before(timeS) {
    let low = this.first;
    let high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.get("time_s", middle) <= timeS) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  /** Whether it does not count, once there are bins to decide on. */
  isDoubtful(i) {
    return !this.#has(i, 1) && !(this.get("time_s", i) < this.firstBinS);
  }

  /** Whether the hand moves about as much as in training. */
  isInRange(i) {
    return this.#has(i, 16);
  }

  isLost(i, channel) {
    return this.lost[(i % this.capacity) * this.channels.length + channel] !== 0;
  }

  isOn(i) {
    return this.#has(i, 4);
  }

  /** A decision as `add` took it. */
  decision(i) {
    const decision = { valid: this.#has(i, 1), alarm: this.#has(i, 2), on: this.isOn(i) };
    decision.in_range = this.isInRange(i);
    decision.channels_lost = this.channels.filter((_, c) => this.isLost(i, c));
    for (const name in this.columns) decision[name] = this.get(name, i);
    if (!this.hasOnset) return decision;
    const by = this.#has(i, 8) ? "onset" : "status";
    return { ...decision, hint: this.#has(i, 32), raised_by: decision.alarm ? by : null };
  }

  #has(i, flag) {
    return (this.flags[i % this.capacity] & flag) !== 0;
  }
}
