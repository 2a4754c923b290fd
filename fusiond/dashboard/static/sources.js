// Each source: what it is doing, how often it comes, what became of it, how old and how late it is.
import { agedFurther, sourceLimit } from "./age.js";
import { byId, element, fillRows, known, short, stretch, whole } from "./text.js";

const table = byId("sources"),
  body = table.createTBody();
const head = table.createTHead().insertRow();
const HEAD = [
  ["source", ""],
  ["state", ""],
  ["age", "n"],
  ["latency", "n wide-only"],
  ["rate", "n wide-only"],
  ["received", "n wide-only"],
  ["used", "n"],
  ["refused", "n"],
];
for (const [text, name] of HEAD) head.append(element("th", name, text));

// What is no device says so in its `detail`.
export const derived = (source) => (source.detail || "").startsWith("made by the filter");

const rates = new Map(); // source: [received, t of the hub, Hz]

// From two messages of `health`; of what is slower than they are, from several.
function rate(name, source, at) {
  const [count, t, hz] = rates.get(name) || [null, 0, null];
  if (count === null || source.received < count || at < t) {
    rates.set(name, [source.received, at, null]);
    return null;
  }
  const since = at - t;
  if (since < 1.9) return hz;
  if (source.received - count < 2 && since < 60) return hz;
  const now = (source.received - count) / since;
  rates.set(name, [source.received, at, now]);
  return now;
}

// How many were refused, and the commonest reasons.
function refusals(rejected) {
  const all = Object.entries(rejected || {}).sort((a, b) => b[1] - a[1]);
  const words = ([reason, count]) => `${reason.replaceAll("_", " ")} ${whole(count)}`;
  return {
    count: all.reduce((sum, [, count]) => sum + count, 0),
    why: all.slice(0, 2).map(words).join(", ") + (all.length > 2 ? ", \u2026" : ""),
    title: all.map(words).join("\n"),
  };
}

const frequency = (hz) =>
  !known(hz)
    ? "–"
    : hz >= 10
      ? `${hz.toFixed(0)} Hz`
      : hz >= 0.95
        ? `${hz.toFixed(1)} Hz`
        : hz > 0
          ? `1 in ${(1 / hz).toFixed(0)} s`
          : "0";

export function showSources(store) {
  const health = store.said("health");
  if (!health) return;
  const latest = store.latest.health,
    uptime = (store.said("status") || {}).uptime_s;
  const rows = [];
  const sources = Object.entries(health.sources).sort((a, b) => derived(a[1]) - derived(b[1]));
  for (const [name, s] of sources) {
    const inside = derived(s);
    const hz = latest.at === null ? null : rate(name, s, latest.at);
    const seen = agedFurther(inside ? s.fused_age_s : s.age_s, latest, store.now);
    const old = seen !== null && !inside && seen > sourceLimit(s.received, uptime);
    const service = s.service && s.service !== "nominal" && s.state === "running" ? s.service : "";
    const state = service === "out" ? "left out" : service || (inside ? "derived" : s.state);
    const wrong = (s.diagnosis && s.diagnosis.text) || s.isolated || "";
    const refused = refusals(s.rejected);
    // A device that is not there says so; what was refused before is in the tooltip.
    const trouble = inside || s.state === "running" ? wrong : s.detail || wrong;
    const count = refused.count,
      why = trouble || refused.why,
      title = [wrong, refused.title].filter(Boolean).join("\n");
    const used = agedFurther(s.fused_age_s, latest, store.now);
    const row = [
      { text: name, title: s.detail, className: inside ? "quiet" : "" },
      {
        text: state,
        className: `state ${service || (inside ? "inside quiet" : s.state)}`,
        title: wrong || s.detail,
      },
      {
        text: stretch(seen),
        className: "n",
        title: used === null ? "" : `used ${stretch(used)} ago`,
      },
      { text: short(s.latency_s), className: "n wide-only" },
      { text: inside ? "" : frequency(hz), className: "n wide-only" },
      { text: whole(s.received), className: "n wide-only" },
      { text: whole(s.fused), className: "n" },
      { text: count ? whole(count) : "\u2013", className: "n", title },
    ];
    row.rowClass = [old ? "old" : "", why ? "explained" : ""].filter(Boolean).join(" ");
    rows.push(row);
    if (!why) continue;
    // In a row of its own: a column of it would be cut on all but the widest screens.
    const reason = [{ text: why, title, span: HEAD.length, className: trouble ? "warn" : "quiet" }];
    reason.rowClass = old ? "reason-row old" : "reason-row";
    rows.push(reason);
  }
  fillRows(body, rows);
}
