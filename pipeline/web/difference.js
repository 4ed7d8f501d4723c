// Two models beside each other: how far their errors are apart, when, and which numbers differ.
import { h, inAngle, inLength, say, sayShare, setSquares } from "./parts.js";

const LINES = "reach";
let apart = null;

const ERRORS = [["t", "position error over 2 s", inLength], ["r", "heading error over 2 s", inAngle]];

export const showDifference = (place, one, other) => {
  const [a, b] = [one?.state?.session, other?.state?.session];
  place.hidden = !(a && b);
  if (place.hidden) return;
  const signed = (value) => `${value > 0 ? "+" : ""}${say(value)}`;
  const rows = ERRORS.map(([key, name, inUnit]) => {
    const fall = b.errors[key] - a.errors[key];
    // One unit a row: that of the smaller error.
    const { factor, unit } = inUnit(Math.min(a.errors[key], b.errors[key]));
    const near = Math.abs(fall) < 0.005 * a.errors[key];
    return h("tr", {},
      h("th", { scope: "row" }, `${name} [${unit}]`), h("td", {}, say(a.errors[key] * factor)), h("td", {}, say(b.errors[key] * factor)),
      h("td", { class: near ? "" : fall < 0 ? "fallen" : "risen" }, near ? "the same" : `${signed(fall * factor)} (${sayShare(fall / a.errors[key])})`));
  });
  const numbers = listNumbers(a, b).map(([name, first, second]) => h("tr", { class: "parameter" },
    h("th", { scope: "row" }, name), h("td", {}, first === null ? "not in it" : say(first, 3)), h("td", {}, second === null ? "not in it" : say(second, 3)),
    h("td", {}, first === null || second === null ? "" : first === second ? "the same" : signed(second - first))));
  const alike = a.run === b.run && a.input === b.input;
  place.replaceChildren(
    h("table", {},
      h("thead", {}, h("tr", {}, h("td", {}, alike ? "" : "two runs or inputs, each with its own error"), ["A", "B", "B − A"].map((name) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, rows, numbers)));
};

const listNumbers = (a, b) => {
  const numbers = (session) => new Map(session.effects.flatMap((effect) =>
    effect.parameters.map(({ name, unit, value, about }) => [`${effect.id}: ${about || name}${unit === "1" ? "" : setSquares(` [${unit}]`)}`, value])));
  const [first, second] = [numbers(a), numbers(b)];
  return [...new Set([...first.keys(), ...second.keys()])].map((name) => [name, first.get(name) ?? null, second.get(name) ?? null]);
};

// The errors of both over time, in the figure that each has of its own; of one run only.
export const drawDifference = async (place, one, other) => {
  const sessions = [one, other].map((pane) => pane?.state?.session);
  const there = [one, other].every((pane) => pane?.plots && pane.album?.figures[LINES]);
  place.hidden = !there || sessions[0].run !== sessions[1].run;
  if (place.hidden) {
    apart = null;
    return;
  }
  const rows = [one, other].flatMap((pane, slot) =>
    pane.plots.rowsOf(LINES).filter((row) => row.series === "model").map((row) => ({ ...row, series: "AB"[slot] })));
  const columns = Object.fromEntries(["t", "value", "series"].map((name) => [name, rows.map((row) => row[name])]));
  const drawn = sessions.map((session) => `${session.run} ${session.input}`).join();
  if (apart?.drawn === drawn) {
    await apart.ready;
    return apart.plots.feed({ [LINES]: columns });
  }
  const figures = { [LINES]: structuredClone(one.album.figures[LINES]) };
  const { color } = figures[LINES].layer.find((layer) => layer.encoding?.color).encoding;
  color.scale.domain = ["A", "B"];
  delete color.legend.labelExpr;
  const plots = slipPlots({ figures, rows: { ...one.album.rows, [LINES]: columns }, dark: one.album.dark }, { strict: true, own: one.marks.own });
  place.replaceChildren(h("h3", {}, "Errors of A and B over the run"),
    h("div", { class: "plot", role: "img", "aria-label": "Error of two-second predictions of model A and of model B over time", data: { figure: LINES } }));
  apart = { drawn, plots, ready: plots.draw(place.lastElementChild) };
  return apart.ready;
};

// The room or the colours changed.
export const repaintDifference = (place) => !place.hidden && apart?.plots.draw(place.lastElementChild);
