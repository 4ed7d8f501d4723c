"use strict";
// Draws the figures and links them: a stretch of time marked in one is shown in all.
(() => {
  const page = JSON.parse(document.getElementById("page-data").textContent);
  let spans = [];
  let points = [];
  let zoom = null;

  const fillsView = (span) => zoom !== null && span.t_start <= zoom[0] && span.t_end >= zoom[1];

  const ownRows = (name) => {
    if (name === "marked_spans") return spans.filter((span) => !fillsView(span)).map((span) => ({ ...span }));
    if (name === "marked_points") return points.map((point) => ({ ...point }));
    return null;
  };

  const { dark, draw, rowsOf, unpack, views } = slipPlots(page, { own: ownRows, zoomOf: () => zoom });

  const drawAll = async (selector = ".plot[data-figure]") => {
    for (const place of document.querySelectorAll(selector)) await draw(place);
    document.documentElement.dataset.drawn = "yes";
  };

  // Marking -----------------------------------------------------------------------------------------------

  const track = page.rows.track ? unpack(page.rows.track) : [];
  const bar = document.getElementById("marked");
  const from = document.getElementById("mark-from");
  const to = document.getElementById("mark-to");

  const tell = () => {
    document.getElementById("zoom-in").hidden = document.getElementById("mark-clear").hidden = !spans.length;
    bar.hidden = !spans.length && !zoom;
    if (!spans.length) {
      bar.firstElementChild.textContent = "Zoomed in";
      return;
    }
    const length = spans.reduce((sum, span) => sum + span.t_end - span.t_start, 0);
    const start = spans[0].t_start.toFixed(1);
    const end = spans[spans.length - 1].t_end.toFixed(1);
    const peak = points.reduce((most, point) => Math.max(most, point.modulus ?? 0), 0);
    const many = spans.length > 1 ? ` in ${spans.length} stretches` : "";
    bar.firstElementChild.textContent =
      `Marked ${start}–${end} s: ${length.toFixed(1)} s${many}, highest slip ${peak.toFixed(2)} m/s`;
  };

  const show = () => {
    for (const { view, names } of views.values()) {
      let changed = false;
      for (const name of ["marked_spans", "marked_points"])
        if (names.has(name)) {
          view.data(name, rowsOf(name));
          changed = true;
        }
      if (changed) view.runAsync();
    }
    tell();
  };

  let waiting = false;
  const showSoon = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      show();
    });
  };

  const markTime = (start, end) => {
    const [low, high] = start < end ? [start, end] : [end, start];
    spans = [{ t_start: low, t_end: high }];
    points = track.filter((row) => row.t >= low && row.t <= high);
    if (from) from.value = low.toFixed(1);
    if (to) to.value = high.toFixed(1);
    showSoon();
  };

  const markPoints = (inside) => {
    points = track.filter(inside);
    spans = [];
    if (from) from.value = "";
    if (to) to.value = "";
    let open = null;
    track.forEach((row) => {
      if (!inside(row)) open = null;
      else if (open && open.piece === row.piece) open.span.t_end = row.t;
      else {
        open = { piece: row.piece, span: { t_start: row.t, t_end: row.t } };
        spans.push(open.span);
      }
    });
    showSoon();
  };

  const clear = () => {
    spans = [];
    points = [];
    if (from) from.value = "";
    if (to) to.value = "";
    showSoon();
  };

  const findPanel = (view) => {
    const [left, top] = view.origin();
    for (const mark of view.scenegraph().root.items[0].items)
      if (mark.name === "concat_0_group") return { left: left + mark.items[0].x, top, prefix: "concat_0_" };
    return { left, top, prefix: "" };
  };

  const locate = (place, view, event) => {
    const svg = place.querySelector("svg");
    const box = svg.getBoundingClientRect();
    const ratio = box.width / svg.width.baseVal.value;
    const panel = findPanel(view);
    const at = (axis, pixel) => view.scale(panel.prefix + axis).invert(pixel);
    return {
      x: at("x", (event.clientX - box.left) / ratio - panel.left),
      y: () => at("y", (event.clientY - box.top) / ratio - panel.top),
    };
  };

  const startDrag = (place, event) => {
    const drawn = views.get(place.dataset.figure);
    const brush = drawn?.meta.brush;
    if (!brush || event.button !== 0 || (brush === "plane" && event.pointerType === "touch")) return;
    const { view, meta } = drawn;
    const first = { px: event.clientX, py: event.clientY, ...locate(place, view, event) };
    const firstY = brush === "plane" ? first.y() : 0;
    let box = null;
    place.setPointerCapture(event.pointerId);
    const move = (now) => {
      if (Math.abs(now.clientX - first.px) < 4 && !box && brush === "time") return;
      const here = locate(place, view, now);
      if (brush === "time") {
        box = true;
        markTime(first.x, here.x);
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
    const stop = () => {
      place.removeEventListener("pointermove", move);
      if (box instanceof Element) box.remove();
      if (!box) clear();
    };
    place.addEventListener("pointermove", move);
    place.addEventListener("pointerup", stop, { once: true });
    place.addEventListener("pointercancel", stop, { once: true });
    if (event.pointerType !== "touch") event.preventDefault();
  };

  for (const place of document.querySelectorAll(".plot[data-figure]")) {
    const brush = page.figures[place.dataset.figure].usermeta?.brush;
    if (!brush) continue;
    place.classList.add(`brush-${brush}`);
    place.addEventListener("pointerdown", (event) => startDrag(place, event));
  }
  document.getElementById("mark-clear").addEventListener("click", clear);
  document.getElementById("mark-set")?.addEventListener("click", () => {
    const start = parseFloat(from.value);
    const end = parseFloat(to.value);
    if (Number.isFinite(start) && Number.isFinite(end) && start !== end) markTime(start, end);
  });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    if (spans.length) clear();
    else if (zoom) setZoom(null);
  });

  // Drawing again when room or colours change -----------------------------------------------------------------

  let queue = drawAll();
  let timer = 0;
  let lastWidth = document.documentElement.clientWidth;
  const again = () => {
    clearTimeout(timer);
    timer = setTimeout(() => {
      queue = queue.then(() => drawAll());
    }, 150);
  };
  const setZoom = (domain) => {
    zoom = domain;
    document.getElementById("zoom-out").hidden = zoom === null;
    tell();
    queue = queue.then(() => drawAll(".plot.brush-time"));
  };
  document.getElementById("zoom-in").addEventListener("click", () => {
    const last = spans[spans.length - 1];
    if (last && last.t_end > spans[0].t_start) setZoom([spans[0].t_start, last.t_end]);
  });
  document.getElementById("zoom-out").addEventListener("click", () => setZoom(null));
  addEventListener("resize", () => {
    if (document.documentElement.clientWidth === lastWidth) return;
    lastWidth = document.documentElement.clientWidth;
    again();
  });
  dark.addEventListener("change", again);
})();
