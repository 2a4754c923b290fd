// What all parts of the page share: the document, colours, numbers, the stretch of time in view.
"use strict";
const doc = JSON.parse(document.getElementById("data").textContent);
const two = doc.runs.length > 1;
const timed = !doc.drives; // a page of many drives has no axis of time

function element(tag, className, text) {
  const e = document.createElement(tag);
  if (className) e.className = className;
  if (text !== undefined) e.textContent = text; // never as markup: names come from files
  return e;
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
}

// Little-endian float32 in base64, as numbers.
function floats(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  const values = new Array(bytes.length / 4);
  for (let k = 0; k < values.length; k++) values[k] = view.getFloat32(4 * k, true);
  return values;
}

function figure(v) {
  if (v === null || v === undefined || Number.isNaN(v)) return "–";
  const size = Math.abs(v);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return v.toExponential(2);
  return v.toFixed(size < 1 ? 4 : size < 100 ? 3 : 1);
}

function clock(t) {
  if (view.full[1] - view.full[0] < 600) return figureOfTime(t) + " s";
  const s = Math.floor(t), pad = (n) => String(n).padStart(2, "0");
  const fraction = view.to - view.from < 20 ? (t - s).toFixed(2).slice(1) : "";
  return Math.floor(s / 3600) + ":" + pad(Math.floor((s % 3600) / 60)) + ":" + pad(s % 60) + fraction;
}

function figureOfTime(t) {
  const span = view.to - view.from;
  return t.toFixed(span < 2 ? 3 : span < 20 ? 2 : span < 100 ? 1 : 0);
}

// The stretch of time that all plots show; whoever shows it listens.
const view = {
  full: [doc.span[0], doc.span[1] > doc.span[0] ? doc.span[1] : doc.span[0] + 1],
  from: doc.span[0],
  to: 0,
  cursor: null,
  listeners: [],
  show(from, to, by) {
    if (!(to > from)) return;
    if (Math.abs(from - this.from) + Math.abs(to - this.to) < 1e-9 * (to - from)) return;
    this.from = from;
    this.to = to;
    for (const listener of this.listeners) listener(by);
  },
  all() { this.show(this.full[0], this.full[1], null); },
};
view.to = view.full[1];

const hover = document.getElementById("hover");
const HINT = "Drag across a plot to zoom all of them, double-click for all of the time.";
hover.textContent = HINT;

// Says what is at an instant: time, mode, and the event that is nearest, if it is near.
function tell(run, t, near) {
  view.cursor = t;
  if (t === null) {
    hover.textContent = HINT;
    return;
  }
  let mode = "", event = null;
  for (const [from, to, name] of run.modes) if (t >= from && t <= to) mode = name;
  for (const e of run.events) {
    const off = Math.abs(e[0] - t);
    if (off <= near && (event === null || off < Math.abs(event[0] - t))) event = e;
  }
  const what = event ? `   ${event[1]}: ${event[2]}: ${event[3]}: ${event[4]}` : "";
  hover.textContent = `${clock(t)}   ${mode}${what}`;
}
