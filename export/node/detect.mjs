#!/usr/bin/env node
// Slip alarms in a recording, as JSON lines: node detect.mjs stream.onnx recording.npy

import { once } from "node:events";

import { decisionLine, summaryLine } from "./lines.mjs";
import { pieces } from "./recording.mjs";
import { SlipStream } from "./stream.mjs";

const USAGE =
  "node detect.mjs stream.onnx recording.npy [--rate HZ] [--chunk N] [--threshold T] [--decisions]";
const MOST_ROWS = 2000;
const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i; // Number alone takes spaces and 0x10 too

class UsageError extends Error {}

/** What was asked for, from the words of the command line. */
function options(words) {
  const files = [];
  const asked = { chunk: 200, rate: null, threshold: null, decisions: false };
  for (let i = 0; i < words.length; i += 1) {
    const [name, inline] = words[i].split(/=(.*)/s);
    if (!name.startsWith("-")) files.push(words[i]);
    else if (name === "--decisions" && inline === undefined) asked.decisions = true;
    else if (["--rate", "--chunk", "--threshold"].includes(name)) {
      const read = name === "--chunk" ? chunk : number;
      asked[name.slice(2)] = read(name, inline ?? words[++i]);
    } else throw new UsageError(`unknown option ${words[i]}; usage: ${USAGE}`);
  }
  if (files.length !== 2) {
    throw new UsageError(`wanted two files, got ${files.length}; usage: ${USAGE}`);
  }
  return { ...asked, model: files[0], recording: files[1] };
}

function number(name, word) {
  const value = NUMBER.test(word) ? Number(word) : NaN;
  if (!Number.isFinite(value)) {
    throw new UsageError(`${name} wants a finite decimal number, got ${word ?? "nothing"}`);
  }
  return value;
}

function chunk(name, word) {
  const value = /^\d+$/.test(word) ? Number(word) : NaN;
  if (!(value >= 1 && value <= MOST_ROWS)) {
    throw new UsageError(`${name} wants 1 to ${MOST_ROWS} samples, got ${word ?? "nothing"}`);
  }
  return value;
}

/** Run the stream over the recording and print what it decides. */
async function detect({ model, recording, rate, chunk, threshold, decisions: isWhole }) {
  const stream = await SlipStream.open(model);
  const { channels, precision, sample_rate_hz: wanted } = stream.facts;
  const firstBinS = Math.max(stream.facts.first_samples, stream.facts.frame_samples) / wanted;
  if (rate !== null && rate !== wanted) {
    throw new Error(
      `the recording has ${rate} samples a second, the model wants ${wanted}: ` +
        "resample it, or train a detector for that rate",
    );
  }
  stream.threshold = threshold;
  const count = { samples: 0, decisions: 0, alarms: 0, invalid: 0 };
  let firstInvalid = null;
  for await (const volts of pieces(recording, channels, chunk)) {
    count.samples += volts.length / channels.length;
    let text = "";
    for (const decision of await stream.push(volts)) {
      count.decisions += 1;
      if (decision.alarm) count.alarms += 1;
      if (!decision.valid && decision.time_s >= firstBinS) {
        count.invalid += 1;
        firstInvalid ??= decision.time_s;
      }
      if (isWhole || decision.alarm) text += `${decisionLine(decision, precision, isWhole)}\n`;
    }
    if (text && !process.stdout.write(text)) await once(process.stdout, "drain");
  }
  process.stdout.write(`${summaryLine(count.decisions, count.alarms, count.samples / wanted)}\n`);
  if (count.invalid) {
    process.stderr.write(
      `warning: ${count.invalid} of ${count.decisions} decisions are not valid, the first at ` +
        `${firstInvalid.toFixed(3)} s: too few channels are alive\n`,
    );
  }
}

process.stdout.on("error", ({ code }) => {
  if (code === "EPIPE") process.exit(0); // whoever reads has seen enough
  process.stderr.write(`error: the output cannot be written (${code}); is the disk full?\n`);
  process.exit(1);
});
try {
  await detect(options(process.argv.slice(2)));
} catch (error) {
  process.stderr.write(`error: ${error.message.replace(/\s*\n\s*/g, "; ")}\n`);
  process.exitCode = error instanceof UsageError ? 2 : 1;
}
