// The page in a real browser, for the screenshot and for the tests.

import { mkdtemp, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";

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

/** Play from the start to the end, as fast as the page can. */
export async function playAll(page) {
  const shows = (wanted) =>
    page.waitForFunction((t) => document.getElementById("play-label").textContent === t, wanted);
  await page.locator("#restart").click();
  await shows("Play");
  await page.locator("input[name=speed][value=Infinity]").check({ force: true });
  await page.locator("#play").click();
  await shows("Play again");
}

/** Lines as the other hosts print them with --decisions. */
export async function decisionLines(page) {
  return page.evaluate(async () => (await import("/page.mjs")).decisionLines());
}
