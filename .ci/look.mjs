// node .ci/look.mjs SITE AXE CHROMIUM [PICTURES]: opens every page of a built site in one headless Chromium: light,
// dark, and 400 pixels wide. Printed are errors of the console, serious faults that axe-core (the file AXE) finds, and
// what is wider than the window and does not scroll. Status: 0, none; 1, some; 2, the browser failed.
import { spawn } from "node:child_process";
import { createServer } from "node:http";
import { mkdirSync, mkdtempSync, readFileSync, readdirSync, rmSync, statSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { extname, join, relative, resolve } from "node:path";

const [site, script, chromium, pictures] = process.argv.slice(2).map((word, i) => (i === 2 ? word : resolve(word)));
const axe = readFileSync(script, "utf8");
const LOOKS = { light: ["light", 1280], dark: ["dark", 1280], narrow: ["light", 400] };
const LIMIT_S = 60; // for one step of one page
const TYPES = { ".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json",
  ".svg": "image/svg+xml", ".png": "image/png", ".webp": "image/webp" };
// A page's faults by axe-core, and elements that stick out and that nothing scrolls or cuts.
const CHECK = `(async (width) => {
  const { violations } = await axe.run({ resultTypes: ["violations"] });
  const serious = violations.filter((one) => ["serious", "critical"].includes(one.impact)).map((one) =>
    one.id + ", " + one.nodes.length + " times: " + one.nodes[0].target + " " + one.nodes[0].failureSummary);
  if (document.documentElement.scrollWidth <= width) return serious;
  const held = (element) => element && element !== document.body &&
    (getComputedStyle(element).overflowX !== "visible" || held(element.parentElement));
  const wide = [...document.body.querySelectorAll("*")].filter((one) =>
    one.getBoundingClientRect().right > width + 1 && !held(one.parentElement));
  return [...serious, "wider than the window: " + wide.slice(0, 3).map((one) => one.outerHTML.slice(0, 80)).join(" ")];
})`;

const server = createServer((request, response) => {
  let path = join(site, decodeURIComponent(new URL(request.url, "http://x").pathname));
  try {
    if (statSync(path).isDirectory()) path = join(path, "index.html");
    const body = readFileSync(path);
    response.writeHead(200, { "content-type": TYPES[extname(path)] ?? "application/octet-stream" }).end(body);
  } catch {
    response.writeHead(404).end();
  }
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const home = `http://127.0.0.1:${server.address().port}/`;
const list = (folder) => readdirSync(folder, { withFileTypes: true }).flatMap((entry) =>
  entry.isDirectory() ? list(join(folder, entry.name)) : entry.name === "index.html" ? [relative(site, folder)] : []);
const pages = list(site).sort();

const profile = mkdtempSync(join(tmpdir(), "look-"));
const flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
  "--remote-debugging-pipe", `--user-data-dir=${profile}`, "about:blank"];
const stdio = ["ignore", "ignore", "ignore", "pipe", "pipe"];
const browser = spawn(chromium, flags, { stdio, detached: true }); // a group of its own: all of it is ended
const stop = (status, text) => {
  console.log(text);
  browser.removeAllListeners("exit");
  browser.once("exit", () => {
    try {
      rmSync(profile, { recursive: true, force: true, maxRetries: 5 });
    } catch (error) {
      console.error(`${profile} is left: ${error.code}`);
    }
    process.exit(status);
  });
  try {
    process.kill(-browser.pid, "SIGKILL");
  } catch {
    process.exit(status);
  }
};
browser.on("error", (error) => stop(2, `${chromium}: ${error.message}`));
browser.on("exit", (code) => stop(2, `${chromium} ended by itself, status ${code}`));
process.on("unhandledRejection", (error) => stop(2, error.message));

// Messages are JSON between NULs, through descriptors 3 and 4.
let number = 0, session, rest = [];
const waiting = new Map(), listeners = new Map();
let heard = [];
browser.stdio[4].on("data", (bytes) => {
  for (let end; (end = bytes.indexOf(0)) >= 0; bytes = bytes.subarray(end + 1)) {
    const message = JSON.parse(Buffer.concat([...rest, bytes.subarray(0, end)]).toString());
    rest = [];
    waiting.get(message.id)?.(message);
    if (message.method) heard.push(message), listeners.get(message.method)?.();
  }
  rest.push(bytes);
});
const within = (promise, what) => {
  let timer;
  const late = new Promise((_, fail) => (timer = setTimeout(fail, 1000 * LIMIT_S, new Error(`no answer in ${LIMIT_S} s: ${what}`))));
  return Promise.race([promise, late]).finally(() => clearTimeout(timer));
};
const call = async (method, params = {}, sessionId = session) => {
  const id = ++number;
  const answer = new Promise((done) => waiting.set(id, done));
  browser.stdio[3].write(`${JSON.stringify({ id, method, params, sessionId })}\0`);
  const { result, error } = await within(answer, method).finally(() => waiting.delete(id));
  if (error) throw new Error(`${method}: ${error.message}`);
  return result;
};
const evaluate = async (expression) => {
  const { result, exceptionDetails } =
    await call("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true });
  if (exceptionDetails) throw new Error(exceptionDetails.exception?.description ?? exceptionDetails.text);
  return result.value;
};
const event = (method) => within(new Promise((done) => listeners.set(method, done)), method);

let tab;
const openTab = async (scheme, width) => {
  session = undefined;
  if (tab) await call("Target.closeTarget", { targetId: tab });
  ({ targetId: tab } = await call("Target.createTarget", { url: "about:blank" }));
  ({ sessionId: session } = await call("Target.attachToTarget", { targetId: tab, flatten: true }));
  for (const domain of ["Page", "Runtime", "Log", "Network"]) await call(`${domain}.enable`);
  await call("Storage.clearDataForOrigin", { origin: home.slice(0, -1), storageTypes: "all" }); // the kept look
  await call("Emulation.setEmulatedMedia", { features: [{ name: "prefers-color-scheme", value: scheme }] });
  await call("Emulation.setDeviceMetricsOverride", { width, height: 900, deviceScaleFactor: 1, mobile: width < 500 });
};

const faults = [];
for (const [look, [scheme, width]] of Object.entries(LOOKS)) {
  await openTab(scheme, width);
  for (const page of pages) {
    const fault = (text) => {
      faults.push(text);
      console.log(`${page || "."} (${look}): ${text.replaceAll(/\s+/g, " ")}`);
    };
    heard = [];
    try {
      const loaded = event("Page.loadEventFired");
      await Promise.all([loaded, call("Page.navigate", { url: home + (page && `${page}/`) })]);
      await evaluate(`${axe};0`);
      for (const text of await evaluate(`${CHECK}(${width})`)) fault(text);
      if (pictures) {
        mkdirSync(pictures, { recursive: true });
        const { cssContentSize } = await call("Page.getLayoutMetrics");
        const clip = { x: 0, y: 0, width, height: Math.min(cssContentSize.height, 16000), scale: 1 };
        const { data } = await call("Page.captureScreenshot", { captureBeyondViewport: true, clip });
        writeFileSync(join(pictures, `${page.replaceAll("/", "-") || "start"}-${look}.png`), Buffer.from(data, "base64"));
      }
    } catch (error) { // the next page gets a tab that hangs on nothing
      fault(error.message);
      await openTab(scheme, width);
    }
    for (const { method, params } of heard) {
      if (method === "Runtime.exceptionThrown") fault(params.exceptionDetails.exception?.description ?? params.exceptionDetails.text);
      if (method === "Runtime.consoleAPICalled" && params.type === "error") fault(params.args.map((one) => one.value).join(" "));
      if (method === "Log.entryAdded" && params.entry.level === "error") fault(`${params.entry.text} ${params.entry.url ?? ""}`);
    }
  }
}
stop(faults.length ? 1 : 0, `${pages.length} pages in ${Object.keys(LOOKS).length} looks: ${faults.length} faults`);
