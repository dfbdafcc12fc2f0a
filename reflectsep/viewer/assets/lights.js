// Lights: from a place on the hemisphere, seen from the camera, to alpha and intensity.
const MOST_TILT = 0.9998;  // sine of the largest angle off the view, about 89 degrees
// Where the light directions are unknown a light is a mix of the basis lights, dragged in this triangle.
const CORNERS = [[0, 0.75], [-0.65, -0.375], [0.65, -0.375]];

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const size = a => Math.hypot(...a);

function on_disc(x, y) {
  const r = Math.hypot(x, y), k = r > MOST_TILT ? MOST_TILT / r : 1;
  return [x * k, y * k];
}
function direction(x, y) {
  [x, y] = on_disc(x, y);
  return [x, y, Math.sqrt(Math.max(0, 1 - x * x - y * y))];
}

// alpha with sum_k alpha_k V_k = v (Eq. 15), by Cramer's rule
function mix(basis, v) {
  const [a, b, c] = basis, whole = dot(a, cross(b, c));
  return [dot(v, cross(b, c)) / whole, dot(v, cross(c, a)) / whole, dot(v, cross(a, b)) / whole];
}
function corner_mix(x, y) {
  const [[ax, ay], [bx, by], [cx, cy]] = CORNERS;
  const whole = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay);
  const a = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / whole;
  const b = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / whole;
  return [a, b, 1 - a - b];
}

// Alpha among basis lights of unit intensity, for a light of unit intensity at (x, y); and the mean basis intensity.
function unit_alpha(result, x, y) {
  const basis = PAGE.results[result].basis;
  if (!basis) return corner_mix(x, y);
  const alpha = mix(basis, direction(x, y));
  return alpha.map((value, k) => value * size(basis[k]));
}
function mean_intensity(result) {
  const basis = PAGE.results[result].basis;
  return basis ? (size(basis[0]) + size(basis[1]) + size(basis[2])) / 3 : 1;
}

// The lights that are on: alpha, power, and whether they lie outside the triangle of the basis.
function lights_on(result) {
  const about = PAGE.results[result], mean = mean_intensity(result);
  const found = [{ alpha: unit_alpha(result, state.x, state.y), power: state.i1 * mean }];
  // Without directions a captured light's alpha need not sum to 1: it is taken as it stands.
  if (!about.basis && state.m >= 0 && state.m < about.lights.length) found[0].alpha = about.lights[state.m].alpha;
  if (state.two) found.push({ alpha: unit_alpha(result, state.x2, state.y2), power: state.i2 * mean });
  for (const light of found) light.outside = Math.min(...light.alpha) < -1e-4;
  return found;
}

// Where the light is at first: at the camera, or amid the basis lights where that would be an extrapolation.
function first_light() {
  const basis = PAGE.results[0].basis;
  if (!basis || Math.min(...unit_alpha(0, 0, 0)) >= 0) return {};
  const sum = [0, 1, 2].map(k => basis.reduce((total, v) => total + v[k] / size(v), 0));
  return { x: sum[0] / size(sum), y: sum[1] / size(sum) };
}

// Place of a captured light on the disc.
function place_of(result, index) {
  const about = PAGE.results[result], light = about.lights[index];
  if (light.vector) { const n = size(light.vector); return [light.vector[0] / n, light.vector[1] / n]; }
  const sum = light.alpha[0] + light.alpha[1] + light.alpha[2] || 1;
  const at = k => CORNERS.reduce((total, corner, i) => total + corner[k] * light.alpha[i] / sum, 0);
  return on_disc(at(0), at(1));
}
function use_captured(index) {
  if (index < 0) { change({ m: -1 }); return; }
  const light = PAGE.results[0].lights[index], [x, y] = place_of(0, index);
  change({ m: index, x, y, i1: light.vector ? size(light.vector) / mean_intensity(0) : 1, two: 0, which: 1 });
}
// The measured picture that belongs to where the light is: the one chosen, or the nearest; an index into `measured.lights`.
function measured_index(result) {
  const about = PAGE.results[result];
  if (!about.measured) return -1;
  const chosen = state.m >= 0 ? about.measured.lights.indexOf((PAGE.results[0].lights[state.m] || {}).name) : -1;
  if (chosen >= 0) return chosen;
  let best = 0, least = Infinity;
  about.measured.lights.forEach((name, k) => {
    const [x, y] = place_of(result, about.lights.findIndex(light => light.name === name));
    const far = size(direction(x, y).map((value, i) => value - direction(state.x, state.y)[i]));
    if (far < least) [best, least] = [k, far];
  });
  return best;
}

function draw_dome() {
  const canvas = element("dome"), pixels = Math.max(60, Math.round(canvas.clientWidth * devicePixelRatio));
  if (canvas.width !== pixels) { canvas.width = canvas.height = pixels; canvas.field = null; }
  const pen = canvas.getContext("2d"), R = pixels / 2 - 8 * devicePixelRatio;
  const px = x => pixels / 2 + R * x, py = y => pixels / 2 - R * y;
  pen.clearRect(0, 0, pixels, pixels);
  if (!canvas.field) canvas.field = dome_field(pen, pixels, R);
  pen.putImageData(canvas.field, 0, 0);
  pen.strokeStyle = "#6b737e"; pen.lineWidth = devicePixelRatio;
  for (const tilt of [30, 60, 90]) {
    if (!PAGE.results[0].basis && tilt < 90) continue;
    pen.beginPath(); pen.arc(px(0), py(0), R * Math.sin(tilt * Math.PI / 180), 0, 7); pen.stroke();
  }
  PAGE.results[0].lights.forEach((light, k) => {
    const [x, y] = place_of(0, k);
    pen.beginPath(); pen.arc(px(x), py(y), (k < 3 ? 4 : 3) * devicePixelRatio, 0, 7);
    pen.fillStyle = k < 3 ? "#7fb4ff" : "#a4abb5"; pen.fill();
  });
  const on = lights_on(0);
  const handle = (x, y, text, light, moved) => {
    [x, y] = on_disc(x, y);
    pen.beginPath(); pen.arc(px(x), py(y), 8 * devicePixelRatio, 0, 7);
    pen.fillStyle = light.outside ? "#14161a" : "#ffb000"; pen.fill();
    pen.lineWidth = (moved ? 2.5 : 1.2) * devicePixelRatio; pen.strokeStyle = light.outside ? "#ffb000" : "#fff"; pen.stroke();
    pen.fillStyle = light.outside ? "#ffb000" : "#1a1300"; pen.font = `bold ${10 * devicePixelRatio}px sans-serif`;
    pen.textAlign = "center"; pen.textBaseline = "middle"; pen.fillText(text, px(x), py(y));
  };
  if (state.two) handle(state.x2, state.y2, "2", on[1], state.which === 2);
  handle(state.x, state.y, "1", on[0], state.which === 1 && state.two);
}
function dome_field(pen, pixels, R) {
  const field = pen.createImageData(pixels, pixels);
  for (let j = 0; j < pixels; j++) for (let i = 0; i < pixels; i++) {
    const x = (i + 0.5 - pixels / 2) / R, y = (pixels / 2 - j - 0.5) / R;
    if (x * x + y * y > 1) continue;
    const inside = Math.min(...unit_alpha(0, x, y)) >= 0;
    field.data.set(inside ? [64, 70, 80, 255] : [28, 31, 36, 255], 4 * (j * pixels + i));
  }
  return field;
}
