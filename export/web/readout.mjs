// Numbers beside the picture. Only what changed is written.

const LISTED = 6; // alarms
const element = (id) => document.getElementById(id);

function write(id, text) {
  const target = element(id);
  if (target.textContent !== text) target.textContent = text;
}

/** Facts of the detector, once. */
export function describe(facts, given) {
  const hop = facts.onset_hop_samples ?? facts.hop_samples;
  const perSecond = Math.round(facts.sample_rate_hz / hop);
  element("by").hidden = facts.onset_hop_samples === undefined;
  const kilobytes = Math.round(facts.onnx_bytes / 1000);
  const aheadMs = (1000 * facts.context_after_samples) / facts.sample_rate_hz;
  const parts = [
    `${given.model}, ${kilobytes} kB, ${facts.precision}`,
    `${facts.channels.length} channels at ${facts.sample_rate_hz} Hz`,
    `${perSecond} decisions a second, ${Number(aheadMs.toPrecision(3))} ms look-ahead`,
    facts.train_materials?.length ? `trained on ${facts.train_materials.join(", ")}` : null,
  ];
  write("model", parts.filter(Boolean).join(" · "));
}

/** What of all this is simulated. */
export function describeSimulated(facts, isRecordingSimulated) {
  const what = [
    isRecordingSimulated ? "recording" : null,
    facts.simulated ? "training data" : null,
  ].filter(Boolean);
  write("simulated", what.length ? `simulated: ${what.join(" and ")}` : "");
  element("simulated").hidden = what.length === 0;
}

/** Counts, latencies, status and the last alarms of a player. */
export function report(player, rate) {
  const { history, recording } = player;
  const last = history.count - 1;
  const status = last < 0 ? "waiting" : history.isOn(last) ? "slip" : "no slip";
  const box = element("status");
  if (box.dataset.status !== status) box.dataset.status = status;
  write("status-word", status);
  write("probability", last < 0 ? "–" : history.columns.probability[last].toFixed(2));
  write("alarms", String(history.alarms.length));
  write("decisions", history.count.toLocaleString("en"));
  write("invalid", history.numInvalid.toLocaleString("en"));
  box.classList.toggle("doubtful", last >= 0 && history.isDoubtful(last));
  const rows = recording?.rows ?? 0;
  element("progress").value = rows ? player.position / rows : 0;
  const seconds = (samples) => (samples / rate).toFixed(1);
  write("position", recording ? positionText(player, recording, seconds) : "no recording");
  write("play-label", player.isPlaying ? "Pause" : player.isAtEnd ? "Play again" : "Play");
  reportLatencies(player.latencies);
  listAlarms(history);
}

function positionText(player, recording, seconds) {
  const where = `${seconds(player.position)} of ${seconds(recording.rows)} s`;
  return `${recording.name}: ${player.isCatchingUp ? "scoring again" : where}`;
}

function reportLatencies(latencies) {
  const summary = latencies.summary();
  for (const name of ["last", "median", "p99"]) {
    write(`latency-${name}`, summary ? summary[name].toFixed(2) : "–");
  }
  write(
    "latency-note",
    summary ? `milliseconds, of the last ${summary.held} pushes` : "in milliseconds",
  );
}

function listAlarms(history) {
  const list = element("list");
  const key = `${history.alarms.length}/${history.alarms.at(-1) ?? ""}`;
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  const rows = history.alarms
    .slice(-LISTED)
    .reverse()
    .map((i) => {
      const decision = history.decision(i);
      const { time_s: alarmS, onset_s: onsetS, probability, valid } = decision;
      const row = document.createElement("tr");
      const texts = [`${alarmS.toFixed(3)} s`, `${onsetS.toFixed(3)} s`, probability.toFixed(2)];
      if (decision.raised_by) texts.push(decision.raised_by);
      for (const text of texts) row.insertCell().textContent = text;
      if (!valid) row.title = "not valid: a channel in use is dead or broken";
      row.classList.toggle("doubtful", !valid);
      return row;
    });
  list.replaceChildren(...rows);
}
