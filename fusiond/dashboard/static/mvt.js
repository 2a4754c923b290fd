// A vector tile (Mapbox Vector Tile 2.1, protocol buffers) drawn onto a canvas: water, greens,
// houses, roads and names of places, told by the layers' names that OpenMapTiles, Shortbread and
// Protomaps have.
import { colour } from "./text.js";

const LINE = 2,
  POLYGON = 3;
const MOVE = 1,
  DRAW = 2; // commands of a geometry; 7 closes a ring
// Layer names, the colour and, of lines, the width in pixels; drawn in this order.
const STYLE = [
  [/^(landcover|landuse|land|park|parks|natural|earth_cover)$/, "land", 0],
  [/^(water|ocean|water_polygons|waterway|water_lines)$/, "water", 1.5],
  [/^(buildings?)$/, "house", 0],
  [/^(transportation|roads?|streets?|highways?)$/, "road", 2],
  [/^(boundar(y|ies))$/, "quiet", 1],
];

class Reader {
  constructor(bytes) {
    Object.assign(this, { bytes, at: 0, end: bytes.length });
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  }

  number() {
    for (let value = 0, weight = 1; ; weight *= 128) {
      if (this.at >= this.end) throw new Error("a tile of the map is cut short");
      const byte = this.bytes[this.at++];
      value += (byte & 127) * weight;
      if (byte < 128) return value;
    }
  }

  part() {
    const length = this.number();
    this.at += length;
    return new Reader(this.bytes.subarray(this.at - length, this.at));
  }

  text() {
    return new TextDecoder().decode(this.part().bytes);
  }

  numbers() {
    const inner = this.part(),
      found = [];
    while (inner.at < inner.end) found.push(inner.number());
    return found;
  }

  // Calls what `fields` has for each field's number, skips the rest by its wire type.
  each(fields) {
    while (this.at < this.end) {
      const key = this.number(),
        take = fields[key >> 3];
      if (take) take();
      else if ((key & 7) === 0) this.number();
      else if ((key & 7) === 2) this.part();
      else this.at += (key & 7) === 1 ? 8 : 4;
    }
    return this;
  }
}

function layerOf(reader) {
  const layer = { name: "", extent: 4096, features: [], keys: [], values: [] };
  reader.each({
    1: () => (layer.name = reader.text()),
    2: () => layer.features.push(reader.part()),
    3: () => layer.keys.push(reader.text()),
    4: () => {
      const value = reader.part();
      let text = null;
      value.each({ 1: () => (text = value.text()) });
      layer.values.push(text); // of the values only names are read
    },
    5: () => (layer.extent = reader.number()),
  });
  return layer;
}

function featureOf(reader) {
  const feature = { tags: [], kind: 0, geometry: [] };
  reader.each({
    2: () => (feature.tags = reader.numbers()),
    3: () => (feature.kind = reader.number()),
    4: () => (feature.geometry = reader.numbers()),
  });
  return feature;
}

// A path of a geometry; its coordinates are differences, the sign in the lowest bit.
function pathOf(geometry, scale) {
  const path = new Path2D(),
    signed = (n) => (n & 1 ? -(n + 1) / 2 : n / 2);
  for (let k = 0, x = 0, y = 0; k < geometry.length; ) {
    const command = geometry[k] & 7,
      count = geometry[k++] >> 3;
    if (command !== MOVE && command !== DRAW) {
      path.closePath();
      continue;
    }
    for (let n = 0; n < count; n++) {
      x += signed(geometry[k++]);
      y += signed(geometry[k++]);
      if (command === MOVE) path.moveTo(x * scale, y * scale);
      else path.lineTo(x * scale, y * scale);
    }
  }
  return path;
}

export function drawTile(ctx, bytes, size) {
  const layers = [],
    tile = new Reader(bytes);
  tile.each({ 3: () => layers.push(layerOf(tile.part())) });
  for (const [names, paint, width] of STYLE)
    for (const layer of layers.filter((each) => names.test(each.name))) {
      ctx.fillStyle = ctx.strokeStyle = colour(paint);
      for (const feature of layer.features.map(featureOf)) {
        const path = pathOf(feature.geometry, size / layer.extent);
        ctx.lineWidth = width * (size / 256);
        if (feature.kind === POLYGON) ctx.fill(path, "evenodd");
        else if (feature.kind === LINE && width) ctx.stroke(path);
      }
    }
  ctx.fillStyle = colour("quiet");
  ctx.textAlign = "center";
  for (const layer of layers.filter((each) => /^(places?|place_labels)$/.test(each.name)))
    for (const feature of layer.features.map(featureOf)) named(ctx, layer, feature, size);
}

function named(ctx, layer, { tags, geometry }, size) {
  for (let k = 0; k + 1 < tags.length; k += 2)
    if (layer.keys[tags[k]] === "name" && geometry.length >= 3) {
      const [x, y] = geometry.slice(1, 3).map((n) => (n & 1 ? -(n + 1) / 2 : n / 2));
      const scale = size / layer.extent;
      ctx.fillText(layer.values[tags[k + 1]] || "", x * scale, y * scale);
    }
}
