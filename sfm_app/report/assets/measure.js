"use strict";
// Two marks on the model or the points: where they are, how far apart, and the commands that use them.
(() => {
  const viewer = window.sfmViewer;
  if (!viewer) return; // no 3D in this browser
  const { view, canvas } = viewer, byId = (id) => document.getElementById(id);
  const button = byId("measure"), stage = canvas.parentElement, overlay = byId("marks"), say = byId("measured-hint");
  const marks = [];
  let on = false;

  const number = (value) => String(Number(value.toPrecision(6)) || 0);
  const coordinates = (point) => point.toArray().map(number).join(",");
  // --scale takes places in the frame of the model on disk: before the size was known, or with another one
  const { scale, R, t } = view.fromModel;
  function inModel(point) {
    const at = point.toArray().map((value, k) => (value - t[k]) / scale);
    return [0, 1, 2].map((k) => number(R[k] * at[0] + R[3 + k] * at[1] + R[6 + k] * at[2])).join(",");
  }
  const length = (value) => (view.unit ? `${Number(value.toPrecision(4))} ${view.unit}` : `${Number(value.toPrecision(4))} units of the model`);

  function turnOn(wanted) {
    on = wanted;
    button.setAttribute("aria-pressed", String(on));
    stage.classList.toggle("measuring", on);
    byId("measured").hidden = !on && !marks.length;
    if (on && marks.length === 2) marks.length = 0;
    show();
  }

  function mark(x, y) {
    const point = viewer.pick(x, y);
    if (!point) {
      say.textContent = "There is neither surface nor point: mark a place on the model.";
      return;
    }
    if (marks.length === 2) marks.length = 0;
    marks.push(point);
    show();
  }

  // a page that was opened from a file knows the folder that it lies in
  function folder() {
    if (location.protocol !== "file:" || location.host) return "OUT";
    const path = decodeURIComponent(location.pathname).replace(/\/[^/]*$/, "").replace(/^\/(?=[A-Za-z]:)/, "");
    if (/^[\w@%+=:,./-]+$/.test(path)) return path;
    return path[1] === ":" ? `"${path}"` : `'${path.replaceAll("'", `'"'"'`)}'`;
  }

  // a line does not end within an option
  function write(id, command) {
    const parts = command.split(/(--\w*)/).map((part, k) => (k % 2 ? Object.assign(document.createElement("span"), { textContent: part }) : part));
    byId(id).replaceChildren(...parts);
  }

  function show() {
    const [a, b] = marks;
    byId("measured-a").textContent = a ? coordinates(a) : "–";
    byId("measured-b").textContent = b ? coordinates(b) : "–";
    byId("measured-length").textContent = b ? length(a.distanceTo(b)) : "–";
    if (byId("measured-commands")) byId("measured-commands").hidden = !b;
    viewer.onMarks?.(marks);
    say.textContent = b
      ? `A and B are ${length(a.distanceTo(b))} apart.${on ? " Another click begins again." : ""}`
      : `Mark ${a ? "B" : "A"}: click or tap on the model. By keyboard: turn the view until the cross is there, and press Enter.`;
    if (b && byId("measured-commands")) {
      const places = `"${coordinates(a)}" "${coordinates(b)}"`, out = view.out || folder();
      byId("out-stands").hidden = out !== "OUT";
      write("command-scale", `sfm-app run PHOTOS -o ${out} --scale "${inModel(a)}" "${inModel(b)}" 1.25m`);
      // after "--", a negative coordinate is no option
      write("command-measure", `sfm-app measure ${out} ${places.includes('"-') ? "-- " : ""}${places}`);
    }
    canvas.dataset.marks = String(marks.length);
    viewer.redraw();
  }

  // marks lie over the canvas, so that they are as large and as sharp at any distance
  viewer.onDraw = () => {
    const [line, ...spots] = overlay.children, at = marks.map(viewer.project);
    spots.forEach((spot, k) => {
      spot.setAttribute("display", at[k] ? "inline" : "none");
      if (at[k]) spot.setAttribute("transform", `translate(${at[k][0].toFixed(1)} ${at[k][1].toFixed(1)})`);
    });
    const both = at[0] && at[1];
    line.setAttribute("display", both ? "inline" : "none");
    if (both) for (const [name, value] of [["x1", at[0][0]], ["y1", at[0][1]], ["x2", at[1][0]], ["y2", at[1][1]]]) line.setAttribute(name, value.toFixed(1));
  };
  viewer.places = () => marks.map(inModel);
  viewer.onTap = (x, y) => {
    if (on) mark(x, y);
    return on;
  };
  button.addEventListener("click", () => turnOn(!on));
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === "m" || event.key === "M") turnOn(!on);
    else if (on && event.key === "Escape") turnOn(false);
    else if (on && (event.key === "Enter" || event.key === " ")) mark(canvas.clientWidth / 2, canvas.clientHeight / 2);
    else return;
    event.preventDefault();
  });
  byId("measured-clear").addEventListener("click", () => { marks.length = 0; turnOn(on); });
  for (const copy of document.querySelectorAll("[data-copy]")) {
    copy.addEventListener("click", async () => {
      const code = byId(copy.dataset.copy);
      getSelection().selectAllChildren(code);
      try {
        await navigator.clipboard.writeText(code.textContent);
        say.textContent = "Copied.";
      } catch { // a page from the disk may not be let to: the text is selected instead
        say.textContent = document.execCommand("copy") ? "Copied." : "It is selected: copy it with Ctrl-C.";
      }
    });
  }
})();
