// The alarm in words, and from a slider to its threshold: by false alarms an hour where the model says
// what they cost.

/** How an alarm comes about, for people: sentences. */
export function explain({ rule, sample_rate_hz: rate, hop_samples: hop, onset_hop_samples: fast }) {
  const every = (samples) => `every ${Number(((1000 * samples) / rate).toPrecision(3))} ms`;
  const rules = {
    k_of_n: () =>
      `k_of_n is the ${ordinal(rule.k)}highest evidence of the last ${rule.n} decisions. So an alarm ` +
      `comes when ${rule.k} of ${rule.n} decisions reach the threshold.`,
    cusum: () =>
      "cusum adds up the evidence of all decisions and never falls below 0" +
      (rule.ceiling === null ? "" : ` or rises above ${rounded(rule.ceiling)}`) +
      (rule.drift
        ? `; ${rounded(rule.drift)} is taken off each, so that weak evidence fades`
        : "") +
      ". An alarm comes when the sum reaches the threshold.",
  };
  const standing = "An alarm sets the status to slip until the statistic has been low for a while.";
  if (fast)
    return (
      `A classifier of slipping now looks at the stream ${every(fast)}. An alarm comes when its score ` +
      `reaches the threshold, and sets the status to slip until the score has been low for a while. ` +
      `The probability of slip is that of bins, ${every(hop)}; they raise no alarm.`
    );
  return [
    `A decision is made ${every(hop)}. Its evidence says how much more likely its samples are with ` +
      "slip than without: above 0 for slip, below 0 against it (the logarithm of the ratio).",
    rules[rule?.name]?.() ?? "An alarm comes when the statistic reaches the threshold.",
    standing,
  ].join(" ");
}

function ordinal(number) {
  return number === 1 ? "" : `${number}${{ 2: "nd", 3: "rd" }[number] ?? "th"} `;
}

/**
 * The scale of the slider, from 0 (left) to 1.
 *
 * Where the sidecar has a `threshold_curve` it runs over false alarms an hour, by their logarithm,
 * from few to many; else over the statistic itself, from low to high.
 *
 * @param {object} facts of the sidecar
 * @returns {{title: string, note: string, own: number, toThreshold: (share: number) => number,
 *   text: (share: number) => string, ownText: string}} `own` is where the file's threshold stands
 */
export function thresholdScale(facts) {
  const curve = risingRates(facts.threshold_curve ?? []);
  return curve.length < 2 ? byStatistic(facts) : byRate(facts, curve);
}

/** [threshold, log10 of the rate], rates strictly rising and positive. */
function risingRates(curve) {
  const rising = [];
  const byThreshold = curve.filter(([, rate]) => rate > 0).sort(([a], [b]) => b - a);
  for (const [threshold, rate] of byThreshold) {
    const level = Math.log10(rate);
    if (rising.length === 0 || level > rising.at(-1)[1]) rising.push([threshold, level]);
  }
  return rising;
}

function byRate(facts, curve) {
  const [thresholds, levels] = [0, 1].map((part) => curve.map((point) => point[part]));
  const [first, last] = [levels[0], levels.at(-1)];
  const level = (share) => first + share * (last - first);
  const toThreshold = (share) => interpolated(level(share), levels, thresholds);
  const falling = thresholds.map((threshold) => -threshold);
  const own = facts.threshold ?? Infinity; // null is one that nothing reaches
  const ownLevel = interpolated(-own, falling, levels);
  const text = (share) => `${rounded(10 ** level(share))} an hour`;
  const share = (ownLevel - first) / (last - first);
  // beyond the curve nothing was counted: the slider stands at its end, and the text says so
  const beyond = own > thresholds[0] ? "at most " : own < thresholds.at(-1) ? "at least " : "";
  return {
    title: "False alarms allowed",
    note: facts.simulated ? "as counted on simulated recordings" : "as counted on recordings",
    own: share,
    toThreshold,
    text,
    ownText: beyond + text(share),
  };
}

function byStatistic(facts) {
  const { rule, onset_hop_samples: hop } = facts;
  const name = hop ? "onset score" : `${rule?.name ?? "alarm"} statistic`;
  const ceiling = hop ? null : (rule?.ceiling ?? null); // with one, 0 bounds it from below
  const threshold = facts.threshold ?? ceiling ?? 0; // null is one that nothing reaches
  const reach = Math.max(5, Math.abs(threshold));
  const [low, high] = ceiling === null ? [threshold - reach, threshold + reach] : [0, ceiling];
  const toThreshold = (share) => low + share * (high - low);
  return {
    title: "Alarm threshold",
    note: `of the ${name}; this file has no curve of false alarms`,
    own: (threshold - low) / (high - low),
    toThreshold,
    text: (share) => rounded(toThreshold(share)),
    ownText: facts.threshold === null ? "out of reach" : rounded(threshold),
  };
}

/** Piecewise linear, held beyond the ends. `xs` rise. */
function interpolated(x, xs, ys) {
  const right = xs.findIndex((each) => each >= x);
  if (right === 0) return ys[0];
  if (right < 0) return ys.at(-1);
  const share = (x - xs[right - 1]) / (xs[right] - xs[right - 1]);
  return ys[right - 1] + share * (ys[right] - ys[right - 1]);
}

/** Two digits, for people. */
export function rounded(value) {
  return Number(value.toPrecision(2)).toLocaleString("en", { maximumFractionDigits: 4 });
}
