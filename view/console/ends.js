"use strict";
// Both ends in 3D: bodies are read once and again when their generation changes; otherwise only poses change.

const ends = { bodies: null, frame: null, isAsked: false, isNew: false, views: {}, drawn: 0 };
const DRAW_BODIES_MS = 33;   // between two drawings
ends.base = location.pathname.replace(/[^/]*$/, "");

// Takes new poses; does not draw.
ends.take = frame => {
  if (!frame) return;
  ends.frame = frame;
  ends.isNew = true;
  if (!ends.isAsked && (!ends.bodies || ends.bodies.generation !== frame.generation)) {
    ends.isAsked = true;
    fetch(ends.base + "bodies").then(answer => answer.json()).then(ends.load).catch(ends.fail).finally(() => { ends.isAsked = false; });
  }
};

// A failed drawing does not stop the page.
ends.fail = error => { document.getElementById("ends-notes").textContent = `not drawn: ${error.message}`; };

ends.load = bodies => {
  ends.bodies = bodies;
  bodies.parts.forEach((part, number) => { part.number = number; });
  bodies.trails.forEach((trail, number) => { trail.number = number; });
  document.getElementById("ends").hidden = false;
  document.getElementById("ends-notes").textContent = bodies.notes.join("; ");
  for (const station of ["hand", "robot"]) {
    const figure = document.getElementById("end-" + station), view = bodies.views[station];
    figure.hidden = !view;
    if (!view) continue;
    const caption = figure.querySelector("figcaption");
    const name = document.createElement("b");
    name.textContent = station;
    caption.replaceChildren(name);
    for (const [of, label, colour] of bodies.legend) {
      if (of !== station) continue;
      const sign = document.createElement("i");
      sign.style.background = colour;
      caption.append(sign, label);
    }
    if (!ends.views[station]) {
      ends.views[station] = new View(figure.querySelector("canvas"), bodies.camera, () => { ends.isNew = true; });
    }
    const own = one => one.station === station;
    ends.views[station].load(view, bodies.parts.filter(own), bodies.trails.filter(own));
  }
};

// Called once per browser frame; a hidden page has none.
ends.draw = now => {
  const { bodies, frame } = ends;
  if (!ends.isNew || document.hidden || now - ends.drawn < DRAW_BODIES_MS) return;
  // Poses of another generation belong to other parts.
  if (!bodies || bodies.generation !== frame.generation) return;
  [ends.isNew, ends.drawn] = [false, now];
  try {
    ends.drawBodies(bodies, frame);
  } catch (error) {
    ends.fail(error);
  }
};

ends.drawBodies = (bodies, frame) => {
  const poses = floats(frame.poses), trails = frame.trails.map(floats);
  for (const station of Object.keys(bodies.views)) {
    ends.views[station].draw(part => poses.subarray(12 * part.number, 12 * part.number + 12), trail => trails[trail.number]);
  }
};
