"use strict";
// Two marks and a length give the model its real size: the studio runs the last stages again.
(() => {
  const viewer = window.sfmViewer, form = document.getElementById("size");
  if (!viewer || !form) return;
  viewer.onMarks = (places) => { form.hidden = places.length < 2; };
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const length = `${document.getElementById("size-length").value.replace(",", ".")}${document.getElementById("size-unit").value}`;
    const answer = await fetch(location.pathname.replace(/\/view\/$/, ""), { method: "PATCH", body: JSON.stringify({ size: [...viewer.places(), length] }) });
    const said = document.getElementById("measured-hint");
    said.textContent = answer.ok ? "The size is set; the model follows in a moment." : (await answer.json()).message;
    if (answer.ok) window.parent.postMessage("changed", window.location.origin);
  });
})();
