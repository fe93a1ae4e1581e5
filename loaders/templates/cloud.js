// Draws the page's point cloud by WebGL, and lets the reader turn it, zoom, and colour it by grey level or by depth.
(() => {
  "use strict";
  const cloud = JSON.parse(document.getElementById("cloud").textContent);
  const element = (id) => document.getElementById(id);
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const canvas = element("view");
  const gl = canvas.getContext("webgl", { preserveDrawingBuffer: true });
  if (!gl) return; // the page's sentence on this stays
  element("without").hidden = true;
  element("viewer").hidden = false;

  // Positions are turned about the middle, at a distance of four radii from the eye, in units of the radius.
  const VERTEX = `
    attribute vec3 place; attribute float level;
    uniform mat3 turn; uniform vec3 middle; uniform vec2 window, ends; uniform float radius, zoom, dot;
    varying float fraction;
    void main() {
      vec3 at = turn * ((place - middle) / radius);
      float away = max(4.0 + at.z, 0.1);
      gl_Position = vec4(vec2(at.x, -at.y) * 4.0 * zoom * window, clamp(at.z / 8.0, -0.99, 0.99) * away, away);
      gl_PointSize = clamp(dot * zoom * 4.0 / away, 1.0, 24.0);
      fraction = ends.x == ends.y ? level : clamp((place.z - ends.x) / (ends.y - ends.x), 0.0, 1.0);
    }`;
  const FRAGMENT = `
    precision mediump float; varying float fraction; uniform sampler2D colours;
    void main() { gl_FragColor = texture2D(colours, vec2((fraction * 255.0 + 0.5) / 256.0, 0.5)); }`;
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);

  const places = new Uint16Array(bytes(cloud.places).buffer); // little-endian, as every browser's machine is
  const count = places.length / 3;
  // The box that the view shows, in the steps of the positions.
  const [least, most] = cloud.ends_mm.map((end) => end.map((mm, axis) => (mm - cloud.first_mm[axis]) / cloud.step_mm));
  const middle = least.map((low, axis) => (low + most[axis]) / 2);
  const radius = Math.max(1, Math.hypot(...least.map((low, axis) => most[axis] - low)) / 2);
  const attribute = (name, values, size, type, normalised) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    const index = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(index);
    gl.vertexAttribPointer(index, size, type, normalised, 0, 0);
  };
  attribute("place", places, 3, gl.UNSIGNED_SHORT, false);
  attribute("level", bytes(cloud.greys), 1, gl.UNSIGNED_BYTE, true);

  const table = bytes(cloud.colours);
  const greys = Uint8Array.from({ length: 768 }, (_, index) => 24 + 231 * Math.min(1, Math.floor(index / 3) / cloud.white));
  const colour = (index) => `rgb(${table.slice(3 * index, 3 * index + 3).join()})`;
  const stops = Array.from({ length: 16 }, (_, stop) => colour(17 * stop));
  document.querySelector("#scale i").style.background = `linear-gradient(90deg, ${stops.join()})`;
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  for (const scaled of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, scaled, gl.NEAREST);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(0.082, 0.094, 0.11, 1);

  const spacing = Math.sqrt(((most[0] - least[0] || 1) * (most[1] - least[1] || 1)) / count) / radius;
  let [yaw, pitch, zoom] = [0.5, 0.35, 1]; // opens turned, so that the surface shows its relief
  let byDepth = true, waiting = false;

  const draw = () => {
    waiting = false;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.round(side * devicePixelRatio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const side = Math.min(width, height);
    const [cy, sy, cx, sx] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    gl.viewport(0, 0, width, height);
    gl.uniformMatrix3fv(uniform("turn"), false, [cy, sx * sy, -cx * sy, 0, cx, sx, sy, -sx * cy, cx * cy]);
    gl.uniform3fv(uniform("middle"), middle);
    gl.uniform2f(uniform("window"), (0.95 * side) / width, (0.95 * side) / height);
    gl.uniform2fv(uniform("ends"), byDepth ? [least[2], most[2]] : [0, 0]);
    gl.uniform1f(uniform("radius"), radius);
    gl.uniform1f(uniform("zoom"), zoom);
    gl.uniform1f(uniform("dot"), 0.5 * 0.95 * side * spacing * 1.1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, byDepth ? table : greys);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.drawArrays(gl.POINTS, 0, count);
  };
  const redraw = () => {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  };
  const turn = (right, down) => {
    yaw -= right; // the near side follows the pointer
    pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, pitch + down));
    redraw();
  };
  const zoomBy = (factor) => {
    zoom = Math.max(0.2, Math.min(50, zoom * factor));
    redraw();
  };
  const camera = () => {
    [yaw, pitch, zoom] = [0, 0, 1];
    redraw();
  };
  const colourByDepth = (chosen) => {
    byDepth = chosen;
    element("grey").setAttribute("aria-pressed", !chosen);
    element("depth").setAttribute("aria-pressed", chosen);
    element("scale").hidden = !chosen;
    redraw();
  };

  const KEYS = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
    "+": () => zoomBy(1.15), "=": () => zoomBy(1.15), "-": () => zoomBy(1 / 1.15), r: camera, R: camera,
  };
  canvas.addEventListener("keydown", (event) => {
    if (!(event.key in KEYS) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    KEYS[event.key]();
  });
  const pointers = new Map();
  const apart = () => {
    const [first, second] = pointers.values();
    return Math.max(1, Math.hypot(first.x - second.x, first.y - second.y));
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const before = pointers.size === 2 ? apart() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (before) zoomBy(apart() / before);
    else if (pointers.size === 1) turn((event.clientX - last.x) * 0.008, (event.clientY - last.y) * 0.008);
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(Math.exp(-0.0015 * event.deltaY));
  }, { passive: false });
  element("grey").addEventListener("click", () => colourByDepth(false));
  element("depth").addEventListener("click", () => colourByDepth(true));
  element("nearer").addEventListener("click", () => zoomBy(1.25));
  element("farther").addEventListener("click", () => zoomBy(0.8));
  element("camera").addEventListener("click", camera);
  new ResizeObserver(redraw).observe(canvas);
  colourByDepth(true);
})();
