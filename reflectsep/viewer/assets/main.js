// Start, and one drawing a frame at most.
let asked = false, complete = false, loaded_ms = null;

function refresh() {
  if (asked || !gl) return;
  asked = true;
  complete = false;
  requestAnimationFrame(now => {
    asked = false;
    // Where a frame takes long, a drag is drawn without smoothing until the pointer is lifted.
    if (drag && now - last_frame > 60 && now - last_frame < 2000) slow_drag = true;
    last_frame = now;
    const whole = draw();
    show_panel();
    element("busy").hidden = whole;
    complete = whole && waiting === 0;
    if (whole && loaded_ms === null) loaded_ms = performance.now();
  });
}

function start() {
  if (!start_drawing()) return;
  Object.assign(DEFAULTS, first_light());
  state = parsed(location.hash);
  start_panel();
  start_pointer();
  addEventListener("hashchange", () => { state = parsed(location.hash); refresh(); });
  addEventListener("resize", refresh);
  addEventListener("pagehide", write_fragment);
  refresh();
}

// For scripts: the state, to set it, whether all is drawn, the pixels of the canvas, the picture, and the time of a frame.
window.reflectsep = {
  state: () => ({ ...state }),
  set: part => change(part),
  ready: () => complete && !asked,
  loaded_ms: () => loaded_ms,
  canvas_png: () => { draw(); return element("picture").toDataURL("image/png"); },
  picture: async () => {
    const pixels = await full_picture(), canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [pixels.width, pixels.height];
    canvas.getContext("2d").putImageData(pixels, 0, 0);
    return canvas.toDataURL("image/png");
  },
  frame_ms: count => {
    const kept = { ...state }, one = new Uint8Array(4), began = performance.now();
    for (let k = 0; k < count; k++) {
      state.x = 0.3 * Math.cos(k);
      state.y = 0.3 * Math.sin(k);
      draw();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, one);  // waits for the drawing
    }
    const took = performance.now() - began;
    state = kept;
    return took / count;
  },
};
start();
