// The list of runs, and what a model can be set beside.
import { h, say, sayDuration } from "./parts.js";

const ORDERS = {
  newest: (a, b) => b.analyzed_s - a.analyzed_s || a.run.localeCompare(b.run),
  slip: (a, b) => (b.median_modulus ?? -1) - (a.median_modulus ?? -1),
  name: (a, b) => a.run.localeCompare(b.run),
  length: (a, b) => (b.duration_s ?? 0) - (a.duration_s ?? 0),
};
const ORDER_WORDS = { newest: "analyzed last first", slip: "most slip first", name: "by name", length: "longest first" };

// How far a run cannot be trusted: the number of losses and warnings; infinite where it allows no conclusions.
const doubt = (run) => {
  const count = (severity) => run.findings.filter((finding) => finding.severity === severity).length;
  return count("error") || !Number.isFinite(run.median_modulus) ? Infinity : run.losses.length + count("warning");
};

export const sortByAge = (runs) => [...runs].sort(ORDERS.newest);

const sortBySoundness = (runs) => [...runs].sort((a, b) => doubt(a) - doubt(b) || ORDERS.slip(a, b));

const sayHealth = (run) => {
  const told = [run.losses.length && "losses", run.findings.some((finding) => finding.severity === "error") && "no conclusions"].filter(Boolean).join(", ");
  return told && h("i", { class: "lossy" }, told);
};

// One list a pane: a run that is chosen there opens there.
export const buildRuns = (pane) => {
  const search = h("input", { type: "search", class: "search", placeholder: "search runs", "aria-label": "Search runs" });
  const sort = h("select", { class: "sort", "aria-label": "Order of the runs" }, Object.keys(ORDERS).map((name) => h("option", { value: name }, ORDER_WORDS[name])));
  const count = h("span", { class: "quiet count" });
  const list = h("ul", { class: "runs" });
  const show = (runs = pane.runs ?? []) => {
    pane.runs = runs;
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const text = (run) => [run.run, run.vehicle, run.terrain, run.dataset].join(" ").toLowerCase();
    const shown = runs.filter((run) => words.every((word) => text(run).includes(word)));
    shown.sort(ORDERS[sort.value]);
    const most = Math.max(...shown.map((run) => run.median_modulus ?? 0), 0);
    count.textContent = `${shown.length} of ${runs.length}`;
    list.replaceChildren(...shown.map((run) => h("li", {},
      h("button", { type: "button", class: "run", "aria-current": pane.run === run.run ? "true" : null, title: run.run, bar: most > 0 ? (run.median_modulus ?? 0) / most : 0, onclick: () => pane.open(run.run) },
        h("b", {}, run.run),
        h("span", { class: "slip-of" }, Number.isFinite(run.median_modulus) ? `slip ${say(run.median_modulus, 2)} m/s` : ""),
        h("span", { class: "facts" }, [run.vehicle, run.terrain, sayDuration(run.duration_s)].filter(Boolean).join(" · "), " ", sayHealth(run))))));
  };
  search.addEventListener("input", () => show());
  sort.addEventListener("change", () => show());
  pane.showRuns = show;
  return [h("div", { class: "find" }, search, sort, count), list];
};

// What is set beside the model of a run: another model of it, or another run.
export const listRivals = (pane, runs) => {
  const { session, run, inputs, diagnosis } = pane.state;
  const other = inputs.find((name) => name !== session.input);
  const rivals = [];
  if (session.effects.length) rivals.push({ words: "the ideal model", run: session.run, make: "ideal" });
  if ((diagnosis?.effects ?? []).length) rivals.push({ words: "the model of the diagnosis", run: session.run, make: "named" });
  if (other) rivals.push({ words: `the model ${{ command: "from commands", measured: "from wheel encoders" }[other]}`, run: session.run, input: other });
  const near = (entry) => (entry.vehicle === run.vehicle ? 0 : 2) + (entry.terrain === run.terrain ? 0 : 1);
  const others = sortBySoundness(runs.filter((entry) => entry.run !== session.run)).sort((a, b) => near(a) - near(b));
  rivals.push(...others.map((entry) => ({ words: entry.run, run: entry.run, facts: [entry.vehicle, entry.terrain].filter(Boolean).join(" · ") })));
  return rivals;
};

export const buildRivals = (pane, runs, compare) => {
  if (!pane.state) return [];
  const rivals = listRivals(pane, runs);
  if (!rivals.length) return [h("p", { class: "quiet" }, "Nothing to compare with yet: add an effect, or drop another log.")];
  return [h("p", { class: "lead" }, "Set beside this model:"),
    h("ul", { class: "rivals" }, rivals.map((rival) => h("li", {}, h("button", { type: "button", class: "rival", onclick: () => compare(rival) }, rival.words), rival.facts && h("span", { class: "quiet" }, ` ${rival.facts}`))))];
};
