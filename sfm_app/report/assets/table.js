"use strict";
// a click on a title sorts the photos by that column, another one the other way round
(() => {
  const table = document.getElementById("photo-table");
  if (!table) return;
  const body = table.tBodies[0];
  const value = (row, column) => row.cells[column].textContent.trim();
  for (const button of table.tHead.querySelectorAll(".sort")) {
    button.addEventListener("click", () => {
      const column = Number(button.dataset.column);
      const title = button.closest("th");
      const down = title.getAttribute("aria-sort") === "ascending";
      for (const other of table.querySelectorAll("th[aria-sort]")) other.removeAttribute("aria-sort");
      title.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = [...body.rows].sort((a, b) => {
        const x = value(a, column), y = value(b, column);
        const order = column > 2 ? (parseFloat(x) || -1) - (parseFloat(y) || -1) : x.localeCompare(y, undefined, { numeric: true });
        return down ? -order : order;
      });
      body.append(...rows);
    });
  }
})();
