// The picture: columns of one pixel, each drawn once and kept in a ring as long as it is in view;
// over them names of the lanes, scales, the axis, and the marks of alarms.

import {
  isOutgrown,
  laneScales,
  leastHeight,
  onsetRange,
  panels,
  statisticRange,
  usedChannels,
  withUnit,
} from "./lanes.mjs";

const COLOURS = "ink muted grid panel slow rest slip pale alarm hatch".split(" ");
const FONT = "10px system-ui, sans-serif";
const TITLE = "600 11px system-ui, sans-serif";
const [LEFT, RIGHT] = [[60, 120], 46]; // widths of the margins; the left one by the longest name
const SCALED_S = 10; // of a live stream, by which its lanes are scaled
const SCALE_MS = 2000; // and how often

/** Colours of the page, by name. */
export function pageColours() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(
    COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]),
  );
}

/** Draws what a source has at its position. */
export class Scope {
  #canvas;
  #ring = new OffscreenCanvas(1, 1);
  #first = 0; // columns from here ...
  #end = 0; // ... to here are in the ring
  #history = null; // whose they are
  #samples = null;
  #hatch = null; // fills what is lost or not valid
  #scaledAt = -Infinity;
  #drawn = ""; // what the picture shows

  constructor(canvas, source) {
    this.#canvas = canvas;
    this.source = source;
    this.facts = source.facts;
    this.used = usedChannels(this.facts);
    this.range = statisticRange(this.facts);
    this.onsetRange = onsetRange(this.facts);
    canvas.style.minHeight = `${Math.ceil(leastHeight(this.facts))}px`;
    this.restyle();
  }

  /** Take the colours of the page. */
  restyle() {
    this.colours = pageColours();
    this.resize(); // the hatching has a colour too
  }

  /** Take the size of the canvas' box. */
  resize() {
    const ratio = window.devicePixelRatio;
    const { width, height } = this.#canvas.getBoundingClientRect();
    this.#canvas.width = Math.round(width * ratio);
    this.#canvas.height = Math.round(height * ratio);
    const context = this.#canvas.getContext("2d");
    context.font = FONT;
    const names = this.facts.channels.map((name) => context.measureText(name).width);
    const left = Math.min(LEFT[1], Math.max(LEFT[0], Math.max(...names) + 20));
    this.size = { width, height, ratio, left, right: width - RIGHT };
    this.#ring.width = Math.max(1, Math.floor((width - RIGHT - left) * ratio));
    this.#ring.height = this.#canvas.height;
    this.panels = panels(this.facts, height);
    this.#hatch = hatching(this.#ring.getContext("2d"), this.colours.hatch, ratio);
    this.#forget();
  }

  /** Draw everything anew with the next frame. */
  #forget() {
    this.#first = this.#end = 0;
    this.#drawn = "";
  }

  /** Draw the view that ends at the source's position, if it is another one. */
  draw() {
    const { source, facts } = this;
    const { history, samples, position, threshold } = source;
    if (samples !== this.#samples) this.#forget();
    this.#samples = samples;
    this.#scale();
    const samplesPerColumn = (source.viewS * facts.sample_rate_hz) / this.#ring.width;
    const end = Math.floor(position / samplesPerColumn);
    const state = [end, history.count, threshold].join();
    if (history === this.#history && state === this.#drawn) return;
    const context = this.#canvas.getContext("2d");
    const { width, height } = this.#ring;
    const left = Math.round(this.size.left * this.size.ratio);
    const first = Math.max(0, end - width);
    this.#fill(first, end, samplesPerColumn);
    this.#drawn = state;
    context.fillStyle = this.colours.panel;
    context.fillRect(0, 0, this.#canvas.width, height);
    const seam = first % width; // columns to the right of it are the older ones
    const shift = end <= width ? 0 : seam;
    context.drawImage(this.#ring, shift, 0, width - shift, height, left, 0, width - shift, height);
    if (shift > 0) {
      context.drawImage(this.#ring, 0, 0, shift, height, left + width - shift, 0, shift, height);
    }
    const startS = (first * samplesPerColumn) / facts.sample_rate_hz;
    const endS = (end * samplesPerColumn) / facts.sample_rate_hz;
    context.save();
    context.scale(this.size.ratio, this.size.ratio);
    context.textBaseline = "middle";
    this.#drawLanes(context);
    this.#drawTraces(context);
    this.#drawAxis(context, startS);
    this.#drawMarks(context, startS, endS);
    this.#drawTitles(context);
    context.restore();
  }

  /** Scale the lanes: of a recording by all of it, of a live stream by its last seconds. */
  #scale() {
    const { samples, isLive } = this.source;
    if (this.#end > 0 && (!isLive || performance.now() - this.#scaledAt < SCALE_MS)) return;
    const from = isLive ? samples.end - SCALED_S * this.facts.sample_rate_hz : 0;
    const wanted = laneScales(samples, this.facts.kinds, Math.max(samples.first, Math.floor(from)));
    this.#scaledAt = performance.now();
    if (this.#end > 0 && !isOutgrown(this.scales, wanted)) return;
    this.scales = wanted;
    this.#forget();
  }

  // Columns ---------------------------------------------------------------------------------------

  /** Bring the ring from what it holds to the columns in view. */
  #fill(first, end, samplesPerColumn) {
    const context = this.#ring.getContext("2d");
    const { history } = this.source;
    const isOther = history !== this.#history || end < this.#end || this.#end < first;
    if (isOther || this.#end === this.#first) {
      context.clearRect(0, 0, this.#ring.width, this.#ring.height);
      this.#history = history;
      this.#end = first;
    }
    for (let column = this.#end; column < end; column += 1) {
      this.#column(context, column, samplesPerColumn);
    }
    this.#first = first;
    this.#end = end;
  }

  #column(context, column, samplesPerColumn) {
    const { width, height } = this.#ring;
    const { ratio } = this.size;
    const { colours, facts } = this;
    const { history, samples } = this.source;
    const { status, probability, statistic, onset, groups } = this.panels;
    const x = column % width;
    const from = Math.max(samples.first, Math.ceil(column * samplesPerColumn) - 1); // joins the last
    const to = Math.min(samples.end, Math.ceil((column + 1) * samplesPerColumn));
    const now = history.before(to / facts.sample_rate_hz);
    const isKnown = now >= history.first;
    const isOn = isKnown && history.isOn(now);
    context.clearRect(x, 0, 1, height);
    const bottom = groups.at(-1).top + groups.at(-1).height;
    const fill = (style, panel) => {
      context.fillStyle = style;
      context.fillRect(x, panel.top * ratio, 1, panel.height * ratio);
    };
    const traces = [status, probability, statistic];
    const lanes = { top: groups[0].top, height: bottom - groups[0].top };
    if (isOn) fill(colours.pale, lanes);
    if (isKnown) fill(isOn ? colours.slip : colours.rest, status);
    if (isKnown && history.isDoubtful(now)) for (const p of traces) fill(this.#hatch, p);
    for (const group of groups) {
      const colour = group.kind === "SG" ? colours.slow : isOn ? colours.slip : colours.rest;
      for (const channel of group.members) {
        const top = this.panels.centre[channel] - group.lane / 2;
        const lost = isKnown && history.isLost(now, channel);
        if (lost) fill(this.#hatch, { top, height: group.lane });
        context.fillStyle = colour;
        this.#lane(context, x, channel, group.lane, from, to);
      }
    }
    if (!isKnown) return;
    const before = Math.max(history.first, history.before(from / facts.sample_rate_hz));
    context.fillStyle = colours.ink;
    this.#trace(context, x, probability, [0, 1], "probability", before, now);
    this.#trace(context, x, statistic, this.range, "statistic", before, now);
    if (onset) this.#trace(context, x, onset, this.onsetRange, "onset_score", before, now);
  }

  /** From the lowest to the highest sample of a channel in a column; half a lane beyond its own. */
  #lane(context, x, channel, lane, from, to) {
    const { values, width, capacity } = this.source.samples;
    let low = Infinity;
    let high = -Infinity;
    for (let i = from; i < to; i += 1) {
      const value = values[(i % capacity) * width + channel];
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (low > high) return; // nothing but NaN
    const { middle, height } = this.scales;
    const place = (value) => {
      const lanes = (value - middle[channel]) / height[channel];
      return this.panels.centre[channel] - lane * Math.min(1, Math.max(-1, lanes));
    };
    this.#stroke(context, x, place(high), place(low), 1);
  }

  /** From the value before a column to the one at its end; nothing where there is none. */
  #trace(context, x, panel, [low, high], name, before, now) {
    const values = [before, now].map((i) => this.source.history.get(name, i));
    const places = values.filter(Number.isFinite).map((value) => {
      const share = (value - low) / (high - low);
      return panel.top + panel.height * (1 - Math.min(1, Math.max(0, share)));
    });
    if (places.length) this.#stroke(context, x, Math.min(...places), Math.max(...places), 1.5);
  }

  #stroke(context, x, top, bottom, thickness) {
    const { ratio } = this.size;
    const spare = Math.max(0, thickness - (bottom - top)) / 2;
    context.fillRect(x, (top - spare) * ratio, 1, (bottom - top + 2 * spare) * ratio);
  }

  // Over the columns ------------------------------------------------------------------------------

  #drawLanes(context) {
    const { facts, colours, panels, scales, size, used } = this;
    for (const { members, top, lane } of panels.groups) {
      write(context, FONT, colours.muted, "right", "lane height", size.width - 2, top - 9);
      members.forEach((channel, i) => {
        const y = panels.centre[channel];
        const colour = used[channel] ? colours.ink : colours.muted;
        const label = facts.channels[channel];
        write(context, FONT, colour, "right", label, size.left - 12, y, size.left - 14);
        if (used[channel]) dot(context, size.left - 6, y, colours.rest);
        const height = withUnit(scales.height[channel], facts.unit ?? "");
        write(context, FONT, colours.muted, "right", height, size.width - 2, y, RIGHT - 4);
        if (i === 0) return;
        context.strokeStyle = colours.grid;
        context.lineWidth = 0.5;
        line(context, size.left, y - lane / 2, size.right);
      });
    }
  }

  #drawTraces(context) {
    const { colours, facts, size } = this;
    const { status, probability, statistic, onset } = this.panels;
    const label = (text, y, colour = colours.ink) =>
      write(context, FONT, colour, "right", text, size.left - 6, y);
    label("status", status.top + status.height / 2);
    label("P(slip)", probability.top + probability.height / 2);
    label(facts.rule?.name ?? "statistic", statistic.top + statistic.height / 2);
    if (onset) label("onset", onset.top + onset.height / 2);
    label("1", probability.top, colours.muted);
    label("0", probability.top + probability.height, colours.muted);
    context.strokeStyle = colours.grid;
    context.lineWidth = 1;
    for (const panel of [probability, statistic, onset].filter(Boolean)) {
      for (const share of [0, 1])
        line(context, size.left, panel.top + share * panel.height, size.right);
    }
    const { threshold } = this.source;
    const ofBins = onset ? (facts.status_threshold ?? Infinity) : threshold;
    this.#drawThreshold(context, statistic, this.range, ofBins);
    if (onset) this.#drawThreshold(context, onset, this.onsetRange, threshold);
  }

  #drawThreshold(context, panel, [low, high], threshold) {
    const { colours, size } = this;
    const share = Math.min(1, Math.max(0, (threshold - low) / (high - low)));
    const y = panel.top + panel.height * (1 - share);
    context.strokeStyle = colours.alarm;
    context.setLineDash([6, 4]);
    line(context, size.left, y, size.right);
    context.setLineDash([]);
    write(
      context,
      FONT,
      colours.alarm,
      "left",
      "threshold",
      size.left + 4,
      y < panel.top + 9 ? y + 8 : y - 7,
    );
  }

  #drawAxis(context, startS) {
    const { colours, panels, size, source } = this;
    const step = source.viewS > 2 ? 0.5 : source.viewS > 0.5 ? 0.1 : 0.02;
    for (let tick = Math.ceil(startS / step); tick * step <= startS + source.viewS; tick += 1) {
      const x = this.#place(tick * step, startS);
      context.strokeStyle = colours.grid;
      context.lineWidth = 1;
      upright(context, x, panels.axis, panels.axis + 4);
      if (x < size.left + 14 || x > size.right - 14) continue; // no room for a number
      const text = (tick * step).toFixed(step < 0.1 ? 2 : 1);
      write(context, FONT, colours.muted, "center", text, x, panels.axis + 11);
    }
    write(context, FONT, colours.muted, "right", "time, s", size.left - 6, panels.axis + 11);
  }

  #place(timeS, startS) {
    const { left, right } = this.size;
    return left + ((timeS - startS) * (right - left)) / this.source.viewS;
  }

  /** Alarms as lines with a head, the onsets they speak of as dots; where slip truly began, dashes. */
  #drawMarks(context, startS, endS) {
    const { colours, size } = this;
    const { history, recording } = this.source;
    const bottom = this.panels.status.top + this.panels.status.height;
    const mark = (timeS, colour, dash, top) => {
      const x = this.#place(timeS, startS);
      if (x < size.left || timeS > endS) return;
      context.strokeStyle = context.fillStyle = colour;
      context.lineWidth = 1.5;
      context.setLineDash(dash);
      upright(context, x, top, bottom);
      context.setLineDash([]);
      if (dash.length === 0) head(context, x);
    };
    for (const onsetS of recording?.onsetsS ?? []) mark(onsetS, colours.ink, [8, 4], 4);
    for (let k = history.alarms.length - 1; k >= 0; k -= 1) {
      const alarmS = history.get("time_s", history.alarms[k]);
      if (alarmS < startS) break;
      if (alarmS > endS) continue;
      mark(history.get("onset_s", history.alarms[k]), colours.alarm, [2, 3], 14);
      mark(alarmS, colours.alarm, [], 10);
    }
  }

  /** Names of kinds, outlined, so that marks that cross them leave them legible. */
  #drawTitles(context) {
    const { colours, panels, size, used } = this;
    for (const { members, name, top } of panels.groups) {
      const numUsed = members.filter((channel) => used[channel]).length;
      const text = `${name}: ${numUsed} of ${members.length} in use`;
      context.strokeStyle = colours.panel;
      context.lineWidth = 4;
      context.font = TITLE;
      context.textAlign = "left";
      context.strokeText(text, size.left, top - 9);
      write(context, TITLE, colours.ink, "left", text, size.left, top - 9);
    }
  }
}

/** Diagonal lines, for lost channels and decisions that are not valid. */
function hatching(context, colour, ratio) {
  const size = Math.round(8 * ratio);
  const tile = new OffscreenCanvas(size, size);
  const pen = tile.getContext("2d");
  pen.strokeStyle = colour;
  pen.lineWidth = ratio;
  for (const shift of [-size, 0, size]) {
    pen.moveTo(shift, size);
    pen.lineTo(shift + size, 0);
  }
  pen.stroke();
  return context.createPattern(tile, "repeat");
}

function write(context, font, colour, align, text, x, y, most) {
  context.font = font;
  context.fillStyle = colour;
  context.textAlign = align;
  context.fillText(text, x, y, most);
}

function dot(context, x, y, colour) {
  context.fillStyle = colour;
  context.beginPath();
  context.arc(x, y, 2, 0, 2 * Math.PI);
  context.fill();
}

/** The head of an alarm's line. */
export function head(context, x) {
  context.beginPath();
  context.moveTo(x - 5, 1);
  context.lineTo(x + 5, 1);
  context.lineTo(x, 10);
  context.fill();
}

function line(context, left, y, right) {
  context.beginPath();
  context.moveTo(left, y);
  context.lineTo(right, y);
  context.stroke();
}

export function upright(context, x, top, bottom) {
  context.beginPath();
  context.moveTo(x, top);
  context.lineTo(x, bottom);
  context.stroke();
}
