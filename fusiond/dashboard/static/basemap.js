// The land below the track, from a file that the dashboard serves: tiles of images or of shapes.
import { drawTile } from "./mvt.js";
import { Archive } from "./pmtiles.js";
import { colour, forgotten } from "./text.js";

const RAD = Math.PI / 180;
const EQUATOR_M = 40075016.7; // of the Web Mercator's sphere
const TILE = 256; // pixels of a tile at the scale it is made for
const DRAWN = 1024; // pixels of a tile that is drawn from shapes: sharp up to four times larger
const MOST_TILES = 128; // some screens full of them
const MOST_ON_SCREEN = 64;

const lonOf = (x, z) => (x / 2 ** z) * 360 - 180;
const latOf = (y, z) => Math.atan(Math.sinh(Math.PI * (1 - (2 * y) / 2 ** z))) / RAD;
const column = (lon, z) => ((lon + 180) / 360) * 2 ** z;
const row = (lat, z) => ((1 - Math.asinh(Math.tan(lat * RAD)) / Math.PI) / 2) * 2 ** z;

export class BaseMap {
  // `changed` is called when there is more to draw.
  constructor(url, changed) {
    Object.assign(this, { archive: new Archive(url), changed, tiles: new Map(), fault: "" });
    this.ready = this.archive.open().then(
      (there) => {
        if (there) changed();
        return there;
      },
      (error) => this.failed(error),
    );
    this.ready.then((there) => (this.there = there));
  }

  failed(error) {
    this.fault = `map: ${error.message}`;
    this.changed();
    return false;
  }

  // `corners`: south, west, north, east in degrees of what is seen; `scale` in pixels a metre;
  // `place` makes a point on the canvas of a latitude and a longitude.
  draw(ctx, [south, west, north, east], scale, place) {
    if (!this.there) return;
    const archive = this.archive,
      metres = EQUATOR_M * Math.cos(((south + north) / 2) * RAD);
    const wanted = Math.round(Math.log2((metres * scale) / TILE));
    const z = Math.min(archive.most, Math.max(archive.least, wanted)),
      last = 2 ** z - 1;
    const within = (n) => Math.min(last, Math.max(0, Math.floor(n)));
    const [x0, x1] = [within(column(west, z)), within(column(east, z))];
    const [y0, y1] = [within(row(north, z)), within(row(south, z))];
    if ((x1 - x0 + 1) * (y1 - y0 + 1) > MOST_ON_SCREEN) return; // farther out than the map goes
    for (let x = x0; x <= x1; x++)
      for (let y = y0; y <= y1; y++) {
        const image = this.image(z, x, y);
        if (!image) continue;
        const [left, top] = place(latOf(y, z), lonOf(x, z));
        const [right, bottom] = place(latOf(y + 1, z), lonOf(x + 1, z));
        ctx.drawImage(image, left, top, right - left, bottom - top);
      }
  }

  get attribution() {
    return this.there ? this.archive.attribution : this.fault;
  }

  // What is drawn of a tile, null while it is on its way and where there is none.
  image(z, x, y) {
    const key = `${z}/${x}/${y}/${forgotten()}`; // shapes are drawn anew by night
    if (!this.tiles.has(key)) {
      this.tiles.set(key, null);
      if (this.tiles.size > MOST_TILES) this.tiles.delete(this.tiles.keys().next().value);
      this.made(z, x, y).then(
        (image) => {
          this.tiles.set(key, image);
          if (image) this.changed();
        },
        (error) => this.failed(error),
      );
    }
    return this.tiles.get(key);
  }

  async made(z, x, y) {
    const bytes = await this.archive.tile(z, x, y);
    if (!bytes || !bytes.length) return null;
    if (this.archive.kind !== "mvt")
      return createImageBitmap(new Blob([bytes], { type: `image/${this.archive.kind}` }));
    const canvas = new OffscreenCanvas(DRAWN, DRAWN),
      ctx = canvas.getContext("2d");
    ctx.font = `${DRAWN / 20}px sans-serif`;
    ctx.fillStyle = colour("card");
    ctx.fillRect(0, 0, DRAWN, DRAWN);
    drawTile(ctx, bytes, DRAWN);
    return canvas;
  }
}
