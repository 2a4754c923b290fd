// Sigma and innovations over the last minutes, with the mode behind them.
import { derived } from "./sources.js";
import { colour, element, known } from "./text.js";

/* global uPlot */
const SPANS_MIN = [1, 2, 5, 10];
const LEAST_HEIGHT = 150; // pixels
const LEGEND = 30;
const GAP_S = 3;
const LEAST_NIS = 0.01; // smaller ones are drawn there: they say nothing more
const MARK = { error: "m-invalid", warning: "m-coasting" };

const figure = (u, v) => (known(v) ? v.toFixed(v < 0.1 ? 3 : v < 10 ? 2 : 1) : "–");
const ago = (u, v) => (known(v) ? label(v) : "–");

function label(v) {
  const s = Math.round(-v);
  return s === 0 ? "now" : `\u2212${Math.floor(s / 60)}:${String(s % 60).padStart(2, "0")}`;
}

const sizeOf = (holder) => ({
  width: holder.clientWidth,
  height: Math.max(LEAST_HEIGHT, holder.clientHeight - LEGEND),
});

// The legend says what was last, unless the cursor is on the plot.
function setData(u, columns) {
  u.setData(columns);
  if (u.cursor.left === null || u.cursor.left < 0) {
    u.setLegend({ idxs: columns.map((c) => c.findLastIndex(known)) }, false);
  }
}

export class Plots {
  constructor(store, sigmaHolder, nisHolder, tools) {
    Object.assign(this, { store, sigmaHolder, nisHolder, minutes: 2, shown: "" });
    this.buttons = SPANS_MIN.map((minutes) => {
      const button = tools.appendChild(element("button", "", `${minutes} min`));
      button.onclick = () => this.show(minutes);
      return button;
    });
    this.show(2);
  }

  show(minutes) {
    this.minutes = minutes;
    this.buttons.forEach((b, k) =>
      b.setAttribute("aria-pressed", String(SPANS_MIN[k] === minutes)),
    );
    this.draw();
  }

  next(step) {
    const at = SPANS_MIN.indexOf(this.minutes) + step;
    this.show(SPANS_MIN[Math.max(0, Math.min(SPANS_MIN.length - 1, at))]);
  }

  get span() {
    return 60 * this.minutes;
  }

  rebuild() {
    for (const u of [this.sigma, this.nis]) if (u) u.destroy();
    this.sigma = this.nis = null;
    this.draw();
  }

  resize() {
    if (this.sigma) this.sigma.setSize(sizeOf(this.sigmaHolder));
    if (this.nis) this.nis.setSize(sizeOf(this.nisHolder));
  }

  options(holder, unit, series, y, draw = []) {
    const ink = colour("quiet"),
      grid = { stroke: colour("grid"), width: 1 };
    const font = `12px ${getComputedStyle(document.body).fontFamily}`;
    const axis = { stroke: ink, grid, ticks: grid, font, labelFont: font };
    return {
      ...sizeOf(holder),
      padding: [8, 14, 0, 0],
      scales: { x: { time: false, range: () => [-this.span, 0] }, y },
      axes: [
        {
          ...axis,
          size: 28,
          space: 80,
          values: (u, ticks) => ticks.map(label),
          incrs: [5, 10, 15, 20, 30, 60, 120],
        },
        {
          ...axis,
          size: 52,
          label: unit,
          labelSize: 16,
          values: (u, ticks) => ticks.map((v) => (v === null ? null : String(+v.toPrecision(3)))),
        },
      ],
      series: [{ label: "t", value: ago }, ...series],
      cursor: { drag: { x: false, y: false } },
      legend: { live: true },
      hooks: {
        drawClear: [(u) => this.modes(u)],
        draw: [(u) => this.events(u), ...draw],
      },
    };
  }

  // The mode as background, from the rows of the solution.
  modes(u) {
    const { ctx, bbox } = u,
      rows = this.store.rows.nav,
      now = this.now;
    ctx.save();
    ctx.globalAlpha = 0.13;
    for (let k = 0; k < rows.length;) {
      const [from, , mode] = rows[k];
      let end = k;
      while (
        end + 1 < rows.length &&
        rows[end + 1][2] === mode &&
        rows[end + 1][0] - rows[end][0] < GAP_S
      )
        end++;
      const next = rows[end + 1],
        joined = next && next[0] - rows[end][0] < GAP_S;
      const to = joined ? next[0] : rows[end][0] + 0.5;
      k = end + 1;
      if (to < now - this.span) continue;
      const left = Math.max(bbox.left, u.valToPos(from - now, "x", true));
      const right = Math.min(bbox.left + bbox.width, u.valToPos(Math.min(0, to - now), "x", true));
      ctx.fillStyle = colour(`m-${mode}`) || colour("quiet");
      if (right > left) ctx.fillRect(left, bbox.top, right - left, bbox.height);
    }
    ctx.restore();
  }

  // Warnings and errors as ticks along the top.
  events(u) {
    const { ctx, bbox } = u;
    ctx.save();
    for (const [at, event] of this.store.rows.event) {
      if (at === null || !MARK[event.level] || at < this.now - this.span) continue;
      const x = u.valToPos(at - this.now, "x", true),
        size = 3.5 * devicePixelRatio;
      ctx.fillStyle = colour(MARK[event.level]);
      ctx.beginPath();
      ctx.moveTo(x - size, bbox.top);
      ctx.lineTo(x + size, bbox.top);
      ctx.lineTo(x, bbox.top + 2 * size);
      ctx.fill();
    }
    ctx.restore();
  }

  draw() {
    if (!this.sigmaHolder.clientWidth || typeof uPlot === "undefined") return;
    this.now = this.store.now;
    this.drawSigma();
    this.drawNis();
  }

  drawSigma() {
    if (!this.sigma) {
      const line = (name, c) => ({
        label: name,
        stroke: colour(c),
        width: 1.6,
        points: { show: false },
        value: figure,
      });
      const range = (u, low, high) => [0, known(high) && high > 0 ? high * 1.1 : 1];
      this.sigma = new uPlot(
        this.options(
          this.sigmaHolder,
          "m; heading: deg",
          [
            line("north", "s0"),
            line("east", "s1"),
            line("vertical", "s2"),
            { ...line("heading (deg)", "s3"), dash: [4, 3] },
          ],
          { range },
        ),
        [[], [], [], [], []],
        this.sigmaHolder,
      );
    }
    const columns = [[], [], [], [], []];
    let before = null;
    for (const [at, , , , , , n, e, d, yaw] of this.store.rows.nav) {
      if (at < this.now - this.span - 1) continue;
      if (before !== null && at - before > GAP_S)
        add(columns, before + 0.1 - this.now, null, null, null, null);
      add(columns, at - this.now, n, e, d, yaw);
      before = at;
    }
    setData(this.sigma, columns);
  }

  // NIS a degree of freedom: 1 is expected. Single innovations where they come, else the averages
  // of the consistency tests.
  drawNis() {
    const single = this.store.innovations.size > 0;
    const rows = single ? this.innovations() : this.averages();
    const names = [...new Set(rows.map((row) => row.source))].sort();
    const key = `${single} ${names.join(" ")}`;
    if (!this.nis || key !== this.shown) {
      if (this.nis) this.nis.destroy();
      this.shown = key;
      this.nis = this.makeNis(names, single);
    }
    const times = [...new Set(rows.map((row) => row.t))].sort((a, b) => a - b);
    const place = new Map(times.map((t, k) => [t, k]));
    const columns = [
      times,
      ...[...names, ...(single ? ["refused"] : [])].map(() => new Array(times.length).fill(null)),
    ];
    for (const row of rows) {
      const to = row.refused ? columns.length - 1 : 1 + names.indexOf(row.source);
      columns[to][place.get(row.t)] = row.nis;
    }
    setData(this.nis, columns);
  }

  averages() {
    return this.store.rows.nis
      .filter((row) => row[0] > this.now - this.span)
      .map(([at, source, nis]) => ({ t: at - this.now, source, nis }));
  }

  // Of what is judged and of devices; constraints that the filter makes itself would hide them.
  innovations() {
    const judged = (this.store.said("consistency") || {}).sources || {};
    const devices = (this.store.said("health") || {}).sources || {};
    const shown = (name) => name in judged || (name in devices && !derived(devices[name]));
    const found = [];
    for (const [at, source, outcome, nis, degrees] of this.store.innovations.values()) {
      if (at < this.now - this.span || !known(nis) || !(degrees > 0) || !shown(source)) continue;
      found.push({
        t: at - this.now,
        source,
        nis: Math.max(nis / degrees, LEAST_NIS),
        refused: outcome !== "fused",
      });
    }
    return found;
  }

  makeNis(names, single) {
    const series = names.map((name, k) => {
      const stroke = colour(`s${k % 6}`);
      const base = { label: name, stroke, value: figure, spanGaps: true };
      return single
        ? { ...base, paths: () => null, points: { show: true, size: 3.5, fill: stroke, width: 0 } }
        : { ...base, width: 1.6, points: { show: false } };
    });
    const refused = colour("m-invalid");
    if (single)
      series.push({
        label: "refused",
        stroke: refused,
        value: figure,
        paths: () => null,
        points: { show: true, size: 6, fill: refused, width: 0 },
      });
    const scale = single
      ? { distr: 3, range: (u, low, high) => [LEAST_NIS, Math.max(20, 1.2 * (high || 0))] }
      : { range: (u, low, high) => [0, Math.max(2, known(high) ? Math.ceil(1.1 * high) : 2)] };
    const expected = (u) => {
      const y = u.valToPos(1, "y", true);
      u.ctx.save();
      u.ctx.strokeStyle = colour("quiet");
      u.ctx.setLineDash([3 * devicePixelRatio, 4 * devicePixelRatio]);
      u.ctx.beginPath();
      u.ctx.moveTo(u.bbox.left, y);
      u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
      u.ctx.stroke();
      u.ctx.restore();
    };
    const unit = single ? "NIS a degree of freedom" : "mean NIS";
    const columns = [[], ...series.map(() => [])];
    return new uPlot(
      this.options(this.nisHolder, unit, series, scale, [expected]),
      columns,
      this.nisHolder,
    );
  }
}

function add(columns, ...values) {
  values.forEach((v, k) => columns[k].push(v));
}
