// One session: its numbers, its figures, and beside them its model.
import { buildModel } from "./model.js";
import { h, post, runTo, say, sayDuration, sayShare, toast } from "./parts.js";

const WAIT_MS = 60;
const HEADROOM = 1.05;
const SIGNATURE = "signature";

// The effects whose signatures can be drawn: not those that are off, or neutral.
const listSignatures = (rows) => Object.keys(rows).filter((name) => name.startsWith("signature_"));

// The signature of an effect at its neutral value: it does nothing, and leaves what stood there without it.
const flatten = (rows) => {
  const without = rows.filter((row) => row.series === "before");
  const there = [...without.map((row) => ({ ...row, series: "curve", mean: 0, low: null, high: null })), ...without, ...without.map((row) => ({ ...row, series: "after" }))];
  return Object.fromEntries(["value", "mean", "low", "high", "series"].map((name) => [name, there.map((row) => row[name])]));
};

const buildFigure = (figure) =>
  h("figure", { class: figure.width, data: { id: figure.id } },
    h("figcaption", {}, h("h3", {}, figure.title)),
    h("div", { class: "plot", role: "img", "aria-label": figure.words, data: { figure: figure.id } }),
    figure.note && h("p", { class: "note" }, figure.note));

// Seen only where an answer takes longer than a moment.
const working = () => h("i", { class: "working", role: "progressbar", "aria-label": "working" });

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
    this.figures = h("section", { class: "figures", "aria-label": "Figures" });
    this.marks = this.buildMarks();
    this.root = h("article", { class: "pane", data: { slot } }, this.hero, this.glance, this.model, this.figures);
  }

  // Beside the runs where there is room, else between the numbers and the figures.
  place(side) {
    if (side) side.append(this.model);
    else this.root.insertBefore(this.model, this.figures);
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
      if (error.code === "error_rises") toast(error.message, "Apply anyway", () => this.act(action, { ...more, anyway: true }));
      else toast(error.message);
      return false;
    } finally {
      this.busy(false);
    }
  }

  // The numbers first, then the figures.
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
    for (const part of [this.glance, this.model, this.figures]) part.replaceChildren();
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
    this.glance.querySelector(".said").textContent = session.said;
    buildModel(this);
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
    const number = (key, unit, name) =>
      h("div", { class: `number ${key}` },
        h("p", { class: "big" }, h("span", { class: "value" }, "–"), h("small", {}, ` ${unit}`)),
        h("p", { class: "what" }, name, " ", h("b", { class: "fall" })));
    const tool = (name, text, act) => h("button", { type: "button", class: name, onclick: act }, text);
    this.hero.dataset.run = session.run + session.input;
    this.hero.replaceChildren(...[
      h("div", { class: "title" }, h("h2", {}, session.run), h("p", { class: "facts" }, facts.join(" · ")), choice),
      run.verdict && h("p", { class: "verdict" }, run.verdict),
      this.warn(run),
      h("div", { class: "tools" },
        tool("fit", "Fit again", () => this.act("fit")),
        tool("save", "Save model", () => this.save()),
        h("a", { class: "download button", href: `/model.toml?${new URLSearchParams({ run: session.run, slot: this.slot })}` }, "Download"),
        run.report && h("a", { class: "report button", href: `/report?${new URLSearchParams({ run: session.run })}`, target: "_blank", rel: "noopener" }, "Report")),
    ].filter(Boolean));
    this.glance.replaceChildren(
      working(),
      h("div", { class: "numbers" }, number("t", "m", "position error after 2 s"), number("r", "rad", "heading error after 2 s"),
        h("div", { class: "scale" },
          h("div", { class: "track", role: "img" }, h("i", { class: "now" }), h("i", { class: "floor" }), h("i", { class: "ceiling" })),
          h("p", { class: "ends" }, h("span", { class: "floor-said" }), h("span", { class: "ideal-said" }))),
        h("div", { class: "steps" }, tool("undo", "Undo", () => this.act("undo")), tool("redo", "Redo", () => this.act("redo")))),
      h("p", { class: "where" }), h("p", { class: "said", role: "status" }));
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
      const place = this.glance.querySelector(`.number.${key}`);
      runTo(place.querySelector(".value"), errors[key]);
      const fall = ideal[key] ? errors[key] / ideal[key] - 1 : 0;
      const last = before && before[key] ? errors[key] / before[key] - 1 : 0;
      const told = Math.abs(fall) < 0.005 ? "as ideal" : `${sayShare(fall)} vs ideal`;
      place.querySelector(".fall").textContent = Math.abs(last) < 0.005 || Math.abs(last - fall) < 0.005 ? told : `${told}, ${sayShare(last)} now`;
      place.classList.toggle("fallen", fall < -0.005);
      place.classList.toggle("risen", fall > 0.005);
    }
    const most = Math.max(ideal.t, errors.t) * HEADROOM;
    const track = this.glance.querySelector(".track");
    track.style.setProperty("--now", errors.t / most);
    track.style.setProperty("--floor", floor ? floor.t / most : 0);
    track.style.setProperty("--ideal", ideal.t / most);
    track.setAttribute("aria-label", `position error ${say(errors.t)} m of ${say(ideal.t)} m for the ideal model${floor ? `, floor ${say(floor.t)} m` : ""}`);
    this.glance.querySelector(".floor-said").textContent = floor ? `floor ${say(floor.t)} m` : "";
    this.glance.querySelector(".ideal-said").textContent =
      `ideal model ${say(ideal.t)} m${byHand ? " · set by hand, not fitted" : ""}`;
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
          const answer = await post("/api/session", { ...asked, run: this.run, slot: this.slot, input: this.state.session.input, action: "preview" });
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
    await this.act("add_named");
    this.tryAll();
  }

  // The formula that the diagnosis found for what no effect explains.
  async addFound() {
    await this.act("add_found");
    this.tryAll();
  }

  async tryAll() {
    if (await this.ask("try")) this.follow();
  }

  // How far the trial is, as long as it goes on; what comes while something else was asked is not shown.
  async follow() {
    if (this.following) return;
    this.following = true;
    let ended = false;
    try {
      while (this.state?.trial && this.state.trial.tried < this.state.trial.total) {
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
    return { run: this.run, slot: this.slot, input: this.state.session.input };
  }

  async draw() {
    const turn = (this.turn += 1);
    if (!this.album) this.figures.replaceChildren(h("p", { class: "lead waiting" }, "drawing the figures …"));
    let album;
    try {
      album = await post("/api/figures", this.request);
    } catch (error) {
      toast(error.message);
      return;
    }
    if (turn !== this.turn) return;
    this.album = album;
    this.signatures = listSignatures(album.rows);
    this.tellWhere(album.where);
    this.figures.replaceChildren(this.marking, ...album.shown.map(buildFigure));
    if (this.drawnRun !== this.run) this.marks.reset();
    this.drawnRun = this.run;
    this.plots = slipPlots(album, { strict: true, own: this.marks.own, zoomOf: this.marks.zoomOf });
    this.marks.join(album, this.plots, () => this.paint(), this.figures.querySelectorAll(".plot[data-figure]"));
    await this.paint(turn);
    this.moved?.();
  }

  // Panels came or went with their effects: that figure alone is put in, out, or in the place of the old one.
  async renewSignatures(turn) {
    const album = await post("/api/figures", this.request);
    if (turn !== this.turn) return;
    const find = (id) => this.figures.querySelector(`figure[data-id="${id}"]`);
    const at = album.shown.findIndex(({ id }) => id === SIGNATURE);
    find(SIGNATURE)?.remove();
    this.plots.forget(SIGNATURE);
    Object.assign(this.album.figures, album.figures);
    Object.assign(this.album.rows, album.rows);
    this.signatures = listSignatures(album.rows);
    if (at >= 0) {
      const node = buildFigure(album.shown[at]);
      find(album.shown[at - 1].id).after(node);
      await this.plots.draw(node.querySelector(".plot"));
    }
  }

  tellWhere(regions) {
    this.glance.querySelector(".where").textContent = regions.length
      ? `Where: ${regions.slice(0, 2).join("; ")}`
      : "Where: the error is spread evenly over the run.";
  }

  // What another model moves: rows of the figures, where it fails, what the figures say to those who hear them.
  async take({ rows, where, words }) {
    this.tellWhere(where);
    for (const [id, text] of Object.entries(words)) this.figures.querySelector(`[data-figure=${id}]`)?.setAttribute("aria-label", text);
    // Words are seen before the figures are drawn.
    await new Promise((done) => setTimeout(done));
    const idle = this.signatures.filter((name) => !(name in rows)).map((name) => [name, flatten(this.plots.rowsOf(name))]);
    await this.plots?.feed({ ...rows, ...Object.fromEntries(idle) });
    this.moved?.();
  }

  async paint(turn = this.turn) {
    for (const place of this.figures.querySelectorAll(".plot[data-figure]")) {
      if (turn !== this.turn) return;
      await this.plots.draw(place);
    }
    this.root.dataset.drawn = String(turn);
  }

  // Only rows, but steps of the staircase come and go, so that figure changes its height and is drawn whole; and
  // where effects came or went their signatures do.
  async redraw() {
    if (!this.plots) {
      await this.draw();
      return;
    }
    const turn = (this.turn += 1);
    delete this.root.dataset.drawn;
    try {
      const answer = await post("/api/rows", this.request);
      if (turn !== this.turn) return;
      const fed = this.take(answer);
      const ladder = this.figures.querySelector("[data-figure=ladder]");
      if (ladder) await this.plots.draw(ladder);
      await fed;
      if (turn !== this.turn) return;
      if (listSignatures(answer.rows).join() !== this.signatures.join()) await this.renewSignatures(turn);
      if (turn !== this.turn) return;
      this.root.dataset.drawn = String(turn);
      if (this.state.trial) this.follow();
    } catch (error) {
      toast(error.message);
    }
  }
}
