// Artificial horizon, and a compass card under the heading; both with one sigma where it shows.
import { byId, colour, fixed, known, prepared, sigma } from "./text.js";

const canvas = byId("attitude");
const RAD = Math.PI / 180;
const PITCH_SPAN = 30; // degrees from the middle to the rim

function horizon(ctx, x, y, r, roll, pitch) {
  ctx.save();
  ctx.beginPath();
  ctx.arc(x, y, r, 0, 2 * Math.PI);
  ctx.clip();
  ctx.translate(x, y);
  ctx.rotate(-roll * RAD);
  const step = r / PITCH_SPAN,
    level = Math.max(-2 * r, Math.min(2 * r, pitch * step));
  ctx.fillStyle = colour("sky");
  ctx.fillRect(-2 * r, -4 * r, 4 * r, 4 * r + level);
  ctx.fillStyle = colour("ground");
  ctx.fillRect(-2 * r, level, 4 * r, 4 * r);
  ctx.strokeStyle = ctx.fillStyle = colour("ink");
  ctx.lineWidth = 1.5;
  line(ctx, -2 * r, level, 2 * r, level);
  ctx.lineWidth = 1;
  ctx.textAlign = "left";
  ctx.textBaseline = "middle";
  for (let p = -90; p <= 90; p += 5) {
    const at = level - p * step;
    if (p === 0 || Math.abs(at) > 0.8 * r) continue;
    const half = p % 10 ? 0.1 * r : 0.2 * r;
    line(ctx, -half, at, half, at);
    if (p % 10 === 0) ctx.fillText(String(Math.abs(p)), half + 5, at);
  }
  ctx.restore();
}

function line(ctx, x1, y1, x2, y2) {
  ctx.beginPath();
  ctx.moveTo(x1, y1);
  ctx.lineTo(x2, y2);
  ctx.stroke();
}

function rollScale(ctx, x, y, r, roll) {
  ctx.strokeStyle = ctx.fillStyle = colour("ink");
  ctx.lineWidth = 1;
  for (const angle of [-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60]) {
    const a = (angle - 90) * RAD,
      long = angle % 30 === 0 ? 8 : 5;
    line(
      ctx,
      x + r * Math.cos(a),
      y + r * Math.sin(a),
      x + (r + long) * Math.cos(a),
      y + (r + long) * Math.sin(a),
    );
  }
  // The pointer belongs to the horizon: it shows by how much the vehicle leans.
  const a = (-roll - 90) * RAD;
  ctx.beginPath();
  for (const [off, at] of [
    [0, r - 1],
    [-4.5 / r, r - 10],
    [4.5 / r, r - 10],
  ])
    ctx.lineTo(x + at * Math.cos(a + off), y + at * Math.sin(a + off));
  ctx.fill();
}

function vehicleMark(ctx, x, y, r) {
  ctx.strokeStyle = colour("s1");
  ctx.lineWidth = 3;
  line(ctx, x - 0.55 * r, y, x - 0.24 * r, y);
  line(ctx, x + 0.24 * r, y, x + 0.55 * r, y);
  ctx.beginPath();
  ctx.arc(x, y, 2, 0, 2 * Math.PI);
  ctx.stroke();
}

function compass(ctx, x, y, r, yaw, sd) {
  ctx.strokeStyle = colour("line");
  ctx.lineWidth = 1;
  ctx.beginPath();
  ctx.arc(x, y, r, 0, 2 * Math.PI);
  ctx.stroke();
  ctx.textAlign = "center";
  ctx.textBaseline = "middle";
  for (let d = 0; d < 360; d += 10) {
    const a = (d - yaw - 90) * RAD,
      main = d % 30 === 0;
    ctx.strokeStyle = colour(main ? "ink" : "quiet");
    const inner = r - (main ? 9 : 5);
    line(
      ctx,
      x + inner * Math.cos(a),
      y + inner * Math.sin(a),
      x + r * Math.cos(a),
      y + r * Math.sin(a),
    );
    if (!main) continue;
    const name = { 0: "N", 90: "E", 180: "S", 270: "W" }[d];
    ctx.fillStyle = colour(name ? "ink" : "quiet");
    ctx.fillText(name || String(d), x + (r - 19) * Math.cos(a), y + (r - 19) * Math.sin(a));
  }
  if (known(sd) && sd > 0.5) {
    ctx.beginPath();
    ctx.moveTo(x, y);
    ctx.arc(x, y, r - 30, (-90 - 2 * Math.min(sd, 90)) * RAD, (-90 + 2 * Math.min(sd, 90)) * RAD);
    ctx.fillStyle = colour("s0");
    ctx.globalAlpha = 0.16;
    ctx.fill();
    ctx.globalAlpha = 1;
  }
  ctx.fillStyle = colour("s1");
  ctx.beginPath();
  ctx.moveTo(x, y - r - 1);
  ctx.lineTo(x - 6, y - r - 10);
  ctx.lineTo(x + 6, y - r - 10);
  ctx.fill();
}

function caption(ctx, x, y, name, text) {
  ctx.textAlign = "center";
  ctx.textBaseline = "alphabetic";
  const family = getComputedStyle(document.body).fontFamily;
  ctx.fillStyle = colour("ink");
  ctx.font = `600 15px ${family}`;
  ctx.fillText(text, x, y);
  ctx.fillStyle = colour("quiet");
  ctx.font = `12px ${family}`;
  ctx.fillText(name, x, y + 16);
}

export function showAttitude(store) {
  const surface = prepared(canvas);
  if (!surface) return;
  const { ctx, width, height } = surface;
  const n = store.said("nav") || {};
  const r = Math.max(30, Math.min(width / 4 - 14, (height - 66) / 2));
  const y = r + 14,
    left = width / 4,
    right = (3 * width) / 4;
  const tilt = known(n.roll_deg) && known(n.pitch_deg);
  if (tilt) {
    horizon(ctx, left, y, r, n.roll_deg, n.pitch_deg);
    rollScale(ctx, left, y, r, n.roll_deg);
    vehicleMark(ctx, left, y, r);
  } else empty(ctx, left, y, r);
  caption(
    ctx,
    left,
    y + r + 26,
    "roll, pitch",
    tilt ? `${fixed(n.roll_deg, 1)}\u00b0  ${fixed(n.pitch_deg, 1)}\u00b0` : "not known",
  );
  if (known(n.yaw_deg)) compass(ctx, right, y, r, n.yaw_deg, n.sd_yaw_deg);
  else empty(ctx, right, y, r);
  const heading = known(n.yaw_deg)
    ? `${fixed(n.yaw_deg, 1)}\u00b0 \u00b1 ${sigma(n.sd_yaw_deg)}\u00b0`
    : "not known";
  caption(ctx, right, y + r + 26, "true heading", heading);
}

function empty(ctx, x, y, r) {
  ctx.strokeStyle = colour("line");
  ctx.lineWidth = 1;
  ctx.beginPath();
  ctx.arc(x, y, r, 0, 2 * Math.PI);
  ctx.stroke();
}
