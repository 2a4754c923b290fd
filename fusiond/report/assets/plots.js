// Plots on uPlot: one axis of time for all, modes behind them, events as marks.
"use strict";
const HEIGHT = 230;
const MARKS = { error: "wrong", warning: "m-coasting", info: "quiet" };
const timePlots = [];

// Columns of a plot as uPlot takes them: null is a gap; a logarithm knows no zero.
function columnsOf(item) {
  if (!item.columns) {
    const known = (v) => (Number.isFinite(v) && !(item.log && v <= 0) ? v : null);
    item.columns = [floats(item.x), ...item.series.map((s) => floats(s.y).map(known))];
  }
  return item.columns;
}

// Smallest and largest value of items that are compared with each other, within a stretch of x.
function extent(items, from, to) {
  let low = Infinity, high = -Infinity;
  for (const item of items) {
    const [x, ...ys] = columnsOf(item);
    for (let k = 0; k < x.length; k++) {
      if (x[k] < from || x[k] > to) continue;
      for (const y of ys) {
        if (y[k] === null) continue;
        if (y[k] < low) low = y[k];
        if (y[k] > high) high = y[k];
      }
    }
  }
  return [low, high];
}

function verticalRange(items, from, to) {
  let [low, high] = extent(items, from, to);
  if (low > high) return items[0].log ? [0.1, 10] : [-1, 1];
  if (items[0].series.some((s) => s.role === "bars")) low = 0.7; // counts: a bar of one is seen
  if (items[0].log) return uPlot.rangeLog(low, high, 10, false);
  const margin = high > low ? 0.06 * (high - low) : Math.max(0.5, 0.1 * Math.abs(high));
  return [low - (low === 0 ? 0 : margin), high + margin];
}

// A tick of a logarithmic axis; uPlot has left out those that would stand too close.
function power(v) {
  if (v === null) return null;
  return v < 1e-3 || v >= 1e5 ? v.toExponential(0) : String(+v.toPrecision(3));
}

function seriesOf(item) {
  let next = 0;
  const colours = [];
  return item.series.map((s) => {
    const own = s.like === null ? next++ % 6 : colours[s.like];
    colours.push(own);
    const stroke = colour("s" + own);
    const options = {
      label: s.label,
      stroke,
      width: 1.4,
      points: { show: columnsOf(item)[0].length < 60, size: 5 },
      value: (u, v) => (v === null ? "" : figure(v)),
    };
    if (s.role === "bound")
      Object.assign(options, { dash: [5, 4], width: 1, points: { show: false }, class: "bound" });
    if (s.role === "steps") options.paths = uPlot.paths.stepped({ align: 1 });
    if (s.role === "bars") {
      Object.assign(options, { paths: uPlot.paths.bars({ size: [1] }), fill: stroke, width: 0 });
      options.points.show = false;
    }
    if (s.role === "points" || s.role === "refused") {
      const fill = s.role === "refused" ? colour("refused") : stroke;
      options.paths = () => null;
      options.points = { show: true, size: s.role === "refused" ? 6 : 3.5, fill, stroke: fill, width: 0 };
    }
    return options;
  });
}

function behind(u, run) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.globalAlpha = 0.13;
  for (const [from, to, mode] of run.modes) {
    const left = Math.max(bbox.left, u.valToPos(from, "x", true));
    const right = Math.min(bbox.left + bbox.width, u.valToPos(to, "x", true));
    if (right <= left) continue;
    ctx.fillStyle = colour("m-" + mode) || colour("quiet");
    ctx.fillRect(left, bbox.top, right - left, bbox.height);
  }
  ctx.restore();
}

function marks(u, run) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.setLineDash([]);
  ctx.lineWidth = devicePixelRatio;
  for (const [t, level] of run.events) {
    const x = u.valToPos(t, "x", true);
    if (x < bbox.left || x > bbox.left + bbox.width) continue;
    ctx.strokeStyle = ctx.fillStyle = colour(MARKS[level] || "quiet");
    ctx.globalAlpha = level === "info" ? 0.35 : 0.7;
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.globalAlpha = 1;
    const size = 4 * devicePixelRatio;
    ctx.beginPath();
    ctx.moveTo(x - size, bbox.top);
    ctx.lineTo(x + size, bbox.top);
    ctx.lineTo(x, bbox.top + 1.6 * size);
    ctx.fill();
  }
  ctx.restore();
}

function lines(u, levels) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.strokeStyle = colour("quiet");
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([2 * devicePixelRatio, 4 * devicePixelRatio]);
  for (const level of levels) {
    const y = u.valToPos(level, "y", true);
    if (y < bbox.top || y > bbox.top + bbox.height) continue;
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
  }
  ctx.restore();
}

// One plot; `pair` are the plots of the same thing in both runs, which share their vertical range.
function plot(item, run, pair, parent) {
  const overTime = item.x_label === null;
  const ink = colour("quiet"), grid = { stroke: colour("grid"), width: 1 };
  const axis = { stroke: ink, grid, ticks: grid, font: "12px system-ui, sans-serif" };
  const bars = item.series.some((s) => s.role === "bars");
  const stretch = (u, low, high) => {
    const [x] = columnsOf(item);
    // uPlot asks with the ends of the data when nobody has chosen a stretch.
    if (overTime) return low === x[0] && high === x[x.length - 1] ? [view.from, view.to] : [low, high];
    const half = bars && x.length > 1 ? 0.5 * (x[1] - x[0]) : 0;
    return high > low ? [low - half, high + half] : [low - 1, low + 1];
  };
  const options = {
    width: Math.max(260, parent.clientWidth),
    height: HEIGHT,
    scales: {
      x: { time: false, range: stretch },
      y: {
        distr: item.log ? 3 : 1,
        range: (u) => verticalRange(pair, u.scales.x.min ?? -Infinity, u.scales.x.max ?? Infinity),
      },
    },
    axes: [
      overTime
        ? { ...axis, space: 70, size: 32, values: (u, ticks) => ticks.map(clock) }
        : { ...axis, label: item.x_label, labelSize: 18, size: 32, labelFont: axis.font },
      {
        ...axis,
        size: 58,
        label: item.unit,
        labelSize: 16,
        labelFont: axis.font,
        ...(item.log ? { values: (u, ticks) => ticks.map(power) } : {}),
      },
    ],
    series: [
      { label: overTime ? "t" : item.x_label, value: (u, v) => (v === null ? "" : overTime ? clock(v) : figure(v)) },
      ...seriesOf(item),
    ],
    cursor: { drag: { x: true, y: false } },
    hooks: {},
  };
  if (overTime) {
    options.cursor.sync = { key: "time" };
    options.cursor.bind = { dblclick: () => () => view.all() };
    options.hooks = {
      drawClear: [(u) => behind(u, run)],
      draw: [(u) => lines(u, item.levels), (u) => marks(u, run)],
      setScale: [(u, key) => key === "x" && view.show(u.scales.x.min, u.scales.x.max, u)],
      setCursor: [
        (u) => {
          if (!u.over.matches(":hover")) return;
          const left = u.cursor.left, inside = left >= 0;
          const near = u.posToVal(6, "x") - u.posToVal(0, "x");
          tell(run, inside ? u.posToVal(left, "x") : null, near);
        },
      ],
    };
  }
  const u = new uPlot(options, columnsOf(item), parent);
  if (overTime) timePlots.push(u);
  return u;
}

view.listeners.push((by) => {
  for (const u of timePlots) if (u !== by) u.setScale("x", { min: view.from, max: view.to });
});
