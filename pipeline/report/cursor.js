"use strict";
// One moment in every figure of a run: a line in those over time, dots on paths and on the map. It follows the pointer,
// the slider and playback; the report and the workbench use it. `bar` gets the controls, `moved(t)` what the reader does.
const slipCursor = (bar, { moved = () => {} } = {}) => {
  const FASTER = 5;
  const NEAR_PX = 40;
  const STEP_S = 0.05;
  const NAMES = { velocity: "measured", command: "ideal", measured: "ideal", model: "model" };
  const ROWS = [["forward", "x", "m/s", 2], ["yaw rate", "w", "°/s", 0]];

  const make = (tag, properties, ...children) => {
    const node = Object.assign(document.createElement(tag), properties);
    node.append(...children);
    return node;
  };
  const play = make("button", { type: "button", className: "play" }, "Play");
  const slider = make("input", { type: "range", step: STEP_S, className: "moment-slider", ariaLabel: "moment that all figures show [s]" });
  const speed = make("select", { ariaLabel: "speed of playback" }, ...[1, FASTER].map((times) => make("option", { value: times, selected: times === FASTER }, `${times}×`)));
  const told = make("output", { className: "moment-said", ariaLive: "off" });
  bar.append(play, slider, speed, told);

  let now = null;
  let span = [0, 0];
  let plots = null;
  let rows = new Map();
  let frame = 0;

  const rowsOf = (name) => {
    if (!rows.has(name)) {
      let there = [];
      try {
        there = plots.rowsOf(name).filter((row) => Number.isFinite(row.t));
      } catch {
        // A figure that was not drawn has no rows.
      }
      rows.set(name, there);
    }
    return rows.get(name);
  };

  // The row nearest to a moment, unless the line is broken there.
  const find = (name, t, series = null) => {
    let best = null;
    for (const row of rowsOf(name)) {
      if ((series !== null && row.series !== series) || row.value === null || row.x === null) continue;
      if (best === null || Math.abs(row.t - t) < Math.abs(best.t - t)) best = row;
    }
    return best !== null && Math.abs(best.t - t) < 0.5 ? best : null;
  };

  // Where a view's panels lie within its place, and how its scales are called.
  const locate = ({ place, view }) => {
    const svg = place.querySelector("svg");
    if (!svg || !place.clientWidth) return null;
    const [box, edge] = [svg.getBoundingClientRect(), place.getBoundingClientRect()];
    const ratio = box.width / svg.width.baseVal.value;
    const { left, top, bottom, prefix } = plots.findPanels(view);
    const at = (axis, value) => view.scale(prefix + axis)(value);
    return {
      x: (value) => box.left - edge.left + ratio * (left + at("x", value)),
      y: (value) => box.top - edge.top + ratio * (top + at("y", value)),
      holds: (axis, value) => {
        const ends = view.scale(prefix + axis).domain();
        return value >= Math.min(...ends) && value <= Math.max(...ends);
      },
      top: box.top - edge.top + ratio * top,
      height: ratio * (bottom - top),
    };
  };

  const put = (place, kind, shown) => {
    let node = place.querySelector(`:scope > .${kind}`);
    if (!shown) {
      node?.remove();
      return;
    }
    if (!node) place.append((node = make("i", { className: `cursor-mark ${kind}` })));
    Object.assign(node.style, shown);
  };

  const mark = (drawn) => {
    const at = locate(drawn);
    if (!at) return;
    const { brush, dots = {} } = drawn.meta;
    if (brush === "time" || brush === "zoom") {
      const inside = now !== null && at.holds("x", now);
      put(drawn.place, "at-time", inside && { left: `${at.x(now)}px`, top: `${at.top}px`, height: `${at.height}px` });
    }
    for (const [name, kind] of Object.entries(dots)) {
      const row = now === null ? null : find(name, now);
      put(drawn.place, `at-${kind}`, row && at.holds("x", row.x) && at.holds("y", row.y) && { left: `${at.x(row.x)}px`, top: `${at.y(row.y)}px` });
    }
  };

  const tell = () => {
    if (now === null) {
      slider.ariaValueText = `${Number(slider.value).toFixed(1)} s`;
      told.textContent = "Point at a figure, or play: all of them show one moment.";
      return;
    }
    const parts = ROWS.map(([words, name, unit, digits]) => {
      const values = [...new Set(rowsOf(`stretch_v_${name}`).map((row) => row.series))].map((series) => [NAMES[series], find(`stretch_v_${name}`, now, series)]);
      values.push(["model", find(`stretch_model_${name}`, now)]);
      const said = values.filter(([, row]) => row).map(([who, row]) => `${who} ${row.value.toFixed(digits)}`);
      return said.length ? `${words} [${unit}] ${said.join(", ").replaceAll("-", "−")}` : "";
    });
    const [here, there] = ["stretch_way", "stretch_arcs"].map((name) => find(name, now));
    if (here && there) parts.push(`model ${(100 * Math.hypot(here.x - there.x, here.y - there.y)).toFixed(0)} cm off`);
    told.textContent = [`${now.toFixed(1)} s`, ...parts.filter(Boolean)].join(" · ");
    slider.ariaValueText = told.textContent;
  };

  const refresh = () => {
    for (const drawn of plots?.views.values() ?? []) mark(drawn);
    tell();
  };

  const show = (t, { told: isTold = true } = {}) => {
    now = t;
    slider.value = t ?? span[0];
    if (isTold) moved(t);
    if (frame) return;
    frame = requestAnimationFrame(() => {
      frame = 0;
      refresh();
    });
  };

  // Playback ---------------------------------------------------------------------------------------------------

  let playing = 0;
  const stop = () => {
    cancelAnimationFrame(playing);
    playing = 0;
    play.textContent = "Play";
  };
  const start = () => {
    let last = performance.now();
    let t = now === null || now >= span[1] - STEP_S || now < span[0] ? span[0] : now;
    const step = (time) => {
      t += (Number(speed.value) * (time - last)) / 1000;
      last = time;
      show(Math.min(t, span[1]));
      if (t >= span[1]) stop();
      else playing = requestAnimationFrame(step);
    };
    play.textContent = "Pause";
    playing = requestAnimationFrame(step);
  };
  play.addEventListener("click", () => (playing ? stop() : start()));
  slider.addEventListener("input", () => {
    stop();
    show(Number(slider.value));
  });

  // The pointer ------------------------------------------------------------------------------------------------

  const follow = (place, event) => {
    const drawn = plots?.views.get(place.dataset.figure);
    const at = drawn && !playing && !event.buttons && event.pointerType !== "touch" ? locate(drawn) : null;
    if (!at) return;
    const edge = place.getBoundingClientRect();
    const [x, y] = [event.clientX - edge.left, event.clientY - edge.top];
    if (drawn.meta.brush === "time" || drawn.meta.brush === "zoom") {
      const t = plots.invert(place, drawn.view, event).x;
      if (at.holds("x", t)) show(t);
      return;
    }
    const [name] = Object.keys(drawn.meta.dots);
    let nearest = null;
    for (const row of rowsOf(name)) {
      if (row.x === null) continue;
      const far = Math.hypot(at.x(row.x) - x, at.y(row.y) - y);
      if (far < (nearest?.far ?? NEAR_PX)) nearest = { far, t: row.t };
    }
    if (nearest) show(nearest.t);
  };

  // Figures that are there now; rows may have changed.
  const join = (newPlots, places) => {
    plots = newPlots;
    rows = new Map();
    for (const place of places) {
      const { brush, dots } = plots.metaOf(place.dataset.figure);
      if (brush === "time" || brush === "zoom" || dots) place.addEventListener("pointermove", (event) => follow(place, event));
    }
    refresh();
  };

  // The stretch that the slider and playback go through.
  const setSpan = (from, to) => {
    stop();
    span = [from, to];
    [slider.min, slider.max] = span;
    show(null);
  };

  const renew = () => {
    rows = new Map();
    refresh();
  };

  return { join, refresh, renew, setSpan, show, stop };
};
