"use strict";
// Draws CONTENT, what haptether.view.scene3d describes, and plays it. Matrices are row by row, as NumPy writes them.

const floats = (text) => new Float32Array(bytes(text).buffer);
const shorts = (text) => new Uint16Array(bytes(text).buffer);
function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let n = 0; n < raw.length; n++) out[n] = raw.charCodeAt(n);
  return out;
}
function element(kind, name, parent) {
  const made = document.createElement(kind);
  if (name) made.className = name;
  if (parent) parent.append(made);
  return made;
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
  constructor(run, station, canvas) {
    this.run = run;
    this.canvas = canvas;
    const gl = this.gl = canvas.getContext("webgl", { alpha: false, antialias: true, preserveDrawingBuffer: true });
    if (!gl) { canvas.replaceWith("This browser has no WebGL."); return; }
    const [low, high] = run.views[station];
    this.low = low; this.high = high;
    this.centre = low.map((x, n) => (x + high[n]) / 2);
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
    this.parts = run.parts.filter((part) => part.station === station).map((part) => {
      const buffer = (kind, values) => {
        const made = gl.createBuffer();
        gl.bindBuffer(kind, made); gl.bufferData(kind, values, gl.STATIC_DRAW);
        return made;
      };
      const triangles = shorts(part.triangles);
      return { tint: [...colour(part.colour), part.opacity], poses: floats(part.poses), count: triangles.length,
               points: buffer(gl.ARRAY_BUFFER, floats(part.points)), normals: buffer(gl.ARRAY_BUFFER, floats(part.normals)),
               triangles: buffer(gl.ELEMENT_ARRAY_BUFFER, triangles) };
    });
    // What is seen through comes last.
    this.parts.sort((a, b) => b.tint[3] - a.tint[3]);
    this.trails = run.trails.filter((trail) => trail.station === station).map((trail) => ({
      tint: [...colour(trail.colour), 1], times: floats(trail.times), points: floats(trail.points),
      window: trail.window, drift: trail.drift, buffer: gl.createBuffer() }));
    this.look(CONTENT.camera);
    this.listen();
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
      held = event; dirty = true;
    });
    this.canvas.addEventListener("wheel", (event) => {
      this.zoom = Math.max(0.2, Math.min(5, this.zoom * Math.exp(event.deltaY * 0.001)));
      event.preventDefault(); dirty = true;
    }, { passive: false });
    this.canvas.addEventListener("dblclick", () => { this.look(CONTENT.camera); dirty = true; });
  }

  // The matrix from the base to the screen, column by column as WebGL reads it.
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

  draw(frame, time) {
    const gl = this.gl, canvas = this.canvas;
    if (!gl) return;
    const finer = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * finer)), height = Math.max(1, Math.round(canvas.clientHeight * finer));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.985, 0.988, 0.992, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { seen, back, lamp } = this.camera(width / height);
    gl.uniformMatrix4fv(this.where.seen, false, new Float32Array(seen));
    gl.uniform3fv(this.where.eye, back); gl.uniform3fv(this.where.lamp, lamp);
    gl.enableVertexAttribArray(this.at);
    for (const trail of this.trails) this.drawTrail(trail, time);
    gl.enableVertexAttribArray(this.normal);
    gl.uniform1f(this.where.lit, 1);
    for (const part of this.parts) {
      const m = part.poses.subarray(part.poses.length === 12 ? 0 : 12 * frame).subarray(0, 12);
      if (Number.isNaN(m[0])) continue;
      gl.uniformMatrix4fv(this.where.pose, false, new Float32Array(
        [m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0, m[3], m[7], m[11], 1]));
      // Normals turn by the columns, whatever these are stretched by.
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

  drawTrail(trail, time) {
    const gl = this.gl, kept = [];
    for (let n = 0; n < trail.times.length && trail.times[n] <= time; n++) {
      const age = time - trail.times[n];
      if (age <= trail.window) for (const k of [0, 1, 2]) kept.push(trail.points[3 * n + k] + age * trail.drift[k]);
    }
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

class Line {
  constructor(run, canvas) {
    this.run = run; this.canvas = canvas;
    const go = (event) => {
      const { begin, end } = run.line, box = canvas.getBoundingClientRect();
      show(begin + ((event.clientX - box.left - 10) / (box.width - 20)) * (end - begin));
      playing = false;
    };
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); go(event); });
    canvas.addEventListener("pointermove", (event) => { if (event.buttons) go(event); });
  }

  draw(time) {
    const { canvas, run: { line } } = this, finer = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, pen = canvas.getContext("2d");
    canvas.width = width * finer; canvas.height = 84 * finer;
    pen.scale(finer, finer);
    const x = (t) => 10 + ((t - line.begin) / Math.max(line.end - line.begin, 1e-9)) * (width - 20);
    const box = (a, b, top, high, fill) => { pen.fillStyle = fill; pen.fillRect(x(a), top, Math.max(x(b) - x(a), 1), high); };
    box(line.begin, line.end, 26, 40, "#eef1f5");
    for (const [a, b] of line.trips) box(a, b, 26, 40, "#f8d3d7");
    for (const [a, b, state] of line.ladder) box(a, b, 18, 6, CONTENT.ladder[state]);
    const peak = Math.max(...line.force, 1e-9);
    pen.beginPath();
    line.force.forEach((f, n) => pen.lineTo(x(line.forceTimes[n]), 65 - (f / peak) * 36));
    pen.strokeStyle = "#1769c9"; pen.stroke();
    pen.font = "11px DejaVu Sans, Verdana, sans-serif"; pen.textBaseline = "middle";
    // Names that would overlap are one; where that is too long, trips are what one looks for.
    const groups = [], wide = (texts) => pen.measureText([...new Set(texts)].join(", ")).width;
    for (const [t, text, named] of line.marks) {
      pen.fillStyle = named ? "#1d2733" : "#c9d0d8"; pen.fillRect(x(t), 26, 1, 40);
      if (!named) continue;
      const last = groups[groups.length - 1];
      if (last && x(t) < last.left + wide(last.texts) + 8) last.texts.push(text);
      else groups.push({ left: x(t), texts: [text] });
    }
    groups.forEach(({ left, texts }, number) => {
      const end = number + 1 < groups.length ? groups[number + 1].left - 6 : width - 4;
      while (texts.length > 1 && left + wide(texts) > end) {
        const spare = texts.map((text) => text.startsWith("trip")).lastIndexOf(false);
        texts.splice(spare, 1);
      }
      pen.fillStyle = texts.some((text) => text.startsWith("trip")) ? "#d62839" : "#1d2733";
      pen.fillText([...new Set(texts)].join(", "), Math.min(left, width - wide(texts) - 4), 9);
    });
    pen.fillStyle = "#66727f"; pen.textAlign = "center";
    const wanted = (line.end - line.begin) / Math.max(2, width / 90), power = 10 ** Math.floor(Math.log10(wanted));
    const step = [1, 2, 5, 10].map((s) => s * power).find((s) => s >= wanted * 0.999);
    for (let t = Math.ceil(line.begin / step) * step; t <= line.end + 1e-6; t += step)
      pen.fillText(`${+t.toFixed(3)} s`, Math.max(16, Math.min(width - 18, x(t))), 75);
    pen.fillStyle = "#1d2733"; pen.fillRect(x(time) - 1, 18, 2, 48);
  }
}

const times = CONTENT.times, begin = times[0], end = times[times.length - 1];
let now = begin, playing = true, dirty = true, clock = null;
const views = [], lines = [], status = [];
const pick = (name) => document.getElementById(name);
document.title = CONTENT.runs.map((run) => run.title).join(" | ");
if (CONTENT.runs.length > 1) pick("runs").className = "several";
for (const run of CONTENT.runs) {
  const box = element("div", "run", pick("runs")), head = element("div", "head", box);
  element("b", "", head).textContent = run.title;
  element("span", "faint", head).textContent = run.figures;
  const ends = element("div", "ends", box);
  for (const station of ["hand", "robot"]) {
    const place = element("div", "end", ends), caption = element("div", "caption", place);
    element("b", "", caption).textContent = station;
    for (const [of, label, tint] of run.legend)
      if (of === station) { element("i", "", caption).style.background = tint; caption.append(label); }
    views.push(new View(run, station, element("canvas", "", place)));
  }
  status.push(element("div", "status", box));
  lines.push(new Line(run, element("canvas", "line", box)));
  if (run.notes.length) element("div", "head faint", box).textContent = run.notes.join("; ");
}

function tell(place, of) {
  place.replaceChildren();
  const chip = (text, fill, ink) => {
    const made = element("span", "chip", place);
    made.textContent = text; made.style.background = fill; made.style.color = ink || "";
  };
  if (of.master) chip(`hand ${of.master}`, CONTENT.ladder[of.master]);
  if (of.slave) chip(`robot ${of.slave}`, CONTENT.ladder[of.slave]);
  if (of.acting) chip(`${of.acting} damps`, "#d62839", "#fff");
  for (const text of of.numbers) element("span", "", place).textContent = text;
  for (const [name, share, text] of of.gauges) {
    element("b", "", place).textContent = name;
    const gauge = element("span", "gauge", place), bar = element("span", "", gauge);
    bar.style.width = `${Math.min(100, 75 * share)}%`;
    bar.style.background = share >= 1 ? "#d62839" : "#1a936f";
    element("em", "", gauge);
    element("span", "faint", place).textContent = text;
  }
}

function show(time) {
  now = Math.max(begin, Math.min(end, time));
  dirty = true;
}
function frameAt(time) {
  let low = 0, high = times.length - 1;
  while (low < high) { const middle = (low + high + 1) >> 1; if (times[middle] <= time + 1e-9) low = middle; else high = middle - 1; }
  return low;
}
function draw(clocked) {
  if (playing && clock !== null) {
    now += ((clocked - clock) / 1000) * Number(pick("speed").value);
    if (now > end) now = begin;
    dirty = true;
  }
  clock = clocked;
  if (dirty) {
    const frame = frameAt(now);
    views.forEach((view) => view.draw(frame, times[frame]));
    lines.forEach((line) => line.draw(now));
    CONTENT.runs.forEach((run, n) => tell(status[n], run.status[frame]));
    pick("now").textContent = `${now.toFixed(3)} s`;
    pick("scrub").value = (now - begin) / Math.max(end - begin, 1e-9);
    pick("play").textContent = playing ? "Pause" : "Play";
    dirty = false;
  }
  requestAnimationFrame(draw);
}
const toggle = () => { playing = !playing; dirty = true; };
function nextTrip() {
  const trips = CONTENT.runs.flatMap((run) => run.line.trips.map(([a]) => a)).sort((a, b) => a - b);
  const next = trips.find((t) => t > now + 0.05) ?? trips[0];
  if (next !== undefined) { playing = false; show(next); }
}
pick("play").addEventListener("click", toggle);
pick("trip").addEventListener("click", nextTrip);
pick("scrub").addEventListener("input", (event) => { playing = false; show(begin + event.target.value * (end - begin)); });
addEventListener("resize", () => { dirty = true; });
addEventListener("keydown", (event) => {
  const on = event.target.tagName;
  // A button takes the space for itself; all other keys are ours, for who has clicked it goes on by them.
  if (on === "SELECT" || (on === "BUTTON" && event.key === " ")) return;
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], camera = Object.values(CONTENT.cameras)[Number(event.key) - 1];
  if (event.key === " ") { toggle(); event.preventDefault(); }
  else if (step) { playing = false; show(times[Math.max(0, Math.min(times.length - 1, frameAt(now) + step))]); event.preventDefault(); }
  else if (event.key === "t") nextTrip();
  else if (camera) { views.forEach((view) => view.look(camera)); dirty = true; }
});
requestAnimationFrame(draw);
