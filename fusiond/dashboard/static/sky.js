// Satellites by azimuth and elevation, their C/N0, and which are used or refused and why.
import { byId, colour, element, fixed, known, prepared, put } from "./text.js";

const holder = byId("sky");
const canvas = element("canvas"),
  notes = element("div", "notes");
const NONE = "No raw satellite data: switch on RAWX or MSM, or stay with fixes.";
const RAD = Math.PI / 180;
const CNO = { low: 20, high: 50 }; // dB-Hz: hardly tracked, very strong

function rings(ctx, x, y, r) {
  ctx.strokeStyle = colour("line");
  ctx.lineWidth = 1;
  for (const elevation of [0, 30, 60]) {
    ctx.beginPath();
    ctx.arc(x, y, (r * (90 - elevation)) / 90, 0, 2 * Math.PI);
    ctx.stroke();
  }
  ctx.beginPath();
  ctx.moveTo(x - r, y);
  ctx.lineTo(x + r, y);
  ctx.moveTo(x, y - r);
  ctx.lineTo(x, y + r);
  ctx.stroke();
  ctx.fillStyle = colour("quiet");
  ctx.textAlign = "center";
  ctx.textBaseline = "middle";
  for (const [name, a] of [
    ["N", -90],
    ["E", 0],
    ["S", 90],
    ["W", 180],
  ])
    ctx.fillText(name, x + (r + 10) * Math.cos(a * RAD), y + (r + 10) * Math.sin(a * RAD));
}

function satellite(ctx, x, y, r, name, where, used, refused) {
  if (!known(where.azimuth_deg) || !known(where.elevation_deg)) return;
  const a = (where.azimuth_deg - 90) * RAD,
    d = (r * (90 - Math.max(0, where.elevation_deg))) / 90;
  const sx = x + d * Math.cos(a),
    sy = y + d * Math.sin(a);
  ctx.fillStyle = ctx.strokeStyle = colour(refused ? "m-invalid" : used ? "m-navigating" : "quiet");
  ctx.beginPath();
  ctx.arc(sx, sy, 5, 0, 2 * Math.PI);
  ctx.lineWidth = 1.5;
  if (used) ctx.fill();
  ctx.stroke();
  ctx.fillStyle = colour("ink");
  ctx.textAlign = "left";
  ctx.fillText(name, sx + 8, sy);
}

// C/N0 as bars, in the order of the names.
function strengths(ctx, left, width, height, sky) {
  const all = Object.entries(sky.satellites)
    .filter(([, s]) => known(s.cno_db_hz))
    .sort();
  if (!all.length) return;
  const step = Math.min(16, (height - 14) / all.length),
    used = new Set(sky.used);
  ctx.textBaseline = "middle";
  all.forEach(([name, s], k) => {
    const y = 8 + (k + 0.5) * step,
      share = (s.cno_db_hz - CNO.low) / (CNO.high - CNO.low);
    const long = (width - 62) * Math.min(1, Math.max(0.02, share));
    ctx.fillStyle = colour(
      name in sky.refused ? "m-invalid" : used.has(name) ? "m-navigating" : "quiet",
    );
    ctx.fillRect(left + 32, y - 0.32 * step, long, 0.64 * step);
    if (step < 10 && k % 2) return;
    ctx.fillStyle = colour("quiet");
    ctx.textAlign = "left";
    ctx.fillText(name, left, y);
    if (step >= 10) ctx.fillText(s.cno_db_hz.toFixed(0), left + 36 + long, y);
  });
}

export function showSky(store) {
  const health = store.said("health");
  const found =
    health &&
    Object.entries(health.sources).find(
      ([, s]) => s.sky && Object.keys(s.sky.satellites || {}).length,
    );
  if (!found) {
    if (!holder.querySelector(".none")) holder.replaceChildren(element("p", "none", NONE));
    return;
  }
  if (!canvas.isConnected) holder.replaceChildren(canvas, notes);
  const surface = prepared(canvas);
  if (!surface) return;
  const { ctx, width, height } = surface,
    [name, { sky }] = found;
  const r = Math.min(height / 2 - 20, 0.29 * width),
    x = r + 20,
    y = height / 2;
  rings(ctx, x, y, r);
  const used = new Set(sky.used);
  for (const [id, where] of Object.entries(sky.satellites))
    satellite(ctx, x, y, r, id, where, used.has(id), id in sky.refused);
  strengths(ctx, 2 * r + 58, width - 2 * r - 62, height, sky);
  const refused = Object.entries(sky.refused).map(
    ([id, why]) => `${id} ${why.replaceAll("_", " ")}`,
  );
  put(
    notes,
    `${name}: ${sky.used.length} used, HDOP ${fixed(sky.hdop, 1)}, PDOP ${fixed(sky.pdop, 1)}, innovations ${fixed(sky.innovation_rms, 2)} sigma` +
      (refused.length ? `; refused ${refused.join(", ")}` : ""),
  );
}
