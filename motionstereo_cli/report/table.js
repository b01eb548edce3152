"use strict";
(() => {
  const body = document.querySelector("#recordings tbody");
  const heads = [...document.querySelectorAll("#recordings th[data-column]")];
  const rows = [...body.rows];
  const value = (row, column) => {
    const text = row.cells[column].dataset.sort ?? row.cells[column].textContent.trim();
    return text === "" || isNaN(text) ? text : +text;
  };
  const compare = (a, b) => {  // what is unknown comes last, whatever the direction
    if (a === b) return 0;
    return typeof a === typeof b ? (a < b ? -1 : 1) : typeof a === "number" ? -1 : 1;
  };
  for (const head of heads) {
    head.querySelector("button").addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      heads.forEach((each) => each.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const column = head.cellIndex;
      const sorted = rows.slice().sort((one, other) => {
        const a = value(one, column), b = value(other, column);
        return a === "" || b === "" ? (a === "") - (b === "") : (up ? 1 : -1) * compare(a, b);
      });
      body.append(...sorted);
    });
  }
  const filters = [...document.querySelectorAll("[data-filter]")];
  for (const filter of filters) {
    filter.addEventListener("click", () => {
      const on = filter.getAttribute("aria-pressed") !== "true";
      filters.forEach((each) => each.setAttribute("aria-pressed", each === filter && on));
      rows.forEach((row) => { row.hidden = on && row.dataset.status !== filter.dataset.filter; });
    });
  }
})();
