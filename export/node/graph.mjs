// The stream graph of an exported detector: samples in, decisions out, in Node and in browsers.

const FORMAT = "tactslip_torch onnx 2";
const NO_EVIDENCE = -1e30; // onset score of the graph
const MOST_ROWS = 2000; // in one run; memory grows with its decisions
const SESSION = { intraOpNumThreads: 1, interOpNumThreads: 1, logSeverityLevel: 3 }; // errors only
const COUNTS = ["first_samples", "frame_samples", "tail_samples", "state_size"];
const ARRAYS = { float32: Float32Array, float64: Float64Array };

/**
 * What the sidecar says of a model, once the model is known to be the one it speaks of.
 *
 * @param {Uint8Array} model content of `name`
 * @param {string} sidecar content of `name`.json
 * @param {string} name of the model, for errors
 * @returns {Promise<object>} the sidecar's facts
 * @throws {Error} if the sidecar is none, the model another one, or its graph no stream
 */
export async function checkedFacts(model, sidecar, name) {
  const facts = parsed(sidecar, name);
  if (facts.graph === "bin") {
    throw new Error(`${name} holds a bin graph, wanted a stream graph: export with graph=stream`);
  }
  const { channels, sample_rate_hz: rate, hop_samples: hop, precision } = facts;
  const { onset_hop_samples: fast } = facts; // of a model with an onset classifier
  const wrong = [
    ["graph", facts.graph === "stream", "bin or stream"],
    ["channels", isNames(channels), "a list of names"],
    ["sample_rate_hz", Number.isFinite(rate) && rate > 0, "a positive number"],
    ["hop_samples", isCount(hop) && hop > 0, "a positive whole number"],
    ["onset_hop_samples", fast === undefined || (isCount(fast) && fast > 0), "a positive whole number"],
    ...COUNTS.map((key) => [key, isCount(facts[key]), "a whole number"]),
    ["precision", Object.hasOwn(ARRAYS, precision), Object.keys(ARRAYS).join(" or ")],
    ["onnx_sha256", typeof facts.onnx_sha256 === "string", "64 hexadecimal digits"],
  ].find(([, isRight]) => !isRight);
  if (wrong) {
    const [key, , wanted] = wrong;
    const said = JSON.stringify(facts[key]) ?? "nothing";
    throw new Error(`${name}.json says ${key} ${said}, wanted ${wanted}: export again`);
  }
  if (!globalThis.crypto?.subtle) {
    throw new Error("no SHA-256 here: a browser has it for pages of localhost or https only");
  }
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", model));
  const found = Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
  if (found !== facts.onnx_sha256) {
    throw new Error(
      `${name} (${model.length} bytes) is not the file that ${name}.json describes ` +
        `(${facts.onnx_bytes} bytes): truncated or altered; copy both again, or export again`,
    );
  }
  return facts;
}

function isNames(value) {
  const isText = (name) => typeof name === "string";
  return Array.isArray(value) && value.length > 0 && value.every(isText);
}

function isCount(value) {
  return Number.isInteger(value) && value >= 0;
}

function parsed(sidecar, name) {
  let facts;
  try {
    facts = JSON.parse(sidecar);
  } catch {
    throw new Error(`${name}.json is no JSON: truncated or altered; copy it again`);
  }
  if (facts?.format !== FORMAT) {
    throw new Error(
      `${name}.json has format ${JSON.stringify(facts?.format)}, wanted "${FORMAT}": ` +
        "export with this version of tactslip_torch",
    );
  }
  return facts;
}

/**
 * A detector that watches one stream. It remembers a few samples and the state of the alarm.
 *
 * `facts` is what the sidecar says; `threshold`, null for the file's own, may change at any time.
 */
export class StreamGraph {
  #ort;
  #session;
  #turn = Promise.resolve(); // pushes are taken one after the other
  #tail;
  #state;

  constructor(ort, session, facts) {
    this.#ort = ort;
    this.#session = session;
    this.facts = facts;
    this.threshold = null;
    this.#forget();
  }

  /**
   * Check a model against its sidecar and load it.
   *
   * @param {object} ort onnxruntime-node or onnxruntime-web
   * @param {Uint8Array} model content of `name`
   * @param {string} sidecar content of `name`.json
   * @param {string} name of the model, for errors
   * @throws {Error} as `checkedFacts`, or if onnxruntime refuses the model
   */
  static async load(ort, model, sidecar, name) {
    const facts = await checkedFacts(model, sidecar, name);
    const session = await ort.InferenceSession.create(model, SESSION);
    return new this(ort, session, facts);
  }

  /**
   * The decisions that these samples make possible.
   *
   * @param {Float32Array|Float64Array} samples volts, n rows of all channels; n may be 0. A row is
   *   an instant, NaN a sample that is missing. Not to be changed before the promise is kept
   * @returns {Promise<object[]>} `time_s` (when it could be made, from the first sample), `onset_s`
   *   (when the slip it speaks of began), `score` (at least 0 is slip), `probability`, `statistic`
   *   of the alarm, `valid` (enough channels are alive; else these three are NaN, and there is no
   *   alarm), `in_range` (the living ones move about as much as in training), `channels_lost` (names
   *   of those that are silent or missing), `alarm`, `on` (an alarm stands); with an onset
   *   classifier `onset_score`, NaN without evidence, `hint` (the score reaches a threshold below
   *   that of alarms) and `raised_by`, "onset" or "status", null without alarm
   * @throws {Error} if samples are no volts or no whole rows; nothing is changed then
   */
  push(samples) {
    return this.#next(async () => {
      const rows = this.#rows(samples);
      const width = this.facts.channels.length * MOST_ROWS;
      const decisions = [];
      for (let start = 0; start < rows.length; start += width) {
        decisions.push(...(await this.#run(rows.subarray(start, start + width))));
      }
      return decisions;
    });
  }

  /** Forget the stream: the next sample is the first of another, at 0 s. */
  reset() {
    return this.#next(async () => this.#forget());
  }

  #next(work) {
    const done = this.#turn.then(work);
    this.#turn = done.catch(() => {});
    return done;
  }

  #forget() {
    const { Tensor } = this.#ort;
    const { precision, channels } = this.facts;
    this.#tail = new Tensor(precision, new ARRAYS[precision](0), [0, channels.length]);
    this.#state = new Tensor("float64", new Float64Array(0), [0]);
  }

  #rows(samples) {
    const { precision, channels } = this.facts;
    if (!(samples instanceof Float32Array || samples instanceof Float64Array)) {
      throw new Error("samples must be volts in a Float32Array or Float64Array");
    }
    if (samples.length % channels.length) {
      throw new Error(
        `expected rows of ${channels.length} channels (${channels[0]} to ${channels.at(-1)}), ` +
          `got ${samples.length} numbers`,
      );
    }
    const Wanted = ARRAYS[precision];
    return samples instanceof Wanted ? samples : new Wanted(samples);
  }

  async #run(rows) {
    const { Tensor } = this.#ort;
    const { precision, channels } = this.facts;
    const own = this.threshold === null ? [] : [this.threshold];
    const made = await this.#session.run({
      samples: new Tensor(precision, rows, [rows.length / channels.length, channels.length]),
      tail: this.#tail,
      state: this.#state,
      threshold: new Tensor("float64", Float64Array.from(own), [own.length]),
    });
    this.#tail = made.next_tail;
    this.#state = made.next_state;
    return Array.from(made.score.data, (score, i) => ({
      time_s: made.time_s.data[i],
      onset_s: made.onset_s.data[i],
      score,
      probability: made.probability.data[i],
      valid: made.valid.data[i] !== 0,
      in_range: made.in_range.data[i] !== 0,
      channels_lost: channels.filter((_, c) => made.channels_lost.data[i * channels.length + c]),
      statistic: made.statistic.data[i],
      alarm: made.alarm.data[i] !== 0,
      on: made.on.data[i] !== 0,
      ...(made.onset_score && onsetPart(made, i)),
    }));
  }
}

function onsetPart(made, i) {
  const by = made.by_onset.data[i] ? "onset" : "status";
  const score = made.onset_score.data[i];
  return {
    onset_score: score > NO_EVIDENCE ? score : NaN,
    hint: made.hint.data[i] !== 0,
    raised_by: made.alarm.data[i] ? by : null,
  };
}
