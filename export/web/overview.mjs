// All of a recording, or all that is kept of a live stream, on one line: to see and to seek in.

import { head, pageColours, upright } from "./scope.mjs";

const EVERY_MS = 250;
const STEP_S = 0.1; // of an arrow key; ten times as much with shift or a page key
const EDGE = 8; // half of the slider's thumb: so far from the sides its ends lie
const [MARKS, STATUS] = [11, 5]; // heights

/** A slider over a picture of P(slip), the status and every alarm. */
export class Overview {
  #canvas;
  #slider;
  #window;
  #source;
  #colours = pageColours();
  #drawn = ""; // what the picture shows
  #at = 0; // when it was drawn

  constructor(element, source) {
    [this.#canvas, this.#window, this.#slider] = element.children;
    this.#source = source;
    this.#slider.addEventListener("input", () => this.#seek(this.#slider.valueAsNumber));
    this.#slider.addEventListener("keydown", (event) => {
      const far = event.shiftKey ? 10 : 1;
      const steps = { ArrowLeft: -far, ArrowDown: -far, ArrowRight: far, ArrowUp: far };
      const step = { ...steps, PageDown: -10, PageUp: 10 }[event.key];
      if (step === undefined) return; // the browser knows Home and End
      event.preventDefault();
      this.#seek(this.#seconds(source.position) + step * STEP_S);
    });
  }

  /** Draw anew with the next frame, in the page's colours. */
  restyle() {
    this.#colours = pageColours();
    this.#drawn = "";
  }

  draw(status) {
    const { samples, history, position, viewS } = this.#source;
    const [first, end, now] = [samples.first, samples.end, position].map((row) =>
      this.#seconds(row),
    );
    this.#move(first, end, now, status);
    const box = this.#canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio;
    const share = (timeS) => (end > first ? (timeS - first) / (end - first) : 0);
    const left = Math.max(0, share(now - viewS));
    this.#window.style.left = `${EDGE + left * (box.width - 2 * EDGE)}px`;
    this.#window.style.width = `${Math.max(0, share(now) - left) * (box.width - 2 * EDGE)}px`;
    const state = [history.count, history.numAlarms, end, box.width, ratio].join();
    if (state === this.#drawn) return;
    const isGrowing = this.#source.isLive || this.#source.progress < 1;
    if (isGrowing && performance.now() - this.#at < EVERY_MS) return;
    this.#drawn = state;
    this.#at = performance.now();
    this.#canvas.width = Math.round(box.width * ratio);
    this.#canvas.height = Math.round(box.height * ratio);
    const context = this.#canvas.getContext("2d");
    context.scale(ratio, ratio);
    this.#picture(
      context,
      box,
      (timeS) => EDGE + share(timeS) * (box.width - 2 * EDGE),
      first,
      end,
    );
  }

  #seconds(row) {
    return row / this.#source.facts.sample_rate_hz;
  }

  #seek(seconds) {
    this.#source.seek(seconds * this.#source.facts.sample_rate_hz);
  }

  #move(first, end, now, status) {
    const slider = this.#slider;
    [slider.min, slider.max] = [first, end];
    slider.valueAsNumber = now;
    const text = `${now.toFixed(1)} of ${end.toFixed(1)} s, ${status}`;
    if (slider.getAttribute("aria-valuetext") !== text) slider.setAttribute("aria-valuetext", text);
  }

  /** Of each column of pixels the highest probability, and whether there was slip. */
  #picture(context, { width, height }, place, firstS, endS) {
    const { history, recording } = this.#source;
    const colours = this.#colours;
    const floor = height - STATUS;
    let before = history.first - 1;
    for (let x = EDGE; x < width - EDGE; x += 1) {
      const timeS = firstS + ((x + 1 - EDGE) / (width - 2 * EDGE)) * (endS - firstS);
      const now = history.before(timeS);
      if (now < history.first || (now === history.count - 1 && now === before)) continue;
      let most = 0;
      let isOn = false;
      let isDoubtful = false;
      for (let i = Math.max(history.first, Math.min(before + 1, now)); i <= now; i += 1) {
        most = Math.max(most, history.get("probability", i) || 0);
        isOn ||= history.isOn(i);
        isDoubtful ||= history.isDoubtful(i);
      }
      before = now;
      context.fillStyle = isDoubtful ? colours.hatch : isOn ? colours.slip : colours.rest;
      context.fillRect(x, floor, 1, STATUS);
      const size = most * (floor - MARKS);
      context.fillRect(x, floor - size, 1, size);
    }
    context.lineWidth = 1;
    context.strokeStyle = colours.ink;
    context.setLineDash([4, 3]);
    for (const onsetS of recording?.onsetsS ?? []) upright(context, place(onsetS), 0, height);
    context.setLineDash([]);
    context.strokeStyle = context.fillStyle = colours.alarm;
    for (const i of history.alarms) {
      const x = place(history.get("time_s", i));
      head(context, x);
      upright(context, x, MARKS, height);
    }
  }
}
