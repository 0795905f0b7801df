// A recording on disk, piece by piece: an hour of it needs no more memory than a second.

import { open } from "node:fs/promises";
import { basename } from "node:path";

import { HEADER_BYTES, npyHeader } from "./npy.mjs";

/**
 * Volts of a .npy file, `rows` instants at a time.
 *
 * @param {string} path of the file
 * @param {string[]} channels that the detector wants
 * @param {number} rows of a piece; the last one may have fewer
 * @throws {Error} in one line, as `npyHeader`, or if the file cannot be read
 */
export async function* pieces(path, channels, rows) {
  const name = basename(path);
  const file = await open(path).catch(() => {
    throw new Error(`cannot read the recording ${path}: does it exist?`);
  });
  try {
    const about = await file.stat();
    if (!about.isFile()) throw new Error(`${path} is no file: write a .npy with numpy.save`);
    const bytes = about.size;
    const head = await filled(file, new Uint8Array(Math.min(HEADER_BYTES, bytes)), 0, name);
    const { Type, rows: total, offset } = npyHeader(head, bytes, name, channels);
    let position = offset;
    for (let done = 0; done < total; done += rows) {
      const volts = new Type(Math.min(rows, total - done) * channels.length);
      await filled(file, new Uint8Array(volts.buffer), position, name);
      position += volts.byteLength;
      yield volts;
    }
  } finally {
    await file.close();
  }
}

async function filled(file, into, position, name) {
  for (let done = 0; done < into.length;) {
    const { bytesRead } = await file.read(into, done, into.length - done, position + done);
    if (bytesRead === 0) throw new Error(`${name} is cut off: it shrank while it was read`);
    done += bytesRead;
  }
  return into;
}
