// One session: its numbers, its figures, and beside them its model.
import { EMPTY, SIGNATURES, buildFigure, flatten, listSignatures, working } from "./figures.js";
import { buildModel, nameEffect } from "./model.js";
import { h, inAngle, inLength, post, runTo, sayAngle, sayDuration, sayLength, sayShare, toast, untoast } from "./parts.js";
import { buildRuns } from "./runs.js";
import { Tabs, TABS } from "./tabs.js";

const WAIT_MS = 60;
const HEADROOM = 1.05;
// A change that rounds to nothing.
const NOTHING = 0.005;

export class Pane {
  constructor(slot, changed, working) {
    this.slot = slot;
    this.working = working;
    this.changed = changed;
    this.state = null;
    this.album = null;
    this.plots = null;
    this.signatures = [];
    this.turn = 0;
    this.hero = h("section", { class: "hero", "aria-label": "Run" });
    this.glance = h("section", { class: "glance", "aria-label": "Error of the model" });
    this.model = h("section", { class: "model", "aria-label": "Model" });
    this.first = h("section", { class: "first-view", "aria-label": "Measured and modelled" });
    this.reach = h("section", { class: "reach", "aria-label": "Next effect" });
    this.marks = this.buildMarks();
    this.cursorBar = h("div", { class: "cursor" });
    this.cursor = slipCursor(this.cursorBar, { moved: (t) => this.pointed?.(t) });
    this.stretch = 0;
    this.tabs = new Tabs(slot, (name) => this.openTab(name));
    this.tabs.panels.runs.append(...buildRuns(this));
    this.tabs.panels.where.prepend(this.whereSaid = h("p", { class: "where" }), this.marking);
    this.root = h("article", { class: "pane", data: { slot } }, this.hero, this.glance, this.model, this.first, this.tabs.root, this.reach);
  }

  grid(tab) {
    return tab === "first" ? this.first : this.tabs.grids[tab];
  }

  // Beside the figures where there is room; on a narrow page below the first ones.
  // Of two, the paths come first: their errors stand above them.
  place(side, narrow, two) {
    if (this.beside !== two && this.state) {
      this.beside = two;
      buildModel(this);
    }
    this.beside = two;
    const { hero, glance, model, first } = this;
    this.tabs.root.before(...(two ? [first, hero, glance, model] : narrow ? [hero, glance, first, model] : [hero, glance, model, first]));
    if (side) side.replaceChildren(model);
  }

  // Marking by dragging, or by numbers for those who use keys.
  buildMarks() {
    const number = (name) => h("input", { type: "number", step: "0.1", inputmode: "decimal", class: name });
    const button = (name, text) => h("button", { type: "button", class: name }, text);
    const parts = {
      said: h("span", {}), from: number("mark-from"), to: number("mark-to"), set: button("mark-set", "Mark"),
      zoomIn: button("zoom-in", "Zoom"), clear: button("mark-clear", "Clear"), zoomOut: button("zoom-out", "Whole run"),
    };
    parts.bar = h("div", { class: "marked", role: "status", hidden: true }, parts.said, parts.zoomIn, parts.clear, parts.zoomOut);
    this.marking = h("div", { class: "marking", role: "group", "aria-label": "Mark a stretch of time" },
      h("span", {}, "Mark a stretch: drag over a figure, or"), h("label", {}, "from ", parts.from, " s"), h("label", {}, "to ", parts.to, " s"), parts.set, parts.bar);
    return slipMarks(parts, { marked: (spans) => this.marked?.(spans) });
  }

  get run() {
    return this.state?.session.run ?? null;
  }

  // Asking -------------------------------------------------------------------------------------------------

  async ask(action, more = {}) {
    const run = more.run ?? this.run;
    // What was said of the step before does not stand over this one; a trial leaves it.
    if (action !== "try") untoast();
    this.busy(true);
    try {
      const input = more.input ?? this.state?.session.input ?? null;
      const state = await post("/api/session", { ...more, run, input: more.fresh ? null : input, slot: this.slot, action, fresh: undefined });
      this.state = state;
      this.show();
      return true;
    } catch (error) {
      if (error.code === "no_help") toast(error.message, "Apply anyway", () => this.act(action, { ...more, anyway: true }));
      else toast(error.message);
      return false;
    } finally {
      this.busy(false);
    }
  }

  // The numbers first, then the figures; whether it was done.
  async act(action, more = {}) {
    await this.settle();
    const done = await this.ask(action, more);
    if (done) await this.redraw();
    return done;
  }

  // A value that was set a moment ago becomes a step before anything else happens.
  async settle() {
    clearTimeout(this.rest);
    const asked = this.resting;
    this.resting = null;
    this.wanted = null;
    if (asked) await this.ask("set", asked);
  }

  async open(run, input) {
    await this.settle();
    this.wait(run);
    if (await this.ask("open", { run, ...(input ? { input } : { fresh: true }) })) {
      await this.draw();
      this.changed();
      if (this.state.trial) this.follow();
      else this.tryAll();
    } else {
      this.hero.replaceChildren(h("h2", {}, run), h("p", { class: "lead" }, "This run cannot be fitted."));
      this.shown?.();
      return false;
    }
    return true;
  }

  busy(on) {
    this.root.classList.toggle("busy", on);
    this.root.setAttribute("aria-busy", String(on));
  }

  wait(run) {
    this.state = null;
    this.album = null;
    this.plots = null;
    this.signatures = [];
    this.loaded = new Set();
    this.stretch = 0;
    this.validated = undefined;
    this.cursor.stop();
    for (const part of [this.glance, this.model, this.first, this.reach, ...Object.values(this.tabs.grids)]) part.replaceChildren();
    this.hero.replaceChildren(h("h2", {}, run), h("p", { class: "lead waiting", role: "status" }, "preparing the run …"), working());
  }

  // Numbers ------------------------------------------------------------------------------------------------

  show() {
    const { session, run } = this.state;
    if (!this.glance.querySelector(".numbers") || this.hero.dataset.run !== session.run + session.input) this.buildHero();
    this.showNumbers(session);
    for (const [name, said] of [["undo", session.undo], ["redo", session.redo]]) {
      const button = this.glance.querySelector(`.${name}`);
      button.disabled = said === null;
      button.title = said === null ? `nothing to ${name}` : `${name}: ${said}`;
    }
    this.glance.querySelector(".said").textContent = session.undo === null ? "" : session.said;
    buildModel(this);
    this.validate();
    this.shown?.();
    return run;
  }

  buildHero() {
    const { session, run, inputs } = this.state;
    const facts = [run.vehicle_name ?? run.vehicle, run.terrain, sayDuration(run.duration_s), this.sayStanding(run)].filter(Boolean);
    const words = { command: "from commands", measured: "from wheel encoders" };
    const choice = h("div", { class: "inputs", role: "group", "aria-label": "Input of the model" },
      inputs.map((name) => h("button", {
        type: "button", "aria-pressed": String(name === session.input),
        onclick: () => name !== session.input && this.switchInput(name),
      }, words[name])));
    const number = (key, name) =>
      h("div", { class: `number ${key}` },
        h("p", { class: "big" }, h("span", { class: "value" }, "–"), h("small", {})),
        h("p", { class: "what" }, name),
        h("p", { class: "what" }, h("b", { class: "fall" }), " ", h("b", { class: "now-said" })));
    const tool = (name, text, act, title) => h("button", { type: "button", class: name, title, onclick: act }, text);
    this.hero.dataset.run = session.run + session.input;
    this.hero.replaceChildren(...[
      h("div", { class: "title" }, h("h2", {}, session.run), h("p", { class: "facts" }, facts.join(" · ")), choice),
      run.verdict && h("p", { class: run.refusal ? "verdict refused" : "verdict" }, run.verdict),
      this.warn(run),
      h("div", { class: "tools" },
        tool("fit", "Fit again", () => this.act("fit"), "fits all values that are not held fixed to the motion over half seconds; the errors over 2 s are not necessarily minimal there"),
        tool("save", "Save model", () => this.save(), "write the model file into the results folder"),
        h("a", { class: "download button", href: `/model.toml?${new URLSearchParams({ run: session.run, slot: this.slot })}` }, "Download"),
        run.report && h("a", { class: "report button", href: `/report?${new URLSearchParams({ run: session.run })}`, target: "_blank", rel: "noopener" }, "Report")),
    ].filter(Boolean));
    this.glance.replaceChildren(
      working(),
      h("div", { class: "numbers" }, number("t", "position error over 2\u00a0s"), number("r", "heading error over 2\u00a0s"),
        h("div", { class: "scale" },
          h("div", { class: "track", role: "img" }, h("i", { class: "now" }), h("i", { class: "floor" }), h("i", { class: "ceiling" })),
          h("p", { class: "ends" }, h("span", { class: "floor-said" }), h("span", { class: "ideal-said" }))),
        h("div", { class: "steps" }, tool("undo", "Undo", () => this.act("undo")), tool("redo", "Redo", () => this.act("redo")))),
      h("p", { class: "end", role: "status" }),
      h("p", { class: "said", role: "status" }),
      h("div", { class: "validation" },
        h("label", {}, "Errors on another run, with the numbers of this one: ",
          h("select", { class: "validate", onchange: () => this.validate() }, h("option", { value: "" }, "choose a run …"))),
        h("p", { class: "validated", role: "status" })));
    this.fillValidation();
  }

  // Runs of the same vehicle, those of other grounds after those of the same.
  fillValidation() {
    const choice = this.glance.querySelector(".validate");
    if (!choice || !this.runs || !this.state) return;
    const { run } = this.state;
    const others = this.runs.filter((one) => one.run !== this.run && one.vehicle === run.vehicle && !one.refusal);
    others.sort((one, other) => (other.terrain === run.terrain) - (one.terrain === run.terrain) || one.run.localeCompare(other.run));
    const kept = choice.value;
    choice.replaceChildren(choice.firstElementChild, ...others.map((one) => h("option", { value: one.run }, [one.run, one.terrain].filter(Boolean).join(" · "))));
    choice.value = others.some((one) => one.run === kept) ? kept : "";
    choice.closest(".validation").hidden = !others.length || Boolean(run.refusal);
  }

  // Anew whenever the model is another one; what was asked for a model before it is not shown.
  async validate() {
    const on = this.glance.querySelector(".validate")?.value ?? "";
    const { session } = this.state;
    const key = on && JSON.stringify([on, session.run, session.input, session.effects.map(({ id, parameters }) => [id, parameters.map(({ value }) => value)])]);
    if (key === this.validated) return;
    this.validated = key;
    const said = this.glance.querySelector(".validated");
    said.textContent = on && `predicting ${on} …`;
    if (!on) return;
    try {
      const answer = await post("/api/validate", { run: session.run, slot: this.slot, input: session.input, on });
      if (this.validated === key) said.textContent = this.sayValidation(answer);
    } catch (error) {
      if (this.validated === key) said.textContent = error.message;
    }
  }

  sayValidation({ on, ideal, carried, own, warning }) {
    const isIdeal = !this.state.session.effects.length;
    const parts = [["position", "t", sayLength], ["heading", "r", sayAngle]].map(([name, key, words]) =>
      `${name} ${words(carried[key])}${isIdeal ? "" : ` (ideal model ${words(ideal[key])}, fitted there ${words(own[key])})`}`);
    if (isIdeal) return `${on}: ${parts.join(", ")} with the ideal model.`;
    return `${on}: ${parts.join(", ")}. ${warning ? `${warning[0].toUpperCase()}${warning.slice(1)}` : "The model holds there"}.`;
  }

  // The run beside the others of its dataset.
  sayStanding(run) {
    const others = this.findPeers?.(run) ?? [];
    if (!others.length || !Number.isFinite(run.median_modulus)) return "";
    const below = others.filter((other) => other.median_modulus < run.median_modulus).length;
    if (others.length === 1) return `${below ? "more" : "less"} slip than the one other run of ${run.dataset}`;
    return `vs ${others.length} runs of ${run.dataset}: more slip than ${below}`;
  }

  warn(run) {
    const told = run.findings.filter((finding) => finding.severity !== "info" && finding.text !== run.refusal).map((finding) => finding.text);
    if (run.losses.length) told.unshift(`the log had losses: ${run.losses.map((loss) => loss.text).join("; ")}`);
    return told.length > 0 && h("details", { class: "doubts" }, h("summary", {}, told[0]), h("ul", {}, told.slice(1).map((text) => h("li", {}, text))));
  }

  showNumbers(session) {
    const { errors, ideal, floor, before, by_hand: byHand, effects } = session;
    const inUnits = { t: inLength, r: inAngle };
    const words = { t: sayLength, r: sayAngle };
    const helps = !effects.some((effect) => effect.refused);
    for (const key of ["t", "r"]) {
      const place = this.glance.querySelector(`.number.${key}`);
      const { factor, unit } = inUnits[key](errors[key]);
      runTo(place.querySelector(".value"), errors[key] * factor);
      place.querySelector("small").textContent = unit === "°" ? unit : ` ${unit}`;
      const fall = ideal[key] ? errors[key] / ideal[key] - 1 : 0;
      const last = before && before[key] ? errors[key] / before[key] - 1 : 0;
      const isFirst = Math.abs(last - fall) < NOTHING;
      const still = effects.length ? "unchanged" : "the ideal model";
      place.querySelector(".fall").textContent = Math.abs(fall) < NOTHING ? still : `ideal ${words[key](ideal[key])}, ${sayShare(fall)}`;
      place.querySelector(".now-said").textContent = !before || isFirst ? "" : `last step ${Math.abs(last) < NOTHING ? "unchanged" : sayShare(last)}`;
      place.classList.toggle("fallen", fall < -NOTHING);
      place.classList.toggle("risen", fall > NOTHING);
      // Below the noise floor, or by an effect that does not help, nothing was gained.
      place.classList.toggle("gained", last < -NOTHING && helps && !(floor && before[key] <= floor[key]));
      place.classList.toggle("lost", last > NOTHING);
    }
    const most = Math.max(ideal.t, errors.t) * HEADROOM;
    const track = this.glance.querySelector(".track");
    track.style.setProperty("--now", errors.t / most);
    track.style.setProperty("--floor", floor ? floor.t / most : 0);
    track.style.setProperty("--ideal", ideal.t / most);
    track.setAttribute("aria-label", `position error ${sayLength(errors.t)} of ${sayLength(ideal.t)} for the ideal model${floor ? `, noise floor ${sayLength(floor.t)}` : ""}`);
    this.glance.querySelector(".floor-said").textContent = floor ? `noise floor ${sayLength(floor.t)}` : "";
    this.sayEnd(session);
    this.glance.querySelector(".ideal-said").textContent =
      `ideal model ${sayLength(ideal.t)}${byHand ? " · set by hand, not fitted" : ""}`;
  }

  // What remains, and where to look; green only at the noise floor.
  sayEnd({ done, remains }) {
    const place = this.glance.querySelector(".end");
    // Of a run that cannot show slip, an error says nothing.
    place.hidden = Boolean(this.state.run.refusal);
    place.classList.toggle("done", done);
    const span = done ? null : this.largest;
    place.replaceChildren(remains, ...(span ? [`; largest from ${span.map(Math.round).join(" to ")} s: `, h("button", { type: "button", class: "look", "aria-label": `look at ${span.map(Math.round).join(" to ")} s`, data: { keep: "look" }, onclick: () => this.look(span) }, "look")] : []));
  }

  // The half minute that holds a span, drawn large, with the span marked and the cursor at its beginning.
  async look([from, to]) {
    const middle = (from + to) / 2;
    const place = this.spans.findIndex(([start, end]) => middle >= start && middle <= end);
    if (place >= 0 && place !== this.stretch) await this.showStretch(place);
    this.marks.mark(from, to);
    this.cursor.show(from);
    this.first.scrollIntoView({ block: "nearest" });
  }

  async showStretch(place) {
    this.stretch = place;
    this.loaded.delete("first");
    await this.load("first");
  }

  async switchInput(name) {
    if (await this.ask("open", { input: name })) {
      await this.draw();
      this.tryAll();
    }
  }

  async save() {
    try {
      const { path } = await post("/api/save", { run: this.run, slot: this.slot });
      toast(`saved: ${path}`);
    } catch (error) {
      toast(error.message);
    }
  }

  // What to add --------------------------------------------------------------------------------------------

  // While the slider moves only the latest value is asked for, one request at a time.
  preview(effect, parameter, value) {
    this.wanted = { effect, parameter, value };
    if (this.previewing) return;
    this.previewing = true;
    const step = async () => {
      while (this.wanted) {
        const asked = this.wanted;
        this.wanted = null;
        const turn = this.turn;
        try {
          const answer = await post("/api/session", { ...asked, ...this.request, action: "preview" });
          if (turn === this.turn) {
            this.showNumbers({ ...answer.session, before: this.state.session.errors });
            this.take(answer);
          }
        } catch (error) {
          toast(error.message);
        }
      }
      this.previewing = false;
    };
    setTimeout(step, WAIT_MS);
  }

  async diagnose() {
    try {
      await post("/api/diagnose", { run: this.run });
      this.working();
    } catch (error) {
      toast(error.message);
    }
  }

  // The card has the focus at once: a moment later a person may be at its slider.
  async add(effect) {
    await this.settle();
    if (!(await this.ask("add", { effect }))) return;
    this.model.querySelector(`.card[data-effect="${CSS.escape(effect)}"]`)?.focus({ preventScroll: true });
    await this.redraw();
    this.tryAll();
  }

  // The joint fit of the diagnosis, as one step that can be undone.
  async addAll() {
    if (await this.act("add", { effects: this.state.missing })) this.tryAll();
  }

  async tryAll(anyway = false) {
    if (this.state?.run.refusal) return;
    if (await this.ask("try", { anyway })) this.follow();
  }

  // How far the trial is, as long as it goes on; what comes while something else was asked is not shown.
  async follow() {
    if (this.following) return;
    this.following = true;
    let ended = false;
    try {
      while (this.state?.trial && !this.state.trial.done) {
        await new Promise((done) => setTimeout(done, 700));
        const asked = this.state;
        if (!asked || this.root.classList.contains("busy")) continue;
        const { trial } = await post("/api/session", { ...this.request, action: "open" });
        if (this.state !== asked) continue;
        asked.trial = trial;
        ended = !trial;
        buildModel(this);
      }
    } catch (error) {
      toast(error.message);
    } finally {
      this.following = false;
    }
    // It was ended for another one, which is over.
    if (ended) this.tryAll();
  }

  // Figures ------------------------------------------------------------------------------------------------

  get request() {
    return { run: this.run, slot: this.slot, input: this.state.session.input, stretch: this.stretch };
  }

  // Of all figures only those that can be seen are asked for and drawn.
  async draw() {
    const turn = (this.turn += 1);
    delete this.root.dataset.drawn;
    if (!this.album) this.first.replaceChildren(h("p", { class: "lead waiting" }, "drawing the figures …"));
    if (this.drawnRun !== this.run) this.marks.reset();
    this.drawnRun = this.run;
    this.loaded = new Set();
    this.album = { figures: {}, rows: {} };
    this.plots = null;
    try {
      for (const tab of ["first", this.tabs.shown]) if (tab in TABS || tab === "first") await this.load(tab, turn);
    } catch (error) {
      toast(error.message);
      return;
    }
    this.fillLists();
    this.moved?.();
    if (turn === this.turn) this.root.dataset.drawn = String(turn);
  }

  async load(tab, turn = this.turn) {
    const grid = this.grid(tab);
    if (!grid || this.loaded.has(tab)) return;
    const album = await post("/api/figures", { ...this.request, tab });
    if (turn !== this.turn) return;
    this.loaded.add(tab);
    Object.assign(this.album.figures, album.figures);
    Object.assign(this.album.rows, album.rows);
    this.album.dark = album.dark;
    this.plots ??= slipPlots(this.album, { strict: true, own: this.marks.own, zoomOf: this.marks.zoomOf, drawn: () => this.cursor.refresh() });
    for (const { id } of album.shown) this.plots.forget(id);
    if (tab === "effects") this.signatures = listSignatures(album.rows);
    this.tellWhere(album);
    const nodes = album.shown.map((figure) => this.buildNode(figure));
    grid.replaceChildren(...(tab === "first" ? [this.buildStretch(album.stretch)] : []), ...nodes, ...(nodes.length ? [] : [h("p", { class: "quiet" }, EMPTY[tab] ?? "Nothing to draw on this run.")]));
    const places = nodes.map((node) => node.querySelector(".plot"));
    if (tab === "first" && album.stretch) this.cursor.setSpan(album.stretch.from, album.stretch.to);
    this.cursor.join(this.plots, places);
    this.marks.join(this.album, this.plots, () => this.paintAnew(), places);
    for (const place of places) {
      if (turn !== this.turn) return;
      if (place.clientWidth) await this.plots.draw(place);
    }
  }

  // The stretch that is drawn large: the one in which the ideal model is worst first.
  buildStretch(stretch) {
    if (!stretch) return h("p", { class: "quiet" }, "The run is too short for two-second predictions.");
    const { place, spans, from, to } = stretch;
    const count = spans.length;
    this.spans = spans;
    const go = (by) => () => this.showStretch((place + by + count) % count);
    const button = (by, text, title) => h("button", { type: "button", class: by < 0 ? "stretch-back" : "stretch-on", title, "aria-label": title, disabled: count < 2, onclick: go(by) }, text);
    return h("div", { class: "stretch-said" },
      h("span", {}, `${Math.round(from)} to ${Math.round(to)} s: ${place ? `number ${place + 1} of ${count} by error` : count > 1 ? `the worst of ${count} stretches by error` : "the worst stretch"}`),
      button(-1, "‹", "the stretch before it in the order of error"), button(1, "›", "the next stretch in the order of error"),
      this.cursorBar);
  }

  async openTab(name) {
    this.fillLists();
    this.openedTab?.(name);
    if (!this.plots || !(name in TABS)) return;
    delete this.root.dataset.drawn;
    try {
      await this.load(name);
      for (const place of this.grid(name).querySelectorAll(".plot:not(.drawn)")) await this.plots.draw(place);
    } catch (error) {
      toast(error.message);
    }
    this.root.dataset.drawn = String(this.turn);
  }

  // Opened beside the same tab of the other pane.
  show_(name) {
    if (this.tabs.shown === name || !(name in TABS)) return;
    this.tabs.show(name);
    if (this.plots) this.load(name).catch((error) => toast(error.message));
  }

  fillLists() {
    this.showRuns();
    this.fillValidation();
    this.tabs.panels.compare.replaceChildren(...(this.buildRivals?.() ?? []));
  }

  // The signature of an effect is called as its card is.
  buildNode(figure) {
    const effect = this.state?.session.effects.find(({ id }) => figure.id === SIGNATURES + id);
    return buildFigure(effect ? { ...figure, title: nameEffect(effect) } : figure);
  }

  // Effects came or went, and their signatures with them.
  async renewSignatures(turn) {
    const album = await post("/api/figures", { ...this.request, tab: "effects" });
    if (turn !== this.turn) return;
    const grid = this.grid("effects");
    for (const node of grid.querySelectorAll(`figure[data-id^="${SIGNATURES}"]`)) {
      this.plots.forget(node.dataset.id);
      node.remove();
    }
    Object.assign(this.album.figures, album.figures);
    Object.assign(this.album.rows, album.rows);
    this.signatures = listSignatures(album.rows);
    for (const figure of album.shown.filter(({ id }) => id.startsWith(SIGNATURES))) {
      const node = this.buildNode(figure);
      grid.append(node);
      const place = node.querySelector(".plot");
      if (place.clientWidth) await this.plots.draw(place);
    }
  }

  tellWhere({ where: regions, largest }) {
    this.largest = largest;
    if (this.state) this.sayEnd(this.state.session);
    this.whereSaid.textContent = regions.length
      ? `Where: ${regions.slice(0, 2).join("; ")}`
      : "Where: the error is spread evenly over the run.";
  }

  // What another model moves: rows of the figures, where it fails, what the figures say to those who hear them.
  async take(answer) {
    const { rows, words } = answer;
    this.tellWhere(answer);
    for (const [id, text] of Object.entries(words)) this.root.querySelector(`[data-figure=${id}]`)?.setAttribute("aria-label", text);
    // Words are seen before the figures are drawn.
    await new Promise((done) => setTimeout(done));
    const idle = this.signatures.filter((name) => !(name in rows)).map((name) => [name, flatten(this.plots.rowsOf(name))]);
    await this.plots?.feed({ ...rows, ...Object.fromEntries(idle) });
    this.cursor.renew();
    this.moved?.();
  }

  // The room or the colours changed, or the stretch of time: what is hidden is drawn when it is opened.
  async paintAnew() {
    if (!this.plots) return;
    for (const place of this.root.querySelectorAll(".plot[data-figure]")) {
      if (place.clientWidth) await this.plots.draw(place);
      else if (place.classList.contains("drawn")) {
        this.plots.forget(place.dataset.figure);
        place.classList.remove("drawn");
        place.replaceChildren();
      }
    }
  }

  // Only rows, but steps of the staircase come and go, so that figure changes its height and is drawn whole; and
  // where effects came or went their signatures do. The budget is reckoned only where it is seen.
  async redraw() {
    if (!this.plots) return this.draw();
    const turn = (this.turn += 1);
    delete this.root.dataset.drawn;
    try {
      const answer = await post("/api/rows", this.request);
      if (turn !== this.turn) return;
      const fed = this.take(answer);
      const ladder = this.root.querySelector("[data-figure=ladder]");
      if (ladder?.clientWidth) await this.plots.draw(ladder);
      else if (ladder) ladder.classList.remove("drawn");
      await fed;
      if (turn !== this.turn) return;
      if (this.loaded.has("effects") && listSignatures(answer.rows).join() !== this.signatures.join()) await this.renewSignatures(turn);
      if (turn !== this.turn) return;
      this.loaded.delete("budget");
      if (this.tabs.shown === "budget") await this.load("budget", turn);
      if (turn !== this.turn) return;
      this.fillLists();
      this.root.dataset.drawn = String(turn);
      if (this.state.trial) this.follow();
    } catch (error) {
      toast(error.message);
    }
  }
}
