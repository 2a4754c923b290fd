// A map's tiles in one file, read by ranges: PMTiles 3
// (github.com/protomaps/PMTiles, spec/v3/spec.md). Numbers are little-endian.
const FIRST_BYTES = 16384; // the header and the root directory lie within
const NONE = 1,
  GZIP = 2; // of the compressions; a browser has no brotli and no zstd for us
const KINDS = ["unknown", "mvt", "png", "jpeg", "webp", "avif"];
const MOST_LEAVES = 3;

// Number of a tile along the Hilbert curve of its zoom, after all tiles of the zooms before.
export function tileId(z, x, y) {
  let id = (4 ** z - 1) / 3;
  for (let s = 2 ** z / 2; s >= 1; s /= 2) {
    const right = x & s ? 1 : 0,
      below = y & s ? 1 : 0;
    id += s * s * ((3 * right) ^ below);
    if (!below) {
      if (right) [x, y] = [s - 1 - x, s - 1 - y];
      [x, y] = [y, x];
    }
  }
  return id;
}

// The numbers of a directory: seven bits a byte, the lowest first.
function* varints(bytes) {
  let value = 0,
    weight = 1;
  for (const byte of bytes) {
    value += (byte & 127) * weight;
    weight *= 128;
    if (byte < 128) {
      yield value;
      [value, weight] = [0, 1];
    }
  }
}

function directory(bytes) {
  const numbers = varints(bytes),
    next = () => numbers.next().value;
  const entries = Array.from({ length: next() }, () => ({}));
  let id = 0;
  for (const entry of entries) entry.id = id += next();
  for (const entry of entries) entry.run = next();
  for (const entry of entries) entry.length = next();
  let end = 0;
  for (const entry of entries) {
    const offset = next();
    entry.offset = offset ? offset - 1 : end; // 0: right behind the entry before
    end = entry.offset + entry.length;
  }
  return entries;
}

// The entry that holds a tile or leads to it: the last that begins at or before it.
function entryOf(entries, id) {
  let [low, high] = [0, entries.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (entries[middle].id <= id) low = middle + 1;
    else high = middle;
  }
  const entry = entries[low - 1];
  return entry && (!entry.run || id < entry.id + entry.run) ? entry : null;
}

async function unpacked(bytes, compression) {
  if (compression === NONE) return bytes;
  if (compression !== GZIP) throw new Error(`compression ${compression} of the map is unknown`);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export class Archive {
  constructor(url) {
    Object.assign(this, { url, leaves: new Map() });
  }

  // False where no map is served; throws where the file is none.
  async open() {
    const answer = await this.get(0, FIRST_BYTES);
    if (!answer) return false;
    const view = new DataView(answer.buffer);
    const magic = new TextDecoder().decode(answer.subarray(0, 7));
    if (magic !== "PMTiles" || view.getUint8(7) !== 3) throw new Error("no PMTiles file of version 3");
    const at = (offset) => Number(view.getBigUint64(offset, true));
    Object.assign(this, { leavesAt: at(40), dataAt: at(56) });
    [this.packing, this.tilePacking] = [view.getUint8(97), view.getUint8(98)];
    this.kind = KINDS[view.getUint8(99)] || "unknown";
    [this.least, this.most] = [view.getUint8(100), view.getUint8(101)];
    this.root = directory(await unpacked(await this.part(answer, at(8), at(16)), this.packing));
    const about = await unpacked(await this.part(answer, at(24), at(32)), this.packing);
    const said = about.length ? JSON.parse(new TextDecoder().decode(about)) : {};
    this.attribution = String(said.attribution || "").replace(/<[^>]*>/g, "");
    return true;
  }

  async part(first, offset, length) {
    if (!length) return new Uint8Array();
    if (offset + length <= first.length) return first.subarray(offset, offset + length);
    return this.get(offset, length);
  }

  async get(offset, length) {
    const range = `bytes=${offset}-${offset + length - 1}`;
    const answer = await fetch(this.url, { headers: { range } });
    if (answer.status === 204) return null;
    if (answer.status !== 206) throw new Error(`map: ${answer.status} ${answer.statusText}`);
    return new Uint8Array(await answer.arrayBuffer());
  }

  // The bytes of a tile, null where the map has none.
  async tile(z, x, y) {
    const id = tileId(z, x, y);
    let entries = this.root;
    for (let depth = 0; depth <= MOST_LEAVES; depth++) {
      const entry = entryOf(entries, id);
      if (!entry) return null;
      if (entry.run) {
        const bytes = await this.get(this.dataAt + entry.offset, entry.length);
        return unpacked(bytes, this.tilePacking);
      }
      if (!this.leaves.has(entry.offset))
        this.leaves.set(
          entry.offset,
          this.get(this.leavesAt + entry.offset, entry.length).then(async (bytes) =>
            directory(await unpacked(bytes, this.packing)),
          ),
        );
      entries = await this.leaves.get(entry.offset);
    }
    throw new Error("the map's directories have no end");
  }
}
