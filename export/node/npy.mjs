// Recordings as NumPy keeps them: volts [samples, channels] in a .npy file.

const LAST_VERSION = 3;
const MAGIC = "\x93NUMPY";
export const TYPES = { "<f4": Float32Array, "<f8": Float64Array };
const CUT = (name) => `${name} is cut off within its header: copy it again`;
export const HEADER_BYTES = 4096; // enough for any array of numbers

/**
 * What an array in a .npy file is, from its first bytes.
 *
 * @param {Uint8Array} head the first `HEADER_BYTES`, or all there are
 * @param {string} name of the file, for errors
 * @returns {{type: ?string, isFortran: boolean, shape: number[], offset: number}} NumPy's word for
 *   the type of an element, and where the first one lies
 * @throws {Error} if it is no .npy, or its header is cut off or of no known form
 */
export function npyArray(head, name) {
  const { text, offset } = headerText(head, name);
  const type = /'descr': *'([^']*)'/.exec(text)?.[1];
  const order = /'fortran_order': *(True|False)/.exec(text)?.[1];
  const shape = /'shape': *\(([\d, ]*)\)/.exec(text)?.[1];
  if (order === undefined || shape === undefined) {
    throw new Error(`${name} has a .npy header of no known form: save it again with numpy.save`);
  }
  const sizes = shape.split(",").filter((part) => part.trim());
  return { type, isFortran: order === "True", shape: sizes.map(Number), offset };
}

/**
 * The same of a recording, volts [samples, channels], row by row.
 *
 * @param {number} bytes length of the file
 * @param {string[]} channels that the detector wants
 * @returns {{Type: Function, rows: number, offset: number}}
 * @throws {Error} as `npyArray`, or if it is cut off, of another type or order, or of another hand
 */
export function npyHeader(head, bytes, name, channels) {
  const { type, isFortran, shape, offset } = npyArray(head, name);
  const Type = TYPES[type];
  if (!Type) {
    throw new Error(
      `${name} holds ${type ?? "records"}, wanted volts in little-endian float32 or float64: ` +
        "save it with .astype('<f4')",
    );
  }
  if (shape.length !== 2 || shape[1] !== channels.length) {
    throw new Error(
      `${name} has shape (${shape.join(", ")}), wanted (samples, ${channels.length}): a row an ` +
        `instant, channels ${channels[0]} to ${channels.at(-1)}`,
    );
  }
  if (isFortran && shape[0] > 1) {
    throw new Error(`${name} is in Fortran order, wanted C order: numpy.ascontiguousarray`);
  }
  const wanted = offset + shape[0] * shape[1] * Type.BYTES_PER_ELEMENT;
  if (bytes < wanted) {
    throw new Error(`${name} is cut off: ${bytes} bytes of ${wanted}; copy it again`);
  }
  return { Type, rows: shape[0], offset };
}

function headerText(head, name) {
  const isNpy = latin1(head.subarray(0, MAGIC.length)) === MAGIC;
  if (!isNpy) throw new Error(`${name} is no .npy file: write it with numpy.save`);
  const isLong = head[6] !== 1; // later versions have four bytes for the length of the header
  const start = isLong ? 12 : 10;
  if (head.length < start) throw new Error(CUT(name));
  if (head[6] < 1 || head[6] > LAST_VERSION) {
    throw new Error(
      `${name} has .npy version ${head[6]}, wanted 1 to ${LAST_VERSION}: save it with numpy.save`,
    );
  }
  const view = new DataView(head.buffer, head.byteOffset, head.byteLength);
  const end = start + (isLong ? view.getUint32(8, true) : view.getUint16(8, true));
  if (end > head.length) throw new Error(CUT(name));
  return { text: latin1(head.subarray(start, end)), offset: end };
}

function latin1(bytes) {
  return String.fromCharCode(...bytes);
}

/**
 * All volts of a file in memory, `rows` times channels.
 *
 * @param {ArrayBuffer} content of the file
 * @throws {Error} as `npyHeader`
 */
export function npyVolts(content, name, channels) {
  const head = new Uint8Array(content, 0, Math.min(HEADER_BYTES, content.byteLength));
  const { Type, rows, offset } = npyHeader(head, content.byteLength, name, channels);
  const num = rows * channels.length;
  if (offset % Type.BYTES_PER_ELEMENT === 0) return new Type(content, offset, num);
  return new Type(content.slice(offset, offset + num * Type.BYTES_PER_ELEMENT));
}
