// The RDSS terminal: where in its cycle it is, when it may ask again, how late its fixes are.
import { byId, colour, element, fillRows, known, prepared, put, stretch, whole } from "./text.js";

const holder = byId("rdss");
const detail = element("div", "big"),
  table = element("table", "pairs"),
  canvas = element("canvas");
const body = table.createTBody();
const NONE = "No RDSS terminal configured or seen.";
const BIN_S = 0.25;
const NAMES = [
  ["requested", "asked"],
  ["fixes", "fixes"],
  ["late_fix", "after giving up, still used"],
  ["timeout_feedback", "no feedback"],
  ["timeout_fix", "no fix in time"],
  ["refused_frequency", "refused: too soon"],
  ["no_beam", "no beam"],
  ["suppressed", "suppressed"],
  ["silence", "radio silence"],
  ["no_card", "no card"],
  ["multi_value", "two solutions"],
  ["foreign_fix", "of another card"],
  ["unsolicited", "not asked for"],
];
const MESSAGES = [
  ["messages_written", "written"],
  ["messages_sent", "sent"],
  ["messages_received", "received"],
  ["messages_refused", "refused"],
  ["timeout_message", "without feedback"],
  ["timeout_receipt", "without receipt"],
  ["message_delivered", "delivered"],
  ["message_unconfirmed", "unconfirmed"],
  ["message_failed", "failed"],
  ["message_expired", "expired"],
];

// The power of each beam, and which of them serve.
function beams(said) {
  const levels = said.levels.map((n, k) => (k + 1 === said.serving ? `[${n}]` : n)).join(" ");
  if (!known(said.serving)) return `${levels}: none is received`;
  const second = known(said.time_difference) ? `, with ${said.time_difference}` : "";
  return `${levels}: beam ${said.serving} serves${second}`;
}

const listed = (names, counters) =>
  names
    .filter(([key]) => counters[key])
    .map(([key, word]) => `${whole(counters[key])} ${word}`)
    .join(", ");

function histogram(delays) {
  const surface = prepared(canvas);
  if (!surface) return;
  const { ctx, width, height } = surface,
    base = height - 18;
  const bins = Math.max(12, Math.ceil((Math.max(...delays, 0) + BIN_S) / BIN_S)),
    step = (width - 8) / bins;
  const counts = new Array(bins).fill(0);
  for (const d of delays) if (d >= 0) counts[Math.min(bins - 1, Math.floor(d / BIN_S))]++;
  const most = Math.max(1, ...counts);
  ctx.fillStyle = colour("s0");
  counts.forEach((n, k) => {
    const tall = ((base - 16) * n) / most;
    if (n) ctx.fillRect(4 + k * step + 0.5, base - tall, step - 1, tall);
  });
  ctx.fillStyle = colour("line");
  ctx.fillRect(4, base, width - 8, 1);
  ctx.fillStyle = colour("quiet");
  ctx.textAlign = "center";
  const every = bins * BIN_S > 8 ? 2 : 1;
  for (let s = 0; s <= bins * BIN_S; s += every)
    ctx.fillText(`${s} s`, Math.min(width - 12, Math.max(10, 4 + (s / BIN_S) * step)), height - 4);
  ctx.textAlign = "right";
  ctx.fillText(`delay of the last ${delays.length} fixes, most ${most}`, width - 4, 11);
}

export function showRdss(store) {
  const health = store.said("health");
  const found =
    health &&
    Object.entries(health.sources).find(([, s]) => s.counters && "requested" in s.counters);
  if (!found) {
    if (!holder.querySelector(".none")) holder.replaceChildren(element("p", "none", NONE));
    return;
  }
  if (!table.isConnected) holder.replaceChildren(detail, table, canvas);
  const [name, source] = found,
    counters = source.counters;
  put(detail, counted(source.detail || source.state, store));
  const rows = [
    [
      "last fix",
      source.age_s === null
        ? "none yet"
        : `${stretch(source.age_s + (store.age("health") || 0))} ago, ${stretch(source.latency_s)} late`,
    ],
  ];
  if (source.beams) rows.push(["beams", beams(source.beams)]);
  rows.push(["since the start", listed(NAMES, counters) || "nothing asked yet"]);
  const messages = listed(MESSAGES, counters);
  if (messages) rows.push(["messages", messages]);
  fillRows(body, rows);
  histogram(
    store.rows.delay.filter((row) => row[1] === name && known(row[2])).map((row) => row[2]),
  );
}

// A countdown goes on between the messages.
function counted(text, store) {
  const age = store.age("health") || 0;
  return text.replace(
    /(next (?:request|attempt) in|not transmitting, for) (\d+) s/,
    (all, words, s) => `${words} ${Math.max(0, Math.round(s - age))} s`,
  );
}
