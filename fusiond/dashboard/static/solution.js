// The solution in figures, each with its sigma.
import { byId, element, fillRows, fixed, hypot, known, sigma } from "./text.js";

const table = byId("solution"),
  body = table.createTBody();
const head = table.createTHead().insertRow();
for (const [text, name] of [
  ["", ""],
  ["value", "n"],
  ["1 sigma", "n"],
])
  head.append(element("th", name, text));

function degrees(v, positive, negative) {
  return known(v) ? `${Math.abs(v).toFixed(7)}\u00b0 ${v < 0 ? negative : positive}` : "–";
}

const unit = (text, of) => (text === "–" ? text : `${text} ${of}`);
const value = (text) => ({ text, className: "n value" });
const quiet = (text) => ({ text, className: "n" });

export function showSolution(store) {
  const n = store.said("nav") || {};
  const speed = hypot(n.v_n_m_s, n.v_e_m_s);
  const climb = known(n.v_d_m_s) ? -n.v_d_m_s : null;
  const level = hypot(n.sd_vn_m_s, n.sd_ve_m_s);
  const rows = [
    ["Latitude", value(degrees(n.lat_deg, "N", "S")), quiet(unit(sigma(n.sd_n_m), "m"))],
    ["Longitude", value(degrees(n.lon_deg, "E", "W")), quiet(unit(sigma(n.sd_e_m), "m"))],
    ["Height", value(unit(fixed(n.height_m, 2), "m")), quiet(unit(sigma(n.sd_d_m), "m"))],
    ["Speed", value(unit(fixed(speed, 2), "m/s")), quiet(unit(sigma(level), "m/s"))],
    ["Climb", value(unit(fixed(climb, 2), "m/s")), quiet(unit(sigma(n.sd_vd_m_s), "m/s"))],
    [
      "Roll",
      value(unit(fixed(n.roll_deg, 2), "\u00b0")),
      quiet(unit(sigma(n.sd_roll_deg), "\u00b0")),
    ],
    [
      "Pitch",
      value(unit(fixed(n.pitch_deg, 2), "\u00b0")),
      quiet(unit(sigma(n.sd_pitch_deg), "\u00b0")),
    ],
    [
      "Heading",
      value(unit(fixed(n.yaw_deg, 2), "\u00b0")),
      quiet(unit(sigma(n.sd_yaw_deg), "\u00b0")),
    ],
  ];
  const bounds = [
    ["Error bound, level", n.protection_horizontal_m],
    ["Error bound, height", n.protection_vertical_m],
  ];
  for (const [name, bound] of bounds)
    if (known(bound)) rows.push([name, value(unit(fixed(bound, 1), "m")), quiet("")]);
  fillRows(body, rows);
}
