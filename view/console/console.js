"use strict";
// The page of `haptether console`: one pair, its scales, its bodies in 3D.

const CONFIRM_MS = 10000;  // a change awaits confirmation this long

operator.show = message => {
  ends.take(message.bodies);
  if (message.flights) showFlights(message.flights, element);
  if (message.sides) showSides(message.sides);
};
operator.stopped = () => dismiss();

// ---------------------------------------------------------------------------------------------------- scales

const SCALES = { force: "master", torque: "master", position: "slave", rotation: "slave" };   // scale -> side that has it
for (const [name, side] of Object.entries(SCALES)) {
  $(name + "-form").addEventListener("submit", event => {
    event.preventDefault();
    const text = $(name + "-scale").value, scale = Number(text.trim() || NaN);
    if (Number.isFinite(scale)) confirmed(`${side}: change the ${name} scale to ${scale}?`, side, { do: name + "_scale", scale });
    else say(`${text}: must be a number`, true);
  });
}

function showScales(side) {
  for (const [key, scale] of Object.entries(side.scales || {})) {
    const name = key.replace("_scale", ""), input = $(name + "-scale");
    $(name + "-form").hidden = false;
    // Show the scene's value until the operator types.
    if (input.value === "" && document.activeElement !== input) input.value = scale;
  }
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

// ---------------------------------------------------------------------------------------------------- sides and charts

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
  sides.forEach(showScales);
  $("link").textContent = lostRows ? `${lostRows} rows not shown: this page was too slow` : "";
}

// Side, signal, name, colour.
chosen.charts = {
  position: [["master", "position", "hand", COLOURS.hand], ["slave", "command", "commanded", COLOURS.commanded],
    ["slave", "position", "tool", COLOURS.arm]],
  force: [["master", "rendered_force", "requested F_v", COLOURS.rendered], ["master", "safety_force", "controllers F_c", COLOURS.safety],
    ["master", "device_force", "exerted F_device", COLOURS.hand], ["slave", "environment_force", "on the tool F_e", COLOURS.arm]],
  observer: ["vfc", "hsc", "wsc", "pc"].map(name => ["master", name, name.toUpperCase(), COLOURS[name]]),
};
chosen.draw = now => ends.draw(now);

connect();
requestAnimationFrame(draw);
