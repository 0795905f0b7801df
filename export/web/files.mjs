// Recordings in files: .npy arrays, and .npz and .csv in the layouts that the package writes.

import { npyArray, npyVolts, TYPES } from "../node/npy.mjs";

const FORM = "tactslip_torch recording 1";
const TIME = /^(time|time_s|t|t_s|timestamp|timestamp_s)$/i;
const WORDS = { "": NaN, nan: NaN, inf: Infinity, "-inf": -Infinity };

/**
 * Read a recording for a detector.
 *
 * @param {ArrayBuffer} content of the file
 * @param {string} name of the file; by its ending it is read
 * @param {object} facts of the detector's sidecar
 * @returns {Promise<{name: string, volts: Float32Array|Float64Array, rows: number, onsetsS: number[],
 *   rate: ?number, isSimulated: boolean}>} samples row by row in the detector's order of channels;
 *   moments of slip, if known; the rate is null where the file states none
 * @throws {Error} in one line, if it is damaged or not of this hand, rate or unit
 */
export async function readRecording(content, name, facts) {
  const ending = name.toLowerCase().split(".").at(-1);
  const read = { npy: fromNpy, npz: fromNpz, csv: fromText, tsv: fromText, txt: fromText }[ending];
  if (!read) throw new Error(`${name} is no recording: wanted a .npy, .npz or .csv file`);
  const { header, ...samples } = await read(content, name, facts);
  const { channels, sample_rate_hz: wanted, unit = "V" } = facts;
  const { sample_rate_hz: rate = null, units = unit } = header;
  if (samples.volts.length === 0) throw new Error(`${name} holds no samples`);
  if (rate !== null && Math.abs(rate / wanted - 1) > 1e-5) {
    throw new Error(
      `${name} has ${rate} samples a second, the detector wants ${wanted}: resample it, or train ` +
        "a detector for that rate",
    );
  }
  if (units !== unit) {
    throw new Error(`${name} is in ${units}, the detector wants ${unit}: convert it`);
  }
  return {
    name,
    ...samples,
    rows: samples.volts.length / channels.length,
    onsetsS: header.onsets_s ?? [],
    rate,
    isSimulated: header.provenance?.simulated === true,
  };
}

/** For each channel of the detector its place among those of the file. */
function places(names, num, name, { channels }) {
  if (num !== channels.length) {
    const range = `${channels[0]} to ${channels.at(-1)}`;
    const wanted = `the detector wants ${channels.length}, ${range}`;
    throw new Error(`${name} has ${num} channels, ${wanted}: choose a recording of this hand`);
  }
  if (!names) return channels.map((_, i) => i);
  const missing = channels.find((channel) => !names.includes(channel));
  if (missing === undefined) return channels.map((channel) => names.indexOf(channel));
  throw new Error(
    `${name} has no channel ${missing}, but ${names.slice(0, 3).join(", ")} ...: name its columns ` +
      "as the detector does",
  );
}

function fromNpy(content, name, { channels }) {
  return { volts: npyVolts(content, name, channels), header: {} };
}

// Text --------------------------------------------------------------------------------------------

/** A table: of ours with a header in its first line; of others with a line of names, or without. */
function fromText(content, name, facts) {
  const lines = new TextDecoder().decode(content).split(/\r?\n/);
  const header = textHeader(lines[0], name);
  const first = lines.findIndex((line) => line.trim() && !line.startsWith("#"));
  if (first < 0) throw new Error(`${name} holds no row of numbers`);
  const mark = ["\t", ";", ","].find((each) => lines[first].includes(each)) ?? ",";
  const head = lines[first].split(mark).map((cell) => cell.trim().replace(/^"(.*)"$/, "$1"));
  const names = head.some((cell) => number(cell) === undefined) ? head : null;
  const isTimed = names !== null && TIME.test(names[0]);
  const skipped = Number(isTimed);
  const from = places(names?.slice(skipped), head.length - skipped, name, facts);
  const times = [];
  const volts = [];
  for (let i = first + Number(names !== null); i < lines.length; i += 1) {
    if (!lines[i].trim() || lines[i].startsWith("#")) continue;
    const cells = lines[i].split(mark);
    const wrong = (what) => new Error(`${name} is wrong in line ${i + 1}: ${what}`);
    if (cells.length !== head.length) {
      throw wrong(`${cells.length} cells, wanted ${head.length}; mend the line or take it out`);
    }
    const row = cells.map(number);
    const bad = row.indexOf(undefined);
    if (bad >= 0) {
      throw wrong(`"${cells[bad].slice(0, 40)}" is no number; leave empty what is missing`);
    }
    if (isTimed) times.push(row[0]);
    for (const place of from) volts.push(row[place + skipped]);
  }
  const rows = volts.length / from.length;
  if (header.shape && header.shape[1] !== rows) {
    throw new Error(`${name} is cut off: ${rows} rows of ${header.shape[1]}; copy it again`);
  }
  if (isTimed) header.sample_rate_hz ??= rateOf(times, name);
  return { volts: Float64Array.from(volts), header };
}

function textHeader(line, name) {
  if (!line.startsWith("# tactslip_torch recording")) return {};
  try {
    if (line.startsWith(`# ${FORM} `)) return JSON.parse(line.slice(FORM.length + 2));
  } catch {
    // said below
  }
  throw new Error(`${name} has a damaged header, or one of another version: write it again`);
}

/** A number, NaN for what is missing, or undefined. */
function number(cell) {
  const text = cell.trim();
  const value = Number(text);
  if (text && !Number.isNaN(value)) return value;
  return WORDS[text.toLowerCase()];
}

/** Samples a second, by evenly spaced times in seconds; a round number that they are close to. */
function rateOf(times, name) {
  if (times.length < 2) return undefined;
  const step = (times.at(-1) - times[0]) / (times.length - 1);
  const isEven = times.every(
    (time, i) => i === 0 || Math.abs(time - times[i - 1] - step) < step / 2,
  );
  if (!(step > 0) || !isEven) {
    throw new Error(`${name} has times that are not evenly spaced: resample it`);
  }
  const rate = 1 / step;
  const round = Math.round(rate);
  return Math.abs(rate / round - 1) < 1e-5 ? round : rate;
}

// Archives ----------------------------------------------------------------------------------------

/** `samples` [channels, samples] and what else the archive says. */
async function fromNpz(content, name, facts) {
  let header;
  let samples;
  try {
    const members = zipMembers(new DataView(content));
    const word = async (key) =>
      members.has(key) && value(await unpacked(content, members.get(key)));
    const form = await word("format");
    if (form && form !== FORM) throw new Error(`its format is "${form}", wanted "${FORM}"`);
    if (!members.has("samples")) throw new Error("no array is called samples");
    samples = await unpacked(content, members.get("samples"));
    header = {
      sample_rate_hz: (await word("sample_rate_hz")) || undefined,
      units: (await word("units")) || undefined,
      onsets_s: (await word("onsets_s")) || undefined,
      names: (await word("channel_name")) || undefined,
      provenance: JSON.parse((await word("provenance")) || "{}"),
    };
  } catch (error) {
    throw new Error(
      `${name} is damaged or no recording (${error.message}): copy it again, or save it with ` +
        "tactslip_torch",
    );
  }
  const { type, shape, isFortran, data } = samples;
  const Type = TYPES[type];
  if (!Type || shape.length !== 2) {
    const wanted = "samples in float32 or float64 [channels, samples]";
    throw new Error(`${name} holds ${type} [${shape.join(", ")}], wanted ${wanted}`);
  }
  const [width, rows] = shape;
  const from = places(header.names, width, name, facts);
  const values = new Type(data);
  const volts = new Type(values.length);
  const [perChannel, perRow] = isFortran ? [1, width] : [rows, 1];
  from.forEach((place, channel) => {
    for (let row = 0; row < rows; row += 1) {
      volts[row * width + channel] = values[place * perChannel + row * perRow];
    }
  });
  return { volts, header };
}

/** Where the members of a ZIP archive lie, by name without ending. */
function zipMembers(view) {
  let at = view.byteLength - 22;
  while (at >= 0 && view.getUint32(at, true) !== 0x06054b50) at -= 1; // end of the directory
  if (at < 0) throw new Error("its end is missing");
  const members = new Map();
  let entry = view.getUint32(at + 16, true);
  for (let left = view.getUint16(at + 10, true); left > 0; left -= 1) {
    const [name, extra, comment] = [28, 30, 32].map((place) => view.getUint16(entry + place, true));
    const bytes = new Uint8Array(view.buffer, entry + 46, name);
    const local = view.getUint32(entry + 42, true);
    const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    members.set(new TextDecoder().decode(bytes).replace(/\.npy$/, ""), {
      isPacked: view.getUint16(entry + 10, true) !== 0,
      sum: view.getUint32(entry + 16, true),
      start,
      end: start + view.getUint32(entry + 20, true),
      size: view.getUint32(entry + 24, true),
    });
    entry += 46 + name + extra + comment;
  }
  return members;
}

/** The array of a member, its check sum checked: shape, type and the bytes of its elements. */
async function unpacked(content, { isPacked, sum, start, end, size }) {
  let packed = new Blob([content.slice(start, end)]).stream();
  if (isPacked) packed = packed.pipeThrough(new DecompressionStream("deflate-raw"));
  const bytes = new Uint8Array(await new Response(packed).arrayBuffer());
  if (bytes.length !== size || crc32(bytes) !== sum) throw new Error("a check sum is wrong");
  const array = npyArray(bytes.subarray(0, 4096), "a member");
  return { ...array, data: bytes.buffer.slice(array.offset) };
}

/** Text, a number, or a list of either. */
function value({ type, shape, data }) {
  if (TYPES[type]) {
    const numbers = Array.from(new TYPES[type](data));
    return shape.length ? numbers : numbers[0];
  }
  const length = Number(/^<U(\d+)$/.exec(type)?.[1]);
  if (!length) throw new Error(`${type} where words or numbers were wanted`);
  const points = new Uint32Array(data);
  const words = [];
  for (let at = 0; at < points.length; at += length) {
    const word = Array.from(points.subarray(at, at + length), (point) =>
      String.fromCodePoint(point),
    );
    words.push(word.join("").replace(/\0+$/, ""));
  }
  return shape.length ? words : words[0];
}

const CRC = Uint32Array.from({ length: 256 }, (_, i) => {
  for (let bit = 0; bit < 8; bit += 1) i = i & 1 ? (i >>> 1) ^ 0xedb88320 : i >>> 1;
  return i;
});

function crc32(bytes) {
  let sum = -1;
  for (const byte of bytes) sum = CRC[(sum ^ byte) & 255] ^ (sum >>> 8);
  return (sum ^ -1) >>> 0;
}
