// Mouse, touch and keys.
const pointers = new Map();
let drag = null, last_frame = 0, before_touch = {};

const on_canvas = event => {
  const box = element("picture").getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top, box.width, box.height];
};

function move_light(x, y) {
  [x, y] = on_disc(x, y);
  change(state.two && state.which === 2 ? { x2: x, y2: y } : { x, y, m: -1 });
}
function light_at(event) {
  let [x, y, width, height] = on_canvas(event);
  if (state.layout === "pair") { width /= 2; x %= width; }
  const half_size = Math.min(width, height) / 2;
  move_light((x - width / 2) / half_size, (height / 2 - y) / half_size);
}

// Zoom about a place of the window (CSS pixels), which stays where it is.
function zoom_by(factor, x, y) {
  const canvas = element("picture"), scale = devicePixelRatio, pane = pane_at((x ?? canvas.clientWidth / 2) * scale);
  const before = zoom_in(pane.rect), [cx, cy] = middle_of_view(), after = Math.min(64, Math.max(0.02, before * factor));
  const dx = (x ?? canvas.clientWidth / 2) * scale - pane.rect[0] - pane.rect[2] / 2;
  const dy = (y ?? canvas.clientHeight / 2) * scale - canvas.height + pane.rect[1] + pane.rect[3] / 2;
  const { width, height } = PAGE.results[0], shift = 1 / before - 1 / after;
  change({ zoom: after, cx: cx + dx * shift / width, cy: cy + dy * shift / height });
}
function pan_by(dx, dy) {
  const canvas = element("picture"), zoom = zoom_in(panes(canvas.width, canvas.height)[0].rect), [cx, cy] = middle_of_view();
  const { width, height } = PAGE.results[0], k = devicePixelRatio / zoom;
  const bounded = value => Math.min(1.2, Math.max(-0.2, value));
  change({ zoom, cx: bounded(cx - dx * k / width), cy: bounded(cy - dy * k / height) });
}
function pane_at(x) {
  const canvas = element("picture"), all = panes(canvas.width, canvas.height);
  if (state.layout === "split") return x >= all[1].clip[0] ? all[1] : all[0];
  return state.layout === "pair" && x >= all[1].rect[0] ? all[1] : all[0];
}

function what_is_dragged(event) {
  const [x, y, width, height] = on_canvas(event);
  if (event.button === 1 || event.button === 2) return "pan";
  if (state.layout === "split" && Math.abs(x - state.cut * width) < 14) return "cut";
  if (state.layout === "lens" && Math.hypot(x - state.lx * width, y - state.ly * height) < state.lr * Math.min(width, height)) return "lens";
  return state.mode;
}
function drag_to(event, dx, dy) {
  const [x, , width, height] = on_canvas(event), unit = value => Math.min(1, Math.max(0, value));
  if (drag === "light") light_at(event);
  else if (drag === "pan") pan_by(dx, dy);
  else if (drag === "cut") change({ cut: unit(x / width) });
  else change({ lx: unit(state.lx + dx / width), ly: unit(state.ly + dy / height) });
}

// Two fingers: their middle pans, their distance zooms.
function pinch(event, old) {
  const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
  const now = on_canvas(event), far = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
  pan_by((now[0] - old[0]) / 2, (now[1] - old[1]) / 2);
  if (far(old, other) > 1) zoom_by(far(now, other) / far(old, other), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
}

function read_out(event) {
  const [x, y] = on_canvas(event), canvas = element("picture"), scale = devicePixelRatio;
  const pane = pane_at(x * scale), at = geometry(pane.rect, zoom_in(pane.rect));
  const inside_lens = state.layout === "lens" && what_is_dragged({ ...at, clientX: event.clientX, clientY: event.clientY, button: 0 }) === "lens";
  const result = pane.second || inside_lens ? state.r2 : pane.result, about = PAGE.results[result];
  const unit = about.levels[0].factor * PAGE.results[0].width / about.width;
  const px = (at.offset[0] + x * scale * at.step[0]) / unit, py = (at.offset[1] + (canvas.height - y * scale) * at.step[1]) / unit;
  show_pixel(result, pixel_of(result, Math.floor(px), Math.floor(py)));
  const readout = element("readout");
  readout.style.left = "10px";
  readout.style.bottom = "40px";
}

function start_pointer() {
  const canvas = element("picture"), dome = element("dome");
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, on_canvas(event));
    drag = pointers.size > 1 ? "pinch" : what_is_dragged(event);
    // The first finger of a pinch comes down a little early: what it moved goes back.
    if (drag === "pinch") change(before_touch);
    else before_touch = { x: state.x, y: state.y, x2: state.x2, y2: state.y2, m: state.m, lx: state.lx, ly: state.ly, cut: state.cut };
    if (drag === "light") light_at(event);
    read_out(event);
    canvas.focus({ preventScroll: true });
    event.preventDefault();
  });
  canvas.addEventListener("pointermove", event => {
    const old = pointers.get(event.pointerId);
    read_out(event);
    if (!old) { canvas.style.cursor = { cut: "ew-resize", lens: "move", pan: "grab" }[what_is_dragged(event)] || "crosshair"; return; }
    const now = on_canvas(event);
    if (pointers.size > 1) pinch(event, old);
    else if (drag !== "pinch") drag_to(event, now[0] - old[0], now[1] - old[1]);
    pointers.set(event.pointerId, now);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, event => {
    pointers.delete(event.pointerId);
    if (!pointers.size) { drag = null; slow_drag = false; refresh(); }
  });
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("wheel", event => {
    const [x, y] = on_canvas(event);
    zoom_by(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), x, y);
    event.preventDefault();
  }, { passive: false });
  const from_dome = event => {
    const box = dome.getBoundingClientRect(), radius = box.width / 2 - 8;
    move_light((event.clientX - box.left - box.width / 2) / radius, (box.top + box.height / 2 - event.clientY) / radius);
  };
  dome.addEventListener("pointerdown", event => {
    dome.setPointerCapture(event.pointerId);
    pick_light(event);
    from_dome(event);
    dome.focus({ preventScroll: true });
    event.preventDefault();
  });
  dome.addEventListener("pointermove", event => { if (event.buttons) from_dome(event); });
  document.addEventListener("keydown", on_key);
}
// On the hemisphere the handle that was grabbed moves.
function pick_light(event) {
  if (!state.two) return;
  const box = element("dome").getBoundingClientRect(), radius = box.width / 2 - 8;
  const x = (event.clientX - box.left - box.width / 2) / radius, y = (box.top + box.height / 2 - event.clientY) / radius;
  const near = (ax, ay) => Math.hypot(ax - x, ay - y);
  state.which = near(state.x, state.y) <= near(state.x2, state.y2) ? 1 : 2;
}

// A step of the light along a great circle to the right or up, as the eye sees it.
function step_light(right, up, degrees) {
  const two = state.two && state.which === 2, [x, y, z] = two ? direction(state.x2, state.y2) : direction(state.x, state.y);
  const tilt = Math.asin(Math.min(1, Math.max(-1, y))), turn = Math.atan2(x, z), step = degrees * Math.PI / 180, most = Math.PI / 2 - 0.02;
  const bounded = value => Math.min(most, Math.max(-most, value));
  const new_tilt = bounded(tilt + up * step), new_turn = bounded(turn + right * step);
  move_light(Math.cos(new_tilt) * Math.sin(new_turn), Math.sin(new_tilt));
}

function on_key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  const toggle = layout => change({ layout: state.layout === layout ? "single" : layout, ...arranged(layout) });
  const keys = {
    "2": () => change({ two: 1 - state.two, which: state.two ? 1 : 2 }), h: () => change({ spec: state.spec ? 0 : 1 }),
    l: () => toggle("lens"), s: () => toggle("split"), b: () => toggle("pair"), p: save_view,
    "+": () => zoom_by(1.25), "=": () => zoom_by(1.25), "-": () => zoom_by(0.8), "0": () => change({ zoom: 0 }), "1": () => element("zoom_one").click(),
  };
  if (event.key in steps) step_light(...steps[event.key], event.shiftKey ? 10 : 2);
  else if (Object.hasOwn(keys, event.key)) keys[event.key]();
  else return;
  event.preventDefault();
}
