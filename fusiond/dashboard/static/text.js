// Elements, figures and times as text. What comes from a vehicle is only ever shown as text.

export function element(tag, className = "", text) {
  const e = document.createElement(tag);
  if (className) e.className = className;
  if (text !== undefined) e.textContent = text;
  return e;
}

export const byId = (id) => document.getElementById(id);

// Writes only what has changed: a browser lays out again for each write.
export function put(e, text) {
  if (e.textContent !== text) e.textContent = text;
}

export function mark(e, name, on) {
  if (e.classList.contains(name) !== on) e.classList.toggle(name, on);
}

// Asked hundreds of times a drawing, and the same until the theme changes.
const colours = new Map();
export function colour(name) {
  if (!colours.has(name))
    colours.set(
      name,
      getComputedStyle(document.documentElement)
        .getPropertyValue("--" + name)
        .trim(),
    );
  return colours.get(name);
}
let times = 0;
export function forgetColours() {
  colours.clear();
  times++;
}
// How often that was: what was drawn before has other colours.
export const forgotten = () => times;

export const known = (v) => typeof v === "number" && Number.isFinite(v);

export const hypot = (a, b) => (known(a) && known(b) ? Math.hypot(a, b) : null);

// Without a sign before nothing: -0.0 says that it has one.
export const fixed = (v, digits) =>
  known(v) ? v.toFixed(digits).replace(/^-(0\.?0*)$/, "$1") : "–";

// With the decimals that a sigma deserves: two figures of it.
export function sigma(v) {
  if (!known(v)) return "–";
  return v.toFixed(v < 0.0995 ? 3 : v < 9.95 ? 2 : v < 99.5 ? 1 : 0);
}

export function whole(v) {
  return known(v) ? Math.round(v).toLocaleString("en").replaceAll(",", "\u2009") : "–";
}

// A stretch of time: 0.3 s, 12 s, 3 min 20 s, 2 h 5 min, 4 d.
export function stretch(s) {
  if (!known(s)) return "–";
  if (s < 9.95) return s.toFixed(1) + " s";
  const t = Math.round(s);
  if (t < 120) return t + " s";
  if (t < 7200) return `${Math.floor(t / 60)} min ${t % 60} s`;
  if (t < 172800) return `${Math.floor(t / 3600)} h ${Math.floor((t % 3600) / 60)} min`;
  return Math.floor(t / 86400) + " d";
}

export const short = (s) =>
  !known(s) ? "–" : Math.abs(s) < 1 ? (s * 1000).toFixed(0) + " ms" : s.toFixed(1) + " s";

export function utc(ms, withDate = false) {
  if (!known(ms)) return "--:--:--";
  const iso = new Date(ms).toISOString();
  return withDate ? iso.slice(0, 19).replace("T", " ") : iso.slice(11, 19);
}

// A table's body in place: rows of cells, each text or {text, className, title}.
export function fillRows(body, rows) {
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach((cells, k) => {
    const row = body.rows[k] || body.insertRow();
    const name = cells.rowClass || "";
    if (row.className !== name) row.className = name;
    while (row.cells.length > cells.length) row.deleteCell(-1);
    cells.forEach((given, c) => {
      const cell = row.cells[c] || row.insertCell();
      const {
        text,
        className = "",
        title = "",
        span = 1,
      } = typeof given === "object" ? given : { text: given };
      put(cell, String(text));
      if (cell.className !== className) cell.className = className;
      if (cell.title !== title) cell.title = title;
      if (cell.colSpan !== span) cell.colSpan = span;
    });
  });
}

// A canvas with its context in CSS pixels, cleared; null while it has no size.
export function prepared(canvas) {
  const ratio = devicePixelRatio || 1,
    width = canvas.clientWidth,
    height = canvas.clientHeight;
  if (!width || !height) return null;
  const w = Math.round(width * ratio),
    h = Math.round(height * ratio);
  if (canvas.width !== w) canvas.width = w;
  if (canvas.height !== h) canvas.height = h;
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  ctx.font = `12px ${getComputedStyle(document.body).fontFamily}`;
  return { ctx, width, height };
}
