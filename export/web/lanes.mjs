// Where things stand in the picture: a lane per channel, gauges and films apart, then the status,
// the probability, the statistic of the alarm and, with an onset classifier, its score.

const KINDS = { SG: "gauges", PVDF: "films" };
const SAMPLED = 4000; // samples of a channel that its lane is scaled by
const HEIGHT = { marks: 14, title: 18, gap: 10, status: 12, trace: 54, axis: 18 }; // CSS pixels
const FILM_SHARE = 2; // a film's lane is so much higher than a gauge's
export const GUTTER = 62;

/**
 * Middle of each channel, and volts from lane to lane of each kind, by its channel in the middle.
 * Gauges rest and now and then move far: room for four times the range of half of their samples.
 * Films burst: room for nearly all of them. What is larger crosses the neighbours' lanes.
 *
 * @param {Float32Array|Float64Array} volts row by row
 * @param {string[]} kinds of the channels
 * @returns {{middle: number[], apart: Object<string, number>}}
 */
export function laneScales(volts, kinds) {
  const rows = volts.length / kinds.length;
  const step = Math.max(1, Math.floor(rows / SAMPLED));
  const middle = [];
  const widths = {};
  kinds.forEach((kind, channel) => {
    const known = [];
    for (let row = 0; row < rows; row += step) {
      const value = volts[row * kinds.length + channel];
      if (Number.isFinite(value)) known.push(value);
    }
    const sorted = Float64Array.from(known).sort();
    const at = (share) => sorted[Math.floor(share * (sorted.length - 1))] ?? 0;
    middle.push(at(0.5));
    const width = kind === "PVDF" ? 1.1 * (at(0.995) - at(0.005)) : 4 * (at(0.75) - at(0.25));
    (widths[kind] ??= []).push(width);
  });
  const typical = ([kind, all]) => {
    const some = all.filter((width) => width > 0).sort((a, b) => a - b);
    return [kind, some[some.length >> 1] ?? 1]; // 1 V where all is silence
  };
  return { middle, apart: Object.fromEntries(Object.entries(widths).map(typical)) };
}

/**
 * Panels from top to bottom, in CSS pixels.
 *
 * @param {object} facts of the sidecar
 * @param {number} height of the canvas
 * @returns {{groups: object[], centre: number[], status: object, probability: object,
 *   statistic: object, onset: ?object, axis: number}} tops and heights; `centre` of each channel's lane
 */
export function panels(facts, height) {
  const kinds = [...new Set(facts.kinds)];
  const share = (kind) => (kind === "PVDF" ? FILM_SHARE : 1);
  const traces = facts.onset_hop_samples ? 3 : 2;
  const below = HEIGHT.status + traces * HEIGHT.trace + (1 + traces) * HEIGHT.gap + HEIGHT.axis;
  const above = HEIGHT.marks + kinds.length * HEIGHT.title;
  const shares = facts.kinds.reduce((sum, kind) => sum + share(kind), 0);
  const unit = (height - below - above) / shares;
  let top = HEIGHT.marks;
  const take = (size, gap = 0) => {
    const panel = { top: top + gap, height: size };
    top += gap + size;
    return panel;
  };
  const centre = new Array(facts.channels.length);
  const groups = kinds.map((kind) => {
    const members = facts.kinds.flatMap((each, i) => (each === kind ? [i] : []));
    const lane = unit * share(kind);
    const group = take(members.length * lane, HEIGHT.title);
    members.forEach((channel, i) => (centre[channel] = group.top + (i + 0.5) * lane));
    return { kind, name: KINDS[kind] ?? kind, members, lane, ...group };
  });
  const status = take(HEIGHT.status, HEIGHT.gap);
  const probability = take(HEIGHT.trace, HEIGHT.gap);
  const statistic = take(HEIGHT.trace, HEIGHT.gap);
  const onset = traces === 3 ? take(HEIGHT.trace, HEIGHT.gap) : null;
  return { groups, centre, status, probability, statistic, onset, axis: top };
}

/** Channels that the detector uses: those its features are of; a pooled one is of a whole kind. */
export function usedChannels({ channels, features, kinds }) {
  const named = new Set(features.map((feature) => feature.split(" ")[0]));
  return channels.map((name, i) => named.has(name) || named.has(kinds[i]));
}

/** Lowest and highest statistic shown. */
export function statisticRange(facts) {
  const ceiling = facts.rule?.ceiling ?? null;
  if (ceiling !== null) return [0, 1.05 * ceiling];
  const threshold = facts.status_threshold ?? facts.threshold ?? 0;
  const reach = Math.max(5, Math.abs(threshold));
  return [threshold - reach, threshold + reach];
}

/** Lowest and highest onset score shown. */
export function onsetRange(facts) {
  const threshold = facts.threshold ?? 0;
  const reach = Math.max(2, Math.abs(threshold));
  return [threshold - reach, threshold + reach];
}
