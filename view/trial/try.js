"use strict";
// The page of `haptether try`: one hand on several bridges, their state, and the settings.

const SETTLE_MS = 150;      // from the last move of a slider to its request
const GRIP = { stiffness: ["stiffness", 20, 800, 10, "N/m"], damping: ["damping", 0, 20, 0.5, "N s/m"], strength_n: ["strength", 0.5, 30, 0.5, "N"] };
const NETWORK = { delay_s: ["delay", 0, 300, 5, "ms", 1e3], jitter_s: ["jitter", 0, 30, 1, "ms", 1e3], loss: ["loss", 0, 30, 1, "%", 100] };
const NAMES = { none: "no controller" };
const titled = controller => NAMES[controller] || controller.toUpperCase();

let trial = null;           // settings of the server
const shownPairs = {};
let sidesNow = [];

operator.show = message => {
  if (message.trial) showTrial(message.trial);
  if (message.releases) showReleases(message.releases);
  takeLanes(message.rows);
  if (message.sides) sidesNow = message.sides;
  if (!trial) return;
  if (message.sides) lanes.names.forEach(name => showPair(name, message.sides));
  playForce();
  teach({
    states: lanes.names.map(name => (side(name, "master") || {}).state),
    forces: lanes.names.map(name => norm((lanes.latest[name + ".master"] || {}).device_force)),
    releases: lanes.releases || [],
    network: trial.network,
  });
  $("link").textContent = lostRows ? `${lostRows} rows not shown: this page was too slow` : "";
};
operator.stopped = () => loseHand();

const side = (name, role) => sidesNow.find(one => one.id === `${name}.${role}` && one.side);

async function post(path, change) {
  try {
    const answer = await fetch(base + path, { method: "POST", body: JSON.stringify(change) });
    const { done, text } = await answer.json();
    if (!done) say(text, true);
    return done;
  } catch {
    say("the server does not answer", true);
    return false;
  }
}

// ---------------------------------------------------------------------------------------------------- settings

function slider(place, key, [name, low, high, step, unit, times = 1], value, moved, settled) {
  const line = element("div", "", "slider"), input = element("input"), shown = element("output"), label = element("label", name);
  Object.assign(input, { type: "range", min: low, max: high, step, id: `set-${key}` });
  label.htmlFor = input.id;
  let timer = 0;
  const show = () => { shown.textContent = `${Number(input.value)} ${unit}`; };
  input.set = number => { input.value = Math.round(number * times * 100) / 100; show(); };
  input.set(value);
  input.addEventListener("input", () => {
    show();
    moved(Number(input.value) / times);
    clearTimeout(timer);
    timer = setTimeout(settled, SETTLE_MS);
  });
  line.append(label, input, shown);
  $(place).append(line);
  return input;
}

for (const [key, look] of Object.entries(GRIP)) {
  slider("grip", key, look, hand.grip[key], value => { hand.grip[key] = value; }, () => {});
}

const controls = {};

function makeControls() {
  const network = { ...trial.network };
  for (const [key, look] of Object.entries(NETWORK)) {
    controls[key] = slider("network", key, look, network[key], value => { network[key] = value; }, () => post("network", network));
  }
  const wall = { value: trial.choice.wall_stiffness };
  const restarted = () => restart({ wall_stiffness: wall.value, controllers: chosenControllers() });
  controls.wall = slider("choice", "wall", ["wall", 20, 400, 10, "N/m"], wall.value, value => { wall.value = value; }, () => {});
  controls.wall.addEventListener("change", restarted);
  for (const name of lanes.names) {
    const line = element("div", "", "slider"), label = element("label", name), select = element("select");
    select.id = label.htmlFor = `controller-${name}`;
    for (const one of trial.controllers) select.add(new Option(titled(one), one));
    select.value = trial.choice.controllers[name];
    select.addEventListener("change", restarted);
    line.append(label, select);
    $("choice").append(line);
  }
}

const chosenControllers = () => Object.fromEntries(lanes.names.map(name => [name, $("controller-" + name).value]));

async function restart(choice) {
  letGo();
  openHand();
  say("both bridges restart");
  if (await post("restart", choice)) say("both bridges are back, disengaged: hold Engage");
}

$("restart").addEventListener("click", () => restart({ wall_stiffness: Number(controls.wall.value), controllers: chosenControllers() }));
$("push").addEventListener("click", event => { if (event.isTrusted) pushArms(); });

function showTrial(now) {
  const isFirst = !trial;
  trial = now;
  lanes.names = trial.pairs;
  operator.masters = lanes.names.map(name => `${name}.master`);
  for (const name of lanes.names) lanes.titles[name] = `${name}: ${titled(trial.choice.controllers[name])}`;
  if (isFirst) {
    makeControls();
    beginLesson(0);
    chosen.charts = chartsOf();
  }
  for (const [key, value] of Object.entries(trial.network)) if (document.activeElement !== controls[key]) controls[key].set(value);
  if (trial.phase === "failed") say(`the bridges did not start: ${trial.text}: press Restart`, true);
}

// ---------------------------------------------------------------------------------------------------- state of a pair

const STOPPED = "Press Restart, then hold Engage.";
const ENGAGE = "Hold Engage for a second, then grip.";
const HOLD = `${ENGAGE} Restart also puts the arm back at the stylus.`;
const ADVICE = { disengaged: ENGAGE, hold: HOLD, stop: STOPPED, fault: STOPPED };

function showPair(name, sides) {
  if (!shownPairs[name]) {
    shownPairs[name] = element("section");
    shownPairs[name].id = "pair-" + name;
    $("pairs").append(shownPairs[name]);
  }
  const master = side(name, "master"), slave = side(name, "slave");
  const parts = [element("h2", lanes.titles[name])];
  if (!master || trial.phase === "restarting") {
    parts.push(element("div", trial.phase === "running" ? "not answering" : trial.phase, "state dim"));
  } else {
    const isOver = master.has_ended || Boolean(master.trouble);
    const state = isOver ? "ended" : master.state || "no sample yet";
    parts.push(element("div", state.toUpperCase(), `state ${isOver ? "stop" : state}`));
    parts.push(element("div", isOver ? STOPPED : ADVICE[state] || "", state === "disengaged" ? "" : "trouble"));
    const facts = element("p", "", "facts");
    if (!isOver) {
      facts.append(element("div", `reason: ${master.reason || "none"}`));
      facts.append(element("div", `clutch: ${master.clutch ? "closed" : "open"}, arm: ${slave && !slave.has_ended ? slave.state : "ended"}`));
    }
    facts.append(element("div", linkText(master), "dim"));
    parts.push(facts);
    if (master.cause && !isOver && !ADVICE[state]) parts.push(element("div", `${master.cause.at}: ${master.cause.text}`, "cause"));
    for (const one of master.observers) parts.push(observer(one));
    if (!master.observers.length) parts.push(element("div", "nothing catches the stylus here", "dim"));
  }
  shownPairs[name].replaceChildren(...parts);
}

function linkText(master) {
  const found = Object.fromEntries(master.values.map(one => [one.label, one]));
  const shown = (label, text) => found[label] ? text(found[label]) : null;
  return [shown("round trip [ms]", one => `${number(one.values[0], 0)} ms there and back`),
    shown("frames lost [%]", one => `${number(one.values[0], 0)} % lost`),
    shown("loop late [ms]", one => `loop late by ${number(one.peak, 1)} ms`)].filter(Boolean).join(", ");
}

// Without the sign of a number that rounds to zero.
const rounded = (value, digits) => number(Math.abs(value) < 0.5 * 10 ** -digits ? 0 : value, digits);

function observer(one) {
  const line = element("div", "", "observer"), bar = element("span", "", "bar"), fill = element("i");
  fill.style.width = Math.min(1, one.share || 0) * 100 + "%";
  fill.className = one.share >= 1 ? "over" : one.share >= 0.5 ? "near" : "";
  bar.append(fill);
  line.append(element("b", one.name), ` ${one.symbol} = ${one.value === null ? "-" : rounded(one.value, 3)}, trips ${one.above ? "above" : "below"} ${Number(one.threshold.toPrecision(3))} `,
    element("span", one.tripped ? "TRIPPED" : "armed", one.tripped ? "tripped" : "armed"), bar);
  return line;
}

// ---------------------------------------------------------------------------------------------------- measurements

function showReleases(releases) {
  lanes.releases = releases;
  $("none-yet").hidden = releases.length > 0;
  const body = $("releases").tBodies[0];
  body.replaceChildren();
  for (const row of releases.slice().reverse()) {
    const found = Object.entries(row.pairs), speeds = found.map(([, one]) => one.peak_speed);
    found.forEach(([name, one], index) => {
      const line = body.insertRow();
      if (!index) line.className = "first";
      const isBest = one.is_complete && found.length > 1 && one.peak_speed === Math.min(...speeds) && one.peak_speed < 0.9 * Math.max(...speeds);
      const who = one.controllers.length ? one.controllers.map(titled).join(" ") : titled("none");
      line.append(element("td", index ? "" : `${row.number}. ${row.kind}`), element("td", index ? "" : `${Math.round(row.network.delay_s * 1e3)} ms`),
        element("td", `${name}: ${who}`), element("td", `${one.force_n.toFixed(1)} N`),
        element("td", `${one.peak_speed.toFixed(2)} m/s`, isBest ? "best" : ""), element("td", `${(one.distance * 1e3).toFixed(0)} mm`),
        element("td", one.trip_s === null ? (one.controllers.length ? "none" : "-") : `${(one.trip_s * 1e3).toFixed(0)} ms`));
    });
  }
}

const DASHES = [[6, 3], undefined];
function chartsOf() {
  const series = signal => lanes.names.map((name, index) => [`${name}.master`, signal, name, index ? COLOURS.wsc : COLOURS.arm, DASHES[index]]);
  return { speed: series("velocity"), force: series("device_force") };
}
chosen.height = 150;
chosen.least = { speed: 0.2, force: 1 };   // m/s and N
chosen.draw = () => drawPad();

// ---------------------------------------------------------------------------------------------------- sound

let sound = null;           // { context, gains by name }

$("sound").addEventListener("change", () => {
  if (sound) sound.context.close();
  sound = null;
  if (!$("sound").checked) return;
  const context = new AudioContext(), gains = {};
  lanes.names.forEach((name, index) => {
    const tone = new OscillatorNode(context, { frequency: 140 }), gain = new GainNode(context, { gain: 0 });
    const pan = new StereoPannerNode(context, { pan: lanes.names.length > 1 ? 2 * index / (lanes.names.length - 1) - 1 : 0 });
    tone.connect(gain).connect(pan).connect(context.destination);
    tone.start();
    gains[name] = { gain, tone };
  });
  sound = { context, gains };
});

function playForce() {
  if (!sound) return;
  for (const [name, { gain, tone }] of Object.entries(sound.gains)) {
    const force = norm((lanes.latest[name + ".master"] || {}).device_force), now = sound.context.currentTime;
    gain.gain.setTargetAtTime(Math.min(0.2, force / 40), now, 0.03);
    tone.frequency.setTargetAtTime(140 + 40 * Math.min(force, 10), now, 0.03);
  }
}

hand.ticked = performance.now();
setInterval(tickHand, AIM_MS);
connect();
connectHand();
requestAnimationFrame(draw);
