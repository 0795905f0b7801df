// node .ci/look.mjs SITE MODULES CHROMIUM [PICTURES]: opens every page of a built site in headless Chromium: light,
// dark, and 400 pixels wide. Errors of the console and serious faults that axe-core finds are printed; then
// the status is 1. MODULES is a folder in which npm installed ws and axe-core.
import { spawn } from "node:child_process";
import { createServer } from "node:http";
import { createRequire } from "node:module";
import { mkdirSync, mkdtempSync, readFileSync, readdirSync, rmSync, statSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { extname, join, relative, resolve } from "node:path";

const [site, modules, chromium, pictures] = process.argv.slice(2).map((word, i) => (i === 2 ? word : resolve(word)));
const require = createRequire(join(modules, "x.js"));
const { WebSocket } = require("ws");
const axe = readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
const LOOKS = { light: ["light", 1280], dark: ["dark", 1280], narrow: ["light", 400] };
const TYPES = { ".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json",
  ".svg": "image/svg+xml", ".png": "image/png", ".webp": "image/webp" };

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

const pages = (folder) => readdirSync(folder, { withFileTypes: true }).flatMap((entry) =>
  entry.isDirectory() ? pages(join(folder, entry.name)) : entry.name === "index.html" ? [relative(site, folder)] : []);

const profile = mkdtempSync(join(tmpdir(), "look-"));
const flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", "--remote-debugging-port=0",
  `--user-data-dir=${profile}`, "about:blank"];
const browser = spawn(chromium, flags, { stdio: ["ignore", "ignore", "pipe"] });
const address = await new Promise((found, failed) => {
  let said = "";
  browser.stderr.on("data", (text) => {
    const at = /DevTools listening on (ws:\S+)/.exec((said += text));
    if (at) found(at[1]);
  });
  browser.on("exit", () => failed(new Error(said)));
});
const socket = new WebSocket(address, { perMessageDeflate: false });
await new Promise((done) => socket.on("open", done));
let number = 0, session;
const waiting = new Map(), heard = [];
socket.on("message", (text) => {
  const { id, result, error, method, params } = JSON.parse(text);
  if (id) return waiting.get(id)(error ? { error } : result);
  heard.push({ method, params });
});
const call = (method, params = {}) => new Promise((done) => {
  waiting.set(++number, done);
  socket.send(JSON.stringify({ id: number, method, params, sessionId: session }));
});
const evaluate = async (expression) =>
  (await call("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true })).result?.value;

const { targetId } = await call("Target.createTarget", { url: "about:blank" });
({ sessionId: session } = await call("Target.attachToTarget", { targetId, flatten: true }));
for (const domain of ["Page", "Runtime", "Log", "Network"]) await call(`${domain}.enable`);
const faults = [];
for (const page of pages(site).sort()) {
  for (const [look, [scheme, width]] of Object.entries(LOOKS)) {
    const fault = (text) => faults.push(`${page || "."} (${look}): ${text}`);
    heard.length = 0;
    await call("Storage.clearDataForOrigin", { origin: home.slice(0, -1), storageTypes: "all" }); // the kept look
    await call("Emulation.setEmulatedMedia", { features: [{ name: "prefers-color-scheme", value: scheme }] });
    await call("Emulation.setDeviceMetricsOverride", { width, height: 900, deviceScaleFactor: 1, mobile: width < 500 });
    await call("Page.navigate", { url: home + (page && `${page}/`) });
    while (!heard.some((one) => one.method === "Page.loadEventFired")) await new Promise((done) => setTimeout(done, 20));
    const found = await evaluate(`${axe}; axe.run({resultTypes: ["violations"]}).then((all) => JSON.stringify(
      all.violations.filter((one) => ["serious", "critical"].includes(one.impact)).map((one) =>
        one.id + ", " + one.nodes.length + " times: " + one.nodes[0].target + " " + one.nodes[0].failureSummary)))`);
    for (const text of JSON.parse(found ?? '["axe-core did not run"]')) fault(text.replaceAll(/\s+/g, " "));
    if (await evaluate("document.documentElement.scrollWidth > innerWidth + 1")) fault("wider than the window");
    for (const { method, params } of heard) {
      if (method === "Runtime.exceptionThrown") fault(params.exceptionDetails.text);
      if (method === "Runtime.consoleAPICalled" && params.type === "error") fault(params.args.map((one) => one.value).join(" "));
      if (method === "Log.entryAdded" && params.entry.level === "error") fault(`${params.entry.text} ${params.entry.url ?? ""}`);
    }
    if (pictures) {
      mkdirSync(pictures, { recursive: true });
      const { data } = await call("Page.captureScreenshot", { captureBeyondViewport: false });
      writeFileSync(join(pictures, `${page.replaceAll("/", "-") || "start"}-${look}.png`), Buffer.from(data, "base64"));
    }
  }
}
for (const text of new Set(faults)) console.log(text);
console.log(`${pages(site).length} pages in ${Object.keys(LOOKS).length} looks, ${faults.length} faults`);
browser.removeAllListeners("exit");
browser.kill();
await new Promise((done) => browser.on("exit", done));
rmSync(profile, { recursive: true, force: true });
server.close();
process.exit(faults.length ? 1 : 0);
