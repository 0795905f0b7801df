// The page: a recording played through the detector in this browser, or a live stream of a server;
// with every frame of the screen it draws and reports.

import { explain, thresholdScale } from "./alarm.mjs";
import { Live } from "./live.mjs";
import { Overview } from "./overview.mjs";
import { Scope } from "./scope.mjs";

const AGAIN_MS = 150; // the slider rests for so long before all is scored again
const LIVE_MS = 30; // a live stream is drawn no more often
const SHOWN_S = 1; // of what follows an alarm that is looked up
const element = (id) => document.getElementById(id);
let source = null;

/** One line about what went wrong, or none. */
function say(problem) {
  const line = problem instanceof Error ? problem.message.replace(/\s*\n\s*/g, "; ") : problem;
  element("alert").textContent = line ?? "";
  element("alert").hidden = !line;
}

/** Only what changed is written. */
function write(id, text) {
  const target = element(id);
  if (target.textContent !== text) target.textContent = text;
}

// Loading -----------------------------------------------------------------------------------------

/** What the server has: a live stream, or a detector and perhaps a recording. */
async function opened() {
  const answer = await fetch(`live.json${location.search}`);
  if (answer.ok) {
    const told = await answer.json();
    if (told.token_needed && !new URLSearchParams(location.search).has("token")) {
      throw new Error("this page needs a token: open the address that tactslip stream prints");
    }
    write("model", "waiting for tactslip stream");
    return Live.open(told.socket, say).finally(() => say(null));
  }
  if (answer.status !== 404) {
    throw new Error(`the server refuses (${answer.status}): open the address that it prints`);
  }
  // onnxruntime-web is loaded by this alone
  const { Recorded, fetched } = await import("./recorded.mjs");
  const given = await (await fetched("given.json", "what was given")).json();
  const recorded = await Recorded.open(given);
  if (given.recording) {
    const response = await fetched("recording", given.recording);
    await recorded
      .take(await response.arrayBuffer(), given.recording)
      .then(() => (recorded.recording.isSimulated ||= given.simulated))
      .catch(say);
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) recorded.isPlaying = false;
  }
  return recorded;
}

/** Facts of the detector, once. */
function describe({ facts, isLive }) {
  const hop = facts.onset_hop_samples ?? facts.hop_samples;
  const perSecond = Math.round(facts.sample_rate_hz / hop);
  const aheadMs = (1000 * facts.context_after_samples) / facts.sample_rate_hz;
  const parts = [
    facts.file
      ? `${facts.file}, ${Math.round(facts.onnx_bytes / 1000)} kB, ${facts.precision}`
      : null,
    `${facts.channels.length} channels at ${facts.sample_rate_hz} Hz`,
    `${perSecond} decisions a second, ${Number(aheadMs.toPrecision(3))} ms look-ahead`,
    facts.train_materials?.length ? `trained on ${facts.train_materials.join(", ")}` : null,
  ];
  write("model", parts.filter(Boolean).join(" · "));
  write("explanation", explain(facts));
  element("by").hidden = facts.onset_hop_samples === undefined;
  for (const each of document.querySelectorAll(".of-recorded")) each.hidden = isLive;
  for (const each of document.querySelectorAll(".of-live")) each.hidden = !isLive;
  for (const id of ["play", "restart", "file", "seek"]) element(id).disabled = false;
}

// Controls ----------------------------------------------------------------------------------------

function connectPlayback() {
  element("play").addEventListener("click", () => source.toggle());
  element("restart").addEventListener("click", () => source.seek(0));
  for (const radio of document.getElementsByName("speed")) {
    radio.addEventListener("change", () => (source.speed = Number(radio.value)));
  }
  document.addEventListener("keydown", (event) => {
    const isTaken = event.target.closest("button, input:not([type=range])");
    if (event.key !== " " || isTaken) return;
    event.preventDefault(); // a space would scroll
    source.toggle();
  });
  element("list").addEventListener("click", ({ target }) => {
    const timeS = Number(target.dataset.timeS);
    if (!target.dataset.timeS) return;
    source.isPlaying = false;
    source.seek(Math.min(source.samples.end - 1, (timeS + SHOWN_S) * source.facts.sample_rate_hz));
  });
}

function connectFiles() {
  const open = async (file) => {
    if (!file) return;
    say(null);
    try {
      await source.take(await file.arrayBuffer(), file.name);
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
}

/** Returns whether the slider has moved and nothing was scored with it yet. */
function connectThreshold() {
  const scale = thresholdScale(source.facts);
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
    show();
    document.body.dataset.busy = "true"; // for tests: until all is scored again
    clearTimeout(waiting);
    waiting = setTimeout(() => {
      waiting = 0;
      const isOwn = Number(slider.value) === own;
      source.setThreshold(isOwn ? null : scale.toThreshold(slider.value / slider.max));
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

// Numbers -----------------------------------------------------------------------------------------

/** The status at the position, and counts of all that was decided. */
function report() {
  const { facts, history, position, recording, isPlaying, isLive } = source;
  const now = history.before(position / facts.sample_rate_hz);
  const isKnown = now >= history.first;
  const isDoubtful = isKnown && history.isDoubtful(now);
  const rest = isDoubtful ? "not valid" : "no slip";
  const status = !isKnown ? "waiting" : history.isOn(now) ? "slip" : rest;
  const box = element("status");
  if (box.dataset.status !== status) box.dataset.status = status;
  box.classList.toggle("doubtful", isDoubtful);
  write("status-word", status);
  write("probability", isKnown ? digits(history.get("probability", now)) : "–");
  write("channels", isKnown ? channelsText(now) : "–");
  element("channels").classList.toggle("doubtful", isKnown && !history.isInRange(now));
  write("alarms", history.numAlarms.toLocaleString("en"));
  write("decisions", history.count.toLocaleString("en"));
  write("invalid", history.numInvalid.toLocaleString("en"));
  write("position", positionText());
  const paused = isLive ? "Follow" : source.isAtEnd ? "Play again" : "Play";
  write("play-label", isPlaying ? "Pause" : paused);
  const simulated = [
    recording?.isSimulated ? (isLive ? "samples" : "recording") : null,
    facts.simulated ? "training data" : null,
  ].filter(Boolean);
  write("simulated", simulated.length ? `simulated: ${simulated.join(" and ")}` : "");
  element("simulated").hidden = simulated.length === 0;
  element("truth").hidden = !recording?.onsetsS.length;
  if (isLive) reportStream(source.status);
  else reportLatencies(source.latencies);
  listAlarms(history);
  return status;
}

/** What a decision says of its channels. */
function channelsText(i) {
  const { history, facts } = source;
  const names = facts.channels.filter((_, channel) => history.isLost(i, channel));
  const all = names.length === facts.channels.length ? "all channels" : names.join(", ");
  const isFar = !history.isDoubtful(i) && !history.isInRange(i);
  const parts = [
    names.length ? `lost: ${all}` : "no channel lost",
    history.isDoubtful(i) ? "too few channels are alive" : null,
    isFar ? "levels far from training" : null,
  ];
  return parts.filter(Boolean).join("; ");
}

/** Two digits of a probability, or a dash where there is none. */
function digits(probability) {
  return Number.isFinite(probability) ? probability.toFixed(2) : "–";
}

function positionText() {
  const { recording, facts, position, samples, progress, isLive } = source;
  if (recording === null) return "no recording";
  const [now, end] = [position, samples.end].map((row) => (row / facts.sample_rate_hz).toFixed(1));
  const rate =
    isLive || recording.rate ? "" : ` (no rate in the file: taken as ${facts.sample_rate_hz} Hz)`;
  const scored = progress < 1 ? `, ${Math.floor(100 * progress)} % scored` : "";
  return `${recording.name}: ${now} of ${end} s${scored}${rate}`;
}

function reportLatencies(latencies) {
  const sorted = [...latencies].sort((a, b) => a - b);
  const at = (share) => sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
  const shown = { last: latencies.at(-1), median: at(0.5), p99: at(0.99) };
  for (const [name, ms] of Object.entries(shown)) write(`latency-${name}`, ms?.toFixed(1) ?? "–");
}

function reportStream({ state, text, ...counts }) {
  const box = element("stream");
  if (box.dataset.state !== state) box.dataset.state = state;
  write("stream-state", state);
  write("stream-text", text ?? "");
  for (const name of ["received", "dropped", "dropped_to_page"]) {
    write(name, (counts[name] ?? 0).toLocaleString("en"));
  }
}

/** A row for each alarm, each with a button that shows it; the newest first. */
function listAlarms(history) {
  const list = element("list");
  const { alarms } = history;
  if (list.history !== history) {
    list.replaceChildren();
    list.history = history;
    list.next = 0;
  }
  const rows = element("rows");
  const isAtTop = rows.scrollTop === 0;
  while (alarms.length && list.lastChild && Number(list.lastChild.dataset.index) < alarms[0]) {
    list.lastChild.remove(); // it is kept no longer
  }
  const fresh = alarms.filter((i) => i >= list.next);
  if (fresh.length === 0) return;
  list.next = fresh.at(-1) + 1;
  list.prepend(...fresh.reverse().map((i) => alarmRow(history.decision(i), i)));
  if (isAtTop) rows.scrollTop = 0;
}

function alarmRow({ time_s: alarmS, onset_s: onsetS, probability, raised_by: by }, index) {
  const row = document.createElement("tr");
  row.dataset.index = index;
  const button = document.createElement("button");
  button.textContent = `${alarmS.toFixed(3)} s`;
  button.setAttribute("aria-label", `show the alarm at ${alarmS.toFixed(3)} s`);
  button.dataset.timeS = alarmS;
  row.insertCell().append(button);
  for (const text of [`${onsetS.toFixed(3)} s`, digits(probability), ...(by ? [by] : [])]) {
    row.insertCell().textContent = text;
  }
  return row;
}

// Running -----------------------------------------------------------------------------------------

function run(scope, overview, isWaiting) {
  let last = performance.now();
  const frame = async (now) => {
    if (source.isLive && now - last < LIVE_MS) return requestAnimationFrame(frame);
    const seconds = Math.min(now - last, 100) / 1000; // a tab that slept goes on where it was
    last = now;
    try {
      await source.advance(seconds);
    } catch (error) {
      source.isPlaying = false;
      say(error);
    }
    scope.draw();
    overview.draw(report());
    if (isWaiting() || source.progress < 1) document.body.dataset.busy = "true";
    else delete document.body.dataset.busy;
    return requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

/** For tests: all that the page holds, decisions as `StreamGraph.push` gives them. */
export function held() {
  const { history, samples, facts } = source;
  const decisions = [];
  for (let i = history.first; i < history.count; i += 1) decisions.push(history.decision(i));
  const { first, end, numMissing, values, width, capacity } = samples;
  const at = ((end + capacity - 1) % capacity) * width;
  const last = Array.from(values.subarray(at, at + width));
  return { decisions, first, end, numMissing, last, facts };
}

for (const name of ["dragover", "drop"]) {
  // what is dropped does not replace the page, even where there is no detector
  document.addEventListener(name, (event) => event.preventDefault());
}

try {
  source = await opened();
  describe(source);
  const scope = new Scope(element("scope"), source);
  const overview = new Overview(element("overview"), source);
  connectPlayback();
  if (!source.isLive) connectFiles();
  const isWaiting = source.isLive ? () => false : connectThreshold();
  new ResizeObserver(() => scope.resize()).observe(element("scope"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    scope.restyle();
    overview.restyle();
  });
  run(scope, overview, isWaiting);
} catch (error) {
  write("model", "no detector");
  say(error);
}
