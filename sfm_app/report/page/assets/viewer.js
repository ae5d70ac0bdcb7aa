"use strict";
// The 3D view: an orbit around a point, with up kept upright; cameras that can be chosen.
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
  renderer.setClearColor(0xeceae8);
  const scene = new THREE.Scene();
  scene.add(new THREE.HemisphereLight(0xffffff, 0x888888, 1.2));
  const size = view.size, home = new THREE.Vector3(...view.middle);
  const eye = new THREE.PerspectiveCamera(50, 1, size / 500, size * 50);

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

  // orbit: angles in radians, distance from the target; a fly-to ends in a pose of its own until the user turns again
  const orbit = { target: home.clone(), turn: 0.6, tilt: 0.45, distance: 1.6 * size };
  let flying = null, held = false, dirty = true;

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

  function showAll() {
    flying = null; held = false;
    Object.assign(orbit, { turn: startTurn(), tilt: 0.35, distance: 1.15 * size });
    orbit.target.copy(home);
    eye.fov = 50;
    eye.updateProjectionMatrix();
    place();
  }

  // look from where the cameras stood, on average
  function startTurn() {
    const sum = new THREE.Vector3();
    for (const one of view.cameras) sum.add(new THREE.Vector3(one.matrix[8], 0, one.matrix[10]));
    return sum.lengthSq() > 0.01 * view.cameras.length ** 2 ? Math.atan2(sum.x, sum.z) : 0.6;
  }

  // points
  const places = new Float32Array(bytes(view.places).buffer), colors = bytes(view.colors);
  const cloud = new THREE.BufferGeometry();
  cloud.setAttribute("position", new THREE.BufferAttribute(places, 3));
  const linear = new Float32Array(colors.length), color = new THREE.Color();
  for (let k = 0; k < colors.length; k += 3) {
    color.setRGB(colors[k] / 255, colors[k + 1] / 255, colors[k + 2] / 255).convertSRGBToLinear().toArray(linear, k);
  }
  cloud.setAttribute("color", new THREE.BufferAttribute(linear, 3));
  const points = new THREE.Points(cloud, new THREE.PointsMaterial({ vertexColors: true, size: 2.5, sizeAttenuation: false }));
  scene.add(points);

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
  let model = null;
  const tick = (id, on) => byId(id).addEventListener("change", (event) => { on(event.target.checked); dirty = true; });
  tick("show-points", (on) => { points.visible = on; });
  tick("show-cameras", (on) => { frusta.visible = on; });
  tick("show-model", (on) => { if (model) model.visible = on; });
  function withoutModel() {
    byId("show-points").checked = points.visible = true;
    byId("show-model").disabled = true;
    byId("show-model").checked = false;
    dirty = true;
  }
  points.visible = !view.glb;
  if (view.glb) {
    new THREE.GLTFLoader().parse(bytes(view.glb).buffer, "", (found) => {
      model = found.scene;
      const lines = [];
      model.traverse((node) => { if (node.isLine || node.isLineSegments) lines.push(node); });
      for (const node of lines) node.parent.remove(node); // the file's own cameras: these here can be chosen
      scene.add(model);
      dirty = true;
      canvas.dataset.model = "shown";
    }, withoutModel);
  } else {
    withoutModel();
  }

  // choosing a camera
  function choose(number, fly) {
    for (const lines of frusta.children) lines.material = lines.userData.number === number ? marked : usual;
    const one = view.cameras[number], photo = photos[one.row];
    const row = document.querySelector(`tr[data-row="${one.row}"] img`);
    byId("chosen").hidden = false;
    byId("chosen-picture").src = row ? row.src : "";
    byId("chosen-picture").alt = `The photo ${one.name}`;
    const more = photo && photo.points !== undefined ? `${photo.points} points, ${(photo.residual_px ?? 0).toFixed(2)} px` : "";
    byId("chosen-text").textContent = [one.name, more].filter(Boolean).join(" · ");
    canvas.dataset.chosen = one.name;
    if (fly) flyTo(one);
    dirty = true;
  }

  function flyTo(one) {
    const matrix = new THREE.Matrix4().fromArray(one.matrix), to = { position: new THREE.Vector3(), turn: new THREE.Quaternion() };
    matrix.decompose(to.position, to.turn, new THREE.Vector3());
    const aspect = eye.aspect, tall = Math.max(one.down, one.across / aspect);
    flying = { from: { position: eye.position.clone(), turn: eye.quaternion.clone(), fov: eye.fov }, to, fov: THREE.MathUtils.radToDeg(2 * Math.atan(tall)), start: performance.now() };
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
  let moved = 0, apart = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    moved = 0; apart = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) {
      canvas.style.cursor = nearestCamera(event.offsetX, event.offsetY) >= 0 ? "pointer" : "grab";
      return;
    }
    const dx = event.offsetX - before[0], dy = event.offsetY - before[1];
    moved += Math.hypot(dx, dy);
    if (moved < 5 && fingers.size === 1) return; // a click, so far
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
    if (last && moved < 5 && event.type === "pointerup" && fingers.size === 0) {
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
    const keys = {
      ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, 0.08), ArrowDown: () => turn(0, -0.08),
      "+": () => zoom(0.85), "=": () => zoom(0.85), "-": () => zoom(1.18), 0: showAll,
    };
    if (!(event.key in keys)) return;
    event.preventDefault();
    if (event.key !== "0") takeOver();
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
  byId("chosen-close").addEventListener("click", () => {
    byId("chosen").hidden = true;
    for (const lines of frusta.children) lines.material = usual;
    dirty = true;
    canvas.focus();
  });

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
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    eye.aspect = width / height;
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
  }
  fit();
  showAll();
  requestAnimationFrame(draw);
})();
