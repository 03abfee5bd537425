"use strict";
// The hand: pointer, touch, keys and gamepad move its target and grip; sent while it grips, each aim after the answer
// to the one before. Nothing here presses a clutch.

const AIM_MS = 16;          // between two aims
const HELD_UP_MS = 350;     // a page held up for longer has lost its grip
const FRESH_TOKEN_MS = 250; // age of a token, and of a press of P, that may still grip or push
const KEY_SPEED = 0.08;     // of the target by keys, in m/s
const STICK = 0.08;         // dead zone of a gamepad
const PUSH = { force_n: 3.5, duration_s: 2.0 };

const hand = {
  by: null,                 // what grips: pointer, key or gamepad
  target: [0.02],           // in m
  reach: 0.085,             // largest target in m
  grip: { stiffness: 300, damping: 8, strength_n: 12 },
  socket: null, token: null, isWaiting: false, sent: 0, answered: 0, mustOpen: false, push: null, ticked: 0, wasPressed: false,
  arrows: new Set(),
};

function connectHand() {
  const mine = hand.socket = new WebSocket("ws://" + location.host + base + "hand");
  hand.token = null;
  hand.isWaiting = true;    // until the first token
  mine.onclose = () => {
    loseHand();
    hand.token = null;
    setTimeout(connectHand, RETRY_MS);
  };
  mine.onmessage = event => {
    const answer = JSON.parse(event.data);
    hand.token = answer.token;
    hand.isWaiting = false;
    hand.answered = performance.now();
    if (answer.to === "push") say(answer.done ? "both arms are pushed" : answer.text, !answer.done);
    if (answer.to !== "aim" || answer.done) return;
    if (hand.by) openHand(answer.text);
  };
}

function gripHand(by) {
  if (hand.by || document.hidden) return;
  hand.by = by;
  hand.mustOpen = true;
}

function openHand(why = "") {
  if (!hand.by) return;
  hand.by = null;
  hand.mustOpen = true;
  if (why) say(why, true);
}

function moveHand(at, axis = 0) {
  hand.target[axis] = Math.max(-hand.reach, Math.min(hand.reach, at));
}

function tickHand() {
  const now = performance.now(), gap = now - hand.ticked;
  hand.ticked = now;
  if (gap > HELD_UP_MS && hand.by) openHand("the page was held up: the hand has opened; grip again");
  takeKeys(Math.min(gap, 50) / 1e3);
  takeGamepad();
  if (hand.push && now - hand.push.pressed > FRESH_TOKEN_MS) {
    hand.push = null;
    say("the page was late: nothing is pushed; once more", true);
  }
  if (hand.isWaiting) {
    if (hand.by && now - hand.sent > HELD_UP_MS) openHand("no answer: the hand has opened; grip again");
    return;
  }
  if (!hand.socket || hand.socket.readyState !== WebSocket.OPEN) return;
  const isFresh = now - hand.answered < FRESH_TOKEN_MS;
  if (hand.push && isFresh) {
    sendHand({ do: "push", force: hand.push.force, duration_s: hand.push.duration_s });
    hand.push = null;
  } else if (hand.by || hand.push || hand.mustOpen) {
    // An open hand needs no fresh token, and allows the next grip. A grip that is late stays open until it is released.
    if (hand.by && !hand.mustOpen && !isFresh) openHand("the page was held up: the hand has opened; grip again");
    const strength_n = hand.by && !hand.mustOpen ? hand.grip.strength_n : 0;
    hand.mustOpen = false;
    sendHand({ do: "aim", target: hand.target, stiffness: hand.grip.stiffness, damping: hand.grip.damping, strength_n });
  }
}

function sendHand(request) {
  hand.isWaiting = true;
  hand.sent = performance.now();
  hand.socket.send(JSON.stringify({ ...request, token: hand.token }));
}

function pushArms() {
  hand.push = { force: hand.target.map((_, axis) => axis ? 0 : PUSH.force_n), duration_s: PUSH.duration_s, pressed: performance.now() };
}

// ---------------------------------------------------------------------------------------------------- keys and gamepad

const ARROWS = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowDown: [1, -1], ArrowUp: [1, 1] };

function takeKeys(seconds) {
  for (const key of hand.arrows) {
    const [axis, sign] = ARROWS[key];
    if (axis < hand.target.length) moveHand(hand.target[axis] + sign * KEY_SPEED * seconds, axis);
  }
}

function takeGamepad() {
  const stick = [...navigator.getGamepads()].find(Boolean);
  const isPressed = Boolean(stick && stick.buttons[0] && stick.buttons[0].pressed);
  // Every window sees a gamepad.
  if (isPressed && !hand.wasPressed && document.hasFocus()) gripHand("gamepad");
  if (!isPressed && hand.by === "gamepad") openHand();
  hand.wasPressed = isPressed;
  if (!stick || !document.hasFocus() || (hand.by && hand.by !== "gamepad")) return;
  hand.target.forEach((_, axis) => {
    const at = stick.axes[axis] || 0;
    if (Math.abs(at) > STICK || hand.by === "gamepad") moveHand((axis ? -at : at) * hand.reach, axis);
  });
}

document.addEventListener("keydown", event => {
  if (event.repeat || !event.isTrusted || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.target.closest("input[type=range], select") && event.key in ARROWS) return;
  if (event.key in ARROWS) {
    event.preventDefault();
    hand.arrows.add(event.key);
  } else if (event.key.toLowerCase() === "g") {
    gripHand("key");
  } else if (event.key.toLowerCase() === "p") {
    pushArms();
  }
});
document.addEventListener("keyup", event => {
  hand.arrows.delete(event.key);
  if (event.key.toLowerCase() === "g" && hand.by === "key") openHand();
});

function loseHand() {
  hand.arrows.clear();
  hand.push = null;
  openHand();
}

addEventListener("blur", loseHand);
addEventListener("pagehide", loseHand);
document.addEventListener("visibilitychange", () => { if (document.hidden) loseHand(); });
