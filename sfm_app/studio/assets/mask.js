// The mask of a photo: what is painted, or black in a file, is left out. Resolves to what the server is to do.
import { texts } from "./texts.js";
import { make } from "./elements.js";

const LARGEST_PX = 1600; // masks may be smaller than their photos
const RED = "rgb(220 38 38)";

function loaded(address) {
  return new Promise((ready, failed) => {
    const picture = new Image();
    picture.onload = () => ready(picture);
    picture.onerror = () => failed(new Error(texts.noPicture));
    picture.src = address;
  });
}

// black of a mask becomes red, everything else transparent
function drawMask(context, picture) {
  const { width, height } = context.canvas;
  context.drawImage(picture, 0, 0, width, height);
  const pixels = context.getImageData(0, 0, width, height), { data } = pixels;
  for (let k = 0; k < data.length; k += 4) {
    const isOut = data[k] < 128 || data[k + 3] < 128;
    data.set(isOut ? [220, 38, 38, 255] : [0, 0, 0, 0], k);
  }
  context.putImageData(pixels, 0, 0);
}

// black where it is painted, white elsewhere; null where nothing is
async function maskOf(context) {
  const { width, height } = context.canvas, pixels = context.getImageData(0, 0, width, height), { data } = pixels;
  let any = false;
  for (let k = 0; k < data.length; k += 4) {
    const isOut = data[k + 3] > 127;
    any ||= isOut;
    data.set(isOut ? [0, 0, 0, 255] : [255, 255, 255, 255], k);
  }
  if (!any) return null;
  const file = new OffscreenCanvas(width, height);
  file.getContext("2d").putImageData(pixels, 0, 0);
  return file.convertToBlob({ type: "image/png" });
}

// name of a photo, its address, and that of its mask or "": a blob to keep, null for no mask, undefined to change nothing
export async function editMask(name, photo, mask) {
  const picture = await loaded(photo), scale = Math.min(1, LARGEST_PX / Math.max(picture.width, picture.height));
  const canvas = make("canvas", { width: Math.round(picture.width * scale), height: Math.round(picture.height * scale) });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (mask) drawMask(context, await loaded(mask));
  const width = make("input", { type: "range", min: 0.5, max: 15, step: 0.5, value: 4, id: "brush" });
  const erase = make("button", { type: "button", "aria-pressed": "false", onclick: () => erase.setAttribute("aria-pressed", String(erase.getAttribute("aria-pressed") !== "true")) }, texts.erase);
  const take = async (file) => {
    const address = URL.createObjectURL(file);
    drawMask(context, await loaded(address));
    URL.revokeObjectURL(address);
  };
  const file = make("input", { type: "file", accept: "image/*", hidden: true, onchange: () => take(file.files[0]) });
  let last = null;
  const stroke = (event) => {
    const box = canvas.getBoundingClientRect(), at = [(event.clientX - box.left) * canvas.width / box.width, (event.clientY - box.top) * canvas.height / box.height];
    context.globalCompositeOperation = erase.getAttribute("aria-pressed") === "true" ? "destination-out" : "source-over";
    Object.assign(context, { strokeStyle: RED, lineCap: "round", lineJoin: "round", lineWidth: (width.value / 100) * canvas.width });
    context.beginPath();
    context.moveTo(...(last ?? at));
    context.lineTo(...at);
    context.stroke();
    context.globalCompositeOperation = "source-over";
    last = at;
  };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); last = null; stroke(event); });
  canvas.addEventListener("pointermove", (event) => { if (event.buttons) stroke(event); });
  canvas.addEventListener("dragover", (event) => event.preventDefault());
  canvas.addEventListener("drop", (event) => { event.preventDefault(); if (event.dataTransfer.files.length) take(event.dataTransfer.files[0]); });
  const button = (text, act, className = "") => make("button", { type: "button", className, onclick: act }, text);
  return new Promise((ready) => {
    const end = (value) => { dialog.close(); dialog.remove(); ready(value); };
    const dialog = make(
      "dialog", { className: "mask", "aria-label": texts.maskOf(name), oncancel: () => end(undefined) },
      make("p", {}, make("b", {}, texts.maskOf(name)), " ", texts.maskHelp),
      make("div", { className: "painting" }, make("img", { src: photo, alt: "" }), canvas),
      make(
        "p", { className: "actions" }, button(texts.keep, async () => end(await maskOf(context)), "main"), button(texts.cancel, () => end(undefined)),
        make("label", { for: "brush" }, texts.brush), width, erase, button(texts.clear, () => context.clearRect(0, 0, canvas.width, canvas.height)),
        file, button(texts.maskFile, () => file.click()),
      ),
    );
    document.body.append(dialog);
    dialog.showModal();
  });
}
