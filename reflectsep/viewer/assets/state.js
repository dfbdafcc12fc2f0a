// What is seen, as one flat record; the fragment of the URL holds what differs from the defaults.
const element = id => document.getElementById(id);
const DEFAULTS = {
  x: 0, y: 0, x2: -0.35, y2: 0.35, i1: 1, i2: 0.5, two: 0, which: 1,
  spec: 1, loc: 1, scat: 1, ns: 0, ev: 0, tone: "srgb",
  layout: "single", show: "whole", show2: "nospec", r1: 0, r2: 0, m: -1, flag: "FAINT_LOBE",
  lx: 0.5, ly: 0.5, lr: 0.22, cut: 0.5, zoom: 0, cx: 0.5, cy: 0.5, smooth: 1, mode: "light",
};
const RANGES = {
  x: [-1, 1], y: [-1, 1], x2: [-1, 1], y2: [-1, 1], i1: [0, 3], i2: [0, 3], two: [0, 1], which: [1, 2],
  spec: [0, 2], loc: [0, 2], scat: [0, 2], ns: [0, 1200], ev: [-6, 6], r1: [0, 1], r2: [0, 1], m: [-1, 1000],
  lx: [0, 1], ly: [0, 1], lr: [0.05, 0.6], cut: [0, 1], zoom: [0, 64], cx: [-1, 2], cy: [-1, 2], smooth: [0, 1],
};
const WHOLE_NUMBERS = ["two", "which", "r1", "r2", "m", "smooth"];
const WORDS = {
  tone: ["srgb", "shoulder", "linear"], layout: ["single", "lens", "split", "pair"], mode: ["light", "pan"],
};
const SHOWN = {
  whole: [0, "whole picture"], nospec: [4, "without highlight"], specular: [1, "highlight only (off-specular)"],
  local: [2, "local diffuse only"], scattering: [3, "scattering only"], measured: [5, "measured picture"],
  strength: [6, "highlight strength B"], flags: [7, "quality flags"],
};
WORDS.show = WORDS.show2 = Object.keys(SHOWN);

let state = { ...DEFAULTS };

// A record from text that anyone may have written: unknown keys, other types and values out of range are left out.
function parsed(text) {
  const found = { ...DEFAULTS };
  for (const [key, word] of new URLSearchParams(text.replace(/^#/, ""))) {
    if (key in RANGES && word.trim() !== "" && Number.isFinite(Number(word))) {
      const value = Math.min(Math.max(Number(word), RANGES[key][0]), RANGES[key][1]);
      found[key] = WHOLE_NUMBERS.includes(key) ? Math.round(value) : value;
    } else if (key in WORDS && WORDS[key].includes(word)) found[key] = word;
    else if (key === "flag" && Object.hasOwn(PAGE.flags, word)) found[key] = word;
  }
  found.r1 = Math.min(found.r1, PAGE.results.length - 1);
  found.r2 = Math.min(found.r2, PAGE.results.length - 1);
  return found;
}

function fragment() {
  const words = new URLSearchParams();
  for (const key of Object.keys(DEFAULTS)) {
    if (state[key] === DEFAULTS[key]) continue;
    words.set(key, typeof state[key] === "number" ? String(Number(state[key].toFixed(5))) : state[key]);
  }
  return "#" + words.toString();
}

let fragment_timer = 0;
function change(part) {
  Object.assign(state, part);
  clearTimeout(fragment_timer);
  fragment_timer = setTimeout(write_fragment, 150);
  refresh();
}
function write_fragment() {
  const text = fragment();
  if (text !== (location.hash || "#")) history.replaceState(null, "", text);
}
