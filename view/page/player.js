"use strict";
// Plays CONTENT, a run with precomputed frames. Load the renderer first.

function element(kind, name, parent) {
  const made = document.createElement(kind);
  if (name) made.className = name;
  if (parent) parent.append(made);
  return made;
}

// Visible points of a trail at a time.
function kept(trail, time) {
  const points = [];
  for (let n = 0; n < trail.times.length && trail.times[n] <= time; n++) {
    const age = time - trail.times[n];
    if (age <= trail.window) for (const k of [0, 1, 2]) points.push(trail.points[3 * n + k] + age * trail.drift[k]);
  }
  return points;
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
    // Merge names that would overlap; if the result is too long, keep trips.
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
  for (const part of run.parts) part.poses = floats(part.poses);
  for (const trail of run.trails) { trail.times = floats(trail.times); trail.points = floats(trail.points); }
  const box = element("div", "run", pick("runs")), head = element("div", "head", box);
  element("b", "", head).textContent = run.title;
  element("span", "faint", head).textContent = run.figures;
  const ends = element("div", "ends", box);
  for (const station of ["hand", "robot"]) {
    if (!run.views[station]) continue;
    const place = element("div", "end", ends), caption = element("div", "caption", place);
    element("b", "", caption).textContent = station;
    for (const [of, label, tint] of run.legend)
      if (of === station) { element("i", "", caption).style.background = tint; caption.append(label); }
    const view = new View(element("canvas", "", place), CONTENT.camera, () => { dirty = true; });
    view.load(run.views[station], run.parts.filter((part) => part.station === station),
      run.trails.filter((trail) => trail.station === station));
    views.push(view);
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
    views.forEach((view) => view.draw(
      ({ poses }) => poses.subarray(poses.length === 12 ? 0 : 12 * frame).subarray(0, 12), (trail) => kept(trail, times[frame])));
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
  // The space key acts on a focused button; all other keys are handled here, also after a click on a button.
  if (on === "SELECT" || (on === "BUTTON" && event.key === " ")) return;
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], camera = Object.values(CONTENT.cameras)[Number(event.key) - 1];
  if (event.key === " ") { toggle(); event.preventDefault(); }
  else if (step) { playing = false; show(times[Math.max(0, Math.min(times.length - 1, frameAt(now) + step))]); event.preventDefault(); }
  else if (event.key === "t") nextTrip();
  else if (camera) { views.forEach((view) => view.look(camera)); dirty = true; }
});
requestAnimationFrame(draw);
