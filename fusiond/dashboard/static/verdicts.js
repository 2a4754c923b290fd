// The verdict on each source's sigma: NIS in its interval, correlations of its innovations.
import { byId, colour, element, fixed, known, mark, prepared, put } from "./text.js";

const holder = byId("verdicts");
const shown = new Map();
const WORDS = {
  consistent: "consistent",
  optimistic: "sigma too small",
  pessimistic: "sigma too large",
  cannot_tell: "cannot tell: errors shared",
  coloured: "errors last from fix to fix",
  too_few: "too few yet",
};

function row(name) {
  const line = element("div", "verdict"),
    said = line.appendChild(element("div"));
  const parts = {
    line,
    name: said.appendChild(element("div", "", name)),
    verdict: said.appendChild(element("div", "sub")),
    nis: line.appendChild(element("canvas")),
    rho: line.appendChild(element("canvas")),
  };
  return parts;
}

// Mean NIS on a logarithmic scale of 1/4 to 4, its 95 % interval as a band.
function nisBar(canvas, tests) {
  const surface = prepared(canvas);
  if (!surface) return;
  const { ctx, width } = surface,
    y = 14;
  const at = (v) => 2 + (width - 4) * Math.min(1, Math.max(0, Math.log2(4 * v) / 4));
  ctx.fillStyle = colour("grid");
  ctx.fillRect(2, y - 5, width - 4, 10);
  ctx.textAlign = "center";
  ctx.fillStyle = colour("quiet");
  if (!known(tests.nis_average)) {
    ctx.fillText("NIS –", width / 2, y + 22);
    return;
  }
  ctx.fillStyle = colour("m-navigating");
  ctx.globalAlpha = 0.35;
  ctx.fillRect(at(tests.nis_low), y - 5, at(tests.nis_high) - at(tests.nis_low), 10);
  ctx.globalAlpha = 1;
  ctx.fillStyle = colour("quiet");
  ctx.fillRect(at(1) - 0.5, y - 7, 1, 14);
  const inside = tests.nis_average >= tests.nis_low && tests.nis_average <= tests.nis_high;
  ctx.fillStyle = colour(inside ? "ink" : "m-invalid");
  ctx.fillRect(at(tests.nis_average) - 1.5, y - 9, 3, 18);
  ctx.fillStyle = colour("quiet");
  const interval =
    width < 130 ? "" : `  (${fixed(tests.nis_low, 2)} to ${fixed(tests.nis_high, 2)})`;
  ctx.fillText(`NIS ${fixed(tests.nis_average, 2)}${interval}`, width / 2, y + 23);
}

// Correlation at lags 1 to 8, to 0.6 at full height; the band is the 95 % interval of one lag.
function rhoBars(canvas, tests) {
  const surface = prepared(canvas);
  if (!surface) return;
  const { ctx, width } = surface,
    middle = 14,
    half = 13,
    most = 0.6;
  const high = known(tests.rho_high) ? tests.rho_high : 0;
  const tallOf = (r) => half * Math.min(1, Math.abs(r) / most);
  ctx.fillStyle = colour("grid");
  ctx.fillRect(2, middle - tallOf(high), width - 4, 2 * tallOf(high));
  ctx.fillStyle = colour("line");
  ctx.fillRect(2, middle - 0.5, width - 4, 1);
  const rho = tests.rho || [],
    step = (width - 4) / Math.max(8, rho.length);
  rho.forEach((r, k) => {
    if (!known(r)) return;
    ctx.fillStyle = colour(Math.abs(r) > high ? "m-coasting" : "s0");
    const tall = tallOf(r);
    ctx.fillRect(
      2 + (k + 0.2) * step,
      r > 0 ? middle - tall : middle,
      0.6 * step,
      Math.max(1, tall),
    );
  });
  ctx.textAlign = "center";
  ctx.fillStyle = colour("quiet");
  ctx.fillText("rho, lags 1 to 8", width / 2, 37);
}

export function showVerdicts(store) {
  const said = store.said("consistency"),
    sources = (said && said.sources) || {};
  const names = Object.keys(sources);
  if (!names.length) {
    shown.clear();
    if (!holder.querySelector(".none"))
      holder.replaceChildren(element("p", "none", "No source judged yet: it takes minutes."));
    return;
  }
  if (names.join() !== [...shown.keys()].join()) {
    shown.clear();
    for (const name of names) shown.set(name, row(name));
    holder.replaceChildren(...[...shown.values()].map((parts) => parts.line));
  }
  for (const [name, parts] of shown) {
    const tests = sources[name];
    put(parts.verdict, `${WORDS[tests.verdict] || tests.verdict}, ${tests.k}`);
    parts.verdict.title = `the last ${tests.k} innovations; level ${tests.alpha}; portmanteau ${fixed(tests.portmanteau, 1)} of at most ${fixed(tests.portmanteau_limit, 1)}`;
    for (const word of Object.keys(WORDS)) mark(parts.verdict, word, word === tests.verdict);
    nisBar(parts.nis, tests);
    rhoBars(parts.rho, tests);
  }
}
