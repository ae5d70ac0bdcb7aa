"use strict";
// Marks give the model its real size, or turn it upright: the studio runs the last stages again.
(() => {
  const viewer = window.sfmViewer, byId = (id) => document.getElementById(id);
  if (!viewer) return;
  async function change(values, done) {
    const answer = await fetch(location.pathname.replace(/\/view\/$/, ""), { method: "PATCH", body: JSON.stringify(values) });
    byId("measured-hint").textContent = answer.ok ? done : (await answer.json()).message;
    if (answer.ok) window.parent.postMessage("changed", window.location.origin);
  }
  byId("size").addEventListener("submit", (event) => {
    event.preventDefault();
    const length = `${byId("size-length").value.replace(",", ".")}${byId("size-unit").value}`;
    change({ size: [...viewer.places(), length] }, "The size is set; the model follows in a moment.");
  });
  viewer.onLevel = (level) => change({ level }, "The model turns in a moment.");
})();
