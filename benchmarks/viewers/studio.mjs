// The studio in a real browser: from photos to a model of known size and its files, through a kill; a page of many photos.
//
//     npm --prefix benchmarks/viewers install --no-audit --no-fund --no-package-lock
//     node benchmarks/viewers/studio.mjs SFM_APP PHOTOS [WIDTH]
//
// SFM_APP is the program; the studio's folder is a temporary one. Three of the photos are added late. Above 100 photos
// there is no model: only the page is timed. Prints a line per finding, and errors of the console, requests to other
// hosts and broken rules of axe, if any.
import { spawn } from "node:child_process";
import { mkdtempSync, readdirSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";

const [program, photos, width = "1440"] = process.argv.slice(2), folder = mkdtempSync(join(tmpdir(), "studio-"));
const files = readdirSync(photos).sort().map((name) => join(photos, name)), many = files.length > 100;
const axeSource = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");

let server, address, isDown = false;
async function serve(...options) {
  server = spawn(program, ["studio", folder, "--no-browser", ...options]);
  server.stderr.on("data", (data) => console.log("server:", String(data).trim()));
  address = await new Promise((ready) => server.stdout.on("data", (data) => ready(/http\S+/.exec(String(data))?.[0])));
}
await serve();
const flags = ["--no-sandbox", "--disable-background-networking", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: flags });
const page = await browser.newPage({ viewport: { width: Number(width), height: 900 } });
page.on("console", (one) => { if (!isDown && ["error", "warning"].includes(one.type())) console.log("console:", one.text()); });
page.on("pageerror", (error) => { if (!isDown) console.log("page error:", error.message); });
page.on("request", (one) => { if (!["127.0.0.1", ""].includes(new URL(one.url()).hostname)) console.log("other host:", one.url()); });

let since = performance.now();
const seconds = () => `${((performance.now() - since) / 1000).toFixed(1)} s`;
const until = (what, seek, value) => page.waitForFunction(seek, value, { timeout: 1_800_000 }).then(() => console.log(`${what}: ${seconds()}`));
const says = (text) => until(`"${text}"`, (wanted) => document.querySelector(".status")?.innerText.includes(wanted), text);
const settled = () => until("minutes known", () => document.querySelector("#quality option")?.textContent.includes("–"));
const give = (some, where = "") => page.locator(`${where} input[type=file]`).first().setInputFiles(some);
const press = (name) => page.getByRole("button", { name, exact: true }).click();
const home = () => page.goto(address.replace(/\?.*/, "")).then(() => page.waitForSelector(".drop"));
async function check(where) {
  await page.evaluate(axeSource);
  const broken = await page.evaluate(() => axe.run(document, { iframes: false }).then((found) => found.violations.map((one) => one.id)));
  const over = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  console.log(`${where}: axe ${broken.join(", ") || "clean"}, ${over} px too wide`);
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
  await says("Finished");
  await give(files.slice(-3), "#photos");
  await until("three more listed", (count) => document.querySelectorAll(".photos li").length >= count, files.length);
  await press("make it again");
  await until("all in the model", (count) => document.querySelector(".facts")?.innerText.includes(`${count} of ${count}`), files.length);
  await says("Finished");
  await page.waitForTimeout(5000); // the view loads the model

  const frame = page.frames().find((one) => one.url().includes("/view/")), view = frame.locator("#view");
  since = performance.now();
  await frame.locator("#measure").click();
  for (const share of [0.45, 0.55]) {
    const box = await view.boundingBox();
    await view.click({ position: { x: share * box.width, y: box.height / 2 } });
  }
  await frame.locator("#size-length").fill("25");
  await frame.locator("#size-unit").selectOption("cm");
  await frame.locator("#size button").click();
  await until("real size", () => document.querySelector(".facts")?.innerText.includes("25 cm"));
  await says("Finished");
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
