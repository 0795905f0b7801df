#!/usr/bin/env node
// A picture of the page at the end of a recording, and its decisions as JSON lines:
// node shot.mjs --model stream.onnx --recording recording.npz --output page.png

import { mkdtemp, rename, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

import { decisionLine, summaryLine } from "../node/lines.mjs";
import { given, run, serve } from "./serve.mjs";

const OPTIONS = {
  output: { type: "string", default: "page.png" },
  width: { type: "string", default: "1280" },
  height: { type: "string", default: "800" },
  scale: { type: "string", default: "1" }, // device pixels of a CSS pixel
  scheme: { type: "string", default: "light" }, // or dark
};
const BROWSER = process.env.CHROMIUM ?? "/usr/bin/chromium";
const FLAGS = [
  "--no-sandbox", // containers have no namespaces for it
  "--disable-gpu",
  "--disable-quic",
  "--no-first-run",
  "--disable-background-networking",
  "--disable-component-update",
  "--disable-sync",
];

/**
 * Open a browser that nobody used before, do something with a page of it, close it.
 *
 * @param {{width: number, height: number, scheme: string, scale: number}} look of the page
 * @param {(page: object) => Promise<void>} work
 * @throws {Error} if playwright-core or the browser is missing
 */
export async function withPage({ width = 1280, height = 800, scheme = "light", scale = 1 }, work) {
  const { chromium } = await import("playwright-core").catch(() => {
    throw new Error("playwright-core is not installed: run npm ci in export/web");
  });
  const folder = await mkdtemp(join(tmpdir(), "tactslip-"));
  try {
    const context = await chromium.launchPersistentContext(folder, {
      executablePath: BROWSER,
      headless: true,
      args: FLAGS,
      viewport: { width, height },
      deviceScaleFactor: scale,
      colorScheme: scheme,
    });
    try {
      await work(context.pages()[0] ?? (await context.newPage()));
    } finally {
      await context.close();
    }
  } finally {
    await rm(folder, { recursive: true, force: true, maxRetries: 3 });
  }
}

/** Wait until the page has the detector and a recording. */
export async function ready(page) {
  await page.waitForFunction(() => {
    const problem = document.getElementById("alert");
    return !document.getElementById("play").disabled || !problem.hidden;
  });
  const problem = await page.locator("#alert").textContent();
  if (problem) throw new Error(problem);
}

/** Go to the end, once all is scored. */
export async function toEnd(page) {
  await page.waitForFunction(() => !document.body.dataset.busy);
  await page.locator("#seek").press("End");
  await page.locator("#seek").blur();
  await page.waitForFunction(() =>
    /Play again|Follow/.test(document.getElementById("play").innerText),
  );
}

/** All that the page holds: decisions, facts, and which samples. */
export function held(page) {
  return page.evaluate(async () => (await import("./page.mjs")).held());
}

/** Its decisions as the other hosts print them with --decisions. */
export async function decisionLines(page) {
  const { decisions, facts, end } = await held(page);
  const lines = decisions.map((decision) => decisionLine(decision, facts.precision, true));
  const numAlarms = decisions.filter(({ alarm }) => alarm).length;
  return [...lines, summaryLine(decisions.length, numAlarms, end / facts.sample_rate_hz)];
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  await run(async () => {
    const asked = given(process.argv.slice(2), OPTIONS);
    if (!asked.recording) throw new Error("wanted --recording recording.npz, got none");
    const { address, close } = await serve(asked);
    const [width, height, scale] = [asked.width, asked.height, asked.scale].map(Number);
    try {
      await withPage({ width, height, scale, scheme: asked.scheme }, async (page) => {
        await page.goto(address);
        await ready(page);
        await toEnd(page);
        const temporary = `${asked.output}.partial`;
        await page.screenshot({ path: temporary, fullPage: true, type: "png" });
        await rename(temporary, asked.output);
        for (const line of await decisionLines(page)) process.stdout.write(`${line}\n`);
      });
    } finally {
      close();
    }
  });
}
