// What lies over the columns: names of the lanes, scales, the axis, and the marks of alarms.

import { GUTTER } from "./lanes.mjs";

const FONT = "10px system-ui, sans-serif";
const TITLE = "600 11px system-ui, sans-serif";

/**
 * Draw it, in CSS pixels.
 *
 * @param {CanvasRenderingContext2D} context
 * @param {object} scope with facts, colours, panels, scales, size, used, range
 * @param {{history: object, threshold: number, startS: number, viewS: number}} view
 */
export function drawOverlay(context, scope, view) {
  const { size } = scope;
  const perSecond = (size.width - GUTTER) / view.viewS;
  const place = (timeS) => GUTTER + (timeS - view.startS) * perSecond;
  context.textBaseline = "middle";
  drawLanes(context, scope);
  drawTraces(context, scope, view.threshold);
  drawAxis(context, scope, view, place);
  drawMarks(context, scope, view, place);
}

function drawLanes(context, { facts, colours, panels, scales, size, used }) {
  for (const group of panels.groups) {
    write(context, TITLE, colours.ink, "left", group.name, GUTTER, group.top - 9);
    group.members.forEach((channel) => {
      const colour = used[channel] ? colours.ink : colours.muted;
      const y = panels.centre[channel];
      write(context, FONT, colour, "right", facts.channels[channel], GUTTER - 12, y);
      if (used[channel]) dot(context, GUTTER - 6, y, colours.rest);
    });
    if (!scales) continue;
    const numUsed = group.members.filter((channel) => used[channel]).length;
    const apart = `${Number(scales.apart[group.kind].toPrecision(2))} V from lane to lane`;
    const note = `${numUsed} of ${group.members.length} in use · ${apart}`;
    write(context, FONT, colours.muted, "right", note, size.width - 4, group.top - 9);
  }
}

function drawTraces(context, scope, threshold) {
  const { colours, panels, size, facts } = scope;
  const { status, probability, statistic, onset } = panels;
  const label = (text, y, colour = colours.ink) =>
    write(context, FONT, colour, "right", text, GUTTER - 6, y);
  label("status", status.top + status.height / 2);
  label("P(slip)", probability.top + probability.height / 2);
  label(facts.rule?.name ?? "statistic", statistic.top + statistic.height / 2);
  if (onset) label("onset", onset.top + onset.height / 2);
  for (const [text, share] of [
    ["1", 0],
    ["0", 1],
  ]) {
    label(text, probability.top + share * probability.height, colours.muted);
  }
  context.strokeStyle = colours.grid;
  context.lineWidth = 1;
  for (const panel of [probability, statistic, onset].filter(Boolean)) {
    for (const share of [0, 1]) line(context, panel.top + share * panel.height, size.width);
  }
  const ofBins = onset ? (facts.status_threshold ?? Infinity) : threshold;
  drawThreshold(context, scope, statistic, scope.range, ofBins);
  if (onset) drawThreshold(context, scope, onset, scope.onsetRange, threshold);
}

function drawThreshold(context, { colours, size }, panel, [low, high], threshold) {
  const share = Math.min(1, Math.max(0, (threshold - low) / (high - low)));
  const y = panel.top + panel.height * (1 - share);
  context.strokeStyle = colours.alarm;
  context.setLineDash([6, 4]);
  line(context, y, size.width);
  context.setLineDash([]);
  write(context, FONT, colours.alarm, "left", "threshold", GUTTER + 4, y - 7);
}

function drawAxis(context, { colours, panels, size }, { startS, viewS }, place) {
  context.strokeStyle = colours.grid;
  for (let second = Math.ceil(2 * startS) / 2; second <= startS + viewS; second += 0.5) {
    const x = place(second);
    context.beginPath();
    context.moveTo(x, panels.axis);
    context.lineTo(x, panels.axis + 4);
    context.stroke();
    if (x < GUTTER + 14 || x > size.width - 14) continue; // no room for a number
    write(context, FONT, colours.muted, "center", second.toFixed(1), x, panels.axis + 11);
  }
  write(context, FONT, colours.muted, "right", "time, s", GUTTER - 6, panels.axis + 11);
}

/** Alarms as lines with a head, the onsets they speak of as dots down to the status. */
function drawMarks(context, { colours, panels }, { history, startS, viewS }, place) {
  const bottom = panels.status.top + panels.status.height;
  context.strokeStyle = context.fillStyle = colours.alarm;
  for (let k = history.alarms.length - 1; k >= 0; k -= 1) {
    const alarmS = history.columns.time_s[history.alarms[k]];
    if (alarmS < startS) break;
    if (alarmS > startS + viewS) continue;
    const x = place(alarmS);
    context.lineWidth = 1.5;
    upright(context, x, 10, bottom);
    context.beginPath();
    context.moveTo(x - 5, 1);
    context.lineTo(x + 5, 1);
    context.lineTo(x, 10);
    context.fill();
    const onset = place(history.columns.onset_s[history.alarms[k]]);
    if (onset < GUTTER) continue;
    context.setLineDash([2, 3]);
    upright(context, onset, 14, bottom);
    context.setLineDash([]);
  }
}

function write(context, font, colour, align, text, x, y) {
  context.font = font;
  context.fillStyle = colour;
  context.textAlign = align;
  context.fillText(text, x, y);
}

function dot(context, x, y, colour) {
  context.fillStyle = colour;
  context.beginPath();
  context.arc(x, y, 2, 0, 2 * Math.PI);
  context.fill();
}

function line(context, y, right) {
  context.beginPath();
  context.moveTo(GUTTER, y);
  context.lineTo(right, y);
  context.stroke();
}

function upright(context, x, top, bottom) {
  context.beginPath();
  context.moveTo(x, top);
  context.lineTo(x, bottom);
  context.stroke();
}
