// What `slip watch` says of the recordings that it follows, read again every few seconds.
import { get, h, sayDuration } from "./parts.js";

const PERIOD_MS = 2000;
const place = document.getElementById("watched");
let shown = "";

const sayAge = (one) => `${one.ended ? "ended" : "last look"} ${sayDuration(one.age_s)} ago`;

// Rows that go on with the one before have its label on the screen, too: none.
const buildRows = (rows) => rows.map(([label, text], row) =>
  h("tr", { data: { label } }, h("th", { scope: "row" }, row && rows[row - 1][0] === label ? "" : label), h("td", {}, text)));

const buildOne = (one) => h("section", { class: `watched${one.ended ? " ended" : ""}`, data: { log: one.log } },
  h("h2", {}, one.log), h("p", { class: "quiet age" }, sayAge(one)), h("table", {}, h("tbody", {}, buildRows(one.rows))));

const show = (watched) => {
  const told = JSON.stringify(watched.map(({ age_s, ...rest }) => rest));
  if (told === shown) {
    // A reader of screens hears what has changed, not every second that passes.
    [...place.querySelectorAll(".age")].forEach((node, index) => (node.textContent = sayAge(watched[index])));
    return;
  }
  shown = told;
  place.replaceChildren(...(watched.length ? watched.map(buildOne) : [h("div", { class: "blank" }, h("h2", {}, "No recording is being watched"),
    h("p", {}, "Start ", h("code", {}, "slip watch RUN"), " or ", h("code", {}, "slip watch ws://127.0.0.1:8765"), " with the same results folder: its output appears here."))]));
};

const follow = async () => {
  try {
    show((await get("/api/live")).watched);
    document.getElementById("toast").hidden = true;
  } catch (error) {
    const toast = document.getElementById("toast");
    toast.textContent = `${error.message}: trying again`;
    toast.hidden = false;
  }
  setTimeout(follow, PERIOD_MS);
};
follow();
