// The picture: columns of one pixel, each drawn once and kept in a ring as long as it is in view.

import {
  GUTTER,
  laneScales,
  onsetRange,
  panels,
  statisticRange,
  usedChannels,
} from "./lanes.mjs";
import { drawOverlay } from "./overlay.mjs";

const VIEW_S = 4; // seconds from left to right
const COLOURS = "ink muted grid panel gauge rest slip pale alarm hatch".split(" ");

/** Draws what a player has played. */
export class Scope {
  #canvas;
  #ring = new OffscreenCanvas(1, 1);
  #first = 0; // columns from here ...
  #end = 0; // ... to here are in the ring
  #take = null; // of the history, whose they are
  #hatch = null; // fills what is not valid

  constructor(canvas, facts) {
    this.#canvas = canvas;
    this.facts = facts;
    this.used = usedChannels(facts);
    this.range = statisticRange(facts);
    this.onsetRange = onsetRange(facts);
    this.restyle();
  }

  /** Take the colours of the page. */
  restyle() {
    const style = getComputedStyle(document.documentElement);
    const read = (name) => [name, style.getPropertyValue(`--${name}`).trim()];
    this.colours = Object.fromEntries(COLOURS.map(read));
    this.resize(); // the hatching has a colour too
  }

  /** Take the size of the canvas' box. */
  resize() {
    const ratio = window.devicePixelRatio;
    const { width, height } = this.#canvas.getBoundingClientRect();
    this.size = { width, height, ratio };
    this.#canvas.width = Math.round(width * ratio);
    this.#canvas.height = Math.round(height * ratio);
    this.#ring.width = Math.max(1, Math.floor((width - GUTTER) * ratio));
    this.#ring.height = this.#canvas.height;
    this.samplesPerColumn = (VIEW_S * this.facts.sample_rate_hz) / this.#ring.width;
    this.panels = panels(this.facts, height);
    this.#hatch = hatching(this.#ring.getContext("2d"), this.colours.hatch, ratio);
    this.forget();
  }

  /** Scale the lanes for another recording. */
  show(recording) {
    this.recording = recording;
    this.scales = laneScales(recording.volts, this.facts.kinds);
    this.forget();
  }

  /** Draw everything anew with the next frame. */
  forget() {
    this.#first = this.#end = 0;
  }

  /** Draw the view that ends at the player's position. */
  draw({ history, position, isCatchingUp }, threshold) {
    const context = this.#canvas.getContext("2d");
    const { width, height } = this.#ring;
    const left = this.#canvas.width - width;
    const end = Math.floor(position / this.samplesPerColumn);
    const first = Math.max(0, end - width);
    if (!isCatchingUp && this.recording) this.#fill(first, end, history);
    context.fillStyle = this.colours.panel;
    context.fillRect(0, 0, this.#canvas.width, height);
    const seam = first % width; // columns to the right of it are the older ones
    const shift = end <= width ? 0 : seam;
    context.drawImage(this.#ring, shift, 0, width - shift, height, left, 0, width - shift, height);
    if (shift > 0) {
      context.drawImage(this.#ring, 0, 0, shift, height, left + width - shift, 0, shift, height);
    }
    const startS = (first * this.samplesPerColumn) / this.facts.sample_rate_hz;
    context.save();
    context.scale(this.size.ratio, this.size.ratio);
    drawOverlay(context, this, { history, threshold, startS, viewS: VIEW_S });
    context.restore();
  }

  /** Bring the ring from what it holds to the columns in view. */
  #fill(first, end, history) {
    const context = this.#ring.getContext("2d");
    const isOther = history.take !== this.#take || end < this.#end || this.#end < first;
    if (isOther || this.#end === this.#first) {
      context.clearRect(0, 0, this.#ring.width, this.#ring.height);
      this.#take = history.take;
      this.#end = first;
    }
    for (let column = this.#end; column < end; column += 1) this.#column(context, column, history);
    this.#first = first;
    this.#end = end;
  }

  #column(context, column, history) {
    const { width, height } = this.#ring;
    const { ratio } = this.size;
    const { colours, samplesPerColumn } = this;
    const { status, probability, statistic, onset, groups } = this.panels;
    const x = column % width;
    const from = Math.max(0, Math.ceil(column * samplesPerColumn) - 1); // joins the one before
    const to = Math.min(this.recording.rows, Math.ceil((column + 1) * samplesPerColumn));
    const now = history.before(to / this.facts.sample_rate_hz);
    const isOn = now >= 0 && history.isOn(now);
    context.clearRect(x, 0, 1, height);
    const bottom = groups.at(-1).top + groups.at(-1).height;
    const fill = (style, panel) => {
      context.fillStyle = style;
      context.fillRect(x, panel.top * ratio, 1, panel.height * ratio);
    };
    const lanes = { top: groups[0].top, height: bottom - groups[0].top };
    if (isOn) fill(colours.pale, lanes);
    if (now >= 0) fill(isOn ? colours.slip : colours.rest, status);
    if (now >= 0 && history.isDoubtful(now)) for (const p of [lanes, status]) fill(this.#hatch, p);
    for (const group of groups) {
      context.fillStyle =
        group.kind !== "PVDF" ? colours.gauge : isOn ? colours.slip : colours.rest;
      for (const channel of group.members) this.#lane(context, x, channel, group, from, to);
    }
    if (now < 0) return;
    const before = history.before(Math.max(0, from) / this.facts.sample_rate_hz);
    context.fillStyle = colours.ink;
    this.#trace(context, x, probability, [0, 1], history.columns.probability, before, now);
    this.#trace(context, x, statistic, this.range, history.columns.statistic, before, now);
    if (onset === null) return;
    this.#trace(context, x, onset, this.onsetRange, history.columns.onset_score, before, now);
  }

  /** From the lowest to the highest sample of a channel in a column. */
  #lane(context, x, channel, group, from, to) {
    const { volts } = this.recording;
    const width = this.facts.channels.length;
    let low = Infinity;
    let high = -Infinity;
    for (let i = from * width + channel; i < to * width; i += width) {
      const value = volts[i];
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (low > high) return; // nothing but NaN
    const scale = group.lane / this.scales.apart[group.kind];
    const centre = this.panels.centre[channel];
    const place = (value) => {
      const y = centre - (value - this.scales.middle[channel]) * scale;
      return Math.min(group.top + group.height, Math.max(group.top, y));
    };
    this.#stroke(context, x, place(high), place(low), 1);
  }

  /** From the value before a column to the one at its end. */
  #trace(context, x, panel, [low, high], values, before, now) {
    const place = (i) => {
      const share = (values[i] - low) / (high - low);
      return panel.top + panel.height * (1 - Math.min(1, Math.max(0, share)));
    };
    const [a, b] = [place(Math.max(0, before)), place(now)];
    this.#stroke(context, x, Math.min(a, b), Math.max(a, b), 1.5);
  }

  #stroke(context, x, top, bottom, thickness) {
    const { ratio } = this.size;
    const spare = Math.max(0, thickness - (bottom - top)) / 2;
    context.fillRect(x, (top - spare) * ratio, 1, (bottom - top + 2 * spare) * ratio);
  }
}

/** Diagonal lines, for what is not to be relied on. */
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
