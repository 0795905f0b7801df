#!/usr/bin/env node
// What a user of the page would see, as one JSON object; the tests hold it against Python:
// node check.mjs --model stream.onnx --recording recording.npz --drop other.npy --altered bad.onnx
// or, of a stream that is served: node check.mjs --live http://127.0.0.1:8000/?token=... --seconds 120

import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { basename } from "node:path";

import { decisionLines, held, ready, toEnd, withPage } from "./shot.mjs";
import { given, run, serve } from "./serve.mjs";

const OPTIONS = {
  drop: { type: "string", multiple: true, default: [] },
  altered: { type: "string", multiple: true, default: [] },
  live: { type: "string" },
  seconds: { type: "string", default: "10" },
};
const AXE = createRequire(import.meta.url).resolve("axe-core/axe.min.js");

const text = (page, id) => page.locator(`#${id}`).textContent();
const count = async (page, id) => Number((await text(page, id)).replaceAll(",", ""));
const position = (page) => page.evaluate(() => document.getElementById("seek").valueAsNumber);
const frames = (page) =>
  page.evaluate(async () => {
    for (let i = 0; i < 5; i += 1) await new Promise(requestAnimationFrame);
  });
const labelIs = (page, wanted) =>
  page.waitForFunction((t) => document.getElementById("play-label").textContent === t, wanted);

/** Everything that can be reached with the tabulator, in order, and whether it shows the focus. */
async function tabbed(page) {
  await page.locator("h1").click(); // from the top
  const seen = [];
  for (;;) {
    await page.keyboard.press("Tab");
    const at = await page.evaluate(() => {
      const { id, name, labels, nextElementSibling: next } = document.activeElement;
      const ring = (each) => each !== null && getComputedStyle(each).outlineStyle === "solid";
      const own = document.activeElement.ariaLabel ?? document.activeElement.textContent;
      const label = labels?.[0]?.textContent ?? own;
      const isRinged = ring(document.activeElement) || ring(next);
      return {
        id: id || name || document.activeElement.dataset.timeS,
        label: label.trim(),
        isRinged,
      };
    });
    if (!at.id || seen.some(({ id }) => id === at.id)) return seen;
    seen.push(at);
  }
}

/** It plays when it is loaded; space pauses and plays on. */
async function keyboard(page) {
  await page.waitForFunction(() => document.getElementById("seek").valueAsNumber > 0);
  const playing = await text(page, "play-label");
  await page.keyboard.press("Space");
  await labelIs(page, "Play");
  const paused = await position(page);
  await frames(page);
  return { playing, paused, after: await position(page) };
}

/** Moments that keys, the mouse and the list of alarms lead to, and how many pixels show slip. */
async function seeking(page) {
  const seek = page.locator("#seek");
  await seek.press("End");
  const moments = { end: await position(page) };
  for (const key of ["Home", "ArrowRight", "PageUp", "ArrowLeft"]) {
    await seek.press(key);
    await frames(page);
    moments[key] = await position(page);
  }
  const box = await seek.boundingBox();
  await page.mouse.click(box.x + box.width / 2, box.y + box.height / 2);
  await frames(page);
  moments.middle = await position(page);
  const before = await slipPixels(page);
  const alarms = page.locator("#list button");
  moments.alarms = await alarms.allTextContents();
  await alarms.last().click();
  await frames(page);
  moments.alarm = await position(page);
  return {
    ...moments,
    value: await seek.getAttribute("aria-valuetext"),
    before,
    after: await slipPixels(page),
  };
}

/** Pixels of the picture in the colour of slip. */
function slipPixels(page) {
  return page.evaluate(() => {
    const { width, height } = document.getElementById("scope");
    const context = document.getElementById("scope").getContext("2d");
    const hex = getComputedStyle(document.documentElement).getPropertyValue("--slip").trim();
    const [r, g, b] = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
    const { data } = context.getImageData(0, 0, width, height);
    let num = 0;
    for (let i = 0; i < data.length; i += 4) {
      num += data[i] === r && data[i + 1] === g && data[i + 2] === b;
    }
    return num;
  });
}

/** Alarms at both ends of the slider, and after the reset. */
async function slider(page) {
  const threshold = page.locator("#threshold");
  const move = async (act) => {
    await act();
    await page.waitForFunction(() => !document.body.dataset.busy); // all is scored again
    await frames(page);
    const step = Number(await threshold.inputValue());
    return { step, pixels: await slipPixels(page), lines: await decisionLines(page) };
  };
  await threshold.focus();
  const least = await move(() => page.keyboard.press("Home"));
  const most = await move(() => page.keyboard.press("End"));
  const stepped = await move(() => page.keyboard.press("ArrowLeft"));
  const own = await move(() => page.locator("#reset").click());
  return { least, most, stepped, own };
}

/** What the page says of a dropped file, and what it plays then. */
async function dropped(page, path) {
  const content = (await readFile(path)).toString("base64");
  await page.evaluate(
    ({ content: packed, name }) => {
      const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
      const dataTransfer = new DataTransfer();
      dataTransfer.items.add(new File([bytes], name));
      document.body.dispatchEvent(new DragEvent("drop", { dataTransfer, bubbles: true }));
    },
    { content, name: basename(path) },
  );
  await page.waitForFunction(
    (name) =>
      !document.getElementById("alert").hidden ||
      document.getElementById("position").textContent.startsWith(name),
    basename(path),
  );
  const said = await text(page, "alert");
  await toEnd(page);
  return {
    said,
    position: await text(page, "position"),
    simulated: await text(page, "simulated"),
    lines: await decisionLines(page),
    invalid: await count(page, "invalid"),
    channels: await text(page, "channels"),
    probability: await text(page, "probability"),
  };
}

/** Faults that axe-core finds, light and dark: how bad, which, where. */
async function accessibility(page) {
  const faults = [];
  const axe = await readFile(AXE, "utf8");
  for (const colorScheme of ["dark", "light"]) {
    await page.emulateMedia({ colorScheme });
    await frames(page);
    const { violations } = await page.evaluate(`${axe}; axe.run()`);
    for (const { impact, id, nodes } of violations) {
      faults.push([colorScheme, impact, id, ...nodes.map(({ target }) => target.join(" "))]);
    }
  }
  return faults;
}

/** What the page says of models that are not what they should be. */
async function altered(page, servers) {
  const said = [];
  for (const { address } of servers) {
    await page.goto(address);
    await page.waitForFunction(() => !document.getElementById("alert").hidden);
    said.push(await text(page, "alert"));
  }
  return said;
}

/** A served stream for so many seconds: what the page holds then, and how busy its thread was. */
async function live(page, address, seconds) {
  const client = await page.context().newCDPSession(page);
  const metrics = async () => {
    const { metrics: all } = await client.send("Performance.getMetrics");
    return Object.fromEntries(all.map(({ name, value }) => [name, value]));
  };
  await client.send("Performance.enable", { timeDomain: "threadTicks" }); // CPU time, whatever else runs
  await page.goto(address);
  await ready(page);
  const begun = performance.now();
  const start = await metrics();
  await page.waitForTimeout(1000 * seconds);
  const end = await metrics();
  const busy = (end.TaskDuration - start.TaskDuration) / ((performance.now() - begun) / 1000);
  const heap = [start.JSHeapUsedSize, end.JSHeapUsedSize];
  const { decisions, ...more } = await held(page);
  const told = ["stream-state", "received", "dropped", "dropped_to_page", "position", "simulated"];
  const shown = Object.fromEntries(
    await Promise.all(told.map(async (id) => [id, await text(page, id)])),
  );
  return { busy, heap, ...more, shown, slip: await slipPixels(page), decisions };
}

await run(async () => {
  const words = process.argv.slice(2);
  const isLive = words.some((word) => word.startsWith("--live"));
  const asked = given(isLive ? ["--model=none", ...words] : words, OPTIONS);
  const servers = asked.live ? [] : [await serve(asked)];
  for (const model of asked.altered) servers.push(await serve({ ...asked, model }));
  const seen = { requests: [], errors: [] };
  try {
    await withPage({}, async (page) => {
      page.on("request", (request) => seen.requests.push(request.url()));
      page.on("pageerror", (error) => seen.errors.push(error.message));
      const step = async (name, work) => {
        seen[name] = await work(page).catch((error) => {
          throw new Error(`${name}: ${error.message}`);
        });
      };
      if (asked.live) {
        await step("live", () => live(page, asked.live, Number(asked.seconds)));
        await step("accessibility", accessibility);
        return;
      }
      await page.goto(servers[0].address);
      await ready(page);
      await step("simulated", () => text(page, "simulated"));
      await step("keyboard", keyboard);
      await step("played", toEnd);
      await step("lines", decisionLines);
      await step("tabbed", tabbed);
      await step("accessibility", accessibility);
      await step("seeking", seeking);
      await toEnd(page);
      await step("slider", slider);
      for (const path of asked.drop) await step(basename(path), () => dropped(page, path));
      await step("altered", () => altered(page, servers.slice(1)));
    });
  } finally {
    for (const { close } of servers) close();
  }
  process.stdout.write(`${JSON.stringify(seen)}\n`);
});
