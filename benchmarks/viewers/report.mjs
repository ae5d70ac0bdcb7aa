// node report.mjs REPORT PICTURES: open a report.html from the disk in headless Chromium, without a network, at two widths.
// Prints JSON: what the console said, requests, whether the 3D view draws, and what a click on a camera does.
import chromium from '@sparticuz/chromium';
import fs from 'node:fs';
import { createRequire } from 'node:module';
import path from 'node:path';
import { pathToFileURL } from 'node:url';
import puppeteer from 'puppeteer-core';

const AXE = fs.readFileSync(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8');
const SOFTWARE = ['--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'];
const WIDTHS = { wide: { width: 1440, height: 900 }, narrow: { width: 390, height: 844, isMobile: true, hasTouch: true } };
const [file, pictures] = process.argv.slice(2).map((one) => path.resolve(one));

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

async function visit(browser, name, size) {
  const page = await browser.newPage(), said = [], asked = [];
  page.on('console', (message) => ['error', 'warn'].includes(message.type()) && said.push(message.text()));
  page.on('pageerror', (error) => said.push(String(error)));
  page.on('dialog', async (dialog) => { said.push(`dialog: ${dialog.message()}`); await dialog.dismiss(); });
  page.on('request', (request) => /^(data|blob):/.test(request.url()) || asked.push(request.url()));
  await page.setOfflineMode(true);
  await page.setViewport(size);
  await page.goto(pathToFileURL(file).href, { waitUntil: 'load' });
  await new Promise((ready) => setTimeout(ready, 2500));
  const found = { view: await page.evaluate(drawn) };
  await page.screenshot({ path: path.join(pictures, `report-${name}-top.png`) });
  if (found.view) {
    const row = await page.$('#photo-table tbody tr.good th button');
    await row?.click();
    await new Promise((ready) => setTimeout(ready, 2000));
    found.flown = await page.evaluate(() => document.getElementById('view').dataset.chosen ?? '');
    found.atPhoto = await page.evaluate(drawn);
    await page.screenshot({ path: path.join(pictures, `report-${name}-flown.png`) });
  }
  await page.screenshot({ path: path.join(pictures, `report-${name}-whole.png`), fullPage: true });
  await page.evaluate(AXE);
  found.axe = await page.evaluate(async () => {
    const { violations } = await window.axe.run(document);
    return violations.map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.target.join(' ')).slice(0, 3).join(', ')}`);
  });
  found.overflow = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
  await page.close();
  return { ...found, said: said.filter((text) => !/GPU stall/.test(text)), requests: asked.filter((url) => !url.endsWith(path.basename(file))) };
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
