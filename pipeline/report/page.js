"use strict";
// Draws the figures of a page and links them.
(() => {
  const page = JSON.parse(document.getElementById("page-data").textContent);
  const find = (id) => document.getElementById(id);
  const marks = slipMarks({
    bar: find("marked"),
    said: find("marked").firstElementChild,
    zoomIn: find("zoom-in"),
    zoomOut: find("zoom-out"),
    clear: find("mark-clear"),
    from: find("mark-from"),
    to: find("mark-to"),
    set: find("mark-set"),
  });
  for (const moment of document.querySelectorAll(".moment")) {
    moment.addEventListener("click", () => {
      find("mark-from").value = moment.dataset.from;
      find("mark-to").value = moment.dataset.to;
      find("mark-set").click();
    });
  }
  // What the reader chose, or else the stretch that a figure shows first.
  const zoomOf = (meta) => marks.zoomOf() ?? meta.window ?? null;
  const bar = find("cursor");
  const cursor = bar && slipCursor(bar);
  const plots = slipPlots(page, { own: marks.own, zoomOf, drawn: () => cursor?.refresh() });
  const places = document.querySelectorAll(".plot[data-figure]");

  // What is folded away has no room to be drawn in.
  const isShown = (place) => !place.closest("details:not([open])");
  const drawAll = async (selector = ".plot[data-figure]", within = document) => {
    for (const place of [...within.querySelectorAll(selector)].filter(isShown)) await plots.draw(place);
    document.documentElement.dataset.drawn = "yes";
  };

  let queue = drawAll();
  cursor?.setSpan(Number(bar.dataset.from), Number(bar.dataset.to));
  cursor?.join(plots, places);
  marks.join(page, plots, () => (queue = queue.then(() => drawAll(".plot.brush-time"))), places);
  document.addEventListener("toggle", ({ target }) => (queue = queue.then(() => drawAll(undefined, target))), true);
  document.addEventListener("keydown", (event) => event.key === "Escape" && marks.leave());

  // Signals of the reader's choice -----------------------------------------------------------------------------

  const packed = JSON.parse(find("signals-data")?.textContent ?? "{}");
  const unpackNumbers = (text, Kind) => new Kind(Uint8Array.from(atob(text), (mark) => mark.charCodeAt(0)).buffer);
  const readSignal = (table, name) => {
    const { t: times, hole, columns } = packed[table];
    const { low, step, values } = columns[name];
    const rows = { t: [], value: [] };
    const numbers = unpackNumbers(values, Int16Array);
    unpackNumbers(times, Int32Array).forEach((ms, at, all) => {
      const breaks = at > 0 && ms - all[at - 1] > 1000 * hole;
      rows.t.push(...(breaks ? [ms / 1000] : []), ms / 1000);
      rows.value.push(...(breaks ? [null] : []), numbers[at] < 0 ? null : low + step * numbers[at]);
    });
    return rows;
  };
  for (const choice of document.querySelectorAll(".signal")) {
    choice.addEventListener("change", () => {
      const [{ value, dataset }] = choice.selectedOptions;
      const names = [...document.querySelectorAll(".signal")].map((one) => `${one.value} of ${one.selectedOptions[0].dataset.table}`);
      document.querySelector("[data-figure=signals]").setAttribute("aria-label", `Over time: ${names.join(" and ")}.`);
      plots.feed({ [choice.dataset.rows]: readSignal(dataset.table, value) });
    });
  }

  // A way into a folded chapter opens it.
  const unfold = (id) => {
    const fold = id && find(id)?.closest("details");
    if (fold) fold.open = true;
  };
  document.addEventListener("click", ({ target }) => unfold(target.closest?.('a[href^="#"]')?.hash.slice(1)));
  unfold(location.hash.slice(1));

  // Drawing again when room or colours change -----------------------------------------------------------------

  let timer = 0;
  let lastWidth = document.documentElement.clientWidth;
  const again = () => {
    clearTimeout(timer);
    timer = setTimeout(() => {
      queue = queue.then(() => drawAll());
    }, 150);
  };
  addEventListener("resize", () => {
    if (document.documentElement.clientWidth === lastWidth) return;
    lastWidth = document.documentElement.clientWidth;
    again();
  });
  plots.dark.addEventListener("change", again);
})();
