#!/usr/bin/env node
// What a user of the page would see, as one JSON object; the tests hold it against Python:
// node check.mjs --model stream.onnx --recording recording.npy --drop other.npy --altered bad.onnx

import { readFile } from "node:fs/promises";
import { basename } from "node:path";

import { decisionLines, playAll, ready, withPage } from "./browser.mjs";
import { given, run, serve } from "./serve.mjs";

const OPTIONS = {
  drop: { type: "string", multiple: true, default: [] },
  altered: { type: "string", multiple: true, default: [] },
};

const text = (page, id) => page.locator(`#${id}`).textContent();
const count = async (page, id) => Number((await text(page, id)).replaceAll(",", ""));
const alert = (page) => text(page, "alert");
const position = (page) => page.evaluate(() => document.getElementById("progress").value);
const shows = (page, id, wanted) =>
  page.waitForFunction(([i, t]) => document.getElementById(i).textContent === t, [id, wanted]);

/** Everything that can be reached with the tabulator, in order, and whether it shows the focus. */
async function tabbed(page) {
  const seen = [];
  for (;;) {
    await page.keyboard.press("Tab");
    const at = await page.evaluate(() => {
      const { id, name, labels, nextElementSibling: next } = document.activeElement;
      const ring = (each) => each !== null && getComputedStyle(each).outlineStyle === "solid";
      const label = labels?.[0]?.textContent ?? document.activeElement.textContent;
      const isRinged = ring(document.activeElement) || ring(next);
      return { id: id || name, label: label.trim(), isRinged };
    });
    if (!at.id || seen.some(({ id }) => id === at.id)) return seen;
    seen.push(at);
  }
}

/** Space plays, pauses and plays on. */
async function keyboard(page) {
  await page.locator("h1").click(); // the focus on nothing in particular
  await page.keyboard.press("Space");
  await page.waitForFunction(() => document.getElementById("progress").value > 0.01);
  const playing = await text(page, "play-label");
  await page.keyboard.press("Space");
  await shows(page, "play-label", "Play");
  const paused = await position(page);
  await page.evaluate(async () => {
    for (let i = 0; i < 5; i += 1) await new Promise(requestAnimationFrame);
  });
  return { playing, paused, after: await position(page) };
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
    await page.waitForFunction(() => document.body.ariaBusy === "false"); // all is scored again
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

/** What the page says of a dropped file, and whether it still plays, which recording. */
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
  const said = await alert(page);
  await playAll(page);
  return { said, lines: await decisionLines(page), invalid: await count(page, "invalid") };
}

/** A recording of another rate is not played, and is when the rate is right again. */
async function wrongRate(page) {
  const rate = page.locator("#rate");
  const own = await rate.inputValue();
  await rate.fill("1000");
  await page.locator("#play").click();
  const [said, label] = [await alert(page), await text(page, "play-label")];
  await rate.fill(own);
  const saidAfter = await alert(page);
  await playAll(page);
  return { said, label, saidAfter, lines: await decisionLines(page) };
}

/** What the page says of models that are not what they should be. */
async function altered(page, servers) {
  const said = [];
  for (const { address } of servers) {
    await page.goto(address);
    await page.waitForFunction(() => !document.getElementById("alert").hidden);
    said.push(await alert(page));
  }
  return said;
}

await run(async () => {
  const asked = given(process.argv.slice(2), OPTIONS);
  const servers = [await serve(asked)];
  for (const model of asked.altered) servers.push(await serve({ ...asked, model }));
  const seen = { requests: [], errors: [] };
  try {
    await withPage({}, async (page) => {
      page.on("request", (request) => seen.requests.push(request.url()));
      page.on("pageerror", (error) => seen.errors.push(error.message));
      await page.goto(servers[0].address);
      await ready(page);
      const step = async (name, work) => {
        seen[name] = await work(page).catch((error) => {
          throw new Error(`${name}: ${error.message}`);
        });
      };
      await step("simulated", () => text(page, "simulated"));
      await step("tabbed", tabbed);
      await step("keyboard", keyboard);
      await step("played", playAll);
      await step("lines", decisionLines);
      await step("slider", slider);
      for (const path of asked.drop) await step(basename(path), () => dropped(page, path));
      await step("rate", wrongRate);
      await step("altered", () => altered(page, servers.slice(1)));
    });
  } finally {
    for (const { close } of servers) close();
  }
  process.stdout.write(`${JSON.stringify(seen)}\n`);
});
