// Other vehicles on the map: where their reports say that they are, with two sigma and their card.
import { colour, known, stretch } from "./text.js";

const RAD = Math.PI / 180;
const FADES_S = 600; // a report this old is drawn faint: who reports seldom does so every five minutes

export function drawFleet(ctx, map, fleet) {
  for (const other of fleet) {
    const here = nearby(map, other);
    if (!here) continue;
    const [x, y] = map.place(here);
    ctx.save();
    ctx.translate(x, y);
    ctx.globalAlpha = other.age !== null && other.age < FADES_S ? 1 : 0.45;
    ellipse(ctx, other, map.scale);
    arrow(ctx, other);
    ctx.fillStyle = colour("ink");
    ctx.textAlign = "left";
    ctx.textBaseline = "middle";
    const age = other.age === null ? "" : `, ${stretch(other.age)}`;
    ctx.fillText(`${other.card}${age}`, 11, 0);
    ctx.restore();
  }
}

// East and north of the map's origin, which is not moved for another vehicle.
function nearby(map, { lat_deg: lat, lon_deg: lon }) {
  if (!map.origin || !known(lat) || !known(lon)) return null;
  const [lat0, lon0, perEast, perNorth] = map.origin;
  return [(((lon - lon0 + 540) % 360) - 180) * perEast, (lat - lat0) * perNorth];
}

function ellipse(ctx, { sd_e_m: east, sd_n_m: north }, scale) {
  if (!known(east) || !known(north)) return;
  ctx.beginPath();
  ctx.ellipse(0, 0, 2 * east * scale, 2 * north * scale, 0, 0, 2 * Math.PI);
  ctx.strokeStyle = colour("s2") || colour("quiet");
  ctx.lineWidth = 1;
  ctx.stroke();
}

function arrow(ctx, { course_deg: course }) {
  ctx.save();
  ctx.beginPath();
  if (known(course)) {
    ctx.rotate(course * RAD);
    for (const [x, y] of [
      [0, -8],
      [5, 6],
      [0, 3],
      [-5, 6],
    ])
      ctx.lineTo(x, y);
  } else ctx.arc(0, 0, 4, 0, 2 * Math.PI);
  ctx.closePath();
  ctx.fillStyle = colour("s2") || colour("quiet");
  ctx.strokeStyle = colour("card");
  ctx.lineWidth = 1.5;
  ctx.fill();
  ctx.stroke();
  ctx.restore();
}
