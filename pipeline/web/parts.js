// Small pieces: elements without markup in strings, requests, numbers in words.

// Units with squares as pages set them: m/s² for m/s^2.
export const setSquares = (text) => text.replace(/\b(m|rad|s)\^2/g, "$1²");

// Text goes in as text nodes only: what a log holds can never become markup.
export const h = (tag, props = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(props)) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key === "data") Object.assign(node.dataset, value);
    else if (key === "bar") node.style.setProperty("--share", value);
    else if (key in node && typeof value !== "string") node[key] = value;
    else if (value !== null && value !== undefined) node.setAttribute(key, value);
  }
  const shown = children.flat().filter((child) => child !== null && child !== undefined && child !== false);
  const isPlain = (child) => typeof child !== "string" || tag === "code";
  node.append(...shown.map((child) => (isPlain(child) ? child : setSquares(child))));
  return node;
};

export const untoast = () => (document.getElementById("toast").hidden = true);

export const toast = (text, word, action) => {
  const place = document.getElementById("toast");
  place.replaceChildren(h("span", {}, text));
  if (action)
    place.append(
      " ",
      h("button", { type: "button", class: "anyway", onclick: () => {
        place.hidden = true;
        action();
      } }, word),
    );
  place.append(" ", h("button", { type: "button", class: "drop", title: "close this notice", "aria-label": "close this notice", onclick: untoast }, "×"));
  place.hidden = false;
  clearTimeout(toast.timer);
  toast.timer = setTimeout(untoast, 10000);
};

const read = async (answer) => {
  const content = await answer.json().catch(() => ({}));
  if (answer.ok) return content;
  const { message = `the server answered ${answer.status}`, where = "", hint = "" } = content.error ?? {};
  const error = new Error(`${where ? `${where}: ` : ""}${message}.${hint ? ` ${hint}` : ""}`);
  error.code = content.error?.code;
  throw error;
};

export const get = async (path) => read(await fetch(path));

export const post = async (path, body) =>
  read(await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) }));

export const upload = (file, progress) =>
  new Promise((done, fail) => {
    const request = new XMLHttpRequest();
    request.open("POST", `/api/upload?name=${encodeURIComponent(file.name)}`);
    request.upload.onprogress = (event) => progress(event.loaded / (event.total || 1));
    request.onerror = () => fail(new Error("the server cannot be reached"));
    request.onload = () => read(new Response(request.response, { status: request.status })).then(done, fail);
    request.send(file);
  });

export const say = (value, digits = 3) => {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const places = Math.max(0, digits - 1 - Math.floor(Math.log10(Math.abs(value))));
  return value.toFixed(Math.min(places, 4)).replace("-", "−");
};

// Metres and radians as people read them: the text, and its unit.
export const inLength = (metres) => (Math.abs(metres) >= 1 ? { factor: 1, unit: "m" } : Math.abs(metres) >= 0.01 || metres === 0 ? { factor: 100, unit: "cm" } : { factor: 1000, unit: "mm" });
export const inAngle = () => ({ factor: 180 / Math.PI, unit: "°" });
// Two digits in words, as on the screen; three in the large numbers, so that one sees them move.
const sayIn = (value, { factor, unit }, gap) => (Number.isFinite(value) ? `${say(value * factor, Math.abs(value * factor) >= 1 && unit === "m" ? 3 : 2)}${gap}${unit}` : "–");
export const sayLength = (metres) => sayIn(metres, inLength(metres), "\u00a0");
export const sayAngle = (radians) => sayIn(radians, inAngle(), "");

export const sayShare = (value) => {
  const whole = Math.round(value * 100);
  return `${whole < 0 ? "−" : whole > 0 ? "+" : ""}${Math.abs(whole)}\u00a0%`;
};

export const sayDuration = (seconds) => {
  if (!Number.isFinite(seconds)) return "";
  const whole = Math.round(seconds);
  return whole < 60 ? `${whole} s` : `${Math.floor(whole / 60)} min ${String(whole % 60).padStart(2, "0")} s`;
};

// A number that runs to its new value, so that the eye follows the error as it falls.
export const runTo = (node, value, digits = 3) => {
  const from = Number(node.dataset.value);
  node.dataset.value = value;
  cancelAnimationFrame(node.frame);
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (!Number.isFinite(from) || from === value || calm || document.hidden) {
    node.textContent = say(value, digits);
    return;
  }
  const start = performance.now();
  const step = (now) => {
    const share = Math.min((now - start) / 450, 1);
    node.textContent = say(from + (value - from) * (1 - (1 - share) ** 3), digits);
    if (share < 1) node.frame = requestAnimationFrame(step);
  };
  node.frame = requestAnimationFrame(step);
};
