// The studio in a real browser: from photos to a model of known size and its files; what a page of many photos costs.
//
//     npm --prefix benchmarks/viewers install --no-audit --no-fund --no-package-lock
//     node benchmarks/viewers/studio.mjs SFM_APP PHOTOS [WIDTH]
//
// SFM_APP is the program; the studio's folder is made in a temporary one. Prints a line per finding, and errors of the
// console, requests to other hosts and rules of axe that are broken, if any.
import { spawn } from "node:child_process";
import { mkdtempSync, readdirSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";

const [program, photos, width = "1440"] = process.argv.slice(2), folder = mkdtempSync(join(tmpdir(), "studio-"));
const axeSource = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
const server = spawn(program, ["studio", folder, "--no-browser"]);
const address = await new Promise((ready) => server.stdout.on("data", (data) => ready(/http\S+/.exec(String(data))?.[0])));
const flags = ["--no-sandbox", "--disable-background-networking", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: flags });
const page = await browser.newPage({ viewport: { width: Number(width), height: 900 } });
page.on("console", (one) => { if (["error", "warning"].includes(one.type())) console.log("console:", one.text()); });
page.on("pageerror", (error) => console.log("page error:", error.message));
page.on("request", (one) => { if (!["127.0.0.1", ""].includes(new URL(one.url()).hostname)) console.log("other host:", one.url()); });

const since = performance.now(), seconds = () => `${((performance.now() - since) / 1000).toFixed(1)} s`;
const until = (what, seek, value) => page.waitForFunction(seek, value, { timeout: 1_800_000 }).then(() => console.log(`${what}: ${seconds()}`));
const says = (text) => until(text, (wanted) => document.querySelector(".status")?.innerText.includes(wanted), text);
async function check(where) {
  await page.evaluate(axeSource);
  const broken = await page.evaluate(() => axe.run(document, { iframes: false }).then((found) => found.violations.map((one) => one.id)));
  const over = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  console.log(`${where}: axe ${broken.join(", ") || "clean"}, ${over} px too wide`);
}

await page.goto(address);
await page.waitForSelector(".drop");
await check("home");
const files = readdirSync(photos).map((name) => join(photos, name));
await page.locator("input[type=file]").first().setInputFiles(files);
await until(`${files.length} photos listed`, (count) => document.querySelectorAll(".photos li").length >= count, files.length);
await until("minutes known", () => document.querySelector("#quality option")?.textContent.includes("–"));
const project = page.url().replace(/.*#/, "/api/projects/");
for (const path of ["", "/photos"]) {
  const ms = await page.evaluate(async (url) => { const start = performance.now(); await (await fetch(url)).text(); return performance.now() - start; }, project + path);
  console.log(`GET PROJECT${path}: ${ms.toFixed(0)} ms`);
}
const peak = /VmHWM:\s+(\d+)/.exec(readFileSync(`/proc/${server.pid}/status`, "utf8"));
console.log(`peak memory of the server: ${(Number(peak[1]) / 1024).toFixed(0)} MB`);
await check("photos");
await page.selectOption("#quality", "draft");
await page.getByRole("button", { name: "start" }).click();
await until("points", () => document.querySelector("iframe"));
await says("Finished");
await page.waitForTimeout(5000); // the view loads the model

const frame = page.frames().find((one) => one.url().includes("/view/")), view = frame.locator("#view");
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
await browser.close();
server.kill("SIGINT");
