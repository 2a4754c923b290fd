// The track from above on a metric grid, north up: follow or drag, wheel or keys to zoom. The land
// below it comes from a file that the dashboard serves, or there is none: no other host is asked.
import { BaseMap } from "./basemap.js";
import { drawFleet } from "./fleet.js";
import { colour, element, known, mark, prepared } from "./text.js";

const EARTH_A = 6378137,
  EARTH_E2 = 0.00669437999014; // WGS 84
const RAD = Math.PI / 180;
const GAP_S = 3; // a track is not joined over a longer silence
const SCALES = { least: 0.002, most: 400 }; // pixels a metre

// Metres east and north a degree, at a latitude.
function metresPerDegree(lat) {
  const s = 1 - EARTH_E2 * Math.sin(lat * RAD) ** 2;
  return [
    (RAD * EARTH_A * Math.cos(lat * RAD)) / Math.sqrt(s),
    (RAD * EARTH_A * (1 - EARTH_E2)) / s ** 1.5,
  ];
}

export function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= least * 0.999);
}

const length = (m) =>
  m >= 1000
    ? `${+(m / 1000).toPrecision(3)} km`
    : m >= 1
      ? `${+m.toPrecision(3)} m`
      : `${+(m * 100).toPrecision(3)} cm`;

export class TrackMap {
  constructor(canvas, tools, store) {
    Object.assign(this, { canvas, store, scale: 0.8, follow: true, centre: null, origin: null });
    this.followButton = tools.appendChild(element("button", "", "follow"));
    this.followButton.title = "keep the vehicle in the middle (f)";
    this.followButton.onclick = () => this.toggleFollow();
    for (const [text, factor, title] of [
      ["+", 1.5, "closer (+)"],
      ["\u2212", 1 / 1.5, "farther (-)"],
    ]) {
      const button = tools.appendChild(element("button", "", text));
      button.title = title;
      button.onclick = () => this.zoom(factor);
    }
    const all = tools.appendChild(element("button", "", "all"));
    all.title = "all of the track (a)";
    all.onclick = () => this.all();
    this.land = new BaseMap("/map.pmtiles", () => this.draw());
    this.listen();
  }

  listen() {
    const c = this.canvas,
      held = new Map();
    const middle = () => {
      const all = [...held.values()];
      return [
        all.reduce((s, p) => s + p[0], 0) / all.length,
        all.reduce((s, p) => s + p[1], 0) / all.length,
      ];
    };
    const spread = () => {
      const [a, b] = [...held.values()];
      return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
    };
    c.onpointerdown = (e) => {
      held.set(e.pointerId, [e.offsetX, e.offsetY]);
      c.setPointerCapture(e.pointerId);
    };
    c.onpointerup = c.onpointercancel = (e) => held.delete(e.pointerId);
    c.onpointermove = (e) => {
      if (!held.has(e.pointerId)) return;
      const from = middle(),
        before = spread();
      held.set(e.pointerId, [e.offsetX, e.offsetY]);
      const to = middle();
      this.move(to[0] - from[0], to[1] - from[1]);
      if (before > 10 && held.size === 2) this.zoom(spread() / before, to);
    };
    c.addEventListener(
      "wheel",
      (e) => {
        e.preventDefault();
        this.zoom(1.15 ** (e.deltaY < 0 ? 1 : -1), [e.offsetX, e.offsetY]);
      },
      { passive: false },
    );
  }

  move(dx, dy) {
    if (!this.centre) return;
    this.follow = false;
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.draw();
  }

  zoom(factor, at = null) {
    const scale = Math.min(SCALES.most, Math.max(SCALES.least, this.scale * factor));
    if (at && this.centre && !this.follow) {
      const x = at[0] - this.canvas.clientWidth / 2,
        y = this.canvas.clientHeight / 2 - at[1];
      this.centre = [
        this.centre[0] + x / this.scale - x / scale,
        this.centre[1] + y / this.scale - y / scale,
      ];
    }
    this.scale = scale;
    this.draw();
  }

  toggleFollow() {
    this.follow = !this.follow;
    this.draw();
  }

  all() {
    const points = this.track().filter(Boolean);
    if (!points.length) return;
    const [east, north] = [points.map((p) => p[0]), points.map((p) => p[1])];
    const span = (v) => [Math.min(...v), Math.max(...v)];
    const [w, e] = span(east),
      [s, n] = span(north);
    this.centre = [(w + e) / 2, (s + n) / 2];
    this.scale = Math.min(
      SCALES.most,
      0.85 *
        Math.min(
          this.canvas.clientWidth / Math.max(e - w, 5),
          this.canvas.clientHeight / Math.max(n - s, 5),
        ),
    );
    this.follow = false;
    this.draw();
  }

  // East and north in m from the first position; a new origin after a jump of 50 km.
  local(lat, lon) {
    if (!known(lat) || !known(lon)) return null;
    if (!this.origin) this.origin = [lat, lon, ...metresPerDegree(lat)];
    const [lat0, lon0, perEast, perNorth] = this.origin;
    const turned = ((lon - lon0 + 540) % 360) - 180;
    const point = [turned * perEast, (lat - lat0) * perNorth];
    if (Math.hypot(...point) < 50000) return point;
    this.origin = null;
    return this.local(lat, lon);
  }

  // Points [east, north, mode], null where the track is broken.
  track() {
    const points = [];
    let before = null;
    for (const [at, , mode, lat, lon] of this.store.rows.nav) {
      const point = this.local(lat, lon);
      if (!point || (before !== null && at - before > GAP_S)) points.push(null);
      if (point) points.push([...point, mode]);
      before = at;
    }
    return points;
  }

  place([east, north]) {
    return [
      this.width / 2 + (east - this.centre[0]) * this.scale,
      this.height / 2 - (north - this.centre[1]) * this.scale,
    ];
  }

  draw() {
    mark(this.followButton, "on", this.follow);
    this.followButton.setAttribute("aria-pressed", String(this.follow));
    const surface = prepared(this.canvas);
    if (!surface) return;
    Object.assign(this, { width: surface.width, height: surface.height });
    const { ctx } = surface,
      nav = this.store.said("nav") || {};
    const here = this.local(nav.lat_deg, nav.lon_deg);
    if (here && (this.follow || !this.centre)) this.centre = here;
    if (!this.centre) {
      ctx.fillStyle = colour("quiet");
      ctx.textAlign = "center";
      ctx.fillText("No position yet", this.width / 2, this.height / 2);
      return;
    }
    this.below(ctx);
    this.grid(ctx);
    this.line(ctx);
    drawFleet(ctx, this, this.store.fleet);
    if (here) {
      this.ellipse(ctx, here, nav);
      this.arrow(ctx, here, nav);
    }
    this.bar(ctx);
  }

  // The land, and whose it is.
  below(ctx) {
    const [lat0, lon0, perEast, perNorth] = this.origin;
    const at = (x, y) => [
      lat0 + (this.centre[1] + (this.height / 2 - y) / this.scale) / perNorth,
      lon0 + (this.centre[0] + (x - this.width / 2) / this.scale) / perEast,
    ];
    const place = (lat, lon) => this.place([(lon - lon0) * perEast, (lat - lat0) * perNorth]);
    this.land.draw(ctx, [...at(0, this.height), ...at(this.width, 0)], this.scale, place);
    ctx.fillStyle = colour("quiet");
    ctx.textAlign = "right";
    ctx.fillText(this.land.attribution, this.width - 10, this.height - 28);
  }

  grid(ctx) {
    const step = niceStep(70 / this.scale);
    const half = [this.width / 2 / this.scale, this.height / 2 / this.scale];
    ctx.strokeStyle = colour("grid");
    ctx.lineWidth = 1;
    ctx.beginPath();
    for (
      let e = Math.ceil((this.centre[0] - half[0]) / step) * step;
      e < this.centre[0] + half[0];
      e += step
    ) {
      const x = Math.round(this.place([e, 0])[0]) + 0.5;
      ctx.moveTo(x, 0);
      ctx.lineTo(x, this.height);
    }
    for (
      let n = Math.ceil((this.centre[1] - half[1]) / step) * step;
      n < this.centre[1] + half[1];
      n += step
    ) {
      const y = Math.round(this.place([0, n])[1]) + 0.5;
      ctx.moveTo(0, y);
      ctx.lineTo(this.width, y);
    }
    ctx.stroke();
  }

  // The track in the colours of the modes.
  line(ctx) {
    ctx.lineWidth = 2.4;
    ctx.lineJoin = ctx.lineCap = "round";
    let last = null,
      mode = null;
    for (const point of this.track()) {
      const at = point && this.place(point);
      if (!point || !last || point[2] !== mode) {
        if (mode !== null) ctx.stroke();
        mode = point ? point[2] : null;
        ctx.strokeStyle = colour(`m-${mode}`) || colour("quiet");
        ctx.beginPath();
        if (point) ctx.moveTo(...(last || at));
      }
      if (point) ctx.lineTo(...at);
      last = at;
    }
    if (mode !== null) ctx.stroke();
  }

  // Two sigma; north and east only, as `nav` says nothing of how they go together.
  ellipse(ctx, here, nav) {
    if (!known(nav.sd_e_m) || !known(nav.sd_n_m)) return;
    ctx.beginPath();
    ctx.ellipse(
      ...this.place(here),
      2 * nav.sd_e_m * this.scale,
      2 * nav.sd_n_m * this.scale,
      0,
      0,
      2 * Math.PI,
    );
    ctx.fillStyle = ctx.strokeStyle = colour("s0");
    ctx.globalAlpha = 0.13;
    ctx.fill();
    ctx.globalAlpha = 0.8;
    ctx.lineWidth = 1;
    ctx.stroke();
    ctx.globalAlpha = 1;
  }

  arrow(ctx, here, nav) {
    ctx.save();
    ctx.translate(...this.place(here));
    ctx.beginPath();
    if (known(nav.yaw_deg)) {
      ctx.rotate(nav.yaw_deg * RAD);
      for (const [x, y] of [
        [0, -11],
        [7, 9],
        [0, 5],
        [-7, 9],
      ])
        ctx.lineTo(x, y);
    } else ctx.arc(0, 0, 5, 0, 2 * Math.PI);
    ctx.closePath();
    ctx.fillStyle = colour("ink");
    ctx.strokeStyle = colour("card");
    ctx.lineWidth = 1.5;
    ctx.fill();
    ctx.stroke();
    ctx.restore();
  }

  // Scale, north, and what the ellipse is.
  bar(ctx) {
    const step = niceStep(60 / this.scale),
      pixels = step * this.scale,
      y = this.height - 12;
    ctx.strokeStyle = ctx.fillStyle = colour("quiet");
    ctx.lineWidth = 1.5;
    ctx.beginPath();
    ctx.moveTo(12.5, y - 5);
    ctx.lineTo(12.5, y);
    ctx.lineTo(12.5 + pixels, y);
    ctx.lineTo(12.5 + pixels, y - 5);
    ctx.stroke();
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    ctx.fillText(length(step), 18 + pixels, y + 1);
    ctx.textAlign = "right";
    ctx.fillText("ellipse 2 sigma", this.width - 10, y + 1);
    ctx.textAlign = "center";
    ctx.fillText("N", this.width - 16, 30);
    ctx.beginPath();
    ctx.moveTo(this.width - 16, 6);
    ctx.lineTo(this.width - 12, 18);
    ctx.lineTo(this.width - 20, 18);
    ctx.fill();
  }
}
