#!/usr/bin/env node
// A picture of the page at the end of a recording, and its decisions as JSON lines:
// node shot.mjs --model stream.onnx --recording recording.npy --output page.png

import { rename } from "node:fs/promises";

import { decisionLines, playAll, ready, withPage } from "./browser.mjs";
import { given, run, serve } from "./serve.mjs";

const OPTIONS = {
  output: { type: "string", default: "page.png" },
  width: { type: "string", default: "1280" },
  height: { type: "string", default: "800" },
  scale: { type: "string", default: "1" }, // device pixels of a CSS pixel
  scheme: { type: "string", default: "light" }, // or dark
};

await run(async () => {
  const asked = given(process.argv.slice(2), OPTIONS);
  if (!asked.recording) throw new Error("wanted --recording recording.npy, got none");
  const { address, close } = await serve(asked);
  const [width, height, scale] = [asked.width, asked.height, asked.scale].map(Number);
  try {
    await withPage({ width, height, scale, scheme: asked.scheme }, async (page) => {
      await page.goto(address);
      await ready(page);
      await playAll(page);
      const temporary = `${asked.output}.partial`;
      await page.screenshot({ path: temporary, fullPage: true, type: "png" });
      await rename(temporary, asked.output);
      for (const line of await decisionLines(page)) process.stdout.write(`${line}\n`);
    });
  } finally {
    close();
  }
});
