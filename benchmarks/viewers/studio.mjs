// The studio in a real browser: from photos to a model of known size and its files, through a kill; a page of many photos.
//
//     npm --prefix benchmarks/viewers install --no-audit --no-fund --no-package-lock
//     node benchmarks/viewers/studio.mjs SFM_APP PHOTOS [WIDTH] [light|dark] [HOST]
//
// SFM_APP is the program; the studio's folder is a temporary one. The photos are dropped as from a file manager, three of
// them late. Above 100 photos there is no model: only the page is timed. With HOST, an address of this machine, the
// studio listens at all addresses, and the page comes from there. Prints a line per finding, and errors of the console,
// requests to other hosts and broken rules of axe, if any.
import { spawn } from "node:child_process";
import { mkdtempSync, readdirSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";

const [program, photos, width = "1440", scheme = "light", host = "127.0.0.1"] = process.argv.slice(2), folder = mkdtempSync(join(tmpdir(), "studio-"));
const files = readdirSync(photos).sort().map((name) => join(photos, name)), many = files.length > 100;
const axeSource = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");

let server, address, isDown = false;
async function serve(...options) {
  server = spawn(program, ["studio", folder, "--no-browser", ...(host === "127.0.0.1" ? [] : ["--host", "0.0.0.0"]), ...options]);
  server.stderr.on("data", (data) => console.log("server:", String(data).trim()));
  address = await new Promise((ready) => server.stdout.on("data", (data) => ready(/http\S+/.exec(String(data))?.[0])));
  address = address.replace("127.0.0.1", host);
}
await serve();
const flags = ["--no-sandbox", "--disable-background-networking", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: flags });
const context = await browser.newContext({ viewport: { width: Number(width), height: 900 }, colorScheme: scheme });
const page = await context.newPage(), client = await context.newCDPSession(page);
page.on("console", (one) => { if (!isDown && ["error", "warning"].includes(one.type())) console.log("console:", one.text()); });
page.on("pageerror", (error) => { if (!isDown) console.log("page error:", error.message); });
page.on("request", (one) => { if (![host, ""].includes(new URL(one.url()).hostname)) console.log("other host:", one.url()); });

let since = performance.now();
const seconds = () => `${((performance.now() - since) / 1000).toFixed(1)} s`;
const until = (what, seek, value) => page.waitForFunction(seek, value, { timeout: 1_800_000 }).then(() => console.log(`${what}: ${seconds()}`));
const says = (text) => until(`"${text}"`, (wanted) => document.querySelector(".status")?.innerText.includes(wanted), text);
const settled = () => until("minutes known", () => document.querySelector("#quality option")?.textContent.includes("–"));
async function give(some, where = "") { // as a file manager does
  const zone = page.locator(`${where} .drop`).first();
  await page.waitForTimeout(1500); // parts of a finished page change places
  await zone.scrollIntoViewIfNeeded();
  const { x, y } = await zone.boundingBox(), data = { items: [], files: some, dragOperationsMask: 1 };
  for (const type of ["dragEnter", "dragOver", "drop"]) await client.send("Input.dispatchDragEvent", { type, x: x + 40, y: y + 20, data });
}
const press = (name) => page.getByRole("button", { name, exact: true }).click();
const home = () => page.goto(address.replace(/\?.*/, "")).then(() => page.waitForSelector(".drop"));
async function check(where) {
  let broken = [];
  for (const one of page.frames()) {
    await one.evaluate(axeSource);
    broken = broken.concat(await one.evaluate(() => axe.run(document, { iframes: false }).then((found) => found.violations.map((rule) => `${rule.id} (${rule.nodes[0].target})`))));
  }
  const over = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  console.log(`${where}: axe ${broken.join(", ") || "clean"}, ${over} px too wide`);
}
const inView = (what) => page.frames().find((one) => one.url().includes("/view/")).locator(what);
async function mark(tool, shares) {
  await inView(tool).click();
  for (const [across, down] of shares) {
    const { width: w, height: h } = await inView("#view").boundingBox(); // the tool takes place
    await inView("#view").click({ position: { x: across * w, y: down * h } });
  }
}
async function stroke(where, down) {
  const { x, y, width: w, height: h } = await where.boundingBox();
  await page.mouse.move(x + 0.1 * w, y + down * h);
  await page.mouse.down();
  await page.mouse.move(x + 0.9 * w, y + down * h, { steps: 10 });
  await page.mouse.up();
}
async function time(what, act) {
  const start = performance.now();
  await act();
  console.log(`${what}: ${(performance.now() - start).toFixed(0)} ms`);
}

await page.goto(address);
await page.waitForSelector(".drop");
await check("home");
await give(many ? files : files.slice(0, -3));
await until("listed", (count) => document.querySelectorAll(".photos li").length >= count, many ? files.length : files.length - 3);
await settled();
await check("photos");
const first = page.url(), project = first.replace(/.*#/, "/api/projects/");
for (const path of ["", "/photos"]) await time(`GET PROJECT${path}`, () => page.evaluate((url) => fetch(url).then((answer) => answer.text()), project + path));
await time("choose a quality", () => page.selectOption("#quality", "draft"));
await page.fill("#markers", "wide");
await page.keyboard.press("Tab");
await page.waitForTimeout(2500);
console.log(`an error stays to be read: ${await page.locator("#alert").innerText()}`);
if (many) {
  await time("remove a photo", () => page.evaluate((count) => new Promise((done) => { // a click of the driver would scroll first
    const list = document.querySelector(".photos");
    new MutationObserver(() => { if (list.children.length === count) done(); }).observe(list, { childList: true });
    list.querySelector("li:last-child button").click();
  }), files.length - 1));
} else {
  await page.getByRole("button", { name: /^mask / }).first().click();
  await page.waitForSelector("dialog canvas");
  await stroke(page.locator("dialog canvas"), 0.05);
  await check("mask");
  await press("keep");
  await until("masked", () => document.querySelector(".photos").innerText.includes("masked"));
  since = performance.now();
  await press("start");
  await until("points", () => document.querySelector("iframe"));
  await home(); // a second project waits
  await give(files.slice(0, 6));
  await settled();
  await press("start");
  await says("It starts when the other models are done");
  isDown = true;
  server.kill("SIGKILL");
  await page.waitForFunction(() => document.querySelector("#alert")?.innerText.includes("still running"));
  await serve("--port", new URL(address).port);
  await page.goto(address);
  isDown = false;
  await page.goto(first);
  await says("Step");
  await until("depth maps", () => document.querySelector(".depths img"));
  await says("Finished");
  await give(files.slice(-3), "#photos");
  await until("three more listed", (count) => document.querySelectorAll(".photos li").length >= count, files.length);
  await press("make it again");
  await until("all in the model", (count) => document.querySelector(".facts")?.innerText.includes(`${count} of ${count}`), files.length);
  await says("Finished");
  await page.waitForTimeout(5000); // the view loads the model

  await inView("#view").focus();
  await page.keyboard.press("n");
  await page.waitForTimeout(2000);
  await inView("#chosen-beside").click();
  await inView("#show-cameras").uncheck();
  await page.waitForTimeout(2000);
  await page.locator("iframe").screenshot({ path: join(folder, "beside.png") });
  await check("side by side");
  await inView("#chosen-close").click();
  await inView("#show-all").click();
  await mark("#level", [[0.45, 0.6], [0.55, 0.6], [0.5, 0.7]]);
  since = performance.now();
  await inView("#stand").click();
  await until("upright", () => document.querySelector("#model")?.innerText.includes("as you have turned it"));
  await says("Finished");
  await page.waitForTimeout(3000);
  since = performance.now();
  await mark("#measure", [[0.45, 0.5], [0.55, 0.5]]);
  await inView("#size-length").fill("25");
  await inView("#size-unit").selectOption("cm");
  await inView("#size button").click();
  await until("real size", () => document.querySelector(".facts")?.innerText.includes("25 cm"));
  await says("Finished");
  await page.waitForTimeout(3000);
  await inView("#crop").click();
  await inView("[data-side='0']").fill("300");
  await page.locator("iframe").screenshot({ path: join(folder, "crop.png") });
  console.log(await inView("#cropped-size").innerText());
  for (const format of ["glb", "obj"]) {
    const [file] = await Promise.all([page.waitForEvent("download"), page.locator(`[data-format=${format}]`).click()]);
    await file.saveAs(join(folder, file.suggestedFilename()));
    console.log(`saved ${join(folder, file.suggestedFilename())}`);
  }
  await check("model");
  await home();
  await until("two projects", () => document.querySelectorAll(".projects li").length === 2);
}
const peak = /VmHWM:\s+(\d+)/.exec(readFileSync(`/proc/${server.pid}/status`, "utf8"));
console.log(`peak memory of the server: ${(Number(peak[1]) / 1024).toFixed(0)} MB`);
await page.screenshot({ path: join(folder, "page.png"), fullPage: true });
await browser.close();
server.kill("SIGINT");
