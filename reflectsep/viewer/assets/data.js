// The results, and their tiles: unpacked when first needed, kept on the graphics card while there is room.
const PAGE = JSON.parse(element("data").textContent);
const ROOM = 600e6;  // bytes of textures that are kept
const cache = new Map();
let used = 0, stamp = 0;

async function unpacked(id, planes, width, height, size) {
  const text = atob(element(id).textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const raw = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = planes * width * height;
  if (raw.length !== count * size) throw new Error(`${id}: ${raw.length} bytes, expected ${count * size}`);
  const codes = size === 2 ? new Uint16Array(count) : new Uint8Array(count);
  const mask = size === 2 ? 0xffff : 0xff;
  for (let row = 0, i = 0; row < planes * height; row++) {
    let value = 0;
    for (let x = 0; x < width; x++, i++) {
      const step = size === 2 ? raw[i] | raw[count + i] << 8 : raw[i];
      codes[i] = value = value + step & mask;
    }
  }
  return codes;
}

// planes of one pixel stand side by side in a texture, `wide` to a layer
function interleaved(codes, layers, wide, width, height) {
  const out = new codes.constructor(codes.length);
  const area = width * height;
  for (let layer = 0; layer < layers; layer++) for (let k = 0; k < wide; k++) {
    const from = (layer * wide + k) * area, to = layer * area * wide + k;
    for (let i = 0; i < area; i++) out[to + i * wide] = codes[from + i];
  }
  return out;
}

function half(code) {
  const sign = code & 0x8000 ? -1 : 1, exponent = code >> 10 & 31, fraction = code & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  return exponent === 31 ? (fraction ? NaN : sign * Infinity) : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

function tile_size(level, i, j) {
  const whole = PAGE.tile + PAGE.apron;
  return [Math.min(whole, level.width - i * PAGE.tile), Math.min(whole, level.height - j * PAGE.tile)];
}

// The tile if it is there; if not, it is sent for and drawn when it has come.
function tile_of(result, depth, i, j) {
  const id = `r${result}-${depth}-${i}-${j}`;
  const kept = cache.get(id);
  if (kept) { kept.stamp = stamp; return kept.texture ? kept : null; }
  const [width, height] = tile_size(PAGE.results[result].levels[depth], i, j);
  const layers = 2 * PAGE.results[result].channels + 1;
  send_for(id, unpacked(id, 4 * layers, width, height, 2).then(codes => {
    const pixels = interleaved(codes, layers, 4, width, height);
    return [make_texture(pixels, layers, 4, width, height), { pixels, layers, width, height }, pixels.byteLength];
  }));
  return null;
}

function measured_of(result, i, j) {
  const id = `m${result}-${i}-${j}`, about = PAGE.results[result];
  const kept = cache.get(id);
  if (kept) { kept.stamp = stamp; return kept.texture ? kept : null; }
  const [width, height] = tile_size(about.levels[0], i, j);
  const layers = about.measured.lights.length, wide = about.channels;
  const parts = about.measured.lights.map((_, k) => unpacked(`m${result}-${k}-${i}-${j}`, wide, width, height, 1));
  send_for(id, Promise.all(parts).then(all => {
    const pixels = new Uint8Array(layers * wide * width * height);
    all.forEach((codes, k) => pixels.set(interleaved(codes, 1, wide, width, height), k * codes.length));
    return [make_texture(pixels, layers, wide, width, height), { width, height }, pixels.byteLength];
  }));
  return null;
}

let waiting = 0;
function send_for(id, promise) {
  const entry = { stamp };
  cache.set(id, entry);
  waiting++;
  promise.then(([texture, about, bytes]) => {
    Object.assign(entry, about, { texture, bytes });
    used += bytes;
  }).catch(error => fail(`This page is damaged: ${error.message}`)).finally(() => { waiting--; refresh(); });
}

function make_room() {
  if (used < ROOM) return;
  const old = [...cache].filter(([, e]) => e.texture && e.stamp < stamp - 1).sort((a, b) => a[1].stamp - b[1].stamp);
  for (const [id, entry] of old) {
    if (used < 0.8 * ROOM) break;
    gl.deleteTexture(entry.texture);
    used -= entry.bytes;
    cache.delete(id);
  }
}

// Parameters of the pixel (x, y) of the finest level: numbers, or null while they load or off the picture.
function pixel_of(result, x, y) {
  const about = PAGE.results[result], level = about.levels[0];
  if (!(x >= 0 && y >= 0 && x < level.width && y < level.height)) return null;
  const i = Math.floor(x / PAGE.tile), j = Math.floor(y / PAGE.tile), held = tile_of(result, 0, i, j);
  if (!held) return null;
  const at = (layer, k) => half(held.pixels[4 * ((layer * held.height + y - j * PAGE.tile) * held.width + x - i * PAGE.tile) + k]);
  const C = about.channels, high = at(2 * C, 3), base = 2 ** PAGE.flag_bits;
  const d = [], s = [];
  for (let c = 0; c < C; c++) {
    d.push([0, 1, 2].map(k => about.scale[0] * at(c, k)));
    s.push([0, 1, 2].map(k => about.scale[0] * at(C + c, k)));
  }
  const bits = at(C, 3) + base * (high % base);
  const flags = Object.keys(about.flag_values).filter(name => bits & about.flag_values[name]);
  return { x: x * level.factor, y: y * level.factor, d, s, w: [0, 1, 2].map(k => at(2 * C, k)), B: about.scale[1] * at(0, 3), flags, inside: high >= base, material: (high >> 6) & 3 };
}
