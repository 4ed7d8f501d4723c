// The tabs of a pane; those in TABS hold figures.
import { h } from "./parts.js";

export const TABS = { where: "Where", effects: "Effects", residual: "Residual", budget: "Budget" };
const ALL = { ...TABS, runs: "Runs", compare: "Compare" };

export class Tabs {
  constructor(slot, opened) {
    this.opened = opened;
    this.buttons = {};
    this.panels = {};
    this.grids = {};
    for (const [name, words] of Object.entries(ALL)) {
      this.buttons[name] = h("button", { type: "button", role: "tab", id: `tab-${slot}-${name}`, "aria-controls": `panel-${slot}-${name}`, data: { tab: name }, onclick: () => this.choose(name) }, words);
      this.panels[name] = h("section", { role: "tabpanel", id: `panel-${slot}-${name}`, "aria-labelledby": `tab-${slot}-${name}`, class: `panel ${name}` });
      if (name in TABS) this.panels[name].append((this.grids[name] = h("div", { class: "figures" })));
    }
    const bar = h("div", { class: "tab-bar", role: "tablist", "aria-label": "More of this run", onkeydown: (event) => this.step(event) }, Object.values(this.buttons));
    this.root = h("div", { class: "tabs" }, bar, Object.values(this.panels));
    this.show("where");
  }

  show(name) {
    this.shown = name;
    for (const [each, button] of Object.entries(this.buttons)) {
      button.setAttribute("aria-selected", String(each === name));
      this.panels[each].hidden = each !== name;
    }
  }

  choose(name) {
    this.show(name);
    this.opened(name);
  }

  // Arrow keys go from tab to tab, as everywhere.
  step(event) {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!by) return;
    const names = Object.keys(ALL);
    const next = names[(names.indexOf(this.shown) + by + names.length) % names.length];
    this.choose(next);
    this.buttons[next].focus();
  }
}
