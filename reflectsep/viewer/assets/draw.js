// Drawing: every pane is a rectangle of the canvas in which one quantity of one result is shown.
let gl, program, places, slow_drag = false;

function fail(text) {
  element("failure").textContent = text;
  element("failure").hidden = false;
}

function start_drawing() {
  const canvas = element("picture");
  gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false });
  if (!gl) { fail("This page needs WebGL 2, which this browser or computer does not offer."); return false; }
  if (typeof DecompressionStream === "undefined") { fail("This page needs a browser of 2023 or later (DecompressionStream)."); return false; }
  canvas.addEventListener("webglcontextlost", event => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => { cache.clear(); used = 0; compile(); refresh(); });
  compile();
  return true;
}

const programs = new Map();
function compile() {
  programs.clear();
  blank = make_texture(new Uint8Array(1), 1, 1, 1, 1);
}

// The program for so many channels and lights and one quantity, made when first needed.
function use_program(channels, lights, show) {
  const key = `${channels} ${lights} ${show}`;
  if (!programs.has(key)) programs.set(key, built(`#define CHANNELS ${channels}\n#define LIGHTS ${lights}\n#define SHOW ${show}\n`));
  [program, places] = programs.get(key);
  gl.useProgram(program);
  gl.uniform1i(places.planes, 0);
  gl.uniform1i(places.measured, 1);
}
function built(defines) {
  const vertex = "void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }";
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, defines + element("shader").textContent]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, "#version 300 es\n" + text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) fail("The shader does not compile here: " + gl.getShaderInfoLog(shader));
  }
  gl.linkProgram(made);
  return [made, new Proxy({}, { get: (known, name) => known[name] ??= gl.getUniformLocation(made, name) })];
}
let blank = null;

// codes: Uint16Array of half floats, four to a texel, or Uint8Array, one or three to a texel
function make_texture(codes, layers, wide, width, height) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const [inner, outer, type] = codes instanceof Uint16Array ? [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT]
    : wide === 3 ? [gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE] : [gl.R8, gl.RED, gl.UNSIGNED_BYTE];
  gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, inner, width, height, layers, 0, outer, type, codes);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, side, gl.NEAREST);
  return texture;
}

// Panes of a canvas of the given size: what they show and where, in window pixels from the lower left.
function panes(width, height) {
  const a = { result: state.r1, show: state.show, rect: [0, 0, width, height], clip: [0, 0, width, height] };
  const b = { ...a, result: state.r2, show: state.show2, second: true };
  if (state.layout === "pair") {
    const half_width = Math.floor(width / 2);
    a.rect = a.clip = [0, 0, half_width, height];
    b.rect = b.clip = [half_width, 0, width - half_width, height];
  } else if (state.layout === "split") {
    const x = Math.round(state.cut * width);
    a.clip = [0, 0, x, height];
    b.clip = [x, 0, width - x, height];
  } else if (state.layout === "lens") {
    const r = state.lr * Math.min(width, height), x = state.lx * width, y = (1 - state.ly) * height;
    b.clip = [Math.floor(x - r), Math.floor(y - r), Math.ceil(2 * r) + 1, Math.ceil(2 * r) + 1];
    b.lens = [x, y, r, 1];
  }
  return state.layout === "single" ? [a] : [a, b];
}

// [left, top, right, bottom] of the objects of all results, in pixels of the first.
function box_of_all() {
  const boxes = PAGE.results.map(result => result.box.map(v => v * PAGE.results[0].width / result.width));
  return [0, 1, 2, 3].map(k => Math[k < 2 ? "min" : "max"](...boxes.map(box => box[k])));
}
// Window pixels a pixel of the first result: what the state says, or what makes it fit.
function zoom_in(rect) {
  const [left, top, right, bottom] = box_of_all();
  return state.zoom || Math.min(rect[2] / (right - left), rect[3] / (bottom - top));
}
// Place of the first result in the middle of a pane, 0 to 1 across and down: what the state says, or the object's.
function middle_of_view() {
  const { width, height } = PAGE.results[0], [left, top, right, bottom] = box_of_all();
  return state.zoom ? [state.cx, state.cy] : [(left + right) / 2 / width, (top + bottom) / 2 / height];
}

// picture = offset + window * step, in pixels of the first result, y downwards
function geometry(rect, zoom) {
  const { width, height } = PAGE.results[0];
  const [cx, cy] = middle_of_view();
  let x = cx * width - (rect[0] + rect[2] / 2) / zoom;
  let y = cy * height + (rect[1] + rect[3] / 2) / zoom;
  if (zoom === 1) { x = Math.round(x); y = Math.round(y); }  // pixel on pixel
  return { offset: [x, y], step: [1 / zoom, -1 / zoom] };
}

function draw_pane(pane, zoom, at, exact) {
  const about = PAGE.results[pane.result];
  const ratio = PAGE.results[0].width / about.width;  // a second result of another size is shown as large
  let depth = 0;
  while (depth + 1 < about.levels.length && about.levels[depth + 1].factor * ratio * zoom <= 1.0001) depth++;
  // The measured pictures are there at the finest level alone.
  if (pane.show === "measured") depth = 0;
  const wanted = tiles_seen(pane, about.levels[depth], about.levels[depth].factor * ratio, at);
  const missing = wanted.some(([i, j]) => !tile_for(pane, depth, i, j));
  const last = about.levels.length - 1;
  set_pane(pane, about);
  if (missing && depth < last && pane.show !== "measured") {
    for (const [i, j] of tiles_seen(pane, about.levels[last], about.levels[last].factor * ratio, at)) draw_tile(pane, last, i, j, ratio, at, false);
  }
  const unit = about.levels[depth].factor * ratio * zoom;
  const smoothed = !exact && state.smooth === 1 && !slow_drag && Math.abs(unit - 1) > 1e-6;
  for (const [i, j] of wanted) draw_tile(pane, depth, i, j, ratio, at, smoothed);
  return !missing;
}
const tile_for = (pane, depth, i, j) =>
  pane.show === "measured" ? tile_of(pane.result, depth, i, j) && measured_of(pane.result, i, j) : tile_of(pane.result, depth, i, j);

function tiles_seen(pane, level, unit, at) {
  const seen = [], [x, y, w, h] = pane.clip;
  const left = (at.offset[0] + x * at.step[0]) / unit, right = (at.offset[0] + (x + w) * at.step[0]) / unit;
  const top = (at.offset[1] + (y + h) * at.step[1]) / unit, bottom = (at.offset[1] + y * at.step[1]) / unit;
  const last_i = Math.ceil(level.width / PAGE.tile) - 1, last_j = Math.ceil(level.height / PAGE.tile) - 1;
  for (let j = Math.max(0, Math.floor(top / PAGE.tile)); j <= Math.min(last_j, Math.floor(bottom / PAGE.tile)); j++)
    for (let i = Math.max(0, Math.floor(left / PAGE.tile)); i <= Math.min(last_i, Math.floor(right / PAGE.tile)); i++) seen.push([i, j]);
  return seen;
}

function set_pane(pane, about) {
  const on = lights_on(pane.result), g = about.globals;
  use_program(about.channels, on.length, SHOWN[pane.show][0]);
  gl.uniform3fv(places.alpha, [...on[0].alpha, ...(on[1] || on[0]).alpha]);
  gl.uniform1fv(places.power, [on[0].power, (on[1] || on[0]).power]);
  gl.uniform3f(places.globals, g.n_d, g.softness, g.fresnel);
  gl.uniform1i(places.ggx, about.ggx ? 1 : 0);
  // Rows of M become columns: the shader multiplies from the left.
  gl.uniformMatrix3fv(places.M, false, about.M.flat());
  const kinds = [0, 1, 2, 3].map(k => Math.min(k, about.materials.length - 1));
  // A chosen n_s stands for that of the first material; the others keep their ratio to it.
  const gloss = (state.ns || g.n_s) / g.n_s;
  gl.uniform1fv(places.exponents, kinds.map(k => gloss * about.materials[k][1]));
  gl.uniform1fv(places.ceilings, kinds.map(k => about.ceilings[k] ?? 1e30));
  gl.uniform1f(places.root_scale, about.scale[0]);
  gl.uniform1f(places.lobe_scale, about.scale[1]);
  // Faders scale light, and light is the n_d-th power of the roots.
  gl.uniform3f(places.faders, state.spec, state.loc ** (1 / g.n_d), state.scat ** (1 / g.n_d));
  gl.uniform1i(places.measured_light, Math.max(0, measured_index(pane.result)));
  gl.uniform1f(places.measured_white, about.measured ? about.measured.white : 1);
  const flag = about.flag_values[state.flag] || 0, base = 2 ** PAGE.flag_bits;
  gl.uniform1i(places.flag_low, flag % base);
  gl.uniform1i(places.flag_high, Math.floor(flag / base));
  gl.uniform1f(places.flag_base, base);
  // One exposure for both results, so that they can be compared.
  gl.uniform1f(places.gain, 2 ** state.ev / PAGE.results[0].white);
  gl.uniform1f(places.B_gain, 0.5 / about.scale[1]);
  gl.uniform1i(places.curve, { srgb: 0, shoulder: 1, linear: 2 }[state.tone]);
  gl.uniform4fv(places.lens, pane.lens || [0, 0, 0, 0]);
}

function draw_tile(pane, depth, i, j, ratio, at, smoothed) {
  const level = PAGE.results[pane.result].levels[depth], unit = level.factor * ratio, T = PAGE.tile;
  const held = tile_of(pane.result, depth, i, j);
  const photo = pane.show === "measured" ? measured_of(pane.result, i, j) : null;
  if (!held || (pane.show === "measured" && !photo)) return;
  const wide = Math.min(T, level.width - i * T), high = Math.min(T, level.height - j * T);
  // The tile in the window, one pixel wider: the shader cuts it exactly.
  const x0 = (i * T * unit - at.offset[0]) / at.step[0], x1 = ((i * T + wide) * unit - at.offset[0]) / at.step[0];
  const y1 = (j * T * unit - at.offset[1]) / at.step[1], y0 = ((j * T + high) * unit - at.offset[1]) / at.step[1];
  const left = Math.max(pane.clip[0], Math.floor(x0) - 1), right = Math.min(pane.clip[0] + pane.clip[2], Math.ceil(x1) + 1);
  const low = Math.max(pane.clip[1], Math.floor(y0) - 1), top = Math.min(pane.clip[1] + pane.clip[3], Math.ceil(y1) + 1);
  if (right <= left || top <= low) return;
  gl.scissor(left, low, right - left, top - low);
  gl.uniform4f(places.place, at.offset[0] / unit, at.offset[1] / unit, at.step[0] / unit, at.step[1] / unit);
  gl.uniform4i(places.tile, i * T, j * T, wide, high);
  gl.uniform2i(places.held, held.width, held.height);
  gl.uniform1i(places.smoothed, smoothed ? 1 : 0);
  gl.activeTexture(gl.TEXTURE1);
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, photo ? photo.texture : blank);
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, held.texture);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
}

// Draw everything; true where nothing is missing.
function draw() {
  const canvas = element("picture");
  const width = Math.max(1, Math.round(canvas.clientWidth * devicePixelRatio));
  const height = Math.max(1, Math.round(canvas.clientHeight * devicePixelRatio));
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  stamp++;
  gl.viewport(0, 0, width, height);
  gl.enable(gl.SCISSOR_TEST);
  let whole = true;
  for (const pane of panes(width, height)) {
    const zoom = zoom_in(pane.rect);
    gl.scissor(...pane.clip);
    gl.clearColor(0, 0, 0, 1);
    if (!pane.lens) gl.clear(gl.COLOR_BUFFER_BIT);
    whole = draw_pane(pane, zoom, geometry(pane.rect, zoom), false) && whole;
  }
  if (state.layout === "split" || state.layout === "pair") {
    const x = state.layout === "pair" ? Math.floor(width / 2) : Math.round(state.cut * width);
    gl.scissor(x - 1, 0, 2, height);
    gl.clearColor(1, 0.69, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }
  make_room();
  return whole;
}

// The first pane at the finest level, pixel for pixel, as ImageData.
async function full_picture() {
  const about = PAGE.results[state.r1], level = about.levels[0], { width, height } = level;
  if (Math.max(width, height) > gl.getParameter(gl.MAX_RENDERBUFFER_SIZE)) throw new Error(`${width} x ${height} pixels are more than this graphics card draws at once`);
  const unit = level.factor * PAGE.results[0].width / about.width;
  const pane = { result: state.r1, show: state.show, rect: [0, 0, width, height], clip: [0, 0, width, height] };
  const at = { offset: [0, height * unit], step: [unit, -unit] };
  const buffer = gl.createFramebuffer(), store = gl.createRenderbuffer();
  gl.bindRenderbuffer(gl.RENDERBUFFER, store);
  gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
  const out = new ImageData(width, height), rows = new Uint8Array(4 * width * height);
  for (let whole = false; !whole;) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, store);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, 0, width, height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    whole = draw_pane(pane, 1 / unit, at, true);
    if (whole) gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rows);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    if (!whole) await new Promise(done => setTimeout(done, 20));
  }
  for (let y = 0; y < height; y++) out.data.set(rows.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
  gl.deleteFramebuffer(buffer);
  gl.deleteRenderbuffer(store);
  return out;
}
