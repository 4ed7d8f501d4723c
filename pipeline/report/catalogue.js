"use strict";
const body = document.querySelector("tbody");
const heads = [...document.querySelectorAll("thead button")];
const read = (row, column) => row.cells[column].dataset.value ?? row.cells[column].textContent;

function compare(a, b, numeric) {
  if (a === "" || b === "") return (a === "") - (b === "");
  return numeric ? Number(a) - Number(b) : a.localeCompare(b, undefined, { numeric: true });
}

heads.forEach((head, column) => head.addEventListener("click", () => {
  const cell = head.parentElement;
  const down = cell.getAttribute("aria-sort") === "ascending";
  heads.forEach((other) => other.parentElement.removeAttribute("aria-sort"));
  cell.setAttribute("aria-sort", down ? "descending" : "ascending");
  const numeric = cell.classList.contains("number");
  const rows = [...body.rows].map((row) => [read(row, column), row]);
  rows.sort(([a], [b]) => {
    const empty = (a === "") - (b === "");
    return empty || (down ? -compare(a, b, numeric) : compare(a, b, numeric));
  });
  body.append(...rows.map(([, row]) => row));
}));

const wanted = document.querySelector("#wanted");
const shown = document.querySelector("#shown");
wanted.addEventListener("input", () => {
  const words = wanted.value.toLowerCase().split(/\s+/).filter(Boolean);
  let count = 0;
  for (const row of body.rows) {
    const text = row.textContent.toLowerCase();
    row.hidden = !words.every((word) => text.includes(word));
    count += !row.hidden;
  }
  shown.textContent = `${count} of ${body.rows.length} runs`;
});
