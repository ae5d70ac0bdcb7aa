// node check.mjs FOLDER: run the Khronos validator and three.js on every GLB in FOLDER.
// CHROME: path of another browser than the bundled one, which is for Linux.
// Prints JSON {name: {validator, three}} and writes NAME.png, a view of the model, beside each file.
import chromium from '@sparticuz/chromium';
import validator from 'gltf-validator';
import fs from 'node:fs';
import http from 'node:http';
import path from 'node:path';
import { fileURLToPath } from 'node:url';
import puppeteer from 'puppeteer-core';

const HERE = path.dirname(fileURLToPath(import.meta.url));
const SIZE = { width: 720, height: 540 };
const TYPES = { '.html': 'text/html', '.js': 'text/javascript', '.mjs': 'text/javascript', '.glb': 'model/gltf-binary' };

// WebGL without a graphics card
const SOFTWARE = ['--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'];

function serve(folder) {
  const roots = { models: folder, three: path.join(HERE, 'node_modules', 'three'), page: HERE };
  const server = http.createServer((request, response) => {
    const [, root, ...rest] = decodeURIComponent(new URL(request.url, 'http://x').pathname).split('/');
    const file = root in roots ? path.join(roots[root], path.normalize(rest.join('/'))) : '';
    if (!file.startsWith(roots[root] + path.sep) || !fs.existsSync(file)) return response.writeHead(404).end();
    response.writeHead(200, { 'Content-Type': TYPES[path.extname(file)] ?? 'application/octet-stream' });
    response.end(fs.readFileSync(file));
  });
  return new Promise((ready) => server.listen(0, '127.0.0.1', () => ready(server)));
}

async function validated(file) {
  const { issues, info } = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), { uri: path.basename(file) });
  const { numErrors, numWarnings, numInfos, numHints, messages } = issues;
  return {
    errors: numErrors, warnings: numWarnings, infos: numInfos, hints: numHints,
    messages: messages.map(({ code, message, pointer }) => `${code} ${pointer ?? ''}: ${message}`),
    triangles: info.totalTriangleCount, vertices: info.totalVertexCount, materials: info.materialCount,
  };
}

async function shown(browser, port, file) {
  const page = await browser.newPage();
  const said = [];
  page.on('console', (message) => ['error', 'warn'].includes(message.type()) && said.push(message.text()));
  page.on('pageerror', (error) => said.push(String(error)));
  await page.setViewport(SIZE);
  await page.goto(`http://127.0.0.1:${port}/page/page.html`);
  const { png, ...found } = await page.evaluate(
    (url, size) => window.show(url, size), `/models/${encodeURIComponent(path.basename(file))}`, SIZE,
  );
  await page.close();
  fs.writeFileSync(file.replace(/\.glb$/, '.png'), Buffer.from(png.split(',')[1], 'base64'));
  return { ...found, said: said.filter((text) => !/GPU stall|favicon/.test(text)) };
}

const folder = path.resolve(process.argv[2]);
const server = await serve(folder);
const browser = await puppeteer.launch({
  args: [...chromium.args, ...SOFTWARE], executablePath: process.env.CHROME ?? await chromium.executablePath(), headless: 'shell',
});
const found = {};
try {
  for (const name of fs.readdirSync(folder).filter((name) => name.endsWith('.glb')).sort()) {
    const file = path.join(folder, name);
    found[path.basename(name, '.glb')] = {
      validator: await validated(file),
      three: await shown(browser, server.address().port, file),
    };
  }
  found.browser = await browser.version();
} finally {
  await browser.close();
  server.close();
}
process.stdout.write(JSON.stringify(found, null, 1) + '\n');
