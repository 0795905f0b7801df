// Decisions as JSON lines, the same from every host.

const NONE = -0.99e30; // a statistic of too few decisions is below, and NaN is not above
const DIGITS = { float32: 9, float64: 17 }; // read back as the same number

/**
 * One decision, without newline; what is NaN, or not known yet, becomes null.
 *
 * @param {object} decision as `StreamGraph.push` gives it
 * @param {string} precision of the model
 * @param {boolean} isWhole with statistic, alarm and on, and of a classifier its score and hint
 */
export function decisionLine(decision, precision, isWhole) {
  const shown = (value) => (value > NONE ? Number(value.toPrecision(DIGITS[precision])) : null);
  const { time_s, onset_s, score, probability, statistic, alarm, on } = decision;
  const { valid, in_range, channels_lost } = decision;
  const line = {
    time_s,
    onset_s,
    score: shown(score),
    probability: shown(probability),
    valid,
    in_range,
    channels_lost,
  };
  const { onset_score, hint, raised_by } = decision; // undefined, left out, without a classifier
  const whole = isWhole && { statistic: shown(statistic), alarm, on, onset_score, hint };
  return JSON.stringify({ ...line, ...whole, raised_by });
}

/** The last line. */
export function summaryLine(decisions, alarms, seconds) {
  return JSON.stringify({ decisions, alarms, seconds });
}
