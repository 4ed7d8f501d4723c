// What to drive next: planned where it is asked for, then its way, what it promises, and the files to play.
import { get, h, post, toast } from "./parts.js";

const AREA = "20x10m";

export const buildPlan = (pane) => {
  const { diagnosis, plan } = pane.state;
  if (!diagnosis) return null;
  const isOpen = (diagnosis.undecided ?? []).length || (diagnosis.unobservable ?? []).length;
  if (!isOpen && !plan) return h("p", { class: "quiet plan" }, "No open question that a drive could decide.");
  return h("section", { class: "plan", "aria-label": "What to drive next" }, buildAsk(pane), plan && showPlan(pane, plan));
};

const buildAsk = (pane) => {
  const area = h("input", { name: "area", placeholder: AREA, "aria-label": "free ground, length x width", autocomplete: "off", spellcheck: "false", data: { keep: "field area", field: "area" } });
  const ask = async (event) => {
    event.preventDefault();
    try {
      await post("/api/plan", { run: pane.run, area: area.value.trim() || AREA });
      pane.working();
    } catch (error) {
      toast(error.message);
    }
  };
  return h("form", { class: "ask", onsubmit: ask }, h("label", {}, "On free ground of ", area), h("button", { type: "submit" }, "Plan a drive"));
};

// What is drawn stays as long as the plan does: the model around it is built anew after every change.
const showPlan = (pane, made) => {
  if (pane.planned?.of === `${pane.run} ${made}`) return pane.planned.node;
  const node = h("div", { class: "planned" });
  pane.planned = { of: `${pane.run} ${made}`, node };
  fill(pane.planned, pane.run).catch((error) => toast(error.message));
  return node;
};

const fill = async (planned, run) => {
  const { node } = planned;
  const link = (file) => `/plan?${new URLSearchParams({ run, file })}`;
  const plan = await get(link("plan.json"));
  const list = (texts) => h("ul", {}, texts.map((text) => h("li", {}, text)));
  const gains = h("table", {},
    h("thead", {}, h("tr", {}, ["open", "so far", "with this drive"].map((text) => h("th", { scope: "col" }, text)))),
    h("tbody", {}, plan.gains.map(([what, now, after]) => h("tr", {}, h("th", { scope: "row" }, what), h("td", {}, now), h("td", {}, after)))));
  if (!plan.drives) {
    node.replaceChildren(h("p", { class: "quiet" }, plan.gains.length ? "No drive there tells anything of these." : "No open questions."), plan.gains.length ? gains : "");
    return;
  }
  const place = h("div", { class: "plot", role: "img", "aria-label": plan.words, data: { figure: "ways" } });
  node.replaceChildren(...[
    place,
    h("p", { class: "quiet" }, `${Math.round(plan.duration_s)} s on ${plan.area}: `, h("a", { href: link("plan.html"), target: "_blank", rel: "noopener" }, "the whole plan")),
    gains,
    h("p", {}, h("a", { class: "download button", href: link("plan.mcap") }, "Download plan.mcap"), " ", h("code", {}, plan.play)),
    h("div", { class: "doubts" }, list(plan.safety))]);
  const plots = slipPlots(plan, { strict: true });
  planned.paint = () => plots.draw(place);
  await planned.paint();
};
