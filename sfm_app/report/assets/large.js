"use strict";
// a click on the photo of a chosen camera shows it as large as the screen allows
(() => {
  const small = document.getElementById("chosen-picture"), dialog = document.getElementById("large");
  if (!small || !dialog) return;
  const picture = dialog.querySelector("img");
  document.getElementById("chosen-larger").addEventListener("click", () => {
    picture.src = small.dataset.large || small.src;
    picture.alt = small.alt;
    dialog.showModal();
  });
  dialog.addEventListener("click", () => dialog.close());
})();
