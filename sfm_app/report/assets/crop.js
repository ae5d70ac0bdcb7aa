"use strict";
// A box whose sides are moved: only what is in it is drawn, and saved by an export.
(() => {
  const viewer = window.sfmViewer;
  if (!viewer) return; // no 3D in this browser
  const panel = document.getElementById("cropped"), button = document.getElementById("crop"), sliders = [...panel.querySelectorAll("input")];
  let on = false, bounds = null, frame = null;

  // opposite corners of the box in the frame of exported files; null where everything stays
  viewer.box = () => {
    if (!on) return null;
    const [low, high] = bounds.map((corner) => corner.toArray());
    const at = (k) => low[k >> 1] + (sliders[k].value / 1000) * (high[k >> 1] - low[k >> 1]);
    return [[at(0), at(2), at(4)], [at(1), at(3), at(5)]];
  };

  function show() {
    if (frame) viewer.scene.remove(frame);
    const box = viewer.box();
    if (box) {
      const [low, high] = box.map((corner) => new THREE.Vector3(...corner)), axes = [0, 1, 2].map((k) => new THREE.Vector3().setComponent(k, 1));
      viewer.clip(axes.flatMap((axis, k) => [new THREE.Plane(axis, -low.getComponent(k)), new THREE.Plane(axis.clone().negate(), high.getComponent(k))]));
      frame = new THREE.Box3Helper(new THREE.Box3(low, high), 0x1d4ed8);
      viewer.scene.add(frame);
      document.getElementById("cropped-size").textContent = `The box is ${viewer.length(...high.clone().sub(low).toArray())}.`;
      const corner = (one) => `"${one.map((value) => Number(value.toPrecision(6))).join(",")}"`;
      viewer.write("command-crop", `sfm-app export ${viewer.folder()} --format glb -o part.glb --box ${box.map(corner).join(" ")}`);
    } else {
      viewer.clip([]);
      frame = null;
    }
    viewer.redraw();
  }

  button.addEventListener("click", () => {
    on = !on;
    if (on) bounds = viewer.bounds();
    button.setAttribute("aria-pressed", String(on));
    panel.hidden = !on;
    show();
  });
  for (const [k, slider] of sliders.entries()) {
    slider.addEventListener("input", () => { // a side does not pass the other one
      const other = Number(sliders[k ^ 1].value);
      if (k % 2 ? slider.value <= other : slider.value >= other) slider.value = other + (k % 2 ? 1 : -1);
      show();
    });
  }
})();
