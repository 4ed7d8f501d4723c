// Figures as elements, and the rows of those that come and go.
import { h } from "./parts.js";

// Before the id of an effect: the figure with its signature.
export const SIGNATURES = "signature-";

// The effects whose signatures can be drawn: not those that are off, or neutral.
export const listSignatures = (rows) => Object.keys(rows).filter((name) => name.startsWith("signature_"));

// The signature of an effect at its neutral value: it does nothing, and leaves what stood there without it.
export const flatten = (rows) => {
  const without = rows.filter((row) => row.series === "before");
  const there = [...without.map((row) => ({ ...row, series: "curve", mean: 0, low: null, high: null })), ...without, ...without.map((row) => ({ ...row, series: "after" }))];
  return Object.fromEntries(["value", "mean", "low", "high", "series"].map((name) => [name, there.map((row) => row[name])]));
};

export const buildFigure = (figure) =>
  h("figure", { class: figure.width, data: { id: figure.id } },
    h("figcaption", {}, h("h3", {}, figure.title)),
    h("div", { class: "plot", role: "img", "aria-label": figure.words, data: { figure: figure.id } }),
    figure.note && h("p", { class: "note" }, figure.note));

export const EMPTY = {
  budget: "The ideal model explains nothing of the error yet: add an effect, and its share is shown here.",
};

// Seen only where an answer takes longer than a moment.
export const working = () => h("i", { class: "working", role: "progressbar", "aria-label": "working" });
