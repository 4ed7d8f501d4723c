"use strict";
// Marking: a stretch of time dragged over one figure, or a box of points, shows in every figure of the run; the
// report and the workbench use it. `parts` are elements: bar, said, zoomIn, zoomOut, clear, and where the page has
// them from, to, set. `marked(spans)` gets what the reader marks.
const slipMarks = (parts, { marked = () => {} } = {}) => {
  let spans = [];
  let points = [];
  let zoom = null;
  let shown = null;
  let seen = null;
  let track = [];
  let plots = null;
  let redraw = () => {};
  let waiting = false;

  // The points of the map, as they are drawn now: another model slips otherwise.
  const trackOf = () => {
    if (shown && shown.rows.track !== seen) {
      seen = shown.rows.track;
      track = seen ? plots.unpack(seen) : [];
    }
    return track;
  };

  const fillsView = (span) => zoom !== null && span.t_start <= zoom[0] && span.t_end >= zoom[1];

  // The rows of what is marked, for `slipPlots`.
  const own = (name) => {
    if (name === "shown_span" && zoom) return [{ t_start: zoom[0], t_end: zoom[1] }];
    if (name === "marked_spans") return spans.filter((span) => !fillsView(span)).map((span) => ({ ...span }));
    if (name === "marked_points") return points.map((point) => ({ ...point }));
    return null;
  };

  const tell = () => {
    parts.zoomIn.hidden = parts.clear.hidden = !spans.length;
    parts.zoomOut.hidden = zoom === null;
    parts.bar.hidden = !spans.length && !zoom;
    if (!spans.length) {
      parts.said.textContent = "Zoomed in";
      return;
    }
    const length = spans.reduce((sum, span) => sum + span.t_end - span.t_start, 0);
    const start = spans[0].t_start.toFixed(1);
    const end = spans[spans.length - 1].t_end.toFixed(1);
    const peak = points.reduce((most, point) => Math.max(most, point.modulus ?? 0), 0);
    const many = spans.length > 1 ? ` in ${spans.length} stretches` : "";
    parts.said.textContent = `Marked ${start}–${end} s: ${length.toFixed(1)} s${many}, highest slip ${peak.toFixed(2)} m/s`;
  };

  const show = () => {
    for (const { view, names } of plots?.views.values() ?? []) {
      const changed = ["marked_spans", "marked_points"].filter((name) => names.has(name));
      for (const name of changed) view.data(name, plots.rowsOf(name));
      if (changed.length) view.runAsync();
    }
    tell();
  };

  const set = (newSpans, newPoints, { told = true, ends = ["", ""] } = {}) => {
    spans = newSpans;
    points = newPoints;
    if (parts.from) parts.from.value = ends[0];
    if (parts.to) parts.to.value = ends[1];
    if (told) marked(spans);
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      show();
    });
  };

  const clear = () => set([], []);

  const markTime = (start, end) => {
    const [low, high] = start < end ? [start, end] : [end, start];
    const within = trackOf().filter((row) => row.t >= low && row.t <= high);
    set([{ t_start: low, t_end: high }], within, { ends: [low.toFixed(1), high.toFixed(1)] });
  };

  const markPoints = (inside) => {
    const found = [];
    let open = null;
    trackOf().forEach((row) => {
      if (!inside(row)) open = null;
      else if (open && open.piece === row.piece) open.span.t_end = row.t;
      else {
        open = { piece: row.piece, span: { t_start: row.t, t_end: row.t } };
        found.push(open.span);
      }
    });
    set(found, trackOf().filter(inside));
  };

  // Spans that were marked beside this one: shown here, not told again.
  const follow = (others) => {
    const inside = (row) => others.some((span) => row.t >= span.t_start && row.t <= span.t_end);
    set(others.map((span) => ({ ...span })), others.length ? trackOf().filter(inside) : [], { told: false });
  };

  const setZoom = (domain) => {
    zoom = domain;
    tell();
    feedShown();
    redraw();
  };

  const feedShown = () => {
    for (const { view, names } of plots?.views.values() ?? [])
      if (names.has("shown_span")) view.data("shown_span", plots.rowsOf("shown_span")).runAsync();
  };

  // The stretch that is drawn large moves by half of itself, within the strip that shows the whole run.
  const shiftShown = (view, side) => {
    const [shown] = plots.rowsOf("shown_span");
    const [low, high] = view.scale("x").domain();
    const length = shown.t_end - shown.t_start;
    const start = Math.min(Math.max(shown.t_start + (side * length) / 2, low), Math.max(high - length, low));
    setZoom([start, start + length]);
  };

  const startDrag = (place, event) => {
    const drawn = plots?.views.get(place.dataset.figure);
    const brush = drawn?.meta.brush;
    if (!brush || event.button !== 0 || (brush === "plane" && event.pointerType === "touch")) return;
    const { view, meta } = drawn;
    const before = zoom;
    const first = { px: event.clientX, py: event.clientY, ...plots.invert(place, view, event) };
    const firstY = brush === "plane" ? first.y() : 0;
    let box = null;
    place.setPointerCapture(event.pointerId);
    const move = (now) => {
      if (Math.abs(now.clientX - first.px) < 4 && !box && brush !== "plane") return;
      const here = plots.invert(place, view, now);
      if (brush === "time") {
        box = true;
        markTime(first.x, here.x);
        return;
      }
      if (brush === "zoom") {
        box = true;
        const [low, high] = view.scale("x").domain();
        const ends = [first.x, here.x].map((t) => Math.min(Math.max(t, low), high)).sort((a, b) => a - b);
        zoom = ends[1] > ends[0] ? ends : before;
        feedShown();
        return;
      }
      if (!box) {
        box = document.createElement("div");
        box.className = "box";
        place.append(box);
      }
      const edge = place.getBoundingClientRect();
      box.style.left = `${Math.min(first.px, now.clientX) - edge.left}px`;
      box.style.top = `${Math.min(first.py, now.clientY) - edge.top}px`;
      box.style.width = `${Math.abs(now.clientX - first.px)}px`;
      box.style.height = `${Math.abs(now.clientY - first.py)}px`;
      const within = (value, a, b) => value !== null && value >= Math.min(a, b) && value <= Math.max(a, b);
      const y = here.y();
      markPoints((row) => within(row[meta.x], first.x, here.x) && within(row[meta.y], firstY, y));
    };
    const drag = new AbortController();
    const stop = () => {
      drag.abort();
      if (box instanceof Element) box.remove();
      if (brush === "zoom") setZoom(zoom);
      else if (!box) clear();
    };
    for (const [name, act] of [["pointermove", move], ["pointerup", stop], ["pointercancel", stop]])
      place.addEventListener(name, act, { signal: drag.signal });
    if (event.pointerType !== "touch") event.preventDefault();
  };

  // Figures that are there now: their rows, how they are drawn, and how those over time are drawn again.
  const join = (page, newPlots, drawAgain, places) => {
    [plots, redraw, shown, seen, track] = [newPlots, drawAgain, page, undefined, []];
    for (const place of places) {
      const brush = page.figures[place.dataset.figure].usermeta?.brush;
      if (!brush) continue;
      place.classList.add(`brush-${brush}`);
      place.addEventListener("pointerdown", (event) => startDrag(place, event));
      if (brush !== "zoom") continue;
      place.tabIndex = 0;
      place.addEventListener("keydown", (event) => {
        const side = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        const drawn = plots.views.get(place.dataset.figure);
        if (side && drawn) shiftShown(drawn.view, side);
      });
    }
  };

  const leave = () => {
    if (spans.length) clear();
    else if (zoom) setZoom(null);
  };

  parts.clear.addEventListener("click", clear);
  parts.set?.addEventListener("click", () => {
    const start = parseFloat(parts.from.value);
    const end = parseFloat(parts.to.value);
    if (Number.isFinite(start) && Number.isFinite(end) && start !== end) markTime(start, end);
  });
  parts.zoomIn.addEventListener("click", () => {
    const last = spans[spans.length - 1];
    if (last && last.t_end > spans[0].t_start) setZoom([spans[0].t_start, last.t_end]);
  });
  parts.zoomOut.addEventListener("click", () => setZoom(null));

  // For another run.
  const reset = () => {
    zoom = null;
    set([], [], { told: false });
  };

  return { follow, join, leave, mark: markTime, own, reset, zoomOf: () => zoom };
};
