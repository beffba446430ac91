// The abdomen in 3-D: WebGL without libraries. Drag turns, wheel or pinch zooms, double click resets, arrow keys turn.
"use strict";
(function () {
  const root = document.getElementById("surface");
  const canvas = root.querySelector("canvas");
  const data = JSON.parse(document.getElementById("surface-data").textContent);
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) { root.classList.add("flat"); return; }
  const decode = (text, type) => new type(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const VERTEX = `attribute vec3 p; attribute vec3 n; attribute vec3 c; uniform mat4 m; uniform mat3 r; varying vec3 k;
    void main() { vec3 l = normalize(vec3(0.3, 0.45, 0.85)); float s = 0.45 + 0.55 * abs(dot(normalize(r * n), l));
    k = c * s; gl_Position = m * vec4(p, 1.0); }`;
  const FRAGMENT = "precision mediump float; varying vec3 k; void main() { gl_FragColor = vec4(k, 1.0); }";
  const shader = (kind, text) => { const s = gl.createShader(kind); gl.shaderSource(s, text); gl.compileShader(s); return s; };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, FRAGMENT));
  gl.linkProgram(program); gl.useProgram(program); gl.enable(gl.DEPTH_TEST);
  const at = {}; for (const name of ["p", "n", "c"]) at[name] = gl.getAttribLocation(program, name);
  const uniform = { m: gl.getUniformLocation(program, "m"), r: gl.getUniformLocation(program, "r") };
  const buffer = (target, array) => { const b = gl.createBuffer(); gl.bindBuffer(target, b); gl.bufferData(target, array, gl.STATIC_DRAW); return b; };
  const triangles = decode(data.triangles, Uint16Array);
  const index = buffer(gl.ELEMENT_ARRAY_BUFFER, triangles);
  const floats = (text) => buffer(gl.ARRAY_BUFFER, decode(text, Float32Array));
  const bytes = (text) => buffer(gl.ARRAY_BUFFER, decode(text, Uint8Array));
  const layers = data.layers.map((l) => ({ p: floats(l.positions), n: floats(l.normals), c: bytes(l.colors) }));
  const lines = decode(data.outline, Float32Array), outline = buffer(gl.ARRAY_BUFFER, lines);
  const axes = buffer(gl.ARRAY_BUFFER, decode(data.axes, Float32Array)), AXES = 6;  // corners of three segments
  const words = data.words.map(([text, ...place]) => {
    const element = document.createElement("span"); element.className = "place"; element.textContent = text;
    canvas.parentElement.append(element); return { element, place };
  });
  const start = { yaw: -0.5, pitch: -0.95, zoom: 1 };
  const view = Object.assign({}, start);
  let shown = 0;
  const bind = (name, b, size, type, normed) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, b); gl.enableVertexAttribArray(at[name]); gl.vertexAttribPointer(at[name], size, type, normed, 0, 0);
  };
  function draw() {
    const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth * ratio, h = canvas.clientHeight * ratio;
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h); gl.clearColor(0.965, 0.973, 0.98, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    const R = [cy, cp * sy, sp * sy, -sy, cp * cy, sp * cy, 0, -sp, cp];  // columns: turned about z, then tilted about x
    const s = view.zoom / data.radius, a = w / h, sx = s / Math.max(a, 1) , sz = s * Math.min(a, 1);
    const M = [R[0] * sx, R[1] * sz, -R[2] * s / 4, 0, R[3] * sx, R[4] * sz, -R[5] * s / 4, 0, R[6] * sx, R[7] * sz, -R[8] * s / 4, 0, 0, 0, 0, 1];
    gl.uniformMatrix4fv(uniform.m, false, M); gl.uniformMatrix3fv(uniform.r, false, R);
    const layer = layers[shown];
    bind("p", layer.p, 3, gl.FLOAT, false); bind("n", layer.n, 3, gl.FLOAT, false); bind("c", layer.c, 3, gl.UNSIGNED_BYTE, true);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index); gl.drawElements(gl.TRIANGLES, data.layers[shown].corners, gl.UNSIGNED_SHORT, 0);
    if (lines.length && data.layers[shown].outlined) {
      bind("p", outline, 3, gl.FLOAT, false);
      gl.disableVertexAttribArray(at.n); gl.vertexAttrib3f(at.n, 0, 0, 1);
      gl.disableVertexAttribArray(at.c); gl.vertexAttrib3f(at.c, 0.05, 1.0, 0.9); gl.lineWidth(2);
      gl.drawArrays(gl.LINES, 0, lines.length / 3);
    }
    if (data.layers[shown].outlined) {
      bind("p", axes, 3, gl.FLOAT, false);
      gl.disableVertexAttribArray(at.n); gl.vertexAttrib3f(at.n, 0, 0, 1);
      gl.disableVertexAttribArray(at.c); gl.vertexAttrib3f(at.c, 0.1, 0.2, 0.3);
      gl.drawArrays(gl.LINES, 0, AXES);
    }
    for (const { element, place: [x, y, z] } of words) {  // text of the page, over the canvas
      const [u, v] = [M[0] * x + M[4] * y + M[8] * z, M[1] * x + M[5] * y + M[9] * z];
      element.style.left = `${canvas.offsetLeft + (u + 1) / 2 * canvas.clientWidth}px`;
      element.style.top = `${canvas.offsetTop + (1 - v) / 2 * canvas.clientHeight}px`;
      element.hidden = Math.abs(u) > 1 || Math.abs(v) > 1;
    }
    root.dataset.drawn = String(shown);
  }
  const turn = (dx, dy) => { view.yaw += dx; view.pitch = Math.min(0, Math.max(-1.57, view.pitch + dy)); draw(); };
  const pointers = new Map();
  canvas.addEventListener("pointerdown", (e) => { pointers.set(e.pointerId, e); canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", (e) => {
    const before = pointers.get(e.pointerId);
    if (!before) return;
    if (pointers.size === 2) {
      const other = [...pointers.values()].find((p) => p.pointerId !== e.pointerId);
      const span = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY);
      view.zoom *= span(e) / Math.max(1, span(before)); draw();
    } else turn((e.clientX - before.clientX) * 0.008, (e.clientY - before.clientY) * 0.008);
    pointers.set(e.pointerId, e);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => pointers.delete(e.pointerId));
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); view.zoom *= Math.exp(-e.deltaY * 0.001); draw(); }, { passive: false });
  canvas.addEventListener("dblclick", () => { Object.assign(view, start); draw(); });
  canvas.addEventListener("keydown", (e) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
    if (step) { e.preventDefault(); turn(...step); }
  });
  root.querySelectorAll("input[name=layer]").forEach((input, i) => input.addEventListener("change", () => {
    shown = i; root.querySelectorAll(".scale").forEach((scale, j) => { scale.hidden = i !== j; }); draw();
  }));
  window.addEventListener("resize", draw); window.addEventListener("beforeprint", draw);
  draw();
})();
