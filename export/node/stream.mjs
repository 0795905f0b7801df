// SlipStream: a slip detector in a Node program.
//
//     const stream = await SlipStream.open("stream.onnx");
//     for await (const volts of hand) {
//       for (const decision of await stream.push(volts)) if (decision.alarm) stop(decision);
//     }

import { webcrypto } from "node:crypto";
import { readFile } from "node:fs/promises";
import { basename } from "node:path";

import { StreamGraph } from "./graph.mjs";

globalThis.crypto ??= webcrypto; // Node 18 has it under this name alone

/** `StreamGraph` in Node: what it takes, gives and raises stands there. */
export class SlipStream extends StreamGraph {
  /**
   * Load a model, once it is known to be the one that the sidecar beside it describes.
   *
   * @param {string} path of stream.onnx; stream.onnx.json lies beside it
   * @throws {Error} in one line, if a file is missing or the model is not what it should be
   */
  static async open(path) {
    const ort = await import("onnxruntime-node").catch(() => {
      throw new Error("onnxruntime-node is not installed: run npm ci in export/node");
    });
    const model = await readFile(path).catch(() => {
      throw new Error(`cannot read the model ${path}: export one with graph=stream`);
    });
    const sidecar = await readFile(`${path}.json`, "utf8").catch(() => {
      throw new Error(`cannot read ${path}.json, which lies beside the model: copy both`);
    });
    return this.load(ort.default, model, sidecar, basename(path));
  }
}
