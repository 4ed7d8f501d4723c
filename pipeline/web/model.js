// The model of a session: its effects as cards, and what to add next, one row an effect.
import { h, say, sayAngle, sayLength, sayShare, setSquares } from "./parts.js";

const REST_MS = 350;
const FIRST_ROWS = 4;
const CAUSE = ". Cause: ";
const LONGEST = 70;

// All anew, but what is open stays open, what has the focus keeps it, and nothing scrolls.
export const buildModel = (pane) => {
  const { model, state } = pane;
  const { session } = state;
  const focus = document.activeElement?.closest("[data-keep]")?.dataset.keep;
  const fields = [...model.querySelectorAll("[data-field]")].map((field) => [field.dataset.field, field.value]);
  const open = new Set([...model.querySelectorAll("details[open]")].map((part) => part.className));
  const cards = session.effects.map((effect) => buildCard(pane, effect));
  model.replaceChildren(
    h("h2", {}, "Model"),
    ...(cards.length ? [state.partial && h("p", { class: "quiet partial" }, state.partial), foldCards(pane, h("ul", { class: "cards" }, cards))].filter(Boolean) : [h("p", { class: "quiet" }, "The ideal model: no effect yet.")]),
    h("h2", {}, "Add an effect"),
    buildNext(pane),
    buildFormula(pane));
  for (const part of model.querySelectorAll("details")) part.open = open.has(part.className);
  for (const [name, value] of fields) {
    const field = model.querySelector(`[data-field="${name}"]`);
    if (value) field.value = value;
    // What was added is no longer among the choices.
    if (field.selectedIndex < 0) field.selectedIndex = 0;
    field.dispatchEvent(new Event("change"));
  }
  if (focus) model.querySelector(`[data-keep="${CSS.escape(focus)}"]`)?.focus({ preventScroll: true });
};

// Beside another model the cards would push its figures off the screen.
const foldCards = (pane, cards) => (pane.beside ? h("details", { class: "folded-cards" }, h("summary", {}, `Effects (${cards.children.length})`), cards) : cards);

// What an effect does here, or its formula where it is one that anybody reads.
export const nameEffect = (effect) => {
  const formula = effect.formula.join("; ");
  if (formula) return formula.length > LONGEST ? `A formula of ${effect.formula.join(" + ").split(/ [+−-] /).length} terms` : formula;
  return (effect.sentence || effect.about).split(CAUSE)[0];
};

const INPUTS = { v0: "ideal forward speed", s0: "ideal lateral speed", w0: "ideal yaw rate" };

// What the signals of a formula are.
const sayInputs = (effect) => {
  const formula = effect.formula.join(" ");
  return Object.entries(INPUTS).filter(([name]) => new RegExp(`\\b${name}\\b`).test(formula)).map(([name, words]) => `${name}: ${words}`).join("; ");
};

const lead = (text) => `${text[0].toUpperCase()}${text.slice(1)}.`;

// What is to be added next, within reach of a thumb wherever a narrow page is scrolled to.
const buildReach = (pane, next) => {
  const { session } = pane.state;
  const fall = next && Math.min(...["t", "r"].map((key) => next.to[key] / session.errors[key] - 1));
  pane.reach.replaceChildren(...(next
    ? [h("span", {}, "Next: ", h("b", {}, nameEffect(next)), ` ${sayShare(fall)}`), h("button", { type: "button", class: "add", "aria-label": `add ${nameEffect(next)} now`, onclick: () => addRow(pane, next) }, "Add")]
    : [h("span", { class: session.done ? "done" : "" }, session.remains)]));
};

const addRow = (pane, row) => pane.add(row.id);

// Cards -----------------------------------------------------------------------------------------------------

const buildCard = (pane, effect) => {
  const carries = effect.without_m !== null ? effect.without_m - pane.state.session.errors.t : null;
  const cause = effect.sentence.split(CAUSE)[1];
  return h("li", { class: "card", tabindex: "-1", data: { effect: effect.id } },
    h("b", { class: "name" }, nameEffect(effect)), h("p", { class: "quiet id" }, effect.id),
    effect.formula.length ? h("p", { class: "quiet about" }, sayInputs(effect)) : h("p", { class: "quiet about" }, lead(effect.about)),
    cause && h("p", { class: "quiet" }, `Cause: ${cause}`),
    effect.refused && h("p", { class: "no-help", role: "note" }, `Not supported by the data: ${effect.refused}.`),
    effect.parameters.map((parameter) => buildSlider(pane, effect, parameter)),
    h("div", { class: "head" },
      carries !== null && carries > 0 && h("span", { class: "carries" }, `without it ${sayLength(effect.without_m)}`),
      h("button", { type: "button", class: "remove", title: "remove it and fit the rest", "aria-label": `remove ${effect.id} and fit the rest`, onclick: () => pane.act("drop", { effect: effect.id }) }, "Remove")));
};

const buildSlider = (pane, effect, parameter) => {
  const { name, unit, value, at_bound: atBound } = parameter;
  const label = `${effect.id}.${name}`;
  const words = (number) => setSquares(`${say(number, 4)} ${unit === "1" ? "" : unit}`.trim());
  const unitSaid = unit === "1" ? "" : ` ${unit}`;
  const shown = h("output", {}, parameter.said ? setSquares(`${parameter.said.replace("-", "−")}${unitSaid}`) : words(value));
  const input = h("input", {
    type: "range", min: String(parameter.from), max: String(parameter.to), step: String(parameter.step),
    value: String(value), "aria-label": `${label} [${unit}], ${parameter.about}`, "aria-valuetext": words(value), data: { keep: label },
  });
  input.value = String(value);
  input.addEventListener("input", () => {
    shown.textContent = words(Number(input.value));
    input.setAttribute("aria-valuetext", shown.textContent);
    pane.preview(effect.id, name, Number(input.value));
  });
  // Keys change the value many times in a row: only where it comes to rest is a step.
  input.addEventListener("change", () => {
    clearTimeout(pane.rest);
    pane.resting = { effect: effect.id, parameter: name, value: Number(input.value) };
    pane.rest = setTimeout(() => pane.settle().then(() => pane.redraw()), REST_MS);
  });
  const doubt = parameter.doubt ? `: ${parameter.doubt}` : "";
  const span = parameter.ends.length ? `95 %: ${parameter.ends.join(" to ").replaceAll("-", "−")}${doubt}` : parameter.undetermined ? "not determined by this run" : "";
  return h("div", { class: `slider${atBound ? " at-bound" : ""}` },
    h("div", { class: "named-value" }, h("span", { title: label }, effect.formula.length ? name : parameter.about), shown),
    input,
    h("p", { class: "quiet" }, atBound ? h("b", { class: "bound" }, "at its bound") : span,
      h("button", { type: "button", class: "lock", "aria-pressed": String(parameter.locked), "aria-label": `hold ${label} fixed in fits`, title: parameter.locked ? "held fixed in fits; press to release it" : "hold this value fixed in fits", data: { keep: `lock ${label}` }, onclick: () => pane.act("lock", { effect: effect.id, parameter: name }) }, parameter.locked ? "held fixed" : "hold fixed")));
};

// What to add -----------------------------------------------------------------------------------------------

// What lowers the error most comes first: of the diagnosis, its formula among it, or of the other effects that were tried.
const listRows = ({ session, named, trial, diagnosis }) => {
  const there = new Set(session.effects.map((effect) => effect.id));
  const equal = new Map((diagnosis?.undecided ?? []).map((entry) => [entry.in_model ?? entry.candidates?.[0], entry.candidates ?? []]));
  const rows = named.map((entry) => ({ ...entry, named: true, twins: (equal.get(entry.id) ?? []).filter((name) => name !== entry.id) }));
  const known = new Set([...there, ...rows.map((row) => row.id)]);
  const all = [...rows, ...(trial?.found ?? []).filter((row) => !known.has(row.id))];
  return all.sort((one, other) => one.left - other.left);
};

// Least part of an error that an effect lowers for a model that is at the noise floor already.
const MATTERS = 0.1;

// The row to add next; null where nothing lowers the error, or not all that may is known.
const findNext = (rows, running, done) => {
  const fall = (row) => Math.max(1 - row.to.t / row.from.t, 1 - row.to.r / row.from.r);
  const best = rows.filter((row) => !(done && fall(row) < MATTERS)).sort((one, other) => one.left - other.left)[0] ?? null;
  return best && (best.named || !running) ? best : null;
};

// While a hand is over the list, no row moves away from under it.
const holdStill = (pane, rows) => {
  const list = pane.model.querySelector(".proposals");
  if (list?.matches(":hover, :focus-within") && pane.held) {
    const at = new Map(pane.held.map((id, number) => [id, number]));
    rows.sort((one, other) => (at.get(one.id) ?? Infinity) - (at.get(other.id) ?? Infinity));
  }
  pane.held = rows.map((row) => row.id);
  return rows;
};

const buildNext = (pane) => {
  pane.reach.replaceChildren();
  if (pane.state.run.refusal) return h("div", { class: "next" }, h("p", { class: "no-help" }, "No effect can be estimated: this run cannot show slip."));
  const { session, trial, catalogue, diagnosis, missing } = pane.state;
  const there = new Set(session.effects.map((effect) => effect.id));
  const rows = holdStill(pane, listRows(pane.state));
  const running = trial && !trial.done;
  const next = findNext(rows, running, session.done);
  buildReach(pane, next);
  const undecided = (diagnosis?.undecided ?? []).map((entry) => h("p", { class: "quiet" }, `Undecided: ${(entry.candidates ?? []).join(" or ")}. To decide, ${entry.separate_by ?? "drive again"}.`));
  const rest = diagnosis?.unexplained && !diagnosis.unexplained.formula && !session.done ? h("p", { class: "quiet" }, `Unexplained: ${diagnosis.unexplained.where ?? diagnosis.unexplained.channel}. Next: write it as a formula below, or diagnose another run to see whether it repeats.`) : null;
  const build = (row) => buildRow(pane, row, row === next);
  return h("div", { class: "next" },
    running && h("p", { class: "quiet trying" }, trial.total === null ? "ranking the effects of the catalogue …" : `fitting the effects in order of evidence: ${trial.tried} of ${trial.total}`, h("i", { class: "progress", bar: trial.total ? trial.tried / trial.total : 0 })),
    session.done && !next && rows.length > 0 && h("p", { class: "nothing" }, "The model is at the noise floor: no further effect is needed."),
    h("ul", { class: "proposals" }, rows.slice(0, FIRST_ROWS).map(build)),
    rows.length > FIRST_ROWS && h("details", { class: "further" }, h("summary", {}, `${rows.length - FIRST_ROWS} more`), h("ul", { class: "proposals" }, rows.slice(FIRST_ROWS).map(build))),
    missing.length > 1 && h("button", { type: "button", class: "add-all", data: { keep: "add all" }, title: missing.join(", "), onclick: () => pane.addAll() }, `Add all ${missing.length} of the diagnosis`),
    trial?.done && !next && !(session.done && rows.length > 0) && h("p", { class: session.done ? "nothing" : "nothing open" }, tellNothing(session, diagnosis)),
    !trial && h("button", { type: "button", class: "try", title: "rank all effects of the catalogue beside this model, and fit the best", data: { keep: "try" }, onclick: () => pane.tryAll(true) }, "Look for other effects"),
    !diagnosis && h("p", { class: "quiet undiagnosed" }, "Not diagnosed yet.", h("button", { type: "button", class: "diagnose", data: { keep: "diagnose" }, onclick: () => pane.diagnose() }, "Diagnose")),
    undecided, rest,
    buildCatalogue(pane, catalogue.filter((entry) => !there.has(entry.id))));
};

const buildRow = (pane, row, first) => {
  const change = (name, key, words) => {
    const share = sayShare(row.to[key] / pane.state.session.errors[key] - 1);
    return Number.parseInt(share.replace("−", ""), 10) === 0 ? `${name} unchanged` : `${name} to ${words(row.to[key])} (${share})`;
  };
  const inputs = sayInputs(row);
  const about = row.named && row.formula.length ? `a formula that the diagnosis suggests for what no effect explains${inputs && `; ${inputs}`}` : row.about;
  const marks = [row.named && h("i", { class: "mark" }, "named by the diagnosis"),
    row.twins.length > 0 && h("i", { class: "mark twin", title: "they reduce the error of this run equally: add one of them" }, `as good: ${row.twins.join(", ")}`)].filter(Boolean);
  return h("li", { class: first ? "first" : "", data: { effect: row.id, ...(row.named && { named: "" }) }, bar: Math.min(Math.max(1 - row.to.t / row.from.t, 0), 1) },
    h("div", {},
      first && h("span", { class: "quiet" }, "Next"),
      h("b", {}, nameEffect(row)), h("span", { class: "quiet id" }, row.id),
      row.sentence || row.formula.length ? h("span", { class: "quiet about" }, lead(about)) : null,
      h("span", { class: "quiet beside" }, row.beside),
      h("span", { class: "falls" }, `${change("position", "t", sayLength)}, ${change("heading", "r", sayAngle)}`),
      marks.length > 0 && h("span", { class: "marks" }, marks)),
    h("button", { type: "button", class: "add", "aria-label": `add ${nameEffect(row)}`, data: { keep: `add ${row.id}` }, onclick: () => addRow(pane, row) }, "Add"));
};

const tellNothing = (session, diagnosis) => {
  if ((diagnosis?.findings ?? []).some((finding) => finding.id === "little_driving")) return "No effect is identified: the run is too short.";
  if (session.done) return "Nothing is left to add.";
  return "No other effect of the catalogue lowers the error: look where it is largest, or write the effect as a formula.";
};

// Chosen and said apart: with keys one passes every entry of a list.
const buildCatalogue = (pane, entries) => {
  const about = h("p", { class: "quiet about" });
  const tell = () => (about.textContent = chosen.value ? lead(entries.find(({ id }) => id === chosen.value).about) : "");
  const chosen = h("select", { "aria-label": "Any effect of the catalogue", class: "catalogue", data: { keep: "catalogue", field: "catalogue" }, onchange: tell }, h("option", { value: "" }, "any other effect …"),
    entries.map((entry) => h("option", { value: entry.id }, entry.name)));
  const add = h("button", { type: "button", class: "add-chosen", "aria-label": "add the chosen effect", onclick: () => chosen.value && pane.add(chosen.value) }, "Add");
  return h("div", { class: "any" }, chosen, add, about);
};

const buildFormula = (pane) => {
  const field = (name, hint, wide) => h("input", { name, placeholder: hint, "aria-label": hint, class: wide ? "wide" : "", autocomplete: "off", spellcheck: "false", data: { keep: `field ${name}`, field: name } });
  const channel = h("select", { name: "channel", "aria-label": "velocity it adds to", data: { keep: "field channel", field: "channel" } }, ["v_x", "v_y", "v_w"].map((name) => h("option", { value: name }, `${name} +=`)));
  const parts = { effect: field("effect", "name, for example my_skid"), formula: field("formula", "formula: c * v0 * w0", true), parameters: field("parameters", "parameters: c [s] -0.5 .. 0.5", true) };
  const form = h("form", { onsubmit: async (event) => {
    event.preventDefault();
    if (await pane.act("formula", { effect: parts.effect.value.trim(), channel: channel.value, formula: parts.formula.value, parameters: parts.parameters.value })) pane.tryAll();
  } }, parts.effect, channel, parts.formula, parts.parameters, h("button", { type: "submit" }, "Add formula"),
  h("p", { class: "quiet" }, "Signals: v0, s0 (lateral), w0, f_x, f_w, left, right, steering, roll, pitch, yaw, x, y, each with _rate; t, left_angle, right_angle. Units are checked."));
  return h("details", { class: "formula" }, h("summary", {}, "Write a formula"), form);
};
