"use strict";
// Draws a haptether.view.scene3d description from a user-controlled camera. Matrices are row-major, as in
// NumPy.

const floats = (text) => new Float32Array(bytes(text).buffer);
const shorts = (text) => new Uint16Array(bytes(text).buffer);
function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let n = 0; n < raw.length; n++) out[n] = raw.charCodeAt(n);
  return out;
}
const minus = (a, b) => a.map((x, n) => x - b[n]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.hypot(...a));
const colour = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);

const VERTEX = `
attribute vec3 at; attribute vec3 normal;
uniform mat4 pose; uniform mat4 seen; uniform mat3 turn; varying vec3 facing;
void main() { facing = turn * normal; gl_Position = seen * pose * vec4(at, 1.0); }`;
const FRAGMENT = `
precision mediump float;
uniform vec4 tint; uniform float lit; uniform vec3 eye; uniform vec3 lamp; varying vec3 facing;
void main() {
  vec3 n = normalize(facing);
  float light = 0.42 + 0.38 * max(dot(n, eye), 0.0) + 0.34 * max(dot(n, lamp), 0.0);
  gl_FragColor = vec4(tint.rgb * mix(1.0, light, lit), tint.a);
}`;

class View {
  // `changed` is called when the user moves the camera.
  constructor(canvas, camera, changed) {
    this.canvas = canvas; this.home = camera; this.changed = changed;
    this.parts = []; this.trails = [];
    const gl = this.gl = canvas.getContext("webgl", { alpha: false, antialias: true, preserveDrawingBuffer: true });
    if (!gl) { canvas.replaceWith("This browser has no WebGL."); return; }
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program); gl.useProgram(this.program);
    this.where = {};
    for (const name of ["pose", "seen", "turn", "tint", "lit", "eye", "lamp"])
      this.where[name] = gl.getUniformLocation(this.program, name);
    this.at = gl.getAttribLocation(this.program, "at");
    this.normal = gl.getAttribLocation(this.program, "normal");
    gl.enable(gl.DEPTH_TEST); gl.enable(gl.CULL_FACE); gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    this.look(camera);
    this.listen();
  }

  // Replaces bodies and trails; the view covers the box between the corners.
  load([low, high], parts, trails) {
    const gl = this.gl;
    if (!gl) return;
    this.low = low; this.high = high;
    this.centre = low.map((x, n) => (x + high[n]) / 2);
    for (const part of this.parts) for (const name of ["points", "normals", "triangles"]) gl.deleteBuffer(part[name]);
    for (const trail of this.trails) gl.deleteBuffer(trail.buffer);
    const buffer = (kind, values) => {
      const made = gl.createBuffer();
      gl.bindBuffer(kind, made); gl.bufferData(kind, values, gl.STATIC_DRAW);
      return made;
    };
    this.parts = parts.map((part) => {
      const triangles = shorts(part.triangles);
      return { of: part, tint: [...colour(part.colour), part.opacity], count: triangles.length,
               points: buffer(gl.ARRAY_BUFFER, floats(part.points)), normals: buffer(gl.ARRAY_BUFFER, floats(part.normals)),
               triangles: buffer(gl.ELEMENT_ARRAY_BUFFER, triangles) };
    });
    // Draw transparent parts last.
    this.parts.sort((a, b) => b.tint[3] - a.tint[3]);
    this.trails = trails.map((trail) => ({ of: trail, tint: [...colour(trail.colour), 1], buffer: gl.createBuffer() }));
  }

  look(direction) {
    const [x, y, z] = unit(direction);
    this.azimuth = Math.atan2(y, x);
    this.height = Math.asin(z);
    this.zoom = 1;
  }

  listen() {
    let held = null;
    this.canvas.addEventListener("pointerdown", (event) => { held = event; this.canvas.setPointerCapture(event.pointerId); });
    this.canvas.addEventListener("pointerup", () => { held = null; });
    this.canvas.addEventListener("pointermove", (event) => {
      if (!held) return;
      this.azimuth -= (event.clientX - held.clientX) * 0.008;
      this.height = Math.max(-1.5, Math.min(1.55, this.height + (event.clientY - held.clientY) * 0.008));
      held = event; this.changed();
    });
    this.canvas.addEventListener("wheel", (event) => {
      this.zoom = Math.max(0.2, Math.min(5, this.zoom * Math.exp(event.deltaY * 0.001)));
      event.preventDefault(); this.changed();
    }, { passive: false });
    this.canvas.addEventListener("dblclick", () => { this.look(this.home); this.changed(); });
  }

  // Projection from base to screen, column-major for WebGL.
  camera(aspect) {
    const c = Math.cos(this.height);
    const back = [c * Math.cos(this.azimuth), c * Math.sin(this.azimuth), Math.sin(this.height)];
    const right = unit(cross([0, 0, 1], back)), up = cross(back, right);
    const slope = Math.tan((14 * Math.PI) / 180);
    let distance = 0;
    for (let n = 0; n < 8; n++) {
      const corner = minus([0, 1, 2].map((k) => ((n >> k) & 1 ? this.high : this.low)[k]), this.centre);
      const reach = Math.max(Math.abs(dot(up, corner)), Math.abs(dot(right, corner)) / aspect);
      distance = Math.max(distance, dot(back, corner) + (1.06 * reach) / slope);
    }
    distance *= this.zoom;
    const eye = this.centre.map((x, n) => x + distance * back[n]);
    const near = distance * 0.05, far = distance * 8, deep = (near + far) / (near - far);
    const f = 1 / slope;
    const seen = [];
    for (const k of [0, 1, 2])
      seen.push((right[k] * f) / aspect, up[k] * f, back[k] * deep, -back[k]);
    seen.push((-dot(right, eye) * f) / aspect, -dot(up, eye) * f,
              -dot(back, eye) * deep + (2 * near * far) / (near - far), dot(back, eye));
    return { seen, back, lamp: unit([0, 1, 2].map((k) => -0.6 * right[k] + 0.9 * up[k] + 0.8 * back[k])) };
  }

  // `pose` returns the 12 numbers of a part, NaN while it is hidden; `line` returns the points of a trail.
  draw(pose, line) {
    const gl = this.gl, canvas = this.canvas;
    if (!gl || !this.centre) return;
    const finer = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * finer)), height = Math.max(1, Math.round(canvas.clientHeight * finer));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.985, 0.988, 0.992, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { seen, back, lamp } = this.camera(width / height);
    gl.uniformMatrix4fv(this.where.seen, false, new Float32Array(seen));
    gl.uniform3fv(this.where.eye, back); gl.uniform3fv(this.where.lamp, lamp);
    gl.enableVertexAttribArray(this.at);
    for (const trail of this.trails) this.drawTrail(trail, line(trail.of));
    gl.enableVertexAttribArray(this.normal);
    gl.uniform1f(this.where.lit, 1);
    for (const part of this.parts) {
      const m = pose(part.of);
      if (!m || Number.isNaN(m[0])) continue;
      gl.uniformMatrix4fv(this.where.pose, false, new Float32Array(
        [m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0, m[3], m[7], m[11], 1]));
      // Normals transform by the columns divided by their squared lengths, which undoes scaling.
      const columns = [0, 1, 2].map((k) => { const v = [m[k], m[4 + k], m[8 + k]], s = dot(v, v) || 1; return v.map((x) => x / s); });
      gl.uniformMatrix3fv(this.where.turn, false, new Float32Array(columns.flat()));
      gl.uniform4fv(this.where.tint, part.tint);
      gl.depthMask(part.tint[3] >= 1);
      gl.bindBuffer(gl.ARRAY_BUFFER, part.points); gl.vertexAttribPointer(this.at, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, part.normals); gl.vertexAttribPointer(this.normal, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, part.triangles);
      gl.drawElements(gl.TRIANGLES, part.count, gl.UNSIGNED_SHORT, 0);
    }
    gl.depthMask(true);
  }

  drawTrail(trail, kept) {
    const gl = this.gl;
    if (kept.length < 6) return;
    gl.disableVertexAttribArray(this.normal);
    gl.vertexAttrib3f(this.normal, 0, 0, 1);
    gl.uniform1f(this.where.lit, 0);
    gl.uniformMatrix4fv(this.where.pose, false, new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]));
    gl.uniformMatrix3fv(this.where.turn, false, new Float32Array([1, 0, 0, 0, 1, 0, 0, 0, 1]));
    gl.uniform4fv(this.where.tint, trail.tint);
    gl.bindBuffer(gl.ARRAY_BUFFER, trail.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(kept), gl.DYNAMIC_DRAW);
    gl.vertexAttribPointer(this.at, 3, gl.FLOAT, false, 0, 0);
    gl.drawArrays(gl.LINE_STRIP, 0, kept.length / 3);
  }
}
