"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const byId = id => document.getElementById(id);
const style = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Plots. Drawn when they come into sight; drawn anew when light and dark change.
const specs = new Map();
data.plots.forEach((plot, i) => specs.set("plot-" + i, plot));
data.runs.forEach((run, i) => { specs.set("orbit-" + i, run.orbit); if (run.time) specs.set("time-" + i, run.time); });
const drawn = new Set();

function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

function layoutOf(spec) {
  const axis = {gridcolor: style("--line"), zerolinecolor: style("--line"), linecolor: style("--line"), automargin: true, exponentformat: "power"};
  const layout = plain(spec.layout);
  for (const name of ["xaxis", "yaxis"]) layout[name] = {...axis, ...(layout[name] || {})};
  if (layout.scene) {
    const inSpace = {gridcolor: style("--line"), zerolinecolor: style("--line"), color: style("--soft"), showbackground: false};
    for (const name of ["xaxis", "yaxis", "zaxis"]) layout.scene[name] = {...inSpace, ...layout.scene[name]};
    if (innerWidth < 600) for (const a of "xyz") layout.scene.camera.eye[a] *= 1.7;  // or the outer cameras are cut off
    layout.uirevision = "keep";
  }
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: {color: style("--text"), size: 12},
    margin: {l: 55, r: 10, t: 10, b: 45}, showlegend: spec.data.length > 1, legend: {orientation: "h", x: 0, y: 1.02, yanchor: "bottom"},
    autosize: true, ...layout,
  };
}

// A copy in which Plotly takes no name for markup.
function plain(value) { return JSON.parse(JSON.stringify(value).replaceAll("<", "&lt;")); }

function tracesOf(spec) {
  // Black, one of the colours that colour-blind people tell apart, is white on a dark page.
  return isDark() ? JSON.parse(JSON.stringify(plain(spec.data)).replaceAll("#000000", "#ffffff")) : plain(spec.data);
}

function draw(id) {
  const spec = specs.get(id);
  drawn.add(id);
  Plotly.react(id, tracesOf(spec), layoutOf(spec), {responsive: true, displaylogo: false, displayModeBar: false});
}

const watcher = new IntersectionObserver(entries => {
  for (const entry of entries) {
    if (entry.isIntersecting && !drawn.has(entry.target.id)) { draw(entry.target.id); markView(); }
  }
}, {rootMargin: "300px"});
for (const id of specs.keys()) watcher.observe(byId(id));
addEventListener("beforeprint", () => {
  for (const id of specs.keys()) if (byId(id).offsetParent) draw(id);
});

function redraw() { for (const id of drawn) draw(id); }
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
byId("theme").addEventListener("click", () => {
  document.documentElement.dataset.theme = isDark() ? "light" : "dark";
  byId("theme").setAttribute("aria-pressed", String(isDark()));
  redraw();
});

// Step by step.
let run = 0;

function figure(picture) {
  const element = document.createElement("figure"), image = document.createElement("img");
  const caption = document.createElement("figcaption");
  image.src = data.pictures[picture.name];
  image.alt = picture.alt;
  caption.textContent = picture.caption;
  element.append(image, caption);
  return element;
}

function currentView() { return data.runs[run].views[Number(byId("step").value)]; }

function markView() {
  const id = "orbit-" + run, traces = data.runs[run].orbit.data, last = traces.length - 1;
  const [x, y, z] = currentView().eye;
  Object.assign(traces[last], {x: [x], y: [y], z: [z]});
  if (drawn.has(id)) Plotly.restyle(id, {x: [[x]], y: [[y]], z: [[z]]}, [last]);
}

function showStep() {
  const view = currentView(), facts = byId("facts");
  facts.replaceChildren(...view.facts.map(([name, value]) => {
    const row = document.createElement("div"), term = document.createElement("dt"), text = document.createElement("dd");
    term.textContent = name;
    text.textContent = value;
    row.append(term, text);
    return row;
  }));
  byId("step").setAttribute("aria-valuetext", `${view.name}, ${view.facts[1][1]}`);
  byId("pictures").replaceChildren(...view.pictures.map(figure));
  markView();
}

function showRun() {
  run = Number(byId("run").value);
  const views = data.runs[run].views, slider = byId("step");
  slider.max = views.length - 1;
  slider.value = Math.min(Number(slider.value), views.length - 1);
  for (const section of document.querySelectorAll(".of-run")) section.hidden = Number(section.dataset.run) !== run;
  showStep();
}

byId("run").addEventListener("change", showRun);
byId("step").addEventListener("input", showStep);
byId("step").value = 0;
byId("run").value = "0";  // a browser may restore another after a reload
showRun();

// Truth and render.
function options(select, names, chosen) {
  select.replaceChildren(...names.map((name, i) => new Option(name, String(i))));
  select.value = String(chosen);
}

function showCompared() {
  const view = data.compared[Number(byId("compare-view").value)];
  for (const [side, id] of [["left", "compare-a"], ["right", "compare-b"]]) {
    const shown = view.sides[Number(byId("compare-" + side).value)];
    byId(id).src = data.pictures[shown.name];
    byId(id).alt = `${side} of the line: ${shown.alt}`;
  }
  const names = ["left", "right"].map(side => `${side}: ${view.sides[Number(byId("compare-" + side).value)].label}`);
  byId("compare-note").textContent = `${view.view}, ${view.note}; ${names.join("; ")}.`;
}

function showView() {
  const view = data.compared[Number(byId("compare-view").value)];
  for (const [side, first] of [["left", 0], ["right", 1]]) {
    const select = byId("compare-" + side), chosen = select.options.length ? Number(select.value) : first;
    options(select, view.sides.map(one => one.label), chosen);
  }
  showCompared();
}

options(byId("compare-view"), data.compared.map(view => `${view.view} (${view.note})`), 0);
byId("compare-view").addEventListener("change", showView);
byId("compare-left").addEventListener("change", showCompared);
byId("compare-right").addEventListener("change", showCompared);
const at = byId("compare-at"), move = () => byId("divider").style.setProperty("--at", at.value + "%");
at.addEventListener("input", move);
at.value = 50;
move();
showView();
