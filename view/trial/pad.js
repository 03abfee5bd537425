"use strict";
// The field: one lane per bridge with the wall, the stylus, the remote tool and the force; the pointer moves the hand.

const SPAN = 0.1;           // half the width of the field in m
const ARROW = 22;           // pixels of a force of 1 N
const pad = $("pad");
const lanes = { names: [], titles: {}, latest: {}, isNew: true };

function padX(metres) { return (metres + SPAN) / (2 * SPAN) * pad.clientWidth; }

function point(event) {
  const box = pad.getBoundingClientRect();
  moveHand(((event.clientX - box.left) / box.width * 2 - 1) * SPAN);
  if (hand.target.length > 1) moveHand((1 - (event.clientY - box.top) / box.height * 2) * SPAN, 1);
  lanes.isNew = true;
}

pad.addEventListener("pointerdown", event => {
  if (event.button > 0 || !event.isTrusted) return;
  pad.setPointerCapture(event.pointerId);
  point(event);
  gripHand("pointer");
});
pad.addEventListener("pointermove", event => { if (event.isTrusted && (!hand.by || hand.by === "pointer")) point(event); });
for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
  pad.addEventListener(name, () => { if (hand.by === "pointer") openHand(); });
}
pad.addEventListener("contextmenu", event => event.preventDefault());

// Keeps the newest values of each side; a row without one keeps the last.
function takeLanes(rows) {
  for (const row of rows) {
    for (const [id, values] of Object.entries(row)) if (id !== "t") Object.assign(lanes.latest[id] ||= {}, values);
  }
  lanes.isNew = true;
}

const norm = values => values && values.every(Number.isFinite) ? Math.hypot(...values) : 0;

function drawPad() {
  if (!lanes.isNew || document.hidden) return;
  lanes.isNew = false;
  const scale = devicePixelRatio || 1, wide = pad.clientWidth, high = pad.clientHeight;
  if (pad.width !== Math.round(wide * scale)) [pad.width, pad.height] = [Math.round(wide * scale), Math.round(high * scale)];
  const to = pad.getContext("2d");
  to.setTransform(scale, 0, 0, scale, 0, 0);
  to.clearRect(0, 0, wide, high);
  to.font = "13px system-ui, 'DejaVu Sans', sans-serif";
  const height = high / Math.max(1, lanes.names.length);
  lanes.names.forEach((name, index) => drawLane(to, name, index * height, height, wide));
  // The target of the hand.
  const at = padX(hand.target[0]);
  to.strokeStyle = hand.by ? "#1f2328" : "#8c959f";
  to.setLineDash(hand.by ? [] : [4, 4]);
  to.beginPath();
  to.moveTo(at, 0);
  to.lineTo(at, high);
  to.stroke();
  to.setLineDash([]);
}

function drawLane(to, name, top, height, wide) {
  const middle = top + height / 2 + 6, wall = padX(0);
  const master = lanes.latest[name + ".master"] || {}, slave = lanes.latest[name + ".slave"] || {};
  to.fillStyle = "#fff";
  to.fillRect(0, top, wide, height - 4);
  to.fillStyle = "#e7ebef";
  to.fillRect(0, top, wall, height - 4);
  to.fillStyle = "#57606a";
  to.fillText("remote wall", 8, top + height - 14);
  to.fillStyle = "#1f2328";
  to.textAlign = "right";
  to.font = "600 13px system-ui, 'DejaVu Sans', sans-serif";
  to.fillText(lanes.titles[name] || name, wide - 10, top + 18);
  to.font = "13px system-ui, 'DejaVu Sans', sans-serif";
  to.textAlign = "left";
  to.strokeStyle = "#8c959f";
  to.beginPath();
  to.moveTo(0, middle);
  to.lineTo(wide, middle);
  to.stroke();
  if (slave.position) {
    to.fillStyle = COLOURS.arm;
    to.fillRect(padX(slave.position[0]) - 5, middle - 22, 10, 44);
  }
  if (!master.position) return;
  const x = padX(master.position[0]), force = master.device_force || [];
  // A spring between the hand's target and the stylus shows the grip.
  if (hand.by) {
    to.strokeStyle = "#8c959f";
    to.lineWidth = 3;
    to.beginPath();
    to.moveTo(padX(hand.target[0]), middle);
    to.lineTo(x, middle);
    to.stroke();
    to.lineWidth = 1;
  }
  to.fillStyle = COLOURS.hand;
  to.beginPath();
  to.arc(x, middle, 11, 0, 2 * Math.PI);
  to.fill();
  if (hand.by) {
    to.strokeStyle = "#1f2328";
    to.lineWidth = 3;
    to.stroke();
    to.lineWidth = 1;
  }
  const along = Number.isFinite(force[0]) ? force[0] : 0, tip = x + ARROW * along, sign = Math.sign(along);
  if (Math.abs(along) > 0.05) {
    to.strokeStyle = to.fillStyle = COLOURS.rendered;
    to.lineWidth = 4;
    to.beginPath();
    to.moveTo(x, middle - 26);
    to.lineTo(tip, middle - 26);
    to.stroke();
    to.lineWidth = 1;
    to.beginPath();
    to.moveTo(tip + 9 * sign, middle - 26);
    to.lineTo(tip - 2 * sign, middle - 33);
    to.lineTo(tip - 2 * sign, middle - 19);
    to.fill();
  }
  to.fillStyle = "#1f2328";
  to.fillText(`${norm(force).toFixed(1)} N`, Math.max(4, Math.min(wide - 44, x - 14)), middle + 32);
}
