// Short messages of the RDSS terminal, each where it is now, and the other vehicles by their reports.
import { byId, fillRows, fixed, known, sigma, stretch, utc } from "./text.js";

const messages = byId("messages").createTBody(),
  fleet = byId("fleet").createTBody();
const MOST = 40;
const WRONG = new Set(["failed", "expired", "unconfirmed", "too_long", "forbidden", "no_permission"]);

// The last word on each: those of ours by their id, those that came by their serial.
function latest(rows) {
  const found = new Map();
  for (const [, m] of rows) {
    const key = m.direction === "sent" ? `${m.source} ${m.id}` : `${m.source} < ${m.serial}`;
    found.delete(key);
    found.set(key, m);
  }
  return [...found.values()].filter((m) => m.state !== "superseded").slice(-MOST).reverse();
}

function line(m) {
  const sent = m.direction === "sent";
  const cells = [
    utc(m.t_ms),
    sent ? `to ${m.card}` : `from ${m.card}`,
    { text: m.text ?? (m.kind === "text" ? m.hex : m.kind), title: m.hex },
    {
      text: sent ? m.state.replaceAll("_", " ") : m.fault || (m.repeated ? "repeated" : ""),
      title: m.why,
    },
  ];
  if (m.fault || WRONG.has(m.state)) cells.rowClass = "level-warning";
  return cells;
}

function vehicle(other) {
  const speed = known(other.speed_m_s) ? `${fixed(other.speed_m_s * 3.6, 0)} km/h` : "";
  return [
    String(other.card),
    `${fixed(other.lat_deg, 5)}, ${fixed(other.lon_deg, 5)}`,
    `\u00b1 ${sigma(other.sd_n_m)} m`,
    [other.mode || "by the centre", speed].filter(Boolean).join(", "),
    other.age === null ? "from before" : stretch(other.age),
  ];
}

export function showMessages(store) {
  const others = store.fleet.sort((a, b) => a.card - b.card);
  fillRows(fleet, others.map(vehicle));
  const lines = latest(store.rows.message).map(line);
  fillRows(
    messages,
    lines.length
      ? lines
      : [[{ text: "No messages.", className: "none", span: 4 }]],
  );
}
