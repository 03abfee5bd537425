"use strict";
// Three lessons, each a list of steps that the page recognises from what the person does.

const PRESSED_N = 2.0;      // force of a wall worth letting go of
const lessons = { at: 0, step: 0, since: 0, results: [], shown: "" };

const engaged = seen => seen.states.every(state => state === "engaged" || state === "stale");
const letGoRow = (seen, force) => seen.releases.find(row => row.kind === "let go" && row.number > lessons.since && complete(row, force));
const complete = (row, force) => Object.keys(row.pairs).length === lanes.names.length
  && Object.values(row.pairs).every(one => one.is_complete && one.force_n >= force);

const WALL = [
  ["Hold Engage until its bar is full: only a person couples the two sides, at the start and after each HOLD.", engaged],
  [`Press the mouse button right of the wall, keep it pressed, and draw the blue styluses into the wall, until both arrows read ${PRESSED_N}\u00a0N or more.`,
    seen => hand.by && seen.forces.every(force => force >= PRESSED_N)],
  ["Let go of the mouse button.", seen => letGoRow(seen, 0.5 * PRESSED_N)],
];
const LESSONS = [
  { name: "1 Let go at a wall", steps: WALL,
    learnt: speeds => `The wall threw the stylus: ${speeds}. A controller acts once no hand holds the stylus; before, both feel the same.` },
  { name: "2 An unexpected push", steps: [
    WALL[0],
    ["Press the mouse button right of the wall, and keep it pressed: the hand holds both styluses there.", seen => hand.by],
    ["Press the key P: something pushes both remote arms for 2 s.", seen => seen.releases.some(row => row.kind === "push" && row.number > lessons.since)],
    ["Let go of the mouse button while it still pushes. If the push is over, press the mouse button and P again.", seen => letGoRow(seen, 0.5)]],
    learnt: speeds => `The push came through the network, and threw the stylus when the hand let go: ${speeds}.` },
  { name: "3 At 200 ms", steps: [
    ["Set the delay of the network to 200 ms, with its slider. Both bridges HOLD, because nothing arrives for so long.", seen => seen.network.delay_s >= 0.195],
    ...WALL],
    learnt: speeds => `After the hand lets go, the wall pushes for one round trip more, here 0.4 s: ${speeds}. The stylus reaches its stop before that; without a stop it would become faster than in lesson 1.` },
];

function beginLesson(at) {
  const newest = lanes.releases && lanes.releases.length ? lanes.releases[lanes.releases.length - 1].number : 0;
  Object.assign(lessons, { at, step: 0, since: newest, shown: "" });
}

function speeds(row) {
  const of = one => one.controllers.length ? `with ${one.controllers.map(titled).join(" and ")} to catch it` : "without a controller";
  return lanes.names.map(name => `${row.pairs[name].peak_speed.toFixed(2)} m/s ${of(row.pairs[name])}`).join(", ");
}

// Called with each message.
function teach(seen) {
  const lesson = LESSONS[lessons.at];
  // A step that has been done is not asked for again, but a lost engagement is.
  if (lessons.step > 0 && lessons.step < lesson.steps.length && seen.states.some(state => state && !["engaged", "stale"].includes(state))) {
    lessons.step = Math.min(lessons.step, lesson.steps.findIndex(([, done]) => done === engaged));
  }
  while (lessons.step < lesson.steps.length) {
    const found = lesson.steps[lessons.step][1](seen);
    if (!found) break;
    lessons.step += 1;
    if (lessons.step === lesson.steps.length) lessons.results[lessons.at] = speeds(found);
  }
  showLesson();
}

function showLesson() {
  const lesson = LESSONS[lessons.at], isOver = lessons.step >= lesson.steps.length;
  const shown = JSON.stringify([lessons.at, lessons.step, lessons.results]);
  if (shown === lessons.shown) return;
  lessons.shown = shown;
  const nav = element("nav");
  LESSONS.forEach((one, at) => {
    const kind = (at === lessons.at ? "here " : "") + (lessons.results[at] ? "done" : "");
    const button = element("button", (lessons.results[at] ? "✓ " : "") + one.name, kind);
    button.type = "button";
    button.addEventListener("click", () => beginLesson(at));
    nav.append(button);
  });
  const list = element("ol");
  lesson.steps.forEach(([text], step) => list.append(element("li", text, step < lessons.step ? "done" : step === lessons.step ? "next" : "later")));
  const parts = [nav, list];
  if (isOver) {
    parts.pop();
    parts.push(element("p", lesson.learnt(lessons.results[lessons.at])));
    const next = element("button", lessons.at + 1 < LESSONS.length ? "Next lesson" : "Again from the first", "next-lesson");
    next.type = "button";
    next.addEventListener("click", () => beginLesson((lessons.at + 1) % LESSONS.length));
    parts.push(next);
  }
  $("lesson").replaceChildren(...parts);
}
