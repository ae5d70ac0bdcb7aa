// The page of the studio: a list of projects, and one project. State comes from the server, once a second.
import { make } from "./elements.js";
import { editMask } from "./mask.js";
import { texts } from "./texts.js";

const main = document.getElementById("main"), alertBox = document.getElementById("alert");
const CROPPED = ["glb", "obj", "stl", "usdz", "ply", "laz"]; // formats that a box cuts
const STAGES = Object.keys(texts.stages);
document.title = texts.title;
document.getElementById("home").textContent = texts.title;

function warn(text) {
  alertBox.textContent = text;
  alertBox.hidden = !text;
}

async function ask(method, address, body) {
  const before = alertBox.textContent;
  let answer;
  try {
    answer = await fetch(`/api/projects${address}`, { method, body: body instanceof Blob || body === undefined ? body : JSON.stringify(body) });
  } catch {
    warn(texts.gone);
    throw new Error(texts.gone);
  }
  const found = await answer.json().catch(() => ({ message: answer.statusText }));
  if (!answer.ok) {
    warn([found.message, found.hint && texts.toDo(found.hint)].filter(Boolean).join(". "));
    throw new Error(found.message);
  }
  // an error stays to be read until the next action, though the page asks all the time
  if (alertBox.textContent === before && (method !== "GET" || before === texts.gone)) warn("");
  return found;
}

const path = (...parts) => parts.map((part) => `/${encodeURIComponent(part)}`).join("");

// Pictures are loaded when they are in view, two at a time: a browser has six connections, and the rest of the page needs some.

const MOST_LOADING = 2, wantedPictures = new Set();
let loading = 0;
const inView = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    if (isIntersecting) wantedPictures.add(target);
    else wantedPictures.delete(target);
  }
  loadPictures();
});
function loadPictures() {
  for (const one of wantedPictures) {
    if (loading === MOST_LOADING) return;
    wantedPictures.delete(one);
    inView.unobserve(one);
    loading += 1;
    one.onload = one.onerror = () => { loading -= 1; loadPictures(); };
    one.src = one.dataset.src;
  }
}
function picture(address) {
  const one = make("img", { alt: "", "data-src": address });
  inView.observe(one);
  return one;
}

// Files: dropped, chosen, or taken with the camera of a telephone.

async function filesOf(entry) {
  if (entry.isFile) return [await new Promise((ready, failed) => entry.file(ready, failed))];
  const reader = entry.createReader(), found = [];
  for (let some; (some = await new Promise((ready, failed) => reader.readEntries(ready, failed))).length;) found.push(...some);
  return (await Promise.all(found.map(filesOf))).flat();
}

async function dropped(event) {
  const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  return entries.length ? (await Promise.all(entries.map(filesOf))).flat() : [...event.dataTransfer.files];
}

function dropZone(onFiles, title) {
  const choose = (more, label) => {
    const input = make("input", { type: "file", multiple: true, hidden: true, onchange: () => onFiles([...input.files]), ...more });
    for (const [name, value] of Object.entries(more)) input.setAttribute(name, value === true ? "" : value);
    return [input, make("button", { type: "button", onclick: () => input.click() }, label)];
  };
  const zone = make(
    "div", { className: "drop" }, make("p", { className: "big" }, title),
    make("p", {}, ...choose({ accept: "image/*,video/*,.zip,.heic,.dng" }, texts.choose), ...choose({ webkitdirectory: true }, texts.chooseFolder), ...choose({ accept: "image/*", capture: "environment" }, texts.camera)),
    make("p", { className: "quiet" }, texts.dropHelp),
  );
  zone.addEventListener("dragover", (event) => { event.preventDefault(); zone.classList.add("over"); });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", async (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    onFiles(await dropped(event));
  });
  return zone;
}
// a file beside the zone would take the place of the page
for (const kind of ["dragover", "drop"]) window.addEventListener(kind, (event) => event.preventDefault());

const CHECK_EVERY_MS = 4000;
const uploads = new Map(); // by project: files done and all, and when they were checked
async function upload(project, files) {
  const count = uploads.get(project) ?? { done: 0, all: 0, checked: performance.now() };
  uploads.set(project, count);
  count.all += files.length;
  const waiting = [...files];
  const next = async () => {
    for (let file; (file = waiting.shift());) {
      try {
        await ask("PUT", `${path(project)}/files${path(file.name)}`, file);
      } catch (error) {
        if (error.message === texts.gone) waiting.length = 0;
      }
      count.done += 1;
      shown?.refresh();
      if (performance.now() - count.checked < CHECK_EVERY_MS) continue;
      count.checked = performance.now();
      ask("POST", `${path(project)}/check`).catch(() => {});
    }
  };
  await Promise.all([next(), next(), next()]);
  if (count.done < count.all) return;
  uploads.delete(project);
  await ask("POST", `${path(project)}/check`);
  shown?.refresh();
}

// The list of projects.

async function showProjects() {
  const projects = await ask("GET", "");
  if (location.hash.length > 1) return; // meanwhile, the user has gone to a project
  const fresh = async (files) => {
    if (!files.length) return;
    const folder = files[0].webkitRelativePath.split("/")[0], single = files.length === 1 ? files[0].name.replace(/\.[^.]*$/, "") : "";
    const { name } = await ask("POST", "", { name: folder || single || texts.newName });
    location.hash = encodeURIComponent(name);
    upload(name, files);
  };
  const folder = make("input", { id: "folder", required: true, autocomplete: "off" });
  main.replaceChildren(
    make("h1", {}, texts.projects),
    projects.length ? make("ul", { className: "projects" }, ...projects.map(card)) : make("p", {}, texts.none),
    make("h2", {}, texts.begin),
    dropZone(fresh, texts.drop),
    make(
      "form", {
        onsubmit: async (event) => {
          event.preventDefault();
          location.hash = encodeURIComponent((await ask("POST", "", { source: folder.value })).name);
        },
      },
      make("h3", {}, texts.orFolder), make("label", { for: "folder" }, texts.folderPath), " ", folder, " ", make("button", {}, texts.use),
    ),
  );
}

function card(project) {
  const preview = project.has_picture && picture(`/api/projects${path(project.name)}/view/pictures/0`);
  const state = texts.states[project.state] || project.headline;
  return make("li", {}, make("a", { href: `#${encodeURIComponent(project.name)}` }, preview || make("span", { className: "blank" }), make("b", {}, project.title), make("small", {}, state)));
}

// One project. Its parts are made once, and filled with what the server says.

let shown = null;

class ProjectPage {
  constructor(name) {
    this.at = path(name);
    this.name = name;
    this.listed = "";
    this.views = "";
    this.alive = true;
    const part = (id, title, ...content) => make("section", { id, "aria-labelledby": `${id}-title` }, make("h2", { id: `${id}-title` }, title), ...content);
    this.parts = {
      status: make("p", { className: "status", role: "status" }), bar: make("progress", { hidden: true, "aria-label": texts.make }),
      actions: make("p", { className: "actions" }), messages: make("ul", { className: "messages quiet" }), depths: make("div", { className: "depths", role: "img", "aria-label": texts.depths, hidden: true }), problem: make("div", { className: "problem", hidden: true }),
      view: make("div", { hidden: true }), photos: make("ul", { className: "photos" }), photoLine: make("p", {}), warnings: make("div", { hidden: true }),
      size: make("p", {}), facts: make("dl", { className: "facts" }), command: make("code", { tabIndex: 0 }), where: make("p", { className: "quiet" }),
      form: this.settingsForm(), masks: this.maskFiles(), saves: make("ul", { className: "saves" }),
    };
    const { parts } = this;
    this.model = part("model", texts.model, parts.view, parts.size, parts.warnings, parts.facts);
    this.save = part("save", texts.save, parts.saves);
    this.photos = part("photos", texts.photos, parts.photoLine, parts.photos, dropZone((files) => upload(name, files), texts.add), parts.masks);
    this.make = part("make", texts.make, parts.problem, parts.form, parts.actions, parts.status, parts.bar, parts.messages, parts.depths);
    const button = (text, act, className = "") => make("button", { type: "button", className, onclick: act }, text);
    const end = part("end", texts.command, parts.command, parts.where, make("p", { className: "actions" }, button(texts.rename, () => this.rename()), button(texts.delete, () => this.delete(), "risky")));
    this.title = make("h1", {}, name);
    main.replaceChildren(this.title, this.make, this.model, this.save, this.photos, end);
    this.refresh();
    this.timer = setInterval(() => this.refresh(), 1000);
  }

  close() {
    this.alive = false;
    clearInterval(this.timer);
  }

  settingsForm() {
    this.qualities = make("select", { id: "quality", onchange: () => ask("PATCH", this.at, { quality: this.qualities.value }) });
    for (const [name, text] of Object.entries(texts.qualities)) this.qualities.append(make("option", { value: name }, text));
    this.markers = make("input", { id: "markers", size: 8, autocomplete: "off", onchange: () => ask("PATCH", this.at, { markers: this.markers.value }).catch(() => {}) });
    return make(
      "form", { onsubmit: (event) => event.preventDefault() }, make("p", {}, make("label", { for: "quality" }, texts.quality), " ", this.qualities),
      make("p", {}, make("label", { for: "markers" }, texts.markers), " ", this.markers),
    );
  }

  maskFiles() {
    const input = make("input", {
      type: "file", multiple: true, hidden: true, accept: "image/*",
      onchange: async () => {
        for (const file of input.files) await ask("PUT", `${this.at}/masks${path(file.name)}`, file).catch(() => {});
        this.listed = "";
        this.refresh();
      },
    });
    return make("p", { className: "quiet" }, input, make("button", { type: "button", onclick: () => input.click() }, texts.addMasks), " ", texts.masksHelp);
  }

  async refresh() {
    if (this.busy) return;
    this.busy = true;
    try {
      const state = await ask("GET", this.at);
      if (this.alive) await this.fill(state);
    } catch { // the alert says it
    } finally {
      this.busy = false;
    }
  }

  async fill(state) {
    const { parts } = this, { state: wanted } = state, working = wanted === "running", count = uploads.get(this.name);
    this.fillActions(wanted, state, count);
    this.placeMaking(state.has_model && !working && wanted !== "queued");
    const number = STAGES.indexOf(state.stage);
    const stage = number < 0 ? texts.starting : texts.stage(number + 1, STAGES.length, texts.stages[state.stage]);
    const left = number < 1 ? "" : state.minutes_left === null ? texts.longer : texts.left(state.minutes_left);
    setText(parts.status, count ? texts.uploading(count.done, count.all) : working ? [stage, state.total > 1 ? texts.of(state.done, state.total) : "", left].filter(Boolean).join(", ") : texts[wanted] ?? (state.has_model ? texts.finished(state.quality) : state.photos && !state.minutes && !state.failure ? texts.checking : ""));
    parts.bar.hidden = !count && !working;
    const part = count ? count.done / count.all : (Math.max(number, 0) + (state.total ? state.done / state.total : 0)) / STAGES.length;
    parts.bar.value = working && !count ? Math.max(part, this.reached ?? 0) : part; // a stage counts several times
    this.reached = working ? parts.bar.value : 0;
    setList(parts.messages, working ? state.messages.slice(-5) : []);
    const problem = state.problem ?? (state.failure ? { message: state.failure, hint: state.hint } : null);
    parts.problem.hidden = !problem || working || Boolean(count);
    parts.form.hidden = working || wanted === "queued";
    setText(this.title, state.title);
    document.title = `${state.title} – ${texts.title}`;
    this.fillDepths(working ? state.depths : 0);
    if (problem) parts.problem.replaceChildren(make("h3", {}, texts.failed), make("p", {}, problem.message), make("p", {}, problem.hint ? texts.toDo(problem.hint) : ""));
    if (document.activeElement !== this.qualities) this.qualities.value = state.quality;
    if (document.activeElement !== this.markers) this.markers.value = state.markers;
    for (const option of this.qualities.options) option.textContent = [texts.qualities[option.value], state.minutes?.[option.value]].filter(Boolean).join(" – ");
    this.fillModel(state);
    setText(parts.command, state.command);
    setText(parts.where, texts.where(state.folder));
    const listed = JSON.stringify([state.photos, state.views, state.headline, wanted, state.minutes]);
    if (listed !== this.listed) {
      this.listed = listed;
      this.fillPhotos(await ask("GET", `${this.at}/photos`), state, working);
    }
  }

  // a finished model comes first, but while it is made, that does
  placeMaking(isLast) {
    const before = isLast ? this.photos : this.title;
    if (before.nextElementSibling !== this.make) before.after(this.make);
  }

  fillDepths(count) {
    const { depths } = this.parts;
    depths.hidden = !count;
    while (depths.children.length > count) depths.lastChild.remove();
    while (depths.children.length < count) depths.append(make("img", { alt: "", src: `/api/projects${this.at}/view/depths/${depths.children.length}` }));
  }

  fillActions(wanted, state, count) {
    const act = (name, text) => make("button", { type: "button", className: name === "start" ? "main" : "", onclick: async () => { await ask("POST", `${this.at}/${name}`); await this.refresh(); this.make.scrollIntoView({ block: "nearest" }); } }, text);
    const buttons = wanted === "running" ? [["pause", texts.pause], ["cancel", texts.cancel]] : wanted === "queued" ? [["cancel", texts.cancel]] : state.photos && !count ? [["start", wanted === "paused" ? texts.go : state.has_model ? texts.redo : texts.start]] : [];
    const key = JSON.stringify(buttons);
    if (key === this.buttons) return;
    this.buttons = key;
    this.parts.actions.replaceChildren(...buttons.map(([name, text]) => act(name, text)));
  }

  fillModel(state) {
    const { parts } = this;
    this.model.hidden = !state.has_view;
    this.save.hidden = !state.has_model;
    parts.view.hidden = !state.has_view;
    const views = JSON.stringify([state.views, state.has_model]);
    if (state.has_view && views !== this.views) {
      this.views = views;
      parts.view.replaceChildren(make("iframe", { title: texts.viewTitle, src: `/api/projects${this.at}/view/` }));
      setFacts(parts.facts, state.facts ?? []);
    }
    parts.warnings.hidden = !state.warnings?.length;
    const warnings = JSON.stringify(state.warnings);
    if (warnings !== this.warnings) {
      this.warnings = warnings;
      parts.warnings.replaceChildren(make("h3", {}, texts.warnings), make("ul", {}, ...(state.warnings ?? []).map((text) => make("li", {}, text))));
    }
    const size = JSON.stringify([state.has_model, state.sizes, state.level]);
    if (size !== this.sizeState) {
      this.sizeState = size;
      const forget = (key, text) => make("button", { type: "button", onclick: () => ask("PATCH", this.at, { [key]: null }) }, text);
      const sized = state.sizes.length ? [texts.sizeKnown, " ", forget("size", texts.forget)] : [texts.sizeHelp];
      const upright = state.level.length ? [texts.levelKnown, " ", forget("level", texts.forgetLevel)] : [texts.levelHelp];
      parts.size.replaceChildren(...(state.has_model ? [...sized, " ", ...upright] : [texts.pointsOnly]));
      this.fillSaves();
    }
  }

  fillSaves() {
    const { parts } = this;
    const save = (format, text) => {
      const button = make("button", {
        type: "button", "data-format": format,
        onclick: async () => {
          button.disabled = true;
          button.textContent = texts.writing;
          try {
            const box = CROPPED.includes(format) ? parts.view.querySelector("iframe")?.contentWindow.sfmViewer?.box?.() : null;
            const { file } = await ask("POST", `${this.at}/exports`, { format, box });
            download(`/api/projects${this.at}/exports/${file.split("/").map(encodeURIComponent).join("/")}`);
          } catch { // the alert says it
          } finally {
            button.disabled = false;
            button.textContent = texts.download;
          }
        },
      }, texts.download);
      return make("li", {}, text, " ", button);
    };
    const report = make("li", {}, texts.report, " ", make("button", { type: "button", onclick: () => download(`/api/projects${this.at}/exports/report.html`) }, texts.download));
    parts.saves.replaceChildren(...Object.entries(texts.formats).map(([name, text]) => save(name, text)), report);
  }

  fillPhotos(rows, state, working) {
    const whole = rows.filter((row) => row.state !== "read"), used = whole.filter((row) => row.state !== "left out").length;
    this.parts.photoLine.replaceChildren(...[rows.length ? texts.count(used, whole.length) : "", state.source ? texts.linked(state.source) : "", state.has_view ? texts.added : ""].filter(Boolean).map((text) => make("span", {}, `${text} `)));
    // items that say the same stay: there may be hundreds
    const before = new Map([...this.parts.photos.children].map((item) => [item.dataset.key, item]));
    const item = (row) => {
      const key = JSON.stringify([row, working]);
      return before.get(key) ?? make(
        "li", { className: row.reason ? "odd" : "", "data-key": key },
        picture(`/api/projects${this.at}/${row.name === row.file ? `photos${path(row.name)}` : `view/pictures/${row.number}`}`),
        make("b", {}, row.name), make("small", {}, [texts.photoStates[row.state] ?? row.state, row.reason].filter(Boolean).join(": ")),
        ...(working || row.name !== row.file ? [] : [
          make("button", { type: "button", className: "out", "aria-label": texts.removeOf(row.name), title: texts.remove, onclick: (event) => this.remove(row.name, event.target.closest("li")) }, "×"),
          row.can_mask && make("button", { type: "button", "aria-label": `${row.masked ? texts.masked : texts.mask} ${row.name}`, onclick: () => this.paint(row) }, row.masked ? texts.masked : texts.mask),
        ]),
      );
    };
    const wanted = rows.map(item), kept = new Set(wanted);
    for (const one of before.values()) if (!kept.has(one)) one.remove();
    wanted.forEach((one, k) => { if (this.parts.photos.children[k] !== one) this.parts.photos.insertBefore(one, this.parts.photos.children[k] ?? null); });
  }

  async remove(name, item) {
    await ask("DELETE", `${this.at}/photos`, { names: [name] });
    item.remove();
    this.refresh();
  }

  async paint(row) {
    const mask = `${this.at}/masks${path(row.name)}`;
    let made;
    try {
      made = await editMask(row.name, `/api/projects${this.at}/photos${path(row.name)}?large`, row.masked ? `/api/projects${mask}` : "");
    } catch (error) {
      warn(error.message);
    }
    if (made === undefined) return;
    await ask(made ? "PUT" : "DELETE", mask, made ?? undefined);
    this.listed = "";
    this.refresh();
  }

  async rename() {
    const title = window.prompt(texts.newTitle, this.title.textContent);
    if (title?.trim()) await ask("PATCH", this.at, { title: title.trim() });
  }

  async delete() {
    if (!window.confirm(texts.sure(this.title.textContent))) return;
    await ask("DELETE", this.at);
    location.hash = "";
  }
}

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function setList(list, items) {
  if (JSON.stringify(items) === list.dataset.items) return;
  list.dataset.items = JSON.stringify(items);
  list.replaceChildren(...items.map((text) => make("li", {}, text)));
}

function setFacts(list, facts) {
  list.replaceChildren(...facts.map((fact) => make("div", {}, make("dt", {}, fact.name), make("dd", {}, fact.value, make("small", {}, fact.note)))));
}

function download(address) {
  const link = make("a", { href: address, download: "" });
  document.body.append(link);
  link.click();
  link.remove();
}

async function route() {
  shown?.close();
  shown = null;
  const name = decodeURIComponent(location.hash.slice(1));
  document.title = texts.title;
  if (name) shown = new ProjectPage(name);
  else await showProjects();
  main.focus();
}
window.addEventListener("hashchange", route);
window.addEventListener("message", (event) => { if (event.origin === location.origin && event.data === "changed") shown?.refresh(); });
route();
