// node report.mjs REPORT PICTURES: open a report.html from the disk in headless Chromium, without a network, at two widths;
// or a page of `sfm-app view`, where REPORT is its address.
// Prints JSON: what the console said, requests, whether the 3D view draws, what a click on a camera does, and what is measured.
import chromium from '@sparticuz/chromium';
import fs from 'node:fs';
import { createRequire } from 'node:module';
import path from 'node:path';
import { pathToFileURL } from 'node:url';
import puppeteer from 'puppeteer-core';

const AXE = fs.readFileSync(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8');
const SOFTWARE = ['--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'];
const WIDTHS = { wide: { width: 1440, height: 900 }, narrow: { width: 390, height: 844, isMobile: true, hasTouch: true } };
const served = /^http:/.test(process.argv[2]);
const file = served ? process.argv[2] : pathToFileURL(path.resolve(process.argv[2])).href, pictures = path.resolve(process.argv[3]);

// how many colors the view has, and how many of its pixels are not its background
const drawn = () => {
  const canvas = document.getElementById('view');
  if (!canvas) return null;
  const copy = Object.assign(document.createElement('canvas'), { width: canvas.width, height: canvas.height });
  const context = copy.getContext('2d');
  context.drawImage(canvas, 0, 0);
  const { data } = context.getImageData(0, 0, copy.width, copy.height);
  const colors = new Map();
  for (let k = 0; k < data.length; k += 4) {
    const color = (data[k] << 16) | (data[k + 1] << 8) | data[k + 2];
    colors.set(color, (colors.get(color) ?? 0) + 1);
  }
  return { colors: colors.size, covered: 1 - [...colors.values()].reduce((a, b) => Math.max(a, b), 0) / (data.length / 4), model: canvas.dataset.model ?? '' };
};

// two marks, by clicks or taps and by keyboard: what the page says of them
async function measure(page, { hasTouch }) {
  if (await page.$('#chosen:not([hidden])')) await page.click('#chosen-close');
  await page.click('#show-all');
  await page.click('#measure');
  await page.evaluate(() => document.querySelector('.stage').scrollIntoView({ block: 'center' }));
  const { x, y, width, height } = await (await page.$('#view')).boundingBox();
  const said = () => page.evaluate(() => ['measured-hint', 'measured-a', 'measured-b', 'command-scale', 'command-measure'].map((id) => document.getElementById(id).textContent));
  for (const [across, down] of [[0.45, 0.55], [0.6, 0.45]]) await (hasTouch ? page.touchscreen.tap(x + across * width, y + down * height) : page.mouse.click(x + across * width, y + down * height));
  await new Promise((ready) => setTimeout(ready, 500));
  const clicked = await said();
  if (!hasTouch) {
    await page.focus('#view');
    for (const key of ['Escape', 'm', 'Enter', 'ArrowLeft', 'Enter']) await page.keyboard.press(key);
  }
  await new Promise((ready) => setTimeout(ready, 500));
  return { clicked, typed: hasTouch ? [] : await said() };
}

async function visit(browser, name, size) {
  const page = await browser.newPage(), said = [], asked = [];
  page.on('console', (message) => ['error', 'warn'].includes(message.type()) && said.push(message.text()));
  page.on('pageerror', (error) => said.push(String(error)));
  page.on('dialog', async (dialog) => { said.push(`dialog: ${dialog.message()}`); await dialog.dismiss(); });
  page.on('request', (request) => /^(data|blob):/.test(request.url()) || asked.push(request.url()));
  await page.setOfflineMode(!served);
  await page.setViewport(size);
  await page.emulateMediaFeatures([{ name: 'prefers-reduced-motion', value: 'reduce' }]); // a click on what still scrolls misses it
  await page.goto(file, { waitUntil: 'load' });
  await page.waitForFunction(() => !document.getElementById('view') || document.getElementById('view').dataset.model || document.getElementById('show-model').disabled, { timeout: 120000 });
  await new Promise((ready) => setTimeout(ready, 2500));
  const found = { view: await page.evaluate(drawn) };
  await page.screenshot({ path: path.join(pictures, `report-${name}-top.png`) });
  if (found.view) {
    const row = await page.$('#photo-table tbody tr.good th button');
    await row?.evaluate((one) => one.scrollIntoView({ block: 'center' }));
    await new Promise((ready) => setTimeout(ready, 500));
    await row?.click();
    await new Promise((ready) => setTimeout(ready, 2000));
    found.flown = await page.evaluate(() => document.getElementById('view').dataset.chosen ?? '');
    found.atPhoto = await page.evaluate(drawn);
    await page.screenshot({ path: path.join(pictures, `report-${name}-flown.png`) });
    found.measured = await measure(page, size);
    await page.screenshot({ path: path.join(pictures, `report-${name}-measured.png`) });
  }
  await page.screenshot({ path: path.join(pictures, `report-${name}-whole.png`), fullPage: true });
  await page.evaluate(AXE);
  found.axe = await page.evaluate(async () => {
    const { violations } = await window.axe.run(document);
    return violations.map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.target.join(' ')).slice(0, 3).join(', ')}`);
  });
  found.overflow = (await page.evaluate(() => document.documentElement.scrollWidth)) - size.width; // a telephone widens what it calls the page
  await page.close();
  return { ...found, said: said.filter((text) => !/GPU stall/.test(text)), requests: asked.filter((url) => !url.startsWith(file)) };
}

fs.mkdirSync(pictures, { recursive: true });
const browser = await puppeteer.launch({
  args: [...chromium.args, ...SOFTWARE], executablePath: process.env.CHROME ?? await chromium.executablePath(), headless: 'shell',
});
try {
  const found = {};
  for (const [name, size] of Object.entries(WIDTHS)) found[name] = await visit(browser, name, size);
  process.stdout.write(JSON.stringify(found, null, 1) + '\n');
} finally {
  await browser.close();
}
