"use strict";
// Marks on the model or the points: two for a distance, three on a level surface, and the commands that use them.
(() => {
  const viewer = window.sfmViewer;
  if (!viewer) return; // no 3D in this browser
  const { view, canvas } = viewer, byId = (id) => document.getElementById(id);
  const stage = canvas.parentElement, overlay = byId("marks"), say = byId("measured-hint");
  const needed = { measure: 2, level: 3 }, marks = [];
  let mode = "", shown = "measure"; // what clicks are for, and what the marks are of

  const number = (value) => String(Number(value.toPrecision(6)) || 0);
  const coordinates = (point) => point.toArray().map(number).join(",");
  // --scale and --level take places in the frame of the model on disk: before the size was known, or with another one
  const { scale, R, t } = view.fromModel;
  function inModel(point) {
    const at = point.toArray().map((value, k) => (value - t[k]) / scale);
    return [0, 1, 2].map((k) => number(R[k] * at[0] + R[3 + k] * at[1] + R[6 + k] * at[2])).join(",");
  }
  viewer.length = (...values) => `${values.map((value) => Number(value.toPrecision(4))).join(" × ")} ${view.unit || "units of the model"}`;

  function turnOn(wanted) {
    mode = wanted;
    if (mode && mode !== shown) {
      marks.length = 0;
      shown = mode;
    }
    for (const id of Object.keys(needed)) byId(id).setAttribute("aria-pressed", String(mode === id));
    stage.classList.toggle("measuring", mode !== "");
    byId("measured").hidden = !mode && !marks.length;
    if (mode && marks.length === needed[mode]) marks.length = 0;
    show();
  }

  function mark(x, y) {
    const point = viewer.pick(x, y);
    if (!point) {
      say.textContent = "There is neither surface nor point: mark a place on the model.";
      return;
    }
    if (marks.length === needed[mode]) marks.length = 0;
    marks.push(point);
    show();
  }

  // a page that was opened from a file knows the folder that it lies in
  viewer.folder = () => {
    if (view.out) return view.out;
    if (location.protocol !== "file:" || location.host) return "OUT";
    const path = decodeURIComponent(location.pathname).replace(/\/[^/]*$/, "").replace(/^\/(?=[A-Za-z]:)/, "");
    if (/^[\w@%+=:,./-]+$/.test(path)) return path;
    return path[1] === ":" ? `"${path}"` : `'${path.replaceAll("'", `'"'"'`)}'`;
  };

  // a line does not end within an option
  viewer.write = (id, command) => {
    const parts = command.split(/(--\w*)/).map((part, k) => (k % 2 ? Object.assign(document.createElement("span"), { textContent: part }) : part));
    byId(id)?.replaceChildren(...parts);
  };

  function hint(done) {
    const next = "ABC"[marks.length], where = shown === "level" ? "the ground, a table or a floor" : "the model";
    if (!done) return `Mark ${next}: click or tap on ${where}. By keyboard: turn the view until the cross is there, and press Enter.`;
    const result = shown === "level" ? "A, B and C are level." : `A and B are ${viewer.length(marks[0].distanceTo(marks[1]))} apart.`;
    return mode ? `${result} Another click begins again.` : result;
  }

  function show() {
    const [a, b] = marks, done = marks.length === needed[shown], isLength = shown === "measure", out = viewer.folder();
    byId("measured-a").textContent = a ? coordinates(a) : "–";
    byId("measured-b").textContent = b ? coordinates(b) : "–";
    byId("measured-length").textContent = b ? viewer.length(a.distanceTo(b)) : "–";
    byId("measured-values").hidden = !isLength;
    for (const [id, wanted] of [["measured-commands", isLength], ["size", isLength], ["level-command", !isLength], ["stand", !isLength]]) {
      if (byId(id)) byId(id).hidden = !(done && wanted);
    }
    say.textContent = hint(done);
    if (done && isLength && byId("measured-commands")) {
      const places = `"${coordinates(a)}" "${coordinates(b)}"`;
      byId("out-stands").hidden = out !== "OUT";
      viewer.write("command-scale", `sfm-app run PHOTOS -o ${out} --scale "${inModel(a)}" "${inModel(b)}" 1.25m`);
      // after "--", a negative coordinate is no option
      viewer.write("command-measure", `sfm-app measure ${out} ${places.includes('"-') ? "-- " : ""}${places}`);
    }
    byId("turns").hidden = isLength;
    if (done && !isLength) level(levelPlaces());
    canvas.dataset.marks = String(marks.length);
    viewer.redraw();
  }

  // marks lie over the canvas, so that they are as large and as sharp at any distance
  viewer.onDraw = () => {
    const [line, ...spots] = overlay.children, at = marks.map(viewer.project), places = at.filter(Boolean).map(([x, y]) => `${x.toFixed(1)},${y.toFixed(1)}`);
    spots.forEach((spot, k) => {
      spot.setAttribute("display", at[k] ? "inline" : "none");
      if (at[k]) spot.setAttribute("transform", `translate(${at[k][0].toFixed(1)} ${at[k][1].toFixed(1)})`);
    });
    line.setAttribute("points", [...places, ...(places.length === 3 ? [places[0]] : [])].join(" "));
  };
  viewer.places = () => marks.map(inModel);

  // --level takes places counter-clockwise from above: the side that is seen here
  function levelPlaces() {
    const [a, b, c] = marks, normal = b.clone().sub(a).cross(c.clone().sub(a));
    return (normal.dot(viewer.eye.position.clone().sub(a)) > 0 ? [a, b, c] : [a, c, b]).map(inModel);
  }
  function level(places) {
    if (byId("level-command")) byId("level-command").hidden = false;
    viewer.write("command-level", `sfm-app run PHOTOS -o ${viewer.folder()} --level ${places.map((place) => `"${place}"`).join(" ")}`);
  }
  // what is up after a turn by 90 or 180 degrees, as it looks from here: an axis of the model
  function upAfter(turn) {
    const across = new THREE.Vector3(1, 0, 0).applyQuaternion(viewer.eye.quaternion), isX = Math.abs(across.x) > Math.abs(across.z);
    const right = new THREE.Vector3(isX ? Math.sign(across.x) : 0, 0, isX ? 0 : Math.sign(across.z)), up = new THREE.Vector3(0, 1, 0);
    const near = right.clone().cross(up);
    return { over: up.negate(), left: right, right: right.clone().negate(), "towards me": near.clone().negate(), away: near }[turn];
  }
  for (const button of document.querySelectorAll("[data-turn]")) {
    button.addEventListener("click", () => {
      const up = upAfter(button.dataset.turn), side = new THREE.Vector3(up.y, up.z, up.x).multiplyScalar(view.size), other = up.clone().cross(side);
      marks.length = 0;
      show();
      (viewer.onLevel ?? level)([new THREE.Vector3(), side, other].map(inModel));
    });
  }
  byId("stand")?.addEventListener("click", () => viewer.onLevel(levelPlaces()));
  viewer.onTap = (x, y) => {
    if (mode) mark(x, y);
    return mode !== "";
  };
  for (const id of Object.keys(needed)) byId(id).addEventListener("click", () => turnOn(mode === id ? "" : id));
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === "m" || event.key === "M") turnOn(mode === "measure" ? "" : "measure");
    else if (mode && event.key === "Escape") turnOn("");
    else if (mode && (event.key === "Enter" || event.key === " ")) mark(canvas.clientWidth / 2, canvas.clientHeight / 2);
    else return;
    event.preventDefault();
  });
  byId("measured-clear").addEventListener("click", () => { marks.length = 0; turnOn(mode); });
  for (const copy of document.querySelectorAll("[data-copy]")) {
    copy.addEventListener("click", async () => {
      const code = byId(copy.dataset.copy), said = copy.closest(".measured").querySelector("[role=status]");
      getSelection().selectAllChildren(code);
      try {
        await navigator.clipboard.writeText(code.textContent);
        said.textContent = "Copied.";
      } catch { // a page from the disk may not be let to: the text is selected instead
        said.textContent = document.execCommand("copy") ? "Copied." : "It is selected: copy it with Ctrl-C.";
      }
    });
  }
})();
