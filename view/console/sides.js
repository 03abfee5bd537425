"use strict";
// State of a side in words and numbers.

function element(name, text = "", kind = "") {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  return made;
}

const number = (value, digits) => value === null ? "-" : value.toFixed(digits);

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
