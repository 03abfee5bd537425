"use strict";
// Flight recording of each side at its last hold or end: the cause in words and the ticks before it.

function showFlights(flights, element) {
  document.getElementById("flights").replaceChildren(...flights.map(flight => flightSection(flight, element)));
}

function flightSection(flight, element) {
  const section = element("section", "", "flight");
  if (flight.error) {
    section.append(element("div", flight.error, "trouble"));
    return section;
  }
  section.id = "flight-" + flight.side;
  const written = new Date(flight.written_s * 1000).toLocaleTimeString();
  const title = element("h2", `Flight recorder of the ${flight.side} `);
  title.append(element("span", `written at ${written}`, "dim"));
  section.append(title);
  if (flight.cause) {
    const cause = element("div", "", "cause"), steps = element("ol");
    cause.append(element("b", `${flight.cause.time_s.toFixed(3)} s, ${flight.cause.state}: ${flight.cause.at}: ${flight.cause.text}`));
    for (const step of flight.cause.steps) steps.append(element("li", step.text));
    if (flight.cause.steps.length) cause.append(steps);
    section.append(cause);
  }
  for (const [time, from, to, reason] of flight.steps) section.append(element("div", `${time.toFixed(3)} s  ${from} to ${to}: ${reason}`));
  for (const text of flight.interventions) section.append(element("div", `intervention ${text}`));
  const fold = element("details");
  fold.append(element("summary", `the last ${flight.ticks.length} ticks until ${flight.until}`), tickTable(flight, element));
  fold.open = true;
  section.append(fold);
  return section;
}

function tickTable(flight, element) {
  const numbers = values => values.map(value => value === null ? "none" : value.toPrecision(4)).join("  ");
  const columns = {
    "time [s]": tick => tick.time_s.toFixed(4),
    state: tick => tick.state,
    peer: tick => tick.peer || "-",
    "silent [ms]": tick => tick.age_s === null ? "-" : (tick.age_s * 1e3).toFixed(1),
    clutch: tick => tick.clutch ? "closed" : "open",
    gain: tick => tick.gain.toFixed(2),
    trips: tick => tick.tripped.join(" ") || "-",
    "position [m, rad]": tick => numbers(tick.position),
    [flight.side === "master" ? "device force [N, N m]" : "command [m, rad]"]: tick => numbers(tick.command),
    "force [N, N m]": tick => numbers(tick.force),
  };
  const table = element("table"), head = table.createTHead().insertRow(), body = table.createTBody();
  head.append(...Object.keys(columns).map(name => element("th", name)));
  for (const tick of flight.ticks) body.insertRow().append(...Object.values(columns).map(of => element("td", of(tick))));
  return table;
}
