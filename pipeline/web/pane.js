// One session: its numbers, its model as cards, what to add next, its figures.
import { h, post, runTo, say, sayDuration, sayShare, toast } from "./parts.js";

const WAIT_MS = 60;
const REST_MS = 350;
const HEADROOM = 1.05;

export class Pane {
  constructor(slot, changed, working) {
    this.slot = slot;
    this.working = working;
    this.changed = changed;
    this.state = null;
    this.plots = null;
    this.turn = 0;
    this.hero = h("section", { class: "hero", "aria-label": "Error of the model" });
    this.model = h("section", { class: "model", "aria-label": "Model" });
    this.figures = h("section", { class: "figures", "aria-label": "Figures" });
    this.marks = this.buildMarks();
    this.root = h("article", { class: "pane", data: { slot } }, this.hero, this.model, this.figures);
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
    this.busy(true);
    try {
      const input = more.input ?? this.state?.session.input ?? null;
      const state = await post("/api/session", { ...more, run, input: more.fresh ? null : input, slot: this.slot, action, fresh: undefined });
      this.state = state;
      this.show();
      return true;
    } catch (error) {
      if (error.code === "error_rises") toast(error.message, "Take it anyway", () => this.act(action, { ...more, anyway: true }));
      else toast(error.message);
      return false;
    } finally {
      this.busy(false);
    }
  }

  // A change of structure: all figures anew. A change of values: only their rows.
  async act(action, more = {}) {
    await this.settle();
    if (await this.ask(action, more)) await this.redraw();
  }

  // A value that was set a moment ago becomes a step before anything else happens.
  async settle() {
    clearTimeout(this.rest);
    const asked = this.resting;
    this.resting = null;
    this.wanted = null;
    if (asked) await this.ask("set", asked);
  }

  async open(run) {
    await this.settle();
    this.wait(run);
    if (await this.ask("open", { run, fresh: true })) {
      await this.draw();
      this.changed();
      if (this.state.trial) this.follow();
      else this.tryAll();
    } else {
      this.hero.replaceChildren(h("p", { class: "lead" }, "This run cannot be fitted."));
      this.model.replaceChildren();
      this.figures.replaceChildren();
    }
  }

  busy(on) {
    this.root.classList.toggle("busy", on);
    this.root.setAttribute("aria-busy", String(on));
  }

  wait(run) {
    this.state = null;
    this.plots = null;
    this.model.replaceChildren();
    this.figures.replaceChildren();
    this.hero.replaceChildren(h("h2", {}, run), h("p", { class: "lead waiting" }, "making the run ready …"));
  }

  // Numbers ------------------------------------------------------------------------------------------------

  show() {
    const { session, run } = this.state;
    if (!this.hero.querySelector(".numbers") || this.hero.dataset.run !== session.run + session.input) this.buildHero();
    this.showNumbers(session);
    const undo = this.hero.querySelector(".undo");
    undo.disabled = session.undo === null;
    undo.title = session.undo === null ? "nothing to undo" : `undo: ${session.undo}`;
    const redo = this.hero.querySelector(".redo");
    redo.disabled = session.redo === null;
    redo.title = session.redo === null ? "nothing to redo" : `redo: ${session.redo}`;
    this.hero.querySelector(".said").textContent = session.said;
    this.showModel();
    return run;
  }

  buildHero() {
    const { session, run, inputs } = this.state;
    const facts = [run.vehicle_name ?? run.vehicle, run.terrain, sayDuration(run.duration_s), this.sayStanding(run)].filter(Boolean);
    const words = { command: "on command", measured: "on measured wheels" };
    const choice = h("div", { class: "inputs", role: "group", "aria-label": "What the model is fed with" },
      inputs.map((name) => h("button", {
        type: "button", "aria-pressed": String(name === session.input),
        onclick: () => name !== session.input && this.switchInput(name),
      }, words[name])));
    const number = (key, unit, name) =>
      h("div", { class: `number ${key}` },
        h("p", { class: "big" }, h("span", { class: "value" }, "–"), h("small", {}, ` ${unit}`)),
        h("p", { class: "what" }, name, " ", h("b", { class: "fall" })));
    this.hero.dataset.run = session.run + session.input;
    const parts = [
      h("div", { class: "title" }, h("h2", {}, session.run), h("p", { class: "facts" }, facts.join(" · ")), choice),
      this.warn(run),
      h("div", { class: "numbers" }, number("t", "m", "position after 2 s"), number("r", "rad", "heading after 2 s")),
      h("div", { class: "scale" },
        h("div", { class: "track", role: "img" }, h("i", { class: "now" }), h("i", { class: "floor" }), h("i", { class: "ceiling" })),
        h("p", { class: "ends" }, h("span", { class: "floor-said" }), h("span", { class: "ideal-said" }))),
      h("p", { class: "where" }),
      h("div", { class: "tools" },
        h("button", { type: "button", class: "undo", onclick: () => this.act("undo") }, "Undo"),
        h("button", { type: "button", class: "redo", onclick: () => this.act("redo") }, "Redo"),
        h("button", { type: "button", class: "fit", onclick: () => this.act("fit") }, "Fit"),
        h("button", { type: "button", class: "save", onclick: () => this.save() }, "Save model"),
        h("a", { class: "download button", href: `/model.toml?${new URLSearchParams({ run: session.run, slot: this.slot })}` }, "Download"),
        run.report && h("a", { class: "report button", href: `/report?${new URLSearchParams({ run: session.run })}`, target: "_blank", rel: "noopener" }, "Report"),
        h("span", { class: "said", role: "status" })),
    ];
    this.hero.replaceChildren(...parts.filter(Boolean));
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
    const told = run.findings.filter((finding) => finding.severity !== "info").map((finding) => finding.text);
    if (run.losses.length) told.unshift(`the log had losses: ${run.losses.map((loss) => loss.text).join("; ")}`);
    return told.length > 0 && h("details", { class: "doubts" }, h("summary", {}, told[0]), h("ul", {}, told.slice(1).map((text) => h("li", {}, text))));
  }

  showNumbers(session) {
    const { errors, ideal, floor, before, by_hand: byHand } = session;
    for (const key of ["t", "r"]) {
      const place = this.hero.querySelector(`.number.${key}`);
      runTo(place.querySelector(".value"), errors[key]);
      const fall = ideal[key] ? errors[key] / ideal[key] - 1 : 0;
      const last = before && before[key] ? errors[key] / before[key] - 1 : 0;
      const told = Math.abs(fall) < 0.005 ? "as ideal" : `${sayShare(fall)} vs ideal`;
      place.querySelector(".fall").textContent = Math.abs(last) < 0.005 || Math.abs(last - fall) < 0.005 ? told : `${told}, ${sayShare(last)} now`;
      place.classList.toggle("fallen", fall < -0.005);
      place.classList.toggle("risen", fall > 0.005);
    }
    const most = Math.max(ideal.t, errors.t) * HEADROOM;
    const track = this.hero.querySelector(".track");
    track.style.setProperty("--now", errors.t / most);
    track.style.setProperty("--floor", floor ? floor.t / most : 0);
    track.style.setProperty("--ideal", ideal.t / most);
    track.setAttribute("aria-label", `error ${say(errors.t)} m of ${say(ideal.t)} m for the ideal model`);
    this.hero.querySelector(".floor-said").textContent = floor ? `floor at most ${say(floor.t)} m` : "";
    this.hero.querySelector(".ideal-said").textContent =
      `ceiling: the ideal model, ${say(ideal.t)} m${byHand ? " · values set by hand, not fitted" : ""}`;
  }

  async switchInput(name) {
    if (await this.ask("open", { input: name })) {
      this.buildHero();
      this.show();
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

  // Model --------------------------------------------------------------------------------------------------

  showModel() {
    const { session } = this.state;
    const focus = document.activeElement?.dataset?.keep;
    const cards = session.effects.map((effect) => this.card(effect));
    this.model.replaceChildren(
      h("h3", {}, "Model"),
      ...session.warnings.map((told) => h("p", { class: "doubts warning", role: "status" }, told)),
      cards.length ? h("ul", { class: "cards" }, cards) : h("p", { class: "quiet" }, "The ideal model: no effect yet."),
      h("h3", {}, "Add an effect"),
      this.proposals(),
      this.formula());
    if (focus) this.model.querySelector(`[data-keep="${CSS.escape(focus)}"]`)?.focus();
  }

  card(effect) {
    const { session } = this.state;
    const carries = effect.without_m !== null && !effect.off ? effect.without_m - session.errors.t : null;
    return h("li", { class: `card${effect.off ? " off" : ""}`, data: { effect: effect.id } },
      h("div", { class: "head" },
        h("b", {}, effect.id),
        h("button", { type: "button", class: "switch", "aria-pressed": String(!effect.off), title: "on or off, without a fit", onclick: () => this.act("switch", { effect: effect.id }) }, effect.off ? "off" : "on"),
        h("button", { type: "button", class: "drop", title: "drop it and fit the rest", "aria-label": `drop ${effect.id}`, onclick: () => this.act("drop", { effect: effect.id }) }, "×")),
      h("p", { class: "quiet" }, effect.formula.length ? effect.formula.join("; ") : effect.sentence || effect.about),
      effect.parameters.map((parameter) => this.slider(effect, parameter)),
      carries !== null && carries > 0 && h("p", { class: "carries" }, `without it ${say(effect.without_m)} m`));
  }

  slider(effect, parameter) {
    const { name, unit, value, low, high } = parameter;
    const label = `${effect.id}.${name}`;
    const shown = h("output", {}, `${say(value, 4)} ${unit === "1" ? "" : unit}`);
    const input = h("input", {
      type: "range", min: String(parameter.from), max: String(parameter.to), step: String(parameter.step),
      value: String(value), "aria-label": `${label} [${unit}], ${parameter.about}`, data: { keep: label },
    });
    input.value = String(value);
    input.disabled = effect.off;
    input.addEventListener("input", () => {
      shown.textContent = `${say(Number(input.value), 4)} ${unit === "1" ? "" : unit}`;
      this.preview(effect.id, name, Number(input.value));
    });
    // Keys change the value many times in a row: only where it comes to rest is a step.
    input.addEventListener("change", () => {
      clearTimeout(this.rest);
      this.resting = { effect: effect.id, parameter: name, value: Number(input.value) };
      this.rest = setTimeout(() => this.settle().then(() => this.redraw()), REST_MS);
    });
    const span = low === null ? "" : `95 %: ${say(low, 4)} to ${say(high, 4)}`;
    return h("div", { class: "slider" },
      h("label", {}, h("span", {}, name), shown),
      input,
      h("p", { class: "quiet" }, span,
        h("button", { type: "button", class: "lock", "aria-pressed": String(parameter.locked), title: "a locked value stays as it is in a fit", onclick: () => this.act("lock", { effect: effect.id, parameter: name }) }, parameter.locked ? "locked" : "lock")));
  }

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
          const answer = await post("/api/session", { ...asked, run: this.run, slot: this.slot, input: this.state.session.input, action: "preview" });
          if (turn === this.turn) {
            this.showNumbers({ ...answer.session, before: this.state.session.errors });
            this.plots?.feed(answer.rows);
          }
        } catch (error) {
          toast(error.message);
        }
      }
      this.previewing = false;
    };
    setTimeout(step, WAIT_MS);
  }

  // What to add --------------------------------------------------------------------------------------------

  proposals() {
    const { session, trial, catalogue, diagnosis } = this.state;
    const there = new Set(session.effects.map((effect) => effect.id));
    const parts = [this.named(diagnosis, there)];
    if (!trial) parts.push(h("button", { type: "button", class: "try", onclick: () => this.tryAll() }, "Try every effect"));
    else {
      const helping = trial.found.filter((entry) => entry.helps && !there.has(entry.id));
      const running = trial.tried < trial.total;
      if (running) parts.push(h("p", { class: "quiet trying" }, `trying every effect: ${trial.tried} of ${trial.total}`, h("i", { class: "progress", bar: trial.tried / trial.total })));
      parts.push(h("ul", { class: "proposals" }, helping.slice(0, 6).map((entry, rank) => this.proposal(entry, rank === 0 && !running))));
      if (!running && !helping.length) parts.push(h("p", { class: "nothing" }, this.tellNothing(session)));
    }
    const rest = catalogue.filter((entry) => !there.has(entry.id));
    const chosen = h("select", { "aria-label": "Any effect of the catalogue", class: "catalogue" }, h("option", { value: "" }, "any other effect …"),
      rest.map((entry) => h("option", { value: entry.id, title: entry.about }, entry.id)));
    chosen.addEventListener("change", () => chosen.value && this.add(chosen.value));
    return h("div", { class: "next" }, parts, chosen);
  }

  proposal(entry, first) {
    const fall = entry.to.t / entry.from.t - 1;
    const turn = entry.to.r / entry.from.r - 1;
    return h("li", { class: first ? "first" : "", data: { effect: entry.id }, bar: Math.min(Math.max(1 - entry.ratio, 0), 1) },
      h("div", {}, h("b", {}, entry.id), h("span", { class: "quiet" }, `${say(entry.from.t)} → ${say(entry.to.t)} m, ${sayShare(fall)}`), h("span", { class: "quiet" }, `heading ${sayShare(turn)}`)),
      h("button", { type: "button", class: "add", "aria-label": `add ${entry.id}`, title: entry.about, onclick: () => this.add(entry.id) }, "Add"));
  }

  named(diagnosis, there) {
    if (!diagnosis)
      return h("p", { class: "quiet undiagnosed" }, "Not diagnosed yet.", h("button", { type: "button", class: "diagnose", onclick: () => this.diagnose() }, "Diagnose"));
    const effects = (diagnosis.effects ?? []).filter((entry) => !there.has(entry.id) && !entry.corrected).sort((a, b) => (b.gain ?? 0) - (a.gain ?? 0));
    const told = effects.map((entry) => h("li", { class: "first", data: { effect: entry.id }, bar: 1 },
      h("div", {}, h("b", {}, entry.id), entry.sentence && h("span", {}, entry.sentence), h("span", { class: "quiet" }, `named by the diagnosis${Number.isFinite(entry.gain) ? `: without it the loss is ${say(entry.gain + 1)} times as high` : ""}${(entry.equivalent_to ?? []).length ? `; same as ${entry.equivalent_to.join(", ")}` : ""}`)),
      h("button", { type: "button", class: "add", "aria-label": `add ${entry.id}, named by the diagnosis`, onclick: () => this.add(entry.id) }, "Add")));
    const all = effects.length > 1 && h("button", { type: "button", class: "add-all", onclick: () => this.addAll() }, `Add all ${effects.length}`);
    const undecided = (diagnosis.undecided ?? []).map((entry) => h("p", { class: "quiet" }, `Undecided: ${(entry.candidates ?? []).join(" or ")}. ${entry.separate_by ?? ""}`));
    const rest = diagnosis.unexplained ? [h("p", { class: "quiet" }, `Not explained yet: ${diagnosis.unexplained.where ?? diagnosis.unexplained.channel}`)] : [];
    const unseen = (diagnosis.unobservable ?? []).length;
    const command = `slip plan ${this.run} --for ${undecided.length ? "undecided" : "all"} --out plan`;
    const plan = undecided.length || unseen
      ? h("p", { class: "quiet plan" }, "What to drive next: ", h("code", {}, command), ", then play plan/plan.mcap (look at plan/plan.html before).")
      : effects.length || there.size ? h("p", { class: "quiet plan" }, "Nothing is open that a drive could decide.") : null;
    return h("div", { class: "named" }, told.length ? h("ul", { class: "proposals" }, told) : null, all, undecided, plan, rest);
  }

  async diagnose() {
    try {
      await post("/api/diagnose", { run: this.run });
      this.working();
    } catch (error) {
      toast(error.message);
    }
  }

  tellNothing(session) {
    const room = session.floor ? session.errors.t / session.floor.t : Infinity;
    if (room < 1.3) return "Nothing is missing: the model is as good as the localization lets us see.";
    return "No single effect of the catalogue helps further. What is left may be a formula of your own, or noise.";
  }

  async add(effect) {
    await this.act("add", { effect });
    if (this.state?.session.effects.some((entry) => entry.id === effect)) this.tryAll();
  }

  // The joint fit of the diagnosis, as one step that can be undone.
  async addAll() {
    await this.act("add_named");
    this.tryAll();
  }

  async tryAll() {
    if (await this.ask("try")) this.follow();
  }

  async follow() {
    const turn = this.turn;
    const run = this.run;
    while (this.run === run && turn === this.turn && this.state?.trial && this.state.trial.tried < this.state.trial.total) {
      await new Promise((done) => setTimeout(done, 700));
      if (this.run !== run || turn !== this.turn || this.root.classList.contains("busy")) continue;
      try {
        const state = await post("/api/session", { run, slot: this.slot, input: this.state.session.input, action: "open" });
        if (this.run !== run || turn !== this.turn) return;
        this.state.trial = state.trial;
        if (!state.trial) {
          this.tryAll();
          return;
        }
        this.model.querySelector(".next")?.replaceWith(this.proposals());
      } catch (error) {
        toast(error.message);
        return;
      }
    }
  }

  formula() {
    const field = (name, hint, wide) => h("input", { name, placeholder: hint, "aria-label": hint, class: wide ? "wide" : "", autocomplete: "off", spellcheck: "false" });
    const channel = h("select", { name: "channel", "aria-label": "velocity it adds to" }, ["v_x", "v_y", "v_w"].map((name) => h("option", { value: name }, `${name} +=`)));
    const parts = { effect: field("effect", "name, for example my_skid"), formula: field("formula", "formula: c * v0 * w0", true), parameters: field("parameters", "parameters: c [s] -0.5 .. 0.5", true) };
    const form = h("form", { onsubmit: async (event) => {
      event.preventDefault();
      await this.act("formula", { effect: parts.effect.value.trim(), channel: channel.value, formula: parts.formula.value, parameters: parts.parameters.value });
    } }, parts.effect, channel, parts.formula, parts.parameters, h("button", { type: "submit" }, "Add formula"),
    h("p", { class: "quiet" }, "Signals: v0, s0 (sideways), w0, f_x, f_w, left, right, roll, pitch, yaw, x, y, t, and each with _rate. Units are checked."));
    const open = this.model.querySelector(".formula")?.open ?? false;
    if (open) for (const [name, input] of Object.entries(parts)) input.value = this.model.querySelector(`[name=${name}]`)?.value ?? "";
    return h("details", { class: "formula", open }, h("summary", {}, "Write a formula"), form);
  }

  // Figures ------------------------------------------------------------------------------------------------

  get request() {
    return { run: this.run, slot: this.slot, input: this.state.session.input };
  }

  async draw() {
    const turn = (this.turn += 1);
    let album;
    try {
      album = await post("/api/figures", this.request);
    } catch (error) {
      toast(error.message);
      return;
    }
    if (turn !== this.turn) return;
    this.album = album;
    const where = this.hero.querySelector(".where");
    where.textContent = album.where.length
      ? `Where: ${album.where.slice(0, 2).map((region) => `${region.words.toLowerCase()}, ${Math.round(region.slip * 100)} % of the squared slip in ${Math.round(region.time * 100)} % of the time`).join("; ")}`
      : "";
    this.figures.replaceChildren(this.marking, ...album.shown.map((figure) =>
      h("figure", { class: figure.width, data: { id: figure.id } },
        h("figcaption", {}, h("h3", {}, figure.title)),
        h("div", { class: "plot", role: "img", "aria-label": figure.words, data: { figure: figure.id } }),
        figure.note && h("p", { class: "note" }, figure.note))));
    if (this.drawnRun !== this.run) this.marks.reset();
    this.drawnRun = this.run;
    this.plots = slipPlots(album, { strict: true, own: this.marks.own, zoomOf: this.marks.zoomOf });
    this.marks.join(album, this.plots, () => this.paint(), this.figures.querySelectorAll(".plot[data-figure]"));
    await this.paint(turn);
  }

  async paint(turn = this.turn) {
    for (const place of this.figures.querySelectorAll(".plot[data-figure]")) {
      if (turn !== this.turn) return;
      await this.plots.draw(place);
    }
    this.root.dataset.drawn = String(turn);
  }

  // Steps of the staircase come and go: that figure changes its height and is drawn whole.
  async redraw() {
    if (!this.plots) {
      await this.draw();
      return;
    }
    const turn = (this.turn += 1);
    try {
      const { rows } = await post("/api/rows", this.request);
      if (turn !== this.turn) return;
      this.plots.feed(rows);
      const ladder = this.figures.querySelector("[data-figure=ladder]");
      if (ladder) await this.plots.draw(ladder);
      this.root.dataset.drawn = String(turn);
      if (this.state.trial && this.state.trial.tried < this.state.trial.total) this.follow();
    } catch (error) {
      toast(error.message);
    }
  }
}
