// Dropped logs, one pane or two; what is open stands in the address, so that a reload brings it back.
import { drawDifference, repaintDifference, showDifference } from "./difference.js";
import { Pane } from "./pane.js";
import { get, h, post, toast, untoast, upload } from "./parts.js";
import { buildRivals, listRivals, sortByAge } from "./runs.js";

// A notice of what went well goes away by itself.
const NOTICE_MS = 8000;

const find = (id) => document.getElementById(id);
const panes = { a: null, b: null };
let listed = { runs: [], jobs: [], vehicles: [] };
let aimed = "a";
const narrow = matchMedia("(max-width: 860px)");

const address = () => new URLSearchParams(location.hash.slice(1));

const remember = () => {
  const kept = new URLSearchParams();
  for (const [slot, pane] of Object.entries(panes)) if (pane?.run) kept.set(slot, pane.run);
  history.replaceState(null, "", `#${kept}`);
  showRuns();
};

// Runs -------------------------------------------------------------------------------------------------------

const showRuns = () => {
  Object.values(panes).forEach((pane) => pane?.showRuns(listed.runs));
  find("bench").classList.toggle("empty", !listed.runs.length);
  document.body.classList.toggle("without-runs", !listed.runs.length);
  // On an empty page the field for logs, and what becomes of them, stand in its middle.
  if (!listed.runs.length) find("panes").replaceChildren(h("div", { class: "blank" }, h("h2", {}, "No runs yet"), h("p", {}, "Drop an MCAP anywhere on this page: it is analyzed on this machine, and nothing is uploaded."),
    find("drop"), find("jobs"),
    h("p", {}, "No log available?"), h("button", { type: "button", class: "sample", onclick: () => order(() => post("/api/sample", {})) }, "Try it with a sample log")));
  else if (find("drop").closest(".blank")) {
    find("catalogue").after(find("drop"));
    document.querySelector("main").after(find("jobs"));
  }
};

const open_ = (run) => panes[panes.b && aimed === "b" ? "b" : "a"].open(run);

// Runs that can be set beside one, as the report chooses them: of its vehicle on its terrain, slip on the same input
// and scale, each recording once, none with a finding that forbids conclusions.
const findPeers = (run) => {
  if (!run.terrain || run.terrain === "unknown") return [];
  const seen = new Set([run.sha256]);
  return listed.runs.filter((other) => {
    const alike = ["dataset", "leading_input", "length_scale_m"].every((key) => other[key] === run[key]);
    const doubtful = other.findings.some((finding) => finding.severity === "error");
    if (other.run === run.run || !alike || doubtful || !Number.isFinite(other.median_modulus) || seen.has(other.sha256)) return false;
    seen.add(other.sha256);
    return true;
  });
};

const load = async () => {
  listed = await get("/api/runs");
  find("results").textContent = listed.results;
  find("catalogue").hidden = !listed.catalogue;
  showRuns();
  showJobs(listed.jobs);
};

// Panes ------------------------------------------------------------------------------------------------------

const arrange = (two) => {
  find("compare").checked = two;
  panes.a ??= new Pane("a", remember, () => watch());
  panes.b = two ? (panes.b ?? new Pane("b", remember, () => watch())) : null;
  find("bench").classList.toggle("single", !two);
  for (const pane of Object.values(panes)) {
    if (!pane) continue;
    pane.findPeers = findPeers;
    pane.buildRivals = () => buildRivals(pane, listed.runs, compare);
    pane.openedTab = (tab) => Object.values(panes).forEach((other) => other && other !== pane && other.show_(tab));
    pane.showRuns(listed.runs);
    pane.shown = () => showDifference(find("difference"), panes.a, panes.b);
    pane.moved = () => drawDifference(find("apart"), panes.a, panes.b);
    pane.place(two || narrow.matches ? null : find("side"), narrow.matches, two);
  }
  showDifference(find("difference"), panes.a, panes.b);
  drawDifference(find("apart"), panes.a, panes.b);
  // What is marked in one is marked in the other, as long as both show the same run.
  const other = { a: "b", b: "a" };
  for (const pane of Object.values(panes))
    if (pane) pane.pointed = (t) => panes[other[pane.slot]]?.run === pane.run && panes[other[pane.slot]].cursor.show(t, { told: false });
  for (const pane of Object.values(panes))
    if (pane) pane.marked = (spans) => panes[other[pane.slot]]?.run === pane.run && panes[other[pane.slot]].marks.follow(spans);
  if (!listed.runs.length) return;
  find("panes").replaceChildren(...Object.values(panes).filter(Boolean).map((pane) => pane.root));
  for (const pane of Object.values(panes))
    for (const kind of ["pointerdown", "focusin"]) pane?.root.addEventListener(kind, () => (aimed = pane.slot));
};

// Beside A stands something else: what was asked for, or the first that there is.
const compare = async (rival) => {
  arrange(true);
  aimed = "b";
  await panes.a.draw();
  const { run, input, make } = rival ?? listRivals(panes.a, listed.runs)[0] ?? { run: panes.a.run };
  await panes.b.open(run, input);
  const effects = () => panes.b.state?.session.effects ?? [];
  // A model that was made here before stays, as long as it is another one.
  const kept = !rival && effects().length && JSON.stringify(effects()) !== JSON.stringify(panes.a.state.session.effects);
  if (kept) return;
  if (make === "ideal") for (const effect of [...effects()]) await panes.b.act("drop", { effect: effect.id });
  if (make === "named") await panes.b.addAll();
};

find("compare").addEventListener("change", async (event) => {
  if (event.target.checked) await compare();
  else {
    arrange(false);
    aimed = "a";
    remember();
    await panes.a.draw();
  }
});

// Dropped logs -----------------------------------------------------------------------------------------------

// Logs that were refused before the server kept anything of them.
let refused = [];
const leaving = new Map();

const showJobs = (jobs) => {
  const focus = document.activeElement?.dataset?.keep;
  find("jobs").replaceChildren(...[...refused, ...jobs].map((job) => h("li", { class: `job${job.error ? " failed" : ""}`, data: { job: job.id } },
    h("b", {}, job.name),
    !job.done && h("span", {}, `${job.words}, ${Math.round(job.seconds)} s`),
    !job.done && h("i", { class: "progress", bar: job.total && job.stage === "upload" ? (job.received / job.total) / job.steps : job.step / job.steps }),
    job.error && h("p", {}, job.error.message),
    job.error && askVehicle(job),
    job.run && h("button", { type: "button", onclick: () => open_(job.run) }, job.lossy ? "Open (log had losses)" : "Open"),
    h("button", { type: "button", class: "drop", title: job.done ? "close this notice" : "cancel", "aria-label": job.done ? `close the notice of ${job.name}` : `cancel the ${job.name}`, data: { keep: `dismiss ${job.id}` }, onclick: () => dismiss(job) }, "×"))));
  for (const job of jobs) if (job.done && job.run && !job.error && !leaving.has(job.id)) leaving.set(job.id, setTimeout(() => dismiss(job).catch(() => {}), NOTICE_MS));
  if (focus) find("jobs").querySelector(`[data-keep="${CSS.escape(focus)}"]`)?.focus({ preventScroll: true });
};

const dismiss = async (job) => {
  refused = refused.filter((other) => other !== job);
  showJobs((await post(`/api/dismiss?id=${encodeURIComponent(job.id)}`, {})).jobs);
};

const askVehicle = (job) => {
  if (!job.error.code.includes("vehicle")) return null;
  const chosen = h("select", { "aria-label": "vehicle of this log", data: { keep: `vehicle ${job.id}` } }, h("option", { value: "" }, "choose the vehicle …"),
    listed.vehicles.map((vehicle) => h("option", { value: vehicle.id }, vehicle.name)));
  const again = () => chosen.value && order(() => post(`/api/retry?id=${encodeURIComponent(job.id)}&vehicle=${encodeURIComponent(chosen.value)}`, {}));
  return h("div", { class: "any" }, chosen, h("button", { type: "button", class: "analyze", onclick: again }, "Analyze"));
};

const order = async (ask) => {
  try {
    await ask();
    watch();
  } catch (error) {
    toast(error.message);
  }
};

let watching = false;
let isAsked = false;
const opened = new Set();
const watch = async () => {
  isAsked = true;
  if (watching) return;
  watching = true;
  try {
    // What is ordered while the lists are read anew is watched, too.
    while (isAsked) {
      isAsked = false;
      const { jobs } = await get("/api/jobs");
      showJobs(jobs);
      if (!jobs.every((job) => job.done)) {
        isAsked = true;
        await new Promise((done) => setTimeout(done, 400));
        continue;
      }
      const fresh = jobs.find((job) => job.run && !opened.has(job.id));
      jobs.forEach((job) => opened.add(job.id));
      await load();
      arrange(find("compare").checked);
      if (fresh) await open_(fresh.run);
    }
  } catch (error) {
    toast(error.message);
  } finally {
    watching = false;
  }
};

const take = async (files) => {
  for (const file of files) {
    const line = h("li", { class: "job" }, h("b", {}, file.name), h("span", {}, "receiving the log"), h("i", { class: "progress", bar: 0 }));
    find("jobs").prepend(line);
    try {
      await upload(file, (share) => line.querySelector(".progress").style.setProperty("--share", share / 7));
    } catch (error) {
      refused.unshift({ id: `refused-${refused.length}`, name: file.name, done: true, error: { code: error.code ?? "", message: error.message } });
      showJobs(listed.jobs);
      continue;
    }
    await watch();
  }
};

find("file").addEventListener("change", (event) => take([...event.target.files]));
for (const kind of ["dragover", "drop"])
  addEventListener(kind, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", kind === "dragover");
    if (kind === "drop") take([...event.dataTransfer.files]);
  });
addEventListener("dragleave", (event) => event.relatedTarget === null && document.body.classList.remove("dropping"));

// Beginning --------------------------------------------------------------------------------------------------

addEventListener("keydown", (event) => {
  if (event.key === "Escape") {
    untoast();
    Object.values(panes).forEach((pane) => pane?.marks.leave());
  }
  if ((event.ctrlKey || event.metaKey) && event.key === "z" && !/INPUT|SELECT|TEXTAREA/.test(document.activeElement.tagName)) {
    event.preventDefault();
    panes[panes.b ? aimed : "a"]?.act(event.shiftKey ? "redo" : "undo");
  }
});
let timer = 0;
let width = document.documentElement.clientWidth;
const again = () => {
  clearTimeout(timer);
  timer = setTimeout(() => Object.values(panes).forEach((pane) => {
    pane?.paintAnew();
    repaintDifference(find("apart"));
  }), 200);
};
addEventListener("resize", () => {
  if (document.documentElement.clientWidth === width) return;
  width = document.documentElement.clientWidth;
  again();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
narrow.addEventListener("change", () => arrange(find("compare").checked));

const openAddress = async () => {
  const kept = address();
  arrange(kept.has("b"));
  const known = (run) => run && listed.runs.some((entry) => entry.run === run);
  // Unless one was asked for, the run that was analyzed last opens.
  const newest = sortByAge(listed.runs);
  let first = known(kept.get("a")) ? kept.get("a") : null;
  if (first) await panes.a.open(first);
  else for (const { run } of newest.slice(0, 3)) if (await panes.a.open((first = run))) break;
  if (panes.b && first) await panes.b.open(known(kept.get("b")) ? kept.get("b") : first);
};

const begin = async () => {
  try {
    await load();
    for (const job of listed.jobs) if (job.done) opened.add(job.id);
    if (listed.jobs.some((job) => !job.done)) watch();
    await openAddress();
  } catch (error) {
    toast(error.message);
  }
};
// `remember` replaces the address without this event: it comes only from a link, a bookmark or the keyboard.
addEventListener("hashchange", () => openAddress().catch((error) => toast(error.message)));
begin();
