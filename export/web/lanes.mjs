// Where things stand in the picture: a lane for each channel, kinds apart, then the status, the
// probability, the statistic of the alarm and, with an onset classifier, its score.

const KINDS = { SG: "SG, strain gauges", PVDF: "PVDF, films" };
const SAMPLED = 4000; // rows by which lanes are scaled
const IN_LANE = 0.99; // of a channel's samples lie within its lane
const ROOM = 1.25; // height of a lane, in ranges of these
const LEAST = 0.04; // of the highest lane of a kind: what rests is not made to look busy
const HEIGHT = { marks: 14, title: 20, gap: 10, status: 12, trace: 54, axis: 18 }; // CSS pixels
const LANE = 12; // least height
const FAST = 2; // lanes of fast channels are so much higher than others

/**
 * What stands in the middle of each channel's lane, and how much its height is, in the samples' unit.
 *
 * @param {Samples} samples
 * @param {string[]} kinds of the channels
 * @param {number} from first row that counts
 * @returns {{middle: number[], height: number[]}} heights are 1, 2 or 5 times a power of ten
 */
export function laneScales({ values, width, capacity, end }, kinds, from) {
  const step = Math.max(1, Math.floor((end - from) / SAMPLED));
  const ranges = kinds.map((_, channel) => {
    const known = [];
    for (let row = from; row < end; row += step) {
      const value = values[(row % capacity) * width + channel];
      if (Number.isFinite(value)) known.push(value);
    }
    const sorted = Float64Array.from(known).sort();
    const at = (share) => sorted[Math.round(share * (sorted.length - 1))] ?? 0;
    return [at((1 - IN_LANE) / 2), at((1 + IN_LANE) / 2)];
  });
  const spread = ranges.map(([low, high]) => ROOM * (high - low));
  const most = (kind) => Math.max(...spread.filter((_, i) => kinds[i] === kind));
  const height = kinds.map((kind, i) => round(Math.max(spread[i], LEAST * most(kind)) || 1));
  return { middle: ranges.map(([low, high]) => (low + high) / 2), height };
}

/** The next number of 1, 2 and 5 times powers of ten. */
function round(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([1, 2, 5].find((each) => each * power >= value * (1 - 1e-9)) ?? 10);
}

/** A height with its unit. */
export function withUnit(value, unit) {
  const [number, name] = unit === "V" && value < 0.1 ? [1000 * value, "mV"] : [value, unit];
  return `${Number(number.toPrecision(1))} ${name}`;
}

/** Whether lanes are better scaled anew: something left its lane, or fills little of it. */
export function isOutgrown(now, wanted) {
  return now.height.some((height, i) => {
    const moved = Math.abs(now.middle[i] - wanted.middle[i]) / height;
    return wanted.height[i] > height || wanted.height[i] < height / 4 || moved > 0.3;
  });
}

/**
 * Panels from top to bottom, in CSS pixels.
 *
 * @param {object} facts of the detector
 * @param {number} height of the picture
 * @returns {{groups: object[], centre: number[], status: object, probability: object,
 *   statistic: object, onset: ?object, axis: number}} tops and heights; `centre` of each channel's lane
 */
export function panels(facts, height) {
  const kinds = [...new Set(facts.kinds)];
  const unit = (height - fixed(facts)) / facts.kinds.reduce((sum, kind) => sum + share(kind), 0);
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
  const onset = facts.onset_hop_samples ? take(HEIGHT.trace, HEIGHT.gap) : null;
  return { groups, centre, status, probability, statistic, onset, axis: top };
}

/** A picture must be so high for its lanes to be told apart. */
export function leastHeight(facts) {
  return fixed(facts) + LANE * facts.kinds.reduce((sum, kind) => sum + share(kind), 0);
}

function share(kind) {
  return kind === "PVDF" ? FAST : 1;
}

function fixed(facts) {
  const traces = facts.onset_hop_samples ? 3 : 2;
  const below = HEIGHT.status + traces * HEIGHT.trace + (1 + traces) * HEIGHT.gap + HEIGHT.axis;
  return HEIGHT.marks + new Set(facts.kinds).size * HEIGHT.title + below;
}

/** Channels that the detector uses: those its features are of; a pooled one is of a whole kind. */
export function usedChannels({ channels, features = channels, kinds, used_channels: used }) {
  const named = new Set(used ?? features.map((feature) => feature.split(" ")[0]));
  return channels.map((name, i) => named.has(name) || (!used && named.has(kinds[i])));
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
