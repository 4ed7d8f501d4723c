// Two models beside each other: how far their errors are apart, and which numbers differ.
import { h, say, sayShare } from "./parts.js";

const ERRORS = [["t", "position error after 2 s", "m"], ["r", "heading error after 2 s", "rad"]];

export const showDifference = (place, one, other) => {
  const [a, b] = [one?.state?.session, other?.state?.session];
  place.hidden = !(a && b);
  if (place.hidden) return;
  const signed = (value) => `${value > 0 ? "+" : ""}${say(value)}`;
  const rows = ERRORS.map(([key, name, unit]) => {
    const fall = b.errors[key] - a.errors[key];
    const near = Math.abs(fall) < 0.005 * a.errors[key];
    return h("tr", {},
      h("th", { scope: "row" }, `${name} [${unit}]`), h("td", {}, say(a.errors[key])), h("td", {}, say(b.errors[key])),
      h("td", { class: near ? "" : fall < 0 ? "fallen" : "risen" }, near ? "the same" : `${signed(fall)} (${sayShare(fall / a.errors[key])})`));
  });
  const numbers = listNumbers(a, b).map(([name, first, second]) => h("tr", { class: "parameter" },
    h("th", { scope: "row" }, name), h("td", {}, first === null ? "not in it" : say(first, 4)), h("td", {}, second === null ? "not in it" : say(second, 4)),
    h("td", {}, first === null || second === null ? "" : first === second ? "the same" : signed(second - first))));
  const alike = a.run === b.run && a.input === b.input;
  place.replaceChildren(
    h("table", {},
      h("thead", {}, h("tr", {}, h("td", {}, alike ? "" : "two runs or inputs, each with its own error"), ["A", "B", "B − A"].map((name) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, rows, numbers)));
};

const listNumbers = (a, b) => {
  const numbers = (session) => new Map(session.effects.filter((effect) => !effect.off).flatMap((effect) =>
    effect.parameters.map(({ name, unit, value }) => [`${effect.id}.${name} [${unit}]`, value])));
  const [first, second] = [numbers(a), numbers(b)];
  return [...new Set([...first.keys(), ...second.keys()])].map((name) => [name, first.get(name) ?? null, second.get(name) ?? null]);
};
