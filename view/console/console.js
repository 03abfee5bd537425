"use strict";
// The page of `haptether console`: shows the server's messages and sends the operator's commands. Stores
// nothing.

const BEAT_MS = 120;       // between two beats of a hold; the side requires five a second
const WINDOW_S = 10;       // width of the charts
const DRAW_MS = 60;         // between two drawings of the charts; leaves time for clicks
const FRESH_MS = 500;      // from a click to its request
const CONFIRM_MS = 10000;  // a change awaits confirmation this long
const RETRY_MS = 500;      // between two attempts to connect
const $ = id => document.getElementById(id);
const base = location.pathname.replace(/[^/]*$/, "");

let socket = null, asked = 0, lostRows = 0;
const waiting = new Map(); // id of a request -> function that takes the answer

// ---------------------------------------------------------------------------------------------------- connection

function connect() {
  socket = new WebSocket("ws://" + location.host + base + "live");
  socket.onopen = () => say("connected");
  socket.onclose = () => {
    for (const done of waiting.values()) done({ done: false, text: "the console does not answer" });
    waiting.clear();
    say("the console is not reachable: the sides go on as they are; STOP them where they run", true);
    setTimeout(connect, RETRY_MS);
  };
  socket.onmessage = event => take(JSON.parse(event.data));
}

function take(message) {
  if (message.kind === "rows") {
    lostRows += message.lost;
    for (const row of message.rows) add(row);
    ends.take(message.bodies);
    if (message.flights) showFlights(message.flights, element);
    if (message.sides) showSides(message.sides);
    needsDraw = true;
  } else if (message.kind === "answer") {
    const done = waiting.get(message.id);
    waiting.delete(message.id);
    if (done) done(message);
  } else if (message.kind === "stopped") {
    sayStopped(message.answers);
  } else {
    say(message.text, true);
  }
}

function ask(side, request) {
  return new Promise(done => {
    if (!socket || socket.readyState !== WebSocket.OPEN) return done({ done: false, text: "the console does not answer" });
    const id = ++asked;
    waiting.set(id, done);
    socket.send(JSON.stringify({ id, side, ...request }));
  });
}

function say(text, bad = false) {
  $("said").textContent = text;
  $("said").className = bad ? "bad" : "";
}

// A request that changes something carries the token of a fresh status, so that a request delayed in a queue
// is rejected. `clicked` is the time of the click.
async function request(side, what, clicked) {
  const status = await ask(side, { do: "status" });
  if (status.done && performance.now() - clicked > FRESH_MS) return say(`${side}: it took too long to get there: once more`, true);
  const answer = status.done ? await ask(side, { ...what, token: status.token }) : status;
  say(`${side}: ${answer.text}`, !answer.done);
}

// ---------------------------------------------------------------------------------------------------- stop

function stop() {
  letGo();
  dismiss();
  sayStopped.done = false;
  say("STOP");
  if (socket && socket.readyState === WebSocket.OPEN && socket.bufferedAmount === 0) {
    socket.send('{"do":"stop"}');
  }
  // Also send by HTTP: the WebSocket may be stuck.
  fetch(base + "stop", { method: "POST", keepalive: true }).then(answer => answer.json()).then(sayStopped).catch(
    () => say("STOP did not reach the console: stop the sides where they run", true));
}

function sayStopped(answers) {
  const texts = Object.entries(answers).map(([, answer]) => `${answer.side || ""} ${answer.text}`);
  // A side that is not at rest needs the operator's attention.
  const done = texts.length > 0 && Object.values(answers).every(answer => answer.done && answer.is_at_rest);
  if (done) sayStopped.done = true;
  // The second of two stops reaches no side any more.
  if (done || !sayStopped.done) {
    say(texts.length ? texts.join("; ") : "no --control was given: nothing can be stopped from here", !done);
  }
}

// ---------------------------------------------------------------------------------------------------- press and hold

let hold = null;           // { began, timer }

async function beat(mine, token) {
  if (hold !== mine) return;
  const held = performance.now() - mine.began;
  $("engage-fill").style.width = Math.min(100, held / 10) + "%";
  const answer = await ask("master", { do: "hold", held_ms: Math.round(held), ...(token === null ? {} : { token }) });
  if (answer.pressed) {
    // The press counts even if it was let go while the answer was on its way.
    const before = mine.presses;
    if (hold === mine) end();
    say("master: " + answer.text);
    // Check that the loop accepted it.
    setTimeout(async () => {
      const status = await ask("master", { do: "status" });
      if (status.done && before !== null && status.ineffective_presses > before) {
        say("the press did nothing: " + (status.ineffective || "see what is to be done first"), true);
      }
    }, 150);
  } else if (hold !== mine) {
    return;
  } else if (!answer.done) {
    end();
    say("master: " + answer.text, true);
  } else {
    if (mine.presses === null) ask("master", { do: "status" }).then(status => { mine.presses = status.ineffective_presses; });
    mine.timer = setTimeout(beat, BEAT_MS, mine, answer.token);
  }
}

function begin(event) {
  if (hold || event.button > 0 || document.hidden || !event.isTrusted) return;
  $("engage").setPointerCapture(event.pointerId);
  hold = { began: performance.now(), timer: 0, presses: null };
  say("hold until the bar is full");
  beat(hold, null);
}

function end() {
  if (hold) clearTimeout(hold.timer);
  hold = null;
  $("engage-fill").style.width = "0";
}

function letGo() {
  if (!hold) return;
  end();
  ask("master", { do: "let_go" });
  say("let go too early: nothing was pressed");
}

$("engage").addEventListener("pointerdown", begin);
for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) $("engage").addEventListener(name, letGo);
$("engage").addEventListener("contextmenu", event => event.preventDefault());
addEventListener("blur", letGo);
addEventListener("pagehide", letGo);
document.addEventListener("visibilitychange", () => { if (document.hidden) letGo(); });

$("stop").addEventListener("pointerdown", event => { if (event.button === 0) stop(); });
$("stop").addEventListener("keydown", event => { if (event.key === "Enter") stop(); });
document.addEventListener("keydown", event => {
  const types = event.target.closest("input");
  if (event.key === "Escape" || (event.key === " " && !types)) {
    event.preventDefault();
    if (!event.repeat) stop();
  }
}, true);
$("release").addEventListener("click", async () => {
  const answer = await ask("master", { do: "release" });
  say(`master: ${answer.text}`, !answer.done);
});
const SCALES = { force: "master", torque: "master", position: "slave", rotation: "slave" };   // scale -> side that has it
for (const [name, side] of Object.entries(SCALES)) {
  $(name + "-form").addEventListener("submit", event => {
    event.preventDefault();
    const text = $(name + "-scale").value, scale = Number(text.trim() || NaN);
    if (Number.isFinite(scale)) confirmed(`${side}: change the ${name} scale to ${scale}?`, side, { do: name + "_scale", scale });
    else say(`${text}: must be a number`, true);
  });
}

// ---------------------------------------------------------------------------------------------------- confirmation

let change = null;         // { side, what, timer }: change that awaits confirmation

// The question stands on the page because a browser dialog would block STOP.
function confirmed(question, side, what) {
  dismiss();
  change = { side, what, timer: setTimeout(dismiss, CONFIRM_MS) };
  $("question").textContent = question;
  $("confirm").hidden = false;
}

function dismiss() {
  if (change) clearTimeout(change.timer);
  change = null;
  $("confirm").hidden = true;
}

$("confirm-yes").addEventListener("click", event => {
  if (!change || !event.isTrusted) return;
  const { side, what } = change;
  dismiss();
  request(side, what, event.timeStamp);
});
$("confirm-no").addEventListener("click", dismiss);
addEventListener("pagehide", dismiss);
document.addEventListener("visibilitychange", () => { if (document.hidden) dismiss(); });

// ---------------------------------------------------------------------------------------------------- words and numbers

function element(name, text = "", kind = "") {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  return made;
}

const number = (value, digits) => value === null ? "-" : value.toFixed(digits);

const sections = [];

function showSides(sides) {
  while (sections.length < sides.length) {
    const section = element("section");
    const words = element("div"), button = element("button", "Acknowledge", "acknowledge");
    button.type = "button";
    section.append(words, button);
    $("sides").append(section);
    const at = sections.length;
    button.addEventListener("click", event => {
      const side = sections[at].side;
      if (side) request(side, { do: "acknowledge" }, event.timeStamp);
    });
    sections.push({ section, words, button, side: null });
  }
  sides.forEach((side, index) => showSide(sections[index], side));
  for (const side of sides) {
    for (const [key, scale] of Object.entries(side.scales || {})) {
      const name = key.replace("_scale", ""), input = $(name + "-scale");
      $(name + "-form").hidden = false;
      // Show the scene's value until the operator types.
      if (input.value === "" && document.activeElement !== input) input.value = scale;
    }
  }
  $("link").textContent = lostRows ? `${lostRows} rows not shown: this page was too slow` : "";
}

const DO = { press: "hold Engage", acknowledge: "press Acknowledge" };

function showSide(shown, side) {
  shown.side = side.side;
  shown.button.disabled = !side.side;
  const parts = [];
  if (side.side) {
    shown.section.id = "side-" + side.side;
    shown.button.id = "acknowledge-" + side.side;
    const title = element("h2", `${side.side} `);
    title.append(element("span", `${side.device}, Haptether ${side.version}, ${side.time_s.toFixed(1)} s`, "dim"));
    const state = side.has_ended ? "ended" : side.state || "no sample yet";
    const line = element("div", "", "headline");
    line.append(element("b", state.toUpperCase(), state), element("span", side.headline.replace(/^\S+/, " ")));
    parts.push(title, line);
    if (!side.secure) parts.push(element("div", "INSECURE: frames are in plain sight", "insecure"));
  }
  if (side.trouble) parts.push(element("div", side.trouble, "trouble"));
  if (side.cause) {
    const cause = element("div", "", "cause");
    cause.append(element("b", `${side.cause.at}: ${side.cause.text}`));
    const steps = element("ol");
    for (const step of side.cause.steps) steps.append(element("li", step.text + (DO[step.remedy] ? ` (${step.at}: ${DO[step.remedy]})` : "")));
    if (side.cause.steps.length) cause.append(steps);
    parts.push(cause);
  }
  if (side.side) {
    parts.push(numbers(side), observers(side));
    const events = element("div", "", "events");
    for (const [time, text] of side.events.slice().reverse()) events.append(element("div", `${time.toFixed(3)} s  ${text}`));
    parts.push(events);
    if (side.invalid) parts.push(element("div", side.invalid, "trouble"));
    if (side.lost_ticks) parts.push(element("div", `${side.lost_ticks} ticks not seen here`, "dim"));
  }
  const before = shown.words.querySelector(".events"), scrolled = before ? before.scrollTop : 0;
  shown.words.replaceChildren(...parts);
  const after = shown.words.querySelector(".events");
  if (after) after.scrollTop = scrolled;
}

function numbers(side) {
  const table = element("table");
  for (const one of side.values) {
    const row = table.insertRow();
    row.append(element("td", one.label), element("td", one.values.map(value => (one.signed && value >= 0 ? "+" : "") + number(value, one.digits)).join("  "), "number"),
      element("td", one.peak === null ? "" : `1 s: ${number(one.peak, one.digits)}`, "number dim"));
  }
  return table;
}

function observers(side) {
  const table = element("table");
  for (const one of side.observers) {
    const row = table.insertRow(), bar = element("span", "", "bar"), fill = element("i");
    if (one.share !== null) {
      fill.style.width = Math.min(1, one.share) * 100 + "%";
      fill.className = one.share >= 1 ? "over" : one.share >= 0.5 ? "near" : "";
    }
    bar.append(fill);
    const cell = element("td");
    cell.append(bar);
    const threshold = one.threshold === null ? "" : `${one.above ? ">" : "<"} ${one.threshold}`;
    row.append(element("td", `${one.name}  ${one.symbol} = ${one.value === null ? "-" : one.value.toPrecision(3)}`), cell,
      element("td", threshold, "number"), element("td", one.tripped ? "TRIPPED" : "armed", one.tripped ? "tripped" : "armed"));
  }
  if (side.held) table.insertRow().append(element("td", "an intervention is held on"));
  return table;
}

// ---------------------------------------------------------------------------------------------------- charts

// Those of every figure of the project.
const COLOURS = JSON.parse($("colours").textContent);
// Side, signal, name, colour.
const CHARTS = {
  position: [["master", "position", "hand", COLOURS.hand], ["slave", "command", "commanded", COLOURS.commanded],
    ["slave", "position", "tool", COLOURS.arm]],
  force: [["master", "rendered_force", "requested F_v", COLOURS.rendered], ["master", "safety_force", "controllers F_c", COLOURS.safety],
    ["master", "device_force", "exerted F_device", COLOURS.hand], ["slave", "environment_force", "on the tool F_e", COLOURS.arm]],
  observer: ["vfc", "hsc", "wsc", "pc"].map(name => ["master", name, name.toUpperCase(), COLOURS[name]]),
};
const rows = [];
let charts = null, needsDraw = false, drawn = 0;

function add(row) {
  rows.push(row);
  while (rows.length > 1 && rows[0].t < row.t - WINDOW_S) rows.shift();
  const values = (row.master && row.master.position) || (row.slave && row.slave.position);
  const axis = $("axis");
  while (values && axis.options.length < values.length) axis.add(new Option(axis.options.length + 1, axis.options.length));
}

function values(side, signal) {
  const axis = Number($("axis").value);
  return rows.map(row => {
    const value = row[side] && row[side][signal];
    const number = Array.isArray(value) ? value[axis] : value;
    return number === undefined ? null : number;
  });
}

function makeCharts() {
  charts = {};
  for (const [name, series] of Object.entries(CHARTS)) {
    const place = $("chart-" + name);
    charts[name] = new uPlot({
      width: place.clientWidth || 420, height: 170, scales: { x: { time: false } }, cursor: { show: false },
      axes: [{ values: (_, ticks) => ticks.map(tick => tick.toFixed(0) + " s") }, { size: 60 }],
      series: [{ label: "s" }, ...series.map(([, , label, stroke]) => ({ label, stroke, width: 1.5, spanGaps: true }))],
      legend: { live: false },
    }, [[], ...series.map(() => [])], place);
  }
}

function draw(now) {
  if (needsDraw && !document.hidden && now - drawn >= DRAW_MS) {
    [needsDraw, drawn] = [false, now];
    if (!charts) makeCharts();
    const newest = rows.length ? rows[rows.length - 1].t : 0;
    const times = rows.map(row => row.t - newest);
    for (const [name, series] of Object.entries(CHARTS)) {
      charts[name].setData([times, ...series.map(([side, signal]) => values(side, signal))]);
    }
  }
  ends.draw(now);
  requestAnimationFrame(draw);
}

addEventListener("resize", () => {
  for (const name of Object.keys(charts || {})) charts[name].setSize({ width: $("chart-" + name).clientWidth, height: 170 });
});

connect();
requestAnimationFrame(draw);
