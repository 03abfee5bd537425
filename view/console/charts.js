"use strict";
// Charts of the last seconds, drawn from the rows of all sides.

const WINDOW_S = 10;       // width of the charts
const DRAW_MS = 60;        // between two drawings of the charts; leaves time for clicks
// Those of every figure of the project.
const COLOURS = JSON.parse($("colours").textContent);
const rows = [];
// Set by the page: by name of a chart its series, each with side, signal, label, colour and dashes, and the least extent
// of its values in both directions; and the height of all.
const chosen = { charts: {}, least: {}, height: 170, draw: () => {} };
let charts = null, needsDraw = false, drawn = 0;

function add(row) {
  rows.push(row);
  while (rows.length > 1 && rows[0].t < row.t - WINDOW_S) rows.shift();
  const values = Object.values(row).map(side => side.position).find(Boolean), axis = $("axis");
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
  for (const [name, series] of Object.entries(chosen.charts)) {
    const place = $("chart-" + name);
    charts[name] = new uPlot({
      width: place.clientWidth || 420, height: chosen.height, scales: { x: { time: false }, ...extent(chosen.least[name]) }, cursor: { show: false },
      axes: [{ values: (_, ticks) => ticks.map(tick => Number(tick.toFixed(1)) + " s") }, { size: 60, space: 24 }],
      series: [{ label: "s" }, ...series.map(([, , label, stroke, dash]) => ({ label, stroke, dash, width: 1.5, spanGaps: true }))],
      legend: { live: false },
    }, [[], ...series.map(() => [])], place);
  }
}

// Without it, values that are all 0 span 0 to 100.
function extent(least) {
  return least ? { y: { range: (_, low, high) => uPlot.rangeNum(Math.min(low, -least), Math.max(high, least), 0.1, true) } } : {};
}

function draw(now) {
  if (needsDraw && !document.hidden && now - drawn >= DRAW_MS) {
    [needsDraw, drawn] = [false, now];
    if (!charts) makeCharts();
    const newest = rows.length ? rows[rows.length - 1].t : 0;
    const times = rows.map(row => row.t - newest);
    for (const [name, series] of Object.entries(chosen.charts)) {
      charts[name].setData([times, ...series.map(([side, signal]) => values(side, signal))]);
    }
  }
  chosen.draw(now);
  requestAnimationFrame(draw);
}

addEventListener("resize", () => {
  for (const name of Object.keys(charts || {})) charts[name].setSize({ width: $("chart-" + name).clientWidth, height: chosen.height });
});
