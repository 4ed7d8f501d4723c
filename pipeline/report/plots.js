"use strict";
// Draws figures out of specifications and shared rows, fitted to the room there is; the report and the workbench
// use it. `page` holds figures, rows and dark twins of colours; `own(name)` gives rows that are not among them.
const slipPlots = (page, { own = () => null, zoomOf = () => null, drawn = () => {}, strict = false } = {}) => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const RIGHT = 16;
  const NARROW = 480;
  const views = new Map();

  const unpack = (columns) => {
    const names = Object.keys(columns);
    const read = names.map((name) => {
      const column = columns[name];
      return Array.isArray(column) ? column : column.codes.map((code) => column.levels[code]);
    });
    const count = names.length ? read[0].length : 0;
    const rows = new Array(count);
    for (let i = 0; i < count; i += 1) {
      const row = {};
      for (let k = 0; k < names.length; k += 1) row[names[k]] = read[k][i];
      rows[i] = row;
    }
    return rows;
  };

  const swap = (value, twins) => {
    if (typeof value === "string") return twins[value] ?? value;
    if (Array.isArray(value)) return value.map((entry) => swap(entry, twins));
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([key, entry]) => [key, swap(entry, twins)]));
  };

  const widen = ([low, high], span) => [(low + high - span) / 2, (low + high + span) / 2];

  const setDomains = (spec, domains) => {
    for (const layer of spec.layer ?? [])
      for (const axis of ["x", "y"]) {
        const scale = layer.encoding?.[axis]?.scale;
        if (scale?.domain && domains[axis]) scale.domain = domains[axis];
      }
  };

  const fit = (spec, width) => {
    const equal = spec.usermeta?.equal;
    if (equal) {
      const wide = equal.x[1] - equal.x[0];
      const tall = equal.y[1] - equal.y[0];
      const height = Math.min(Math.max((width * tall) / wide, equal.lowest), equal.highest);
      const scale = Math.max(wide / width, tall / height);
      spec.height = Math.round(height);
      setDomains(spec, { x: widen(equal.x, scale * width), y: widen(equal.y, scale * height) });
    }
    for (const part of spec.vconcat ?? [spec]) {
      part.width = Math.floor(width);
      const zoom = spec.usermeta?.brush === "time" ? zoomOf(spec.usermeta) : null;
      if (zoom) setDomains(part, { x: zoom });
    }
  };

  const NAME = 130;
  const narrowLegends = (value, columns) => {
    if (value === null || typeof value !== "object") return;
    if (value.legend?.columns > columns) value.legend.columns = columns;
    Object.values(value).forEach((part) => narrowLegends(part, columns));
  };

  // Long names beside rows, and legends of many columns, leave little of a narrow screen to the rows themselves.
  const squeeze = (spec, room) => {
    narrowLegends(spec, Math.max(1, Math.floor(room / NAME)));
    for (const part of [spec, ...(spec.layer ?? [])]) {
      const axis = part.encoding?.y?.axis;
      if (!axis) continue;
      if (axis.minExtent > 60) axis.minExtent = 60;
      if (axis.labelLimit > 135) axis.labelLimit = 135;
    }
  };

  const namesIn = (value, found) => {
    if (Array.isArray(value)) value.forEach((entry) => namesIn(entry, found));
    else if (value && typeof value === "object") {
      if (value.data && typeof value.data.name === "string") found.add(value.data.name);
      Object.values(value).forEach((entry) => namesIn(entry, found));
    }
    return found;
  };

  const rowsOf = (name) => own(name) ?? unpack(page.rows[name]);

  const embed = async (place, width) => {
    const id = place.dataset.figure;
    const spec = swap(page.figures[id], dark.matches ? page.dark : {});
    fit(spec, width);
    if (place.clientWidth < NARROW) {
      spec.config.legend.columns = 1;
      squeeze(spec, place.clientWidth);
    }
    spec.description = place.ariaLabel;
    spec.padding = { left: 2, right: RIGHT - 4, top: 4, bottom: 4 };
    const names = namesIn(spec, new Set());
    spec.datasets = Object.fromEntries([...names].map((name) => [name, rowsOf(name)]));
    views.get(id)?.finalize();
    const result = await vegaEmbed(place, spec, {
      actions: false,
      ast: true,
      mode: "vega-lite",
      renderer: "svg",
      tooltip: { theme: dark.matches ? "dark" : "light", disableDefaultStyle: strict },
      defaultStyle: !strict,
    });
    // Vega calls every figure a visualization: the place keeps the label that says what is drawn.
    place.setAttribute("role", "img");
    place.removeAttribute("aria-roledescription");
    place.querySelector("svg")?.setAttribute("aria-hidden", "true");
    views.set(id, { place, view: result.view, names, meta: spec.usermeta ?? {}, finalize: () => result.finalize() });
    return result.view;
  };

  const forget = (id) => {
    views.get(id)?.finalize();
    views.delete(id);
  };

  const draw = async (place) => {
    const room = place.clientWidth;
    let width = room - (page.figures[place.dataset.figure].usermeta?.gutter ?? 50) - RIGHT;
    await embed(place, width);
    const excess = place.querySelector("svg").width.baseVal.value - room;
    if (excess > 1 || excess < -30) {
      width -= excess;
      await embed(place, width);
    }
    place.classList.add("drawn");
    drawn();
  };

  // Where the panels of a figure lie within its picture, and how their scales are called.
  const findPanels = (view) => {
    const [left, top] = view.origin();
    const groups = view.scenegraph().root.items[0].items.filter((mark) => /^concat_\d+_group$/.test(mark.name));
    if (!groups.length) return { left, top, bottom: top + view.height(), prefix: "" };
    const [first, last] = [groups[0].items[0], groups[groups.length - 1].items[0]];
    return { left: left + first.x, top, bottom: top + last.y + last.height, prefix: "concat_0_" };
  };

  const invert = (place, view, event) => {
    const svg = place.querySelector("svg");
    const box = svg.getBoundingClientRect();
    const ratio = box.width / svg.width.baseVal.value;
    const panels = findPanels(view);
    const at = (axis, pixel) => view.scale(panels.prefix + axis).invert(pixel);
    return {
      x: at("x", (event.clientX - box.left) / ratio - panels.left),
      y: () => at("y", (event.clientY - box.top) / ratio - panels.top),
    };
  };

  // Puts new rows into what is drawn, into what is in sight first; axes whose ends are fixed stay where they are.
  // What comes while the rest is drawn takes its place.
  let fed = 0;
  const feed = async (rows) => {
    Object.assign(page.rows, rows);
    const turn = (fed += 1);
    const away = ({ place }) => {
      const { top, bottom } = place.getBoundingClientRect();
      return Math.max(top - innerHeight, -bottom, 0);
    };
    const order = [...views.values()].map((drawn) => [away(drawn), drawn]).sort(([one], [other]) => one - other);
    for (const [far, { view, names }] of order) {
      const changed = Object.keys(rows).filter((name) => names.has(name));
      if (!changed.length) continue;
      if (far) await new Promise((done) => setTimeout(done));
      if (turn !== fed) return;
      for (const name of changed) view.data(name, unpack(page.rows[name]));
      await view.runAsync();
    }
  };

  const metaOf = (id) => page.figures[id].usermeta ?? {};

  return { dark, draw, feed, findPanels, forget, invert, metaOf, rowsOf, unpack, views };
};
