// The way from above on a metric grid: drag to move, wheel to zoom; what is out of view is pale.
"use strict";
const RAMP = ["#3b4cc0", "#2f8fbf", "#35b779", "#d8c02c", "#e8743b", "#c2185b"];
const tracks = [];

function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= least);
}

function metres(v) {
  return Math.abs(v) >= 10000 ? v / 1000 + " km" : +v.toFixed(3) + " m";
}

class Track {
  constructor(item, run, parent) {
    this.run = run;
    for (const key of ["t", "north", "east", "sd_n", "sd_e", "mode"]) this[key] = floats(item[key]);
    this.truth = item.truth.map(floats);
    this.by = "mode";
    this.sigma = this.sd_n.map((n, k) => Math.hypot(n, this.sd_e[k]));
    const known = this.sigma.filter((s) => s > 0).sort((a, b) => a - b);
    this.ends = known.length ? [known[Math.floor(0.02 * known.length)], known[Math.floor(0.98 * known.length)]] : null;
    this.tools(parent);
    this.canvas = parent.appendChild(element("canvas"));
    this.listen();
    this.fit();
    tracks.push(this);
  }

  tools(parent) {
    const bar = parent.appendChild(element("div", "tools"));
    const buttons = [];
    for (const by of this.ends ? ["mode", "sigma"] : ["mode"]) {
      const button = bar.appendChild(element("button", "", "by " + by));
      button.onclick = () => {
        this.by = by;
        for (const b of buttons) b.setAttribute("aria-pressed", b === button);
        this.legend();
        this.draw();
      };
      buttons.push(button);
    }
    buttons[0].setAttribute("aria-pressed", true);
    bar.appendChild(element("button", "", "all of it")).onclick = () => { this.fit(); this.draw(); };
    this.note = bar.appendChild(element("span", "quiet"));
    this.legend();
  }

  legend() {
    const sigma = this.ends && `horizontal sigma ${figure(this.ends[0])} m (blue) to ${figure(this.ends[1])} m (red)`;
    this.note.textContent = this.by === "sigma" ? sigma : "colours of the modes as above";
  }

  fit() {
    const bounds = (a, b) => {
      const values = a.concat(b).filter(Number.isFinite);
      const low = values.reduce((x, y) => Math.min(x, y), Infinity);
      const high = values.reduce((x, y) => Math.max(x, y), -Infinity);
      return [low, high];
    };
    const [south, north] = bounds(this.north, this.truth[0]);
    const [west, east] = bounds(this.east, this.truth[1]);
    this.centre = [(west + east) / 2, (south + north) / 2];
    this.span = [Math.max(east - west, 10), Math.max(north - south, 10)];
    this.scale = null; // by the canvas' size, when it is drawn
  }

  listen() {
    const c = this.canvas;
    let held = null;
    c.onpointerdown = (e) => { held = [e.clientX, e.clientY]; c.setPointerCapture(e.pointerId); };
    c.onpointerup = () => { held = null; };
    c.onpointermove = (e) => {
      if (!held) return;
      this.centre[0] -= (e.clientX - held[0]) / this.scale;
      this.centre[1] += (e.clientY - held[1]) / this.scale;
      held = [e.clientX, e.clientY];
      this.draw();
    };
    c.addEventListener("wheel", (e) => {
      e.preventDefault();
      const factor = 1.15 ** (e.deltaY < 0 ? 1 : -1);
      const x = e.offsetX - this.width / 2, y = this.height / 2 - e.offsetY;
      this.centre[0] += (x / this.scale) * (1 - 1 / factor);
      this.centre[1] += (y / this.scale) * (1 - 1 / factor);
      this.scale *= factor;
      this.draw();
    }, { passive: false });
  }

  place(east, north) {
    return [
      this.width / 2 + (east - this.centre[0]) * this.scale,
      this.height / 2 - (north - this.centre[1]) * this.scale,
    ];
  }

  draw() {
    const c = this.canvas, ratio = devicePixelRatio || 1;
    this.width = c.parentNode.clientWidth;
    this.height = Math.round(Math.min(560, Math.max(300, 0.55 * this.width)));
    c.style.height = this.height + "px";
    c.width = this.width * ratio;
    c.height = this.height * ratio;
    if (this.scale === null)
      this.scale = 0.88 * Math.min(this.width / this.span[0], this.height / this.span[1]);
    const ctx = c.getContext("2d");
    ctx.scale(ratio, ratio);
    this.grid(ctx);
    this.line(ctx, this.truth[1], this.truth[0], () => colour("truth"), 6);
    this.ellipses(ctx);
    const colours = this.colours();
    this.line(ctx, this.east, this.north, (k) => colours[k], 2.2, this.t);
    this.here(ctx);
  }

  grid(ctx) {
    const step = niceStep(80 / this.scale);
    ctx.font = "11px system-ui, sans-serif";
    ctx.lineWidth = 1;
    ctx.strokeStyle = colour("grid");
    ctx.fillStyle = colour("quiet");
    const half = [this.width / 2 / this.scale, this.height / 2 / this.scale];
    for (let e = Math.ceil((this.centre[0] - half[0]) / step) * step; e < this.centre[0] + half[0]; e += step) {
      const [x] = this.place(e, 0);
      ctx.beginPath(); ctx.moveTo(x, 0); ctx.lineTo(x, this.height); ctx.stroke();
      ctx.fillText(metres(e), x + 3, this.height - 4);
    }
    for (let n = Math.ceil((this.centre[1] - half[1]) / step) * step; n < this.centre[1] + half[1]; n += step) {
      const [, y] = this.place(0, n);
      ctx.beginPath(); ctx.moveTo(0, y); ctx.lineTo(this.width, y); ctx.stroke();
      if (y < this.height - 20) ctx.fillText(metres(n), 3, y - 3);
    }
    ctx.fillText("east →   north ↑   from the first position", this.width - 240, 14);
  }

  colours() {
    if (this.by === "mode") {
      const named = doc.modes.map((mode) => colour("m-" + mode));
      return this.mode.map((m) => named[m] || colour("s0"));
    }
    const [low, high] = this.ends.map(Math.log);
    return this.sigma.map((s) => {
      if (!(s > 0)) return colour("quiet");
      const part = high > low ? (Math.log(s) - low) / (high - low) : 0;
      return RAMP[Math.round(Math.min(1, Math.max(0, part)) * (RAMP.length - 1))];
    });
  }

  // A line in stretches of one colour and paleness.
  line(ctx, east, north, colourOf, width, t) {
    const pale = (k) => t !== undefined && (t[k] < view.from || t[k] > view.to);
    ctx.lineWidth = width;
    ctx.lineJoin = "round";
    let last = null, key = null;
    const end = () => { if (key !== null) ctx.stroke(); key = null; };
    for (let k = 0; k < east.length; k++) {
      if (!Number.isFinite(east[k] + north[k])) { end(); last = null; continue; }
      const [x, y] = this.place(east[k], north[k]);
      const now = colourOf(k) + pale(k);
      if (now !== key || last === null) {
        end();
        key = now;
        ctx.strokeStyle = colourOf(k);
        ctx.globalAlpha = pale(k) ? 0.22 : 1;
        ctx.beginPath();
        ctx.moveTo(...(last || [x, y]));
      }
      ctx.lineTo(x, y);
      last = [x, y];
    }
    end();
    ctx.globalAlpha = 1;
  }

  // Two sigma, at least 36 pixels apart, where they can be seen.
  ellipses(ctx) {
    let last = null;
    ctx.lineWidth = 1;
    for (let k = 0; k < this.t.length; k++) {
      const [x, y] = this.place(this.east[k], this.north[k]);
      if (last && Math.hypot(x - last[0], y - last[1]) < 36) continue;
      if (x < 0 || y < 0 || x > this.width || y > this.height) continue;
      const a = 2 * this.sd_e[k] * this.scale, b = 2 * this.sd_n[k] * this.scale;
      if (!(Math.max(a, b) > 2.5)) continue;
      last = [x, y];
      ctx.beginPath();
      ctx.ellipse(x, y, a, b, 0, 0, 2 * Math.PI);
      ctx.strokeStyle = ctx.fillStyle = colour("s3");
      ctx.globalAlpha = 0.1;
      ctx.fill();
      ctx.globalAlpha = 0.55;
      ctx.stroke();
    }
    ctx.globalAlpha = 1;
  }

  // Where the cursor of the plots is.
  here(ctx) {
    if (view.cursor === null) return;
    let k = this.t.findIndex((t) => t >= view.cursor);
    if (k < 0) return;
    const [x, y] = this.place(this.east[k], this.north[k]);
    ctx.beginPath();
    ctx.arc(x, y, 6, 0, 2 * Math.PI);
    ctx.lineWidth = 2;
    ctx.strokeStyle = colour("ink");
    ctx.stroke();
  }
}

let due = false;
function redrawTracks() {
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    for (const track of tracks) track.draw();
  });
}
view.listeners.push(redrawTracks);
document.addEventListener("mousemove", redrawTracks);
