// The panel: controls show the state and change it.
const round = (value, digits = 3) => Number.isFinite(value) ? Number(value.toPrecision(digits)).toString() : "not a number";
const times = value => `${value.toFixed(2)} \u00d7`;
const SLIDERS = {
  i1: [times, v => v], i2: [times, v => v], spec: [times, v => v], loc: [times, v => v], scat: [times, v => v],
  lr: [v => `${Math.round(100 * v)} %`, v => v], ev: [v => `${v > 0 ? "+" : ""}${v.toFixed(2)} EV`, v => v],
};

function fill(select, options) {
  select.replaceChildren(...options.map(([value, text]) => {
    const option = document.createElement("option");
    option.value = value;
    option.textContent = text;
    return option;
  }));
}

function start_panel() {
  const names = PAGE.results.map(result => result.name);
  element("title").textContent = names.join("  |  ");
  element("subtitle").textContent = PAGE.results[0].model;
  const scattered = PAGE.results.some(result => result.scattered);
  if (!scattered) {  // Lin & Lee's model: one diffuse part
    SHOWN.local[1] = "diffuse only";
    element("loc_label").textContent = "Diffuse";
    element("components_hint").textContent = "1 is as measured; highlight 0 removes it. Scattering was not measured here: the diffuse part holds it. Double-click a slider to set it back.";
  }
  element("row_scat").hidden = !scattered;
  const there = { measured: PAGE.results[0].measured, scattering: scattered };
  const shown = Object.entries(SHOWN).filter(([key]) => !(key in there) || there[key]).map(([key, [, text]]) => [key, text]);
  for (const id of ["show", "show2"]) {
    fill(element(id), shown);
    element(id).onchange = event => change({ [id]: event.target.value });
  }
  for (const id of ["r1", "r2"]) {
    fill(element(id), names.map((name, k) => [k, name]));
    element(id).hidden = names.length < 2;
    element(id).onchange = event => change({ [id]: Number(event.target.value) });
  }
  const lights = PAGE.results[0].lights;
  fill(element("captured"), [[-1, "(free)"], ...lights.map((light, k) => [k, light.name + (k < 3 ? " (basis)" : "")])]);
  element("captured").onchange = event => use_captured(Number(event.target.value));
  const counts = PAGE.results[0].flag_counts;
  fill(element("flag"), Object.keys(PAGE.flags).map(name => [name, `${PAGE.flags[name]} (${counts[name] || 0} pixels)`]));
  element("flag").onchange = event => change({ flag: event.target.value });
  element("tone").onchange = event => change({ tone: event.target.value });
  for (const id of Object.keys(SLIDERS)) {
    element(id).oninput = event => change({ [id]: Number(event.target.value), ...(id === "i1" && PAGE.results[0].basis ? { m: -1 } : {}) });
    element(id).ondblclick = () => change({ [id]: DEFAULTS[id] });
  }
  element("ns").oninput = event => change({ ns: Math.exp(Number(event.target.value)) });
  element("ns").ondblclick = () => change({ ns: 0 });
  for (const id of ["two", "smooth"]) element(id).onchange = event => change({ [id]: event.target.checked ? 1 : 0, ...(id === "two" ? { which: event.target.checked ? 2 : 1 } : {}) });
  for (const id of ["which", "layout", "mode"]) for (const button of element(id).children)
    button.onclick = () => change({ [id]: id === "which" ? Number(button.dataset.value) : button.dataset.value, ...(id === "layout" ? arranged(button.dataset.value) : {}) });
  element("zoom_in").onclick = () => zoom_by(1.25);
  element("zoom_out").onclick = () => zoom_by(0.8);
  element("zoom_fit").onclick = () => change({ zoom: 0 });
  element("zoom_one").onclick = () => change({ zoom: 1, ...(state.zoom ? {} : { cx: 0.5, cy: 0.5 }) });
  element("save_view").onclick = save_view;
  element("save_full").onclick = save_full;
  element("copy").onclick = copy_link;
  element("reset").onclick = () => change({ ...DEFAULTS });
  element("about").replaceChildren(...PAGE.results.map(about_result));
  if (!PAGE.results[0].basis) element("dome_hint").textContent = "The directions of the lights are unknown: a light is a mix of the three basis lights (blue dots). Drag it here or on the picture; arrow keys move it. Shaded: between the basis lights.";
}

// Two results that are compared show the same thing of each, unless told otherwise.
function arranged(layout) {
  if (PAGE.results.length < 2 || state.r1 !== state.r2 || layout === "single") return {};
  return { r1: 0, r2: 1, show2: state.show };
}

function show_panel() {
  for (const [id, [text]] of Object.entries(SLIDERS)) {
    element(id).value = state[id];
    element(id).nextElementSibling.textContent = text(state[id]);
  }
  const n_s = state.ns || PAGE.results[state.r1].globals.n_s;
  element("ns").value = Math.log(n_s);
  element("ns").nextElementSibling.textContent = state.ns ? n_s.toFixed(1) : `${n_s.toFixed(1)} fitted`;
  for (const id of ["show", "show2", "r1", "r2", "flag", "tone"]) element(id).value = state[id];
  element("captured").value = state.m;
  for (const id of ["two", "smooth"]) element(id).checked = state[id] === 1;
  for (const id of ["which", "layout", "mode"]) for (const button of element(id).children) {
    const on = String(state[id]) === button.dataset.value;
    button.classList.toggle("on", on);
    button.setAttribute("aria-pressed", on);
  }
  element("which").hidden = element("row_i2").hidden = !state.two;
  element("row_show2").hidden = state.layout === "single";
  element("show2_label").textContent = { lens: "In the lens", split: "On the right", pair: "On the right" }[state.layout] || "";
  element("row_lens").hidden = state.layout !== "lens";
  element("row_flag").hidden = state.show !== "flags" && (state.layout === "single" || state.show2 !== "flags");
  const on = lights_on(0);
  element("extrapolated").hidden = !on.some(light => light.outside);
  element("direction").textContent = on.map((light, k) => light_text(light, k, on.length)).join("; ");
  const canvas = element("picture");
  element("zoom_text").textContent = `${Math.round(100 * zoom_in(panes(canvas.width, canvas.height)[0].rect))} %`;
  for (const [id, result, key, seen] of [["label_a", state.r1, state.show, state.layout !== "single" || PAGE.results.length > 1 || state.show !== "whole"], ["label_b", state.r2, state.show2, state.layout !== "single"]]) {
    element(id).hidden = !seen;
    element(id).textContent = (id === "label_b" && state.layout === "lens" ? "in the lens: " : "") + label(result, key);
  }
  draw_dome();
}
function light_text(light, k, count) {
  const which = count > 1 ? `Light ${k + 1}: ` : "", mixed = `mix of the basis ${light.alpha.map(v => v.toFixed(2)).join(", ")}`;
  if (!PAGE.results[0].basis) return which + mixed;
  const [x, y, z] = k ? direction(state.x2, state.y2) : direction(state.x, state.y);
  return `${which}${(Math.acos(Math.min(1, z)) * 180 / Math.PI).toFixed(0)}\u00b0 off the camera, direction ${[x, y, z].map(v => v.toFixed(2)).join(", ")}; ${mixed}`;
}
function label(result, key) {
  const about = PAGE.results[result], name = PAGE.results.length > 1 ? `${about.name}: ` : "";
  if (key === "measured") return `${name}measured picture, light ${about.measured ? about.measured.lights[measured_index(result)] : "?"}`;
  if (key === "flags") return `${name}marked: ${PAGE.flags[state.flag]}`;
  return name + SHOWN[key][1];
}

function table(rows) {
  const body = document.createElement("table");
  for (const [name, text] of rows) {
    const row = body.insertRow(), head = document.createElement("th");
    head.textContent = name;
    row.append(head);
    row.insertCell().textContent = text;
  }
  return body;
}
function about_result(about) {
  const g = about.globals, level = about.levels[0], error = about.accuracy;
  const size_text = level.factor > 1 ? `${about.width} x ${about.height}, here ${level.width} x ${level.height}` : `${about.width} x ${about.height}`;
  const rows = [
    ["result", about.name], ["object", about.object], ["model", about.model], ["made", about.created], ["size", `${size_text} pixels`],
    ["n_s", about.materials.map(m => round(m[1])).join(", ")], ["n_d", `${round(g.n_d, 4)} (${about.n_d_source})`], ["a", g.a.map(v => round(v)).join(", ")],
    ["f", round(g.f)], ["shadow softness", round(g.softness)], ["Fresnel share", round(g.fresnel)], ["lobe", about.ggx ? "GGX microfacets" : "power of a cosine"], ["white", `${round(about.white)} in the capture's units, at exposure 0`],
    ["stored as", `16-bit floats: basis lights ${error.psnr_db === null ? "exact" : error.psnr_db.toFixed(1) + " dB"} from the result, ${(100 * error.within_one).toFixed(2)} % of the values within one of 255 steps, at most ${error.largest}`],
    ...about.warnings.map(text => ["warning", text]),
  ];
  return table(rows.filter(([, text]) => text !== ""));
}

const size_of = (M, v) => Math.hypot(...M.map(row => dot(row, v)));

function lobe(u, size, n, ggx) {
  if (!(u > 0)) return 0;
  if (!ggx) return u ** n;
  const w = 1 + n * (1 - Math.min(u / size, 1)) / 2, least = 1 + n / 2;
  return size ** n * (w ** -2 - least ** -2);
}

// Light that enters the body at the cosine c: T(c) of the model.
function entered(c, g) {
  const y = (c + Math.hypot(c, g.softness)) / 2;
  return y * (1 - g.fresnel * (1 - Math.min(y, 1)) ** 5);
}

// Linear value of the whole picture at a pixel, the formula of the shader in double precision.
function value_of(result, pixel) {
  const about = PAGE.results[result], g = about.globals, kind = pixel.material, n_s = (state.ns || g.n_s) / g.n_s * about.materials[kind][1];
  const full = Math.max(size_of(about.M, pixel.w), 1e-6), size = Math.min(full, about.ceilings[kind] ?? 1e30);
  const power = (base, exponent) => base > 0 ? base ** exponent : 0;
  return pixel.d.map((d, c) => lights_on(result).reduce((sum, light) => {
    const f_d = power(state.loc, 1 / g.n_d), f_s = power(state.scat, 1 / g.n_d), s = pixel.s[c];
    const roots = d.map((v, k) => f_d * v + f_s * s[k]), q = Math.max(size_of(about.M, roots), 1e-6);
    const shine = lobe(dot(pixel.w, light.alpha) * size / full, size, n_s, about.ggx);
    return sum + light.power * (state.spec * shine + power(q * entered(dot(roots, light.alpha) / q, g), g.n_d));
  }, 0));
}
function show_pixel(result, pixel) {
  if (!pixel) return;
  const three = rows => rows.map(row => row.map(v => round(v)).join("  ")).join(" | ");
  const where = `x ${pixel.x}, y ${pixel.y}`;
  element("readout").textContent = pixel.inside ? `${where}: ${value_of(result, pixel).map(v => round(v)).join(", ")}` : `${where}: not on the object`;
  element("readout").hidden = false;
  const rows = [["pixel", where]];
  if (pixel.inside) rows.push(
    ["value", `${value_of(result, pixel).map(v => round(v)).join(", ")} (linear, capture's units)`],
    ["d", `${three(pixel.d)} (a basis light each, roots of the capture's units)`], ["s", three(pixel.s)], ["B", round(pixel.B)], ["a + B d", pixel.w.map(v => round(v)).join("  ")],
    ["flags", pixel.flags.map(name => PAGE.flags[name]).join("; ") || "none"]);
  else rows.push(["", "not on the object"]);
  element("pixel").replaceChildren(table(rows));
}

function say(text) { element("said").textContent = text; }
function save(blob, kind) {
  const link = document.createElement("a"), name = PAGE.results[state.r1].name.replace(/[^A-Za-z0-9_-]+/g, "_") || "result";
  link.href = URL.createObjectURL(blob);
  link.download = `${name}_${kind}.png`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  say(`Saved ${link.download}.`);
}
function save_view() {
  draw();  // the drawing is handed to the screen after this turn: take it before
  element("picture").toBlob(blob => save(blob, "view"), "image/png");
}
async function save_full() {
  try {
    const pixels = await full_picture(), canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [pixels.width, pixels.height];
    canvas.getContext("2d").putImageData(pixels, 0, 0);
    canvas.toBlob(blob => save(blob, state.show), "image/png");
  } catch (error) { say(`Not saved: ${error.message}.`); }
}
async function copy_link() {
  write_fragment();
  try { await navigator.clipboard.writeText(location.href); say("The link to this view is in the clipboard."); }
  catch { say("The address bar holds the link to this view."); }
}
