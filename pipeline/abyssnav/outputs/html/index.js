// SPDX-License-Identifier: Apache-2.0
"use strict";
// A click on a heading sorts by its column, a second click the other way; what has no value is last.
(() => {
  const table = document.getElementById("dives"), heads = [...table.tHead.rows[0].cells];
  const value = (row, column, numeric) => {
    const cell = row.cells[column], text = cell && cell.dataset.value;
    if (text === undefined) return null;
    return numeric ? Number(text) : text;
  };
  const sortBy = (column, falling) => {
    const numeric = heads[column].dataset.sort === "number";
    const rows = [...table.tBodies[0].rows];
    rows.sort((one, other) => {
      const a = value(one, column, numeric), b = value(other, column, numeric);
      if (a === null || b === null) return (a === null) - (b === null);
      const order = numeric ? a - b : a.localeCompare(b, "en", { numeric: true });
      return falling ? -order : order;
    });
    table.tBodies[0].append(...rows);
    heads.forEach((head, k) => head.setAttribute("aria-sort", k === column ? (falling ? "descending" : "ascending") : "none"));
  };
  heads.forEach((head, column) => {
    if (!head.dataset.sort) return;
    head.tabIndex = 0;
    const turn = () => sortBy(column, head.getAttribute("aria-sort") === "ascending");
    head.onclick = turn;
    head.onkeydown = (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); turn(); } };
  });
})();
