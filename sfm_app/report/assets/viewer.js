"use strict";
// The 3D view: an orbit around a point, with up kept upright; cameras that can be chosen. Other scripts add to `sfmViewer`.
(() => {
  const { view, photos } = JSON.parse(document.getElementById("data").textContent);
  const canvas = document.getElementById("view");
  const byId = (id) => document.getElementById(id);
  const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  } catch {
    byId("view-failed").textContent = "This browser shows no 3D (WebGL is off). The model is model.glb beside this page.";
    byId("view-failed").hidden = false;
    document.querySelector(".stage").hidden = true;
    return;
  }
  renderer.outputEncoding = THREE.sRGBEncoding;
  renderer.localClippingEnabled = true;
  renderer.setClearColor(0xeceae8);
  const scene = new THREE.Scene();
  scene.add(new THREE.HemisphereLight(0xffffff, 0x888888, 1.2));
  const size = view.size, home = new THREE.Vector3(...view.middle);
  const eye = new THREE.PerspectiveCamera(50, 1, size / 500, size * 50);

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

  // orbit: angles in radians, distance from the target; a fly-to ends in a pose of its own until the user turns again
  const orbit = { target: home.clone(), turn: 0.6, tilt: 0.45, distance: 1.6 * size };
  let flying = null, held = false, moved = false, dirty = true; // moved: by the user, who then keeps the view

  function place() {
    const flat = Math.cos(orbit.tilt);
    eye.position.set(
      orbit.target.x + orbit.distance * flat * Math.sin(orbit.turn),
      orbit.target.y + orbit.distance * Math.sin(orbit.tilt),
      orbit.target.z + orbit.distance * flat * Math.cos(orbit.turn),
    );
    eye.up.set(0, 1, 0);
    eye.lookAt(orbit.target);
    dirty = true;
  }

  // continue from where the eye is now, after a flight
  function takeOver() {
    flying = null;
    moved = true;
    if (!held) return;
    held = false;
    const ahead = new THREE.Vector3(0, 0, -1).applyQuaternion(eye.quaternion);
    orbit.distance = Math.max(eye.position.distanceTo(home) * 0.6, size * 0.05);
    orbit.target.copy(eye.position).addScaledVector(ahead, orbit.distance);
    orbit.tilt = Math.asin(Math.max(-1, Math.min(1, -ahead.y)));
    orbit.turn = Math.atan2(-ahead.x, -ahead.z);
    eye.fov = 50;
    eye.updateProjectionMatrix();
  }

  // of the whole photo of a camera
  const fieldDeg = (one) => THREE.MathUtils.radToDeg(2 * Math.atan(Math.max(one.down, one.across / eye.aspect)));

  // from in front, as near as nearly everything is seen
  function showAll() {
    flying = null; held = false; moved = false;
    Object.assign(orbit, { turn: startTurn(), tilt: 0.35, distance: 1.15 * size });
    orbit.target.copy(home);
    eye.fov = 50;
    eye.updateProjectionMatrix();
    place();
    const seen = places();
    if (!seen.length) return;
    eye.updateMatrixWorld();
    for (const at of seen) at.applyMatrix4(eye.matrixWorldInverse);
    const part = (values, share) => values.sort((a, b) => a - b)[Math.floor(share * (values.length - 1))];
    const middle = new THREE.Vector3(...["x", "y", "z"].map((axis) => (part(seen.map((at) => at[axis]), 0.03) + part(seen.map((at) => at[axis]), 0.97)) / 2));
    const tall = Math.tan(THREE.MathUtils.degToRad(eye.fov / 2));
    const away = seen.map((at) => at.sub(middle)).map(({ x, y, z }) => z + Math.max(Math.abs(x) / eye.aspect, Math.abs(y)) / tall);
    orbit.distance = Math.max(1.05 * part(away, 0.97), size / 20);
    orbit.target.copy(middle.applyMatrix4(eye.matrixWorld));
    place();
  }

  // some places of the model, or of the points
  function places() {
    const found = [], all = [];
    (model ?? points).traverse((node) => { if (node.geometry) all.push(node.geometry.getAttribute("position")); });
    const step = Math.ceil(all.reduce((sum, one) => sum + one.count, 0) / 3000);
    for (const one of all) for (let k = 0; k < one.count; k += step) found.push(new THREE.Vector3().fromBufferAttribute(one, k));
    return found;
  }

  // look from where the cameras stood, on average; where they stood all round, from where the middle one did
  function startTurn() {
    const sum = new THREE.Vector3();
    for (const one of view.cameras) sum.add(new THREE.Vector3(one.matrix[8], 0, one.matrix[10]));
    if (sum.lengthSq() > 0.01 * view.cameras.length ** 2) return Math.atan2(sum.x, sum.z);
    const middle = view.cameras[Math.floor(view.cameras.length / 2)];
    return middle ? Math.atan2(middle.matrix[8], middle.matrix[10]) : 0.6;
  }

  let model = null;
  // points: in the page, or in levels from coarse to fine that are loaded when they are shown
  const points = new THREE.Group(), dots = new THREE.PointsMaterial({ vertexColors: true, size: 2.5, sizeAttenuation: false });
  const toLinear = Float32Array.from({ length: 256 }, (_, k) => new THREE.Color(k / 255, 0, 0).convertSRGBToLinear().r);
  function addPoints(places, colors) {
    const cloud = new THREE.BufferGeometry();
    cloud.setAttribute("position", new THREE.BufferAttribute(places, 3));
    const linear = new Float32Array(colors.length);
    for (let k = 0; k < colors.length; k += 1) linear[k] = toLinear[colors[k]];
    cloud.setAttribute("color", new THREE.BufferAttribute(linear, 3));
    points.add(new THREE.Points(cloud, dots));
    dirty = true;
  }
  scene.add(points);
  let nextLevel = 0, loadingPoints = false;
  async function loadPoints() {
    if (!view.levels || loadingPoints) return;
    loadingPoints = true;
    while (points.visible && nextLevel < view.levels.length) {
      const count = view.levels[nextLevel], data = await load(`points/${nextLevel}`, `points, level ${nextLevel + 1} of ${view.levels.length}`);
      if (!data) break;
      addPoints(new Float32Array(data, 0, 3 * count), new Uint8Array(data, 12 * count));
      if (!nextLevel && !model && !moved) showAll();
      nextLevel += 1;
    }
    loadingPoints = false;
    canvas.dataset.levels = String(nextLevel);
  }

  // a file from where the page is from; undefined where it cannot be had
  const status = byId("loading");
  async function load(address, what) {
    try {
      const answer = await fetch(address);
      if (!answer.ok) throw new Error(`${answer.status}`);
      const whole = Number(answer.headers.get("Content-Length")), reader = answer.body.getReader(), data = new Uint8Array(whole);
      for (let at = 0, part; !(part = await reader.read()).done; at += part.value.length) {
        data.set(part.value, at);
        status.textContent = whole > 2e6 ? `loading the ${what}: ${Math.round((100 * at) / whole)} % of ${(whole / 1e6).toFixed(0)} MB` : "";
      }
      status.textContent = "";
      return data.buffer;
    } catch {
      status.setAttribute("role", "alert");
      status.textContent = `The ${what} could not be loaded. Is sfm-app view still running?`;
      return undefined;
    }
  }

  // cameras
  const frusta = new THREE.Group(), centers = [];
  const usual = new THREE.LineBasicMaterial({ color: 0xc2410c }), marked = new THREE.LineBasicMaterial({ color: 0x1d4ed8 });
  view.cameras.forEach((one, number) => {
    const d = view.depth, x = d * one.across, y = d * one.down;
    const corners = [[0, 0, 0], [-x, y, -d], [x, y, -d], [x, -y, -d], [-x, -y, -d]];
    const edges = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1].flatMap((k) => corners[k]);
    const shape = new THREE.BufferGeometry();
    shape.setAttribute("position", new THREE.Float32BufferAttribute(edges, 3));
    const lines = new THREE.LineSegments(shape, usual);
    lines.matrixAutoUpdate = false;
    lines.matrix.fromArray(one.matrix);
    lines.userData.number = number;
    frusta.add(lines);
    centers.push(new THREE.Vector3(one.matrix[12], one.matrix[13], one.matrix[14]));
  });
  scene.add(frusta);

  // model
  const tick = (id, on) => byId(id).addEventListener("change", (event) => { on(event.target.checked); dirty = true; });
  tick("show-points", (on) => { points.visible = on; loadPoints(); });
  tick("show-cameras", (on) => { frusta.visible = on; });
  tick("show-model", (on) => { if (model) model.visible = on; });
  function withoutModel() {
    byId("show-points").checked = points.visible = true;
    byId("show-model").disabled = true;
    byId("show-model").checked = false;
    dirty = true;
  }
  function showModel(data) {
    return new Promise((ready, failed) => new THREE.GLTFLoader().parse(data, "", (found) => {
      const lines = [];
      found.scene.traverse((node) => { if (node.isLine || node.isLineSegments) lines.push(node); });
      for (const node of lines) node.parent.remove(node); // the file's own cameras: these here can be chosen
      if (model) discard(model);
      model = found.scene;
      if (!moved) showAll();
      clip(planes);
      model.visible = byId("show-model").checked;
      scene.add(model);
      dirty = true;
      ready();
    }, failed));
  }
  function discard(old) {
    scene.remove(old);
    old.traverse((node) => {
      node.geometry?.dispose();
      node.material?.map?.dispose();
      node.material?.dispose();
    });
  }
  // points are seen at once; then the light model, where there is one; then the full one takes its place
  async function loadModels() {
    loadPoints();
    for (const [number, address] of view.models.entries()) {
      const what = number + 1 < view.models.length ? "light model" : "full model";
      const data = await load(address, what);
      try {
        if (!data) continue;
        await showModel(data);
        canvas.dataset.model = number + 1 < view.models.length ? "light" : "shown";
        if (number === 0) points.visible = byId("show-points").checked;
      } catch {
        status.textContent = `The ${what} cannot be shown here.`;
      }
    }
    if (!model) withoutModel();
    loadPoints();
  }
  if (view.levels) {
    loadModels();
  } else {
    points.visible = !view.glb;
    addPoints(new Float32Array(bytes(view.places).buffer), bytes(view.colors));
    if (view.glb) showModel(bytes(view.glb).buffer).then(() => { canvas.dataset.model = "shown"; }, withoutModel);
    else withoutModel();
  }

  // what is behind one of the planes is not drawn
  let planes = [];
  function clip(wanted) {
    planes = wanted;
    dots.clippingPlanes = planes;
    model?.traverse((node) => { if (node.material) node.material.clippingPlanes = planes; });
    dirty = true;
  }

  // choosing a camera, whose photo can be beside the model
  let chosen = -1;
  const stage = canvas.parentElement;
  function choose(number, fly) {
    chosen = number;
    for (const lines of frusta.children) lines.material = lines.userData.number === number ? marked : usual;
    const one = view.cameras[number], photo = photos[one.row];
    const row = document.querySelector(`tr[data-row="${one.row}"] img`);
    byId("chosen").hidden = false;
    const picture = byId("chosen-picture"), large = view.photos ? `${view.photos}/${one.row}` : "";
    picture.dataset.large = large;
    picture.src = stage.classList.contains("twin") && large ? large : row ? row.src : view.photos ? `pictures/${one.row}` : "";
    picture.alt = `The photo ${one.name}`;
    const more = photo && photo.points !== undefined ? `${photo.points} points, ${(photo.residual_px ?? 0).toFixed(2)} px` : "";
    byId("chosen-text").textContent = [one.name, more].filter(Boolean).join(" · ");
    canvas.dataset.chosen = one.name;
    if (fly) flyTo(one);
    dirty = true;
  }

  function flyTo(one) {
    moved = true;
    const matrix = new THREE.Matrix4().fromArray(one.matrix), to = { position: new THREE.Vector3(), turn: new THREE.Quaternion() };
    matrix.decompose(to.position, to.turn, new THREE.Vector3());
    flying = { from: { position: eye.position.clone(), turn: eye.quaternion.clone(), fov: eye.fov }, to, fov: fieldDeg(one), start: performance.now() };
    held = true;
  }

  function nearestCamera(x, y) {
    const box = canvas.getBoundingClientRect(), at = new THREE.Vector3();
    let best = -1, least = 18;
    if (!frusta.visible) return best;
    centers.forEach((center, number) => {
      at.copy(center).project(eye);
      if (at.z > 1) return;
      const off = Math.hypot((at.x + 1) / 2 * box.width - x, (1 - at.y) / 2 * box.height - y);
      if (off < least) { least = off; best = number; }
    });
    return best;
  }

  // pointer, wheel, keys
  const fingers = new Map();
  let dragged = 0, apart = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    dragged = 0; apart = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) {
      canvas.style.cursor = nearestCamera(event.offsetX, event.offsetY) >= 0 ? "pointer" : "grab";
      return;
    }
    const dx = event.offsetX - before[0], dy = event.offsetY - before[1];
    dragged += Math.hypot(dx, dy);
    if (dragged < 5 && fingers.size === 1) return; // a click, so far
    takeOver();
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (fingers.size === 2) {
      const [a, b] = [...fingers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (apart) zoom(apart / now);
      apart = now;
      pan(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) {
      pan(dx, dy);
    } else {
      turn(-dx * 0.006, dy * 0.006);
    }
  });
  const lift = (event) => {
    const last = fingers.get(event.pointerId);
    fingers.delete(event.pointerId);
    if (last && dragged < 5 && event.type === "pointerup" && fingers.size === 0) {
      if (viewer.onTap?.(event.offsetX, event.offsetY)) return;
      const number = nearestCamera(event.offsetX, event.offsetY);
      if (number >= 0) choose(number, true);
    }
  };
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    takeOver();
    zoom(Math.exp(Math.sign(event.deltaY) * 0.1));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const shift = event.shiftKey;
    const keys = {
      ArrowLeft: () => (shift ? pan(30, 0) : turn(-0.1, 0)), ArrowRight: () => (shift ? pan(-30, 0) : turn(0.1, 0)),
      ArrowUp: () => (shift ? pan(0, 30) : turn(0, 0.08)), ArrowDown: () => (shift ? pan(0, -30) : turn(0, -0.08)),
      "+": () => zoom(0.85), "=": () => zoom(0.85), "-": () => zoom(1.18), 0: showAll,
      n: () => step(1), p: () => step(-1),
    };
    if (!(event.key in keys)) return;
    event.preventDefault();
    if (!"0np".includes(event.key)) takeOver();
    keys[event.key]();
  });
  function turn(across, up) {
    orbit.turn += across;
    orbit.tilt = Math.max(-1.5, Math.min(1.5, orbit.tilt + up));
    place();
  }
  function zoom(factor) {
    orbit.distance = Math.max(size / 200, Math.min(size * 20, orbit.distance * factor));
    place();
  }
  function pan(dx, dy) {
    const step = 2 * orbit.distance * Math.tan(THREE.MathUtils.degToRad(eye.fov / 2)) / canvas.clientHeight;
    const right = new THREE.Vector3(1, 0, 0).applyQuaternion(eye.quaternion), up = new THREE.Vector3(0, 1, 0).applyQuaternion(eye.quaternion);
    orbit.target.addScaledVector(right, -dx * step).addScaledVector(up, dy * step);
    place();
  }
  byId("show-all").addEventListener("click", showAll);
  function beside(on) {
    stage.classList.toggle("twin", on);
    byId("chosen-beside").setAttribute("aria-pressed", String(on));
    fit();
    if (on) choose(chosen, true);
  }
  const step = (by) => choose((Math.max(chosen, -by) + by + view.cameras.length) % view.cameras.length, true);
  byId("chosen-beside").addEventListener("click", () => beside(!stage.classList.contains("twin")));
  byId("chosen-before").addEventListener("click", () => step(-1));
  byId("chosen-after").addEventListener("click", () => step(1));
  byId("chosen-close").addEventListener("click", () => {
    byId("chosen").hidden = true;
    beside(false);
    for (const lines of frusta.children) lines.material = usual;
    dirty = true;
    canvas.focus();
  });

  // what is seen at a place of the canvas: the surface, else the nearest of the points around it
  const ray = new THREE.Raycaster(), NEAR_PX = 8;
  function pick(x, y) {
    const { clientWidth: width, clientHeight: height } = canvas;
    eye.updateMatrixWorld(); // it may have moved since the last frame
    ray.setFromCamera({ x: (2 * x) / width - 1, y: 1 - (2 * y) / height }, eye);
    const isDrawn = (point) => planes.every((plane) => plane.distanceToPoint(point) >= 0);
    const hit = model?.visible ? ray.intersectObject(model, true).find((one) => isDrawn(one.point)) : undefined;
    if (hit) return hit.point;
    if (!points.visible) return null;
    const at = new THREE.Vector3(), toScreen = new THREE.Matrix4().multiplyMatrices(eye.projectionMatrix, eye.matrixWorldInverse);
    let least = Infinity, best = null;
    for (const cloud of points.children) {
      const all = cloud.geometry.getAttribute("position");
      for (let k = 0; k < all.count; k += 1) {
        const isHidden = !isDrawn(at.fromBufferAttribute(all, k));
        at.applyMatrix4(toScreen);
        const off = Math.hypot(((at.x + 1) / 2) * width - x, ((1 - at.y) / 2) * height - y);
        if (!isHidden && Math.abs(at.z) < 1 && off < NEAR_PX && at.z < least) { least = at.z; best = new THREE.Vector3().fromBufferAttribute(all, k); }
      }
    }
    return best;
  }

  // where a point of the scene is on the canvas, in pixels; null behind the eye
  function project(point) {
    const at = point.clone().project(eye);
    return at.z > 1 ? null : [((at.x + 1) / 2) * canvas.clientWidth, ((1 - at.y) / 2) * canvas.clientHeight];
  }
  // corners of what is drawn: of the model, or of the points
  function bounds() {
    const box = new THREE.Box3().setFromObject(model ?? points);
    return [box.min, box.max];
  }
  const viewer = { view, canvas, scene, eye, pick, project, clip, bounds, redraw: () => { dirty = true; }, onTap: null, onDraw: null };
  window.sfmViewer = viewer;

  // rows of the table fly to their camera
  const numberOfRow = new Map(view.cameras.map((one, number) => [one.row, number]));
  for (const row of document.querySelectorAll("#photo-table tbody tr")) {
    const number = numberOfRow.get(Number(row.dataset.row)), name = row.querySelector("th");
    if (number === undefined) continue;
    const button = document.createElement("button");
    button.type = "button";
    button.className = "sort";
    button.textContent = name.textContent;
    button.title = "Show in the 3D view";
    button.addEventListener("click", () => { choose(number, true); byId("model").scrollIntoView(); });
    name.replaceChildren(button);
  }

  function fit() {
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return; // not shown now
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    eye.aspect = width / height;
    if (held && !flying) eye.fov = fieldDeg(view.cameras[chosen]);
    eye.updateProjectionMatrix();
    dirty = true;
  }
  new ResizeObserver(fit).observe(canvas);

  function draw(now) {
    requestAnimationFrame(draw);
    if (flying) {
      const done = still ? 1 : Math.min(1, (now - flying.start) / 900), part = done * done * (3 - 2 * done);
      eye.position.lerpVectors(flying.from.position, flying.to.position, part);
      eye.quaternion.slerpQuaternions(flying.from.turn, flying.to.turn, part);
      eye.fov = flying.from.fov + (flying.fov - flying.from.fov) * part;
      eye.updateProjectionMatrix();
      if (done >= 1) flying = null;
      dirty = true;
    }
    if (!dirty) return;
    dirty = false;
    renderer.render(scene, eye);
    viewer.onDraw?.();
  }
  fit();
  showAll();
  requestAnimationFrame(draw);
})();
