#!/usr/bin/env node
// The page on this machine: node serve.mjs [--model stream.onnx] [--recording recording.npz]

import { createReadStream, existsSync } from "node:fs";
import { access, stat } from "node:fs/promises";
import { createServer } from "node:http";
import { basename, extname } from "node:path";
import { fileURLToPath } from "node:url";
import { parseArgs } from "node:util";

const HERE = new URL("./", import.meta.url);
const ORT = "node_modules/onnxruntime-web/dist/";
const PAGE = {
  "/": "index.html",
  ...own("style.css", "page.mjs", "recorded.mjs", "live.mjs", "history.mjs", "files.mjs"),
  ...own("scope.mjs", "lanes.mjs", "overview.mjs", "alarm.mjs"),
  "/node/graph.mjs": "../node/graph.mjs",
  "/node/npy.mjs": "../node/npy.mjs",
  "/ort/ort.mjs": `${ORT}ort.wasm.bundle.min.mjs`,
  "/ort/ort.wasm": `${ORT}ort-wasm-simd-threaded.wasm`,
};
const SAMPLE = ["stream.onnx", "recording.npz"]; // which the package puts beside a copied page
const TYPES = {
  ".html": "text/html; charset=utf-8",
  ".css": "text/css; charset=utf-8",
  ".mjs": "text/javascript; charset=utf-8",
  ".json": "application/json",
  ".wasm": "application/wasm",
};
const HEADERS = {
  // the browser itself refuses whatever does not come from here
  "Content-Security-Policy":
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; " +
    "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'",
  // alone in its process the page gets a clock fine enough for the latency of a push
  "Cross-Origin-Opener-Policy": "same-origin",
  "Cross-Origin-Embedder-Policy": "require-corp",
  "Cache-Control": "no-cache",
  "X-Content-Type-Options": "nosniff",
};

function own(...names) {
  return Object.fromEntries(names.map((name) => [`/${name}`, name]));
}

/**
 * Serve the page to this machine alone.
 *
 * @param {{model: string, recording?: string, simulated?: boolean, port?: number}} given paths;
 *   whether the recording is simulated; port 0 is any that is free
 * @returns {Promise<{address: string, close: () => void}>}
 * @throws {Error} if onnxruntime-web or a file is missing, or the port is taken
 */
export async function serve({ model, recording, simulated = false, port = 0 }) {
  const told = {
    model: basename(model),
    recording: recording ? basename(recording) : null,
    simulated,
  };
  const files = { "/model": model, "/model.json": `${model}.json`, "/recording": recording };
  for (const [path, file] of Object.entries(PAGE)) files[path] = fileURLToPath(new URL(file, HERE));
  await access(files["/ort/ort.wasm"]).catch(() => {
    throw new Error("onnxruntime-web is not installed: run npm ci in export/web");
  });
  for (const path of [model, recording].filter(Boolean)) {
    await access(path).catch(() => {
      throw new Error(`cannot read ${path}: does it exist?`);
    });
  }
  const server = createServer((request, response) => answer(request, response, files, told));
  await new Promise((listening, failed) => {
    server.once("error", failed).listen(port, "127.0.0.1", listening);
  });
  return {
    address: `http://127.0.0.1:${server.address().port}/`,
    close: () => {
      server.close();
      server.closeAllConnections();
    },
  };
}

async function answer(request, response, files, told) {
  const path = request.url.split("?")[0];
  if (path === "/given.json") {
    response.writeHead(200, { ...HEADERS, "Content-Type": TYPES[".json"] });
    response.end(JSON.stringify(told));
    return;
  }
  const file = Object.hasOwn(files, path) ? files[path] : undefined;
  const size = file && (await stat(file).catch(() => null))?.size;
  if (size === undefined || !["GET", "HEAD"].includes(request.method)) {
    response.writeHead(404, HEADERS).end();
    return;
  }
  const type = TYPES[extname(file)] ?? "application/octet-stream";
  response.writeHead(200, { ...HEADERS, "Content-Type": type, "Content-Length": size });
  if (request.method === "HEAD") response.end();
  else
    createReadStream(file)
      .on("error", () => response.destroy())
      .pipe(response);
}

/** What the command line gives, `serve`'s argument. */
export function given(words, more = {}) {
  const { values } = parseArgs({
    args: words,
    options: {
      model: { type: "string" },
      recording: { type: "string" },
      simulated: { type: "boolean" },
      port: { type: "string", default: "0" },
      ...more,
    },
  });
  const [model, recording] = SAMPLE.map((name) => fileURLToPath(new URL(name, HERE)));
  if (!values.model && !existsSync(model)) {
    throw new Error(
      "wanted --model stream.onnx; tactslip hosts web DIR gives a page with a sample",
    );
  }
  if (!values.model) values.recording ??= recording;
  values.model ??= model;
  const port = Number(values.port);
  if (!Number.isInteger(port) || port < 0 || port > 65535) {
    throw new Error(`--port must be 0 to 65535, got ${values.port}`);
  }
  return { ...values, port };
}

/** Run a command; what goes wrong is one line and a status. */
export async function run(command) {
  try {
    await command();
  } catch (error) {
    const usage = error.code?.startsWith("ERR_PARSE_ARGS") || error.message.startsWith("wanted --");
    process.stderr.write(`error: ${error.message.replace(/\s*\n\s*/g, "; ")}\n`);
    process.exitCode = usage ? 2 : 1;
  }
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  await run(async () => {
    const { address } = await serve(given(process.argv.slice(2)));
    process.stdout.write(`${address}\n`);
  });
}
