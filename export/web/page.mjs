// The page: loads the detector, then a frame at a time plays, draws and reports.

import * as ort from "./ort/ort.mjs";

import { StreamGraph } from "../node/graph.mjs";
import { decisionLine, summaryLine } from "../node/lines.mjs";
import { readRecording } from "./files.mjs";
import { Player } from "./player.mjs";
import { describe, describeSimulated, report } from "./readout.mjs";
import { Scope } from "./scope.mjs";
import { thresholdScale } from "./threshold.mjs";

const AGAIN_MS = 150; // the slider rests for so long before all is scored again
const element = (id) => document.getElementById(id);
let player = null;

/** One line about what went wrong, or none. */
function say(problem) {
  const line = problem instanceof Error ? problem.message.replace(/\s*\n\s*/g, "; ") : problem;
  element("alert").textContent = line ?? "";
  element("alert").hidden = !line;
}

async function fetched(path, what) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`the server cannot read ${what}: is it still there?`);
  return response;
}

async function loadStream(given) {
  ort.env.wasm.numThreads = 1;
  ort.env.wasm.wasmPaths = { wasm: new URL("./ort/ort.wasm", import.meta.url).href };
  const model = await fetched("/model", given.model);
  const sidecar = await fetched("/model.json", `${given.model}.json`);
  const bytes = new Uint8Array(await model.arrayBuffer());
  const stream = await StreamGraph.load(ort, bytes, await sidecar.text(), given.model);
  await stream.push(new Float32Array(stream.facts.channels.length * 400)); // warm
  await stream.reset();
  return stream;
}

/** Take a recording; the one before stays where this one is none. */
async function take(content, name, isSimulated, scope) {
  const { facts } = player.stream;
  const recording = await readRecording(content, name, facts);
  await player.load(recording);
  scope.show(player.recording);
  describeSimulated(facts, isSimulated || recording.isSimulated);
  element("rate").value = facts.sample_rate_hz;
  for (const id of ["play", "restart"]) element(id).disabled = false;
  say(null);
}

async function takeGiven({ recording, simulated }, scope) {
  const response = await fetched("/recording", recording);
  await take(await response.arrayBuffer(), recording, simulated, scope);
}

function isRateRight() {
  return Number(element("rate").value) === player.stream.facts.sample_rate_hz;
}

/** Play where the rate is the detector's, else say so. */
function play() {
  player.isPlaying = isRateRight();
  const wanted = player.stream.facts.sample_rate_hz;
  const problem =
    `the recording has ${element("rate").value || "no"} samples a second, the detector wants ` +
    `${wanted}: resample it, or train a detector for that rate`;
  say(player.isPlaying ? null : problem);
}

async function toggle() {
  if (player.recording === null) return;
  if (player.isPlaying) {
    player.isPlaying = false;
    return;
  }
  if (player.isAtEnd) await player.restart();
  play();
}

function connectPlayback() {
  element("play").addEventListener("click", toggle);
  element("restart").addEventListener("click", () => player.restart());
  for (const radio of document.getElementsByName("speed")) {
    radio.addEventListener("change", () => (player.speed = Number(radio.value)));
  }
  element("rate").addEventListener("input", () => {
    if (isRateRight()) say(null);
    else if (player.isPlaying) play();
  });
  document.addEventListener("keydown", (event) => {
    const isTaken = event.target.closest("button, input:not([type=range])");
    if (event.key !== " " || isTaken) return;
    event.preventDefault(); // a space would scroll
    toggle();
  });
}

function connectFiles(scope) {
  const open = async (file) => {
    if (!file) return;
    try {
      await take(await file.arrayBuffer(), file.name, false, scope);
    } catch (error) {
      say(error);
    }
  };
  element("file").addEventListener("change", ({ target }) => {
    open(target.files[0]);
    target.value = ""; // so that the same file can be chosen again
  });
  const mark = (isOver) => document.body.classList.toggle("dropping", isOver);
  document.addEventListener("dragover", () => mark(true));
  document.addEventListener("dragleave", ({ relatedTarget }) => mark(relatedTarget !== null));
  document.addEventListener("drop", ({ dataTransfer }) => {
    mark(false);
    open(dataTransfer.files[0]);
  });
  element("file").disabled = false;
}

/** Returns whether the slider has moved and nothing was scored with it yet. */
function connectThreshold(facts) {
  const scale = thresholdScale(facts);
  const slider = element("threshold");
  const own = Math.round(scale.own * slider.max);
  let waiting = 0;
  const show = () => {
    const share = slider.value / slider.max;
    const text = Number(slider.value) === own ? scale.ownText : scale.text(share);
    element("threshold-value").textContent = text;
    slider.setAttribute("aria-valuetext", text);
  };
  const move = () => {
    const isOwn = Number(slider.value) === own;
    player.stream.threshold = isOwn ? null : scale.toThreshold(slider.value / slider.max);
    show();
    document.body.ariaBusy = "true"; // until frames have caught up
    clearTimeout(waiting);
    waiting = setTimeout(() => {
      waiting = 0;
      player.scoreAgain();
    }, AGAIN_MS);
  };
  element("threshold-title").textContent = scale.title;
  element("threshold-note").textContent = scale.note;
  element("threshold-low").textContent = scale.text(0);
  element("threshold-high").textContent = scale.text(1);
  element("own").style.setProperty("--share", own / slider.max);
  slider.value = own;
  show();
  slider.addEventListener("input", move);
  element("reset").addEventListener("click", () => {
    slider.value = own;
    move();
  });
  for (const each of [slider, element("reset")]) each.disabled = false;
  return () => waiting !== 0;
}

/** Play, draw and report with every frame of the screen. */
function run(scope, isWaiting) {
  const { facts } = player.stream;
  let last = performance.now();
  const frame = async (now) => {
    const seconds = Math.min(now - last, 100) / 1000; // a tab that slept goes on where it was
    last = now;
    try {
      await player.advance(seconds);
    } catch (error) {
      player.isPlaying = false;
      say(error);
    }
    scope.draw(player, player.stream.threshold ?? facts.threshold ?? Infinity);
    report(player, facts.sample_rate_hz);
    document.body.ariaBusy = String(isWaiting() || player.isCatchingUp);
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

/** Everything decided so far, as the other hosts print it. */
export function decisionLines() {
  const { history, stream, fed } = player;
  const { precision, sample_rate_hz: rate } = stream.facts;
  const lines = [];
  for (let i = 0; i < history.count; i += 1) {
    lines.push(decisionLine(history.decision(i), precision, true));
  }
  return [...lines, summaryLine(history.count, history.alarms.length, fed / rate)];
}

for (const name of ["dragover", "drop"]) {
  // what is dropped does not replace the page, even where there is no detector
  document.addEventListener(name, (event) => event.preventDefault());
}

try {
  const given = await (await fetched("/given.json", "what was given")).json();
  player = new Player(await loadStream(given));
  const { facts } = player.stream;
  const scope = new Scope(element("scope"), facts);
  describe(facts, given);
  describeSimulated(facts, given.simulated);
  connectPlayback();
  connectFiles(scope);
  const isWaiting = connectThreshold(facts);
  new ResizeObserver(() => scope.resize()).observe(element("scope"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => scope.restyle());
  if (given.recording) await takeGiven(given, scope).catch(say);
  run(scope, isWaiting);
} catch (error) {
  element("model").textContent = "no detector";
  say(error);
}
