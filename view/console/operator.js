"use strict";
// Operator commands of every page on live sides: connection, STOP, press and hold. Stores nothing.

const BEAT_MS = 120;       // between two beats of a hold; the side requires five a second
const FRESH_MS = 500;      // from a click to its request
const RETRY_MS = 500;      // between two attempts to connect
const $ = id => document.getElementById(id);
const base = location.pathname.replace(/[^/]*$/, "");

// Set by the page: its masters, which one Engage presses; called with each message, and at each STOP.
const operator = { masters: ["master"], show: () => {}, stopped: () => {} };

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
    needsDraw = true;
    operator.show(message);
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
  sayStopped.done = false;
  if (socket && socket.readyState === WebSocket.OPEN && socket.bufferedAmount === 0) {
    socket.send('{"do":"stop"}');
  }
  // Also send by HTTP: the WebSocket may be stuck.
  fetch(base + "stop", { method: "POST", keepalive: true }).then(answer => answer.json()).then(sayStopped).catch(
    () => say("STOP did not reach the console: stop the sides where they run", true));
  // An exception here must not lose the requests.
  letGo();
  operator.stopped();
  say("STOP");
}

function sayStopped(answers) {
  const texts = Object.entries(answers).map(([, answer]) => `${answer.side || ""} ${answer.text}`);
  // A side that is not at rest needs the operator's attention.
  const done = texts.length > 0 && Object.values(answers).every(answer => answer.done && answer.is_at_rest);
  if (done) sayStopped.done = true;
  if (done && texts.length > 2) texts.splice(0, texts.length, `all ${texts.length} sides have stopped: no force, no motion`);
  // The second of two stops reaches no side any more.
  if (done || !sayStopped.done) {
    say(texts.length ? texts.join("; ") : "no --control was given: nothing can be stopped from here", !done);
  }
}

// ---------------------------------------------------------------------------------------------------- press and hold

let hold = null;           // { began, left: masters not pressed yet, timers, presses: ineffective presses before }

// Each master has beats and tokens of its own; one button holds all.
async function beat(mine, master, token) {
  if (hold !== mine) return;
  const held = performance.now() - mine.began;
  $("engage-fill").style.width = Math.min(100, held / 10) + "%";
  const answer = await ask(master, { do: "hold", held_ms: Math.round(held), ...(token === null ? {} : { token }) });
  if (answer.pressed) {
    // The press counts even if it was let go while the answer was on its way.
    mine.left.delete(master);
    if (hold === mine && !mine.left.size) end();
    say(operator.masters.length > 1 && !mine.left.size ? "both clutches are pressed" : `${master}: ${answer.text}`);
    checkPress(master, mine.presses[master]);
  } else if (hold !== mine) {
    return;
  } else if (!answer.done) {
    letGo();
    say(`${master}: ${answer.text}`, true);
  } else {
    if (!(master in mine.presses)) {
      mine.presses[master] = null;
      ask(master, { do: "status" }).then(status => { mine.presses[master] = status.ineffective_presses; });
    }
    mine.timers[master] = setTimeout(beat, BEAT_MS, mine, master, answer.token);
  }
}

// Check that the loop accepted a press.
function checkPress(master, before) {
  setTimeout(async () => {
    const status = await ask(master, { do: "status" });
    if (status.done && Number.isInteger(before) && status.ineffective_presses > before) {
      say(`${master}: the press did nothing: ` + (status.ineffective || "see what is to be done first"), true);
    }
  }, 150);
}

function begin(event) {
  if (hold || event.button > 0 || document.hidden || !event.isTrusted) return;
  $("engage").setPointerCapture(event.pointerId);
  hold = { began: performance.now(), left: new Set(operator.masters), timers: {}, presses: {} };
  say("hold until the bar is full");
  for (const master of operator.masters) beat(hold, master, null);
}

function end() {
  if (hold) Object.values(hold.timers).forEach(clearTimeout);
  hold = null;
  $("engage-fill").style.width = "0";
}

function letGo() {
  if (!hold) return;
  const left = [...hold.left];
  end();
  for (const master of left) ask(master, { do: "let_go" });
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
  const types = event.target.closest("input:not([type=range], [type=checkbox])");
  if (event.key === "Escape" || (event.key === " " && !types)) {
    event.preventDefault();
    if (!event.repeat) stop();
  }
}, true);
$("release").addEventListener("click", async () => {
  const answers = await Promise.all(operator.masters.map(async master => [master, await ask(master, { do: "release" })]));
  say(answers.map(([master, answer]) => `${master}: ${answer.text}`).join("; "), answers.some(([, answer]) => !answer.done));
});
