// The workbench: a state (channels, window, model, constraints) that the user changes, and the fit that follows it.

const BEGIN = JSON.parse(document.getElementById("begin").textContent), at = (id) => document.getElementById(id);
let state = structuredClone(BEGIN.start), shown = null, view = null, dragged = false;
const look = { experiment: 0, output: state.outputs[0] }; // what is drawn
const past = [], future = [], pins = [], drawn = new Map(), timings = [];
const TICKS = [["rising", "monotone", { direction: "increasing" }], ["falling", "monotone", { direction: "decreasing" }], ["convex", "convex", {}],
  ["concave", "concave", {}], ["odd", "odd", {}], ["even", "even", {}], ["saturation", "saturation", null], ["stable", "stable", { radius: 0.98 }]];
const ORDERS = { na: "Past outputs", nb: "Past inputs", nk: "Delay", nx: "States", basis: "Basis of f", prior: "Prior", ridge: "Ridge" };
const TAKES = { arx: ["na", "nb", "nk", "prior"], ss: ["nx", "basis"], tf: ["na", "nb", "nk", "basis"] };
const MODES = { static: { Point: "through", Corridor: "range", Flat: "dead_zone" }, step: { Band: "step_band" }, poles: { Disc: "disc" }, time: { Window: null } };
const KINDS = ["bias", "loss", "stuck", "drift", "noise", "spike"];

const request = (more) => JSON.stringify({ state, view, ...look, ...more });
function ask(question, more) {
  return fetch("/" + question, { method: "POST", headers: { "X-Optid-Page": BEGIN.secret, "Content-Type": "application/json" }, body: request(more) })
    .then((answer) => answer.json()).catch((error) => ({ error: `The workbench does not respond: ${error.message}` }));
}

// ---- the fit follows the state; during a fit the newest state waits

let busy = false, wanted = false, later = 0;
async function refit() {
  wanted = true;
  clearTimeout(later);
  if (busy) return;
  busy = true;
  document.documentElement.dataset.busy = "yes";
  while (wanted) {
    wanted = false;
    const clock = performance.now(), asked = JSON.stringify(state), found = await ask("fit", { draft: dragged });
    at("trouble").textContent = found.error || "";
    document.querySelectorAll("#plots, #verdict").forEach((one) => one.classList.toggle("stale", !!found.error));
    if (!found.error) { shown = { ...found, asked }; show(found); await new Promise(requestAnimationFrame); timings.push(performance.now() - clock); }
  }
  busy = false;
  delete document.documentElement.dataset.busy;
  document.documentElement.dataset.ready = performance.now().toFixed(0);
  later = setTimeout(judge, 350);
}

async function judge() {
  const asked = JSON.stringify(state);
  if (at("trouble").textContent || shown?.asked !== asked) return;
  const found = await ask("judge");
  if (found.error || JSON.stringify(state) !== asked) return;
  at("verdict").className = `verdict ${found.tone}`;
  at("word").textContent = `The model is ${found.word}`;
  at("sentence").textContent = found.sentence;
  at("parts").replaceChildren(...found.parts.map((part) => row(...part)));
  drawAll(at("testcharts"), found.charts);
  document.documentElement.dataset.judged = asked;
  judgedOrStale();
  fitTables();
}

// The verdict and the tests of an earlier fit are dimmed until those of the fit shown arrive.
function judgedOrStale() {
  const { judged } = document.documentElement.dataset;
  ["word", "sentence", "parts", "tests"].forEach((id) => at(id).classList.toggle("stale", !!judged && judged !== shown.asked));
}

const notes = (id, sentences) => at(id).replaceChildren(...sentences.map((sentence) => element("li", {}, sentence)));
const row = (first, ...cells) => element("tr", {}, element("th", { scope: "row" }, first), ...cells.map((cell) => element("td", {}, cell)));

// ---- history

function change(edit) {
  const before = JSON.stringify(state);
  edit(state);
  if (JSON.stringify(state) === before) return;
  past.push(before);
  future.length = 0;
  settle();
}
function settle() { view = dragged ? view : null; controls(); offer(); refit(); }
function travel(from, to) { if (!from.length) return; to.push(JSON.stringify(state)); state = JSON.parse(from.pop()); settle(); }

// ---- what is shown

function show(found) {
  at("cards").replaceChildren(...found.cards.map(([label, value]) => element("div", { class: "card" }, element("b", {}, value), element("span", {}, label))));
  at("optimum").textContent = `${found.word}. ${found.sentence}`;
  notes("warnings", found.findings);
  if (!document.documentElement.dataset.judged) { at("word").textContent = "Fitted"; at("sentence").textContent = "The verdict follows."; }
  judgedOrStale();
  drawAll(at("time"), found.time);
  drawAll(at("figures"), found.charts);
  offer();
  constraintList();
}

function drawAll(host, charts) {
  const keys = charts.map((chart) => `${host.id} ${chart.title.replace(/ from .*|: .*/, "")}`);
  for (const figure of [...host.children]) if (!keys.includes(figure.dataset.key)) { drawn.delete(figure.dataset.key); figure.remove(); }
  charts.forEach((chart, k) => {
    const known = drawn.get(keys[k]);
    if (known && dragged) return known.update(chart);
    if (known && known.chart.series.map((s) => s.name).join() === chart.series.map((s) => s.name).join() && known.pins === pins.length) return known.update(chart);
    const figure = element("figure", { "data-key": keys[k] }), old = host.querySelector(`[data-key="${CSS.escape(keys[k])}"]`);
    old ? old.replaceWith(figure) : host.insertBefore(figure, host.children[k] || null);
    drawn.set(keys[k], drawChart(figure, chart, keys[k]));
  });
}

function withPins(chart) {
  const others = pins.flatMap((pin, k) => (pin.charts.find((c) => c.tool === chart.tool && c.title.replace(/ from .*/, "") === chart.title.replace(/ from .*/, "")) || { series: [] }).series
    .filter((one) => ["fit", "poles", "simulated"].includes(one.name)).map((one) => ({ ...one, name: pin.name, colour: `var(--c${2 + (k % 7)})`, width: 1.5 })));
  return [...decoded(chart), ...decoded({ series: chart.tool === "time" && view ? [] : others })];
}

function drawChart(figure, chart, key) {
  const hidden = new Set(), heading = element("h3", {}, chart.title), modes = element("div", { class: "modes", role: "group", "aria-label": `Tools of ${chart.title}` });
  const host = element("div", { class: "plot-host", "data-tool": chart.tool || "" }), kept = { chart, mode: "Zoom", pins: pins.length, figure };
  figure.append(heading, modes, host);
  if (chart.caption) figure.append(element("figcaption", {}, chart.caption));
  for (const name of chart.tool ? ["Zoom", ...Object.keys(MODES[chart.tool])] : []) {
    modes.append(element("button", { type: "button", "aria-pressed": String(name === "Zoom"), onclick: (event) => {
      kept.mode = name;
      [...modes.children].forEach((one) => one.setAttribute("aria-pressed", String(one === event.currentTarget)));
      host.style.touchAction = name === "Zoom" ? "" : "none";
    } }, name));
  }
  if (chart.equal) host.style.maxWidth = "25rem";
  const series = withPins(chart), tool = chart.tool;
  let waiting = 0;
  const moved = (low, high) => {
    for (const other of drawn.values()) if (other.chart.group === kept.chart.group && other !== kept) other.plot.setX(low, high);
    if (tool !== "time") return;
    const { start, step } = kept.chart.x, count = ((state.window[1] - state.window[0]) * BEGIN.dt) / step;
    const first = Math.floor((low - start) / step), last = Math.ceil((high - start) / step) + 1;
    view = first <= 0 && last >= count ? null : [Math.max(first, 0), last];
    clearTimeout(waiting);
    waiting = setTimeout(async () => { const sent = request(), found = await ask("time"); if (!found.error && sent === request()) drawAll(at("time"), found); }, 120);
  };
  addLegend(modes, chart.title, series, hidden, () => kept.plot.draw());
  // of a record in a window, or resampled, the samples are counted as those of the whole record
  const x = tool === "time" ? { ...chart.x, start: BEGIN.origins[look.experiment], step: BEGIN.dt } : chart.x;
  kept.plot = makePlot(host, { ...chart, x, label: `${chart.title}. ${chart.caption}`, series, moved: chart.group ? moved : null,
    places: (axis) => (tool ? mine(kept.chart).map((c) => boxOf(c, kept.chart)).flatMap((b) => (axis ? [b.y0, b.y1] : [b.x0, b.x1])) : []),
    below: (f) => (tool ? hands(kept.chart, f) : []), grab: (event, x, y, f) => tool && grab(event, x, y, f, kept) }, hidden);
  kept.update = (next) => { kept.chart = next; heading.textContent = next.title; kept.plot.setSeries(withPins(next), dragged || (tool === "time" && view)); };
  return kept;
}

// Offer the tools whose rule the formulation accepts.
function offer() {
  for (const button of document.querySelectorAll(".modes button")) {
    const word = MODES[button.closest("figure").querySelector(".plot-host").dataset.tool][button.textContent];
    button.hidden = !!word && !accepts(word);
    if (button.hidden && button.getAttribute("aria-pressed") === "true") button.parentElement.firstChild.click();
  }
}

function accepts(word) {
  const { formulation, outputs, arguments: { na } } = state, one = outputs.length === 1, space = formulation.includes("_ss");
  if (word === "step_band") return space ? !formulation.endsWith(".exact") : one && formulation.startsWith("hammerstein_arx");
  if (space) return true;
  if (["dead_zone", "saturation", "odd", "even"].includes(word)) return formulation !== "arx";
  if (["monotone", "convex", "concave"].includes(word)) return one || formulation === "hammerstein_arx.exact";
  if (word === "stable") return one && na > 0;
  return one && (word !== "disc" || na === 1 || na === 2);
}

// ---- constraints on the plots: each has a box in the units of its plot, and handles

const round = (value) => Number(value.toPrecision(5));
const REACH = { through: "static", range: "static", dead_zone: "static", saturation: "static", step_band: "step", disc: "poles" };

function boxOf(c, chart) {
  const a = c.arguments;
  if (c.word === "through") return { x0: a.u, x1: a.u, y0: a.y, y1: a.y };
  if (c.word === "range") return { x0: a.first ?? chart.interval[0], x1: a.last ?? chart.interval[1], y0: a.low ?? -Infinity, y1: a.high ?? Infinity };
  if (c.word === "step_band") return { x0: a.first * chart.dt, x1: a.last * chart.dt, y0: a.low ?? -Infinity, y1: a.high ?? Infinity };
  if (c.word === "disc") return { x0: a.centre - a.radius, x1: a.centre + a.radius, y0: -a.radius, y1: a.radius };
  return { x0: a.low ?? chart.interval[0], x1: a.high ?? chart.interval[1], y0: -Infinity, y1: Infinity };
}

function setBox(c, b, chart) {
  const a = c.arguments, clip = (v) => Math.min(Math.max(v, chart.interval[0]), chart.interval[1]);
  if (c.word === "through") Object.assign(a, { u: round(clip(b.x0)), y: round(b.y0) });
  else if (c.word === "range") Object.assign(a, { low: finite(b.y0), high: finite(b.y1), first: round(clip(b.x0)), last: round(clip(b.x1)) });
  else if (c.word === "step_band") Object.assign(a, { low: finite(b.y0), high: finite(b.y1), first: Math.max(0, Math.round(b.x0 / chart.dt)), last: Math.max(0, Math.round(b.x1 / chart.dt)) });
  else if (c.word === "disc") Object.assign(a, { centre: round((b.x0 + b.x1) / 2), radius: round(Math.max((b.x1 - b.x0) / 2, 0.01)) });
  else Object.assign(a, { low: round(clip(b.x0)), high: round(clip(b.x1)) });
}
const finite = (v) => (Number.isFinite(v) ? round(v) : null);
const mine = (chart) => state.constraints.filter((c) => REACH[c.word] === chart.tool && ["channel", "output"].every((key) => (c.arguments[key] ?? chart[key]) === chart[key]));
const priced = (c) => shown?.prices.find((p) => p.name === c.name);

function pixels(c, chart, f) {
  const b = boxOf(c, chart), ends = { left: f.left, right: f.width - f.right, top: f.top, bottom: f.height - f.bottom };
  const y = (v, low) => (Number.isFinite(v) ? f.y(v) : low ? ends.bottom : ends.top);
  return { x0: f.x(b.x0), x1: f.x(b.x1), y0: y(b.y0, true), y1: y(b.y1, false) };
}

function hands(chart, f) {
  const taken = [];
  return mine(chart).flatMap((c) => {
    const p = pixels(c, chart, f), price = priced(c), mx = (p.x0 + p.x1) / 2, my = (p.y0 + p.y1) / 2, parts = [], style = { class: price?.binding ? "hand" : "hand idle", "data-constraint": c.name };
    if (c.word === "disc") parts.push(element("svg:circle", { ...style, cx: mx, cy: my, r: (p.x1 - p.x0) / 2 }), element("svg:circle", { class: "grip", cx: p.x1, cy: my, r: 5 }));
    else if (c.word === "saturation") for (const x of [p.x0, p.x1]) parts.push(element("svg:path", { ...style, d: `M${x} ${p.y0}V${p.y1}` }), element("svg:circle", { class: "grip", cx: x, cy: my, r: 5 }));
    else if (c.word !== "through") {
      parts.push(element("svg:rect", { ...style, x: p.x0, y: p.y1, width: Math.max(p.x1 - p.x0, 1), height: Math.max(p.y0 - p.y1, 1) }));
      for (const [x, y] of [[p.x0, p.y0], [p.x1, p.y0], [p.x0, p.y1], [p.x1, p.y1]]) parts.push(element("svg:circle", { class: "grip", cx: x, cy: y, r: 3.5 }));
    }
    if (c.word !== "saturation") parts.push(element("svg:circle", { class: "grip", "data-constraint": c.name, cx: mx, cy: my, r: 5.5 }));
    const word = !price ? c.name : price.binding && price.price !== null ? `${significant(price.price, 2)} points per 1 %` : price.binding ? "active" : "not active";
    const x = Math.min(Math.max(mx, f.left + 65), f.width - f.right - 65), above = Math.min(p.y0, p.y1) - 9;
    let y = above > f.top + 12 ? above : Math.min(Math.max(p.y0, p.y1) + 18, f.height - f.bottom - 6);
    for (let k = 0; k < 9 && taken.some(([u, v]) => Math.abs(u - x) < 130 && Math.abs(v - y) < 16); k++) y = y > f.height - f.bottom - 20 ? f.top + 14 : y + 16;
    taken.push([x, y]);
    return [...parts, element("svg:text", { class: "price", x, y, "text-anchor": "middle" }, word)];
  });
}

// Return what the mouse grabs at a place: [constraint, the edges that move].
function held(chart, x, y, f) {
  for (const c of [...mine(chart)].reverse()) {
    const p = pixels(c, chart, f), mx = (p.x0 + p.x1) / 2, my = (p.y0 + p.y1) / 2, near = 8;
    if (c.word !== "saturation" && Math.hypot(x - mx, y - my) < 11) return [c, c.word === "disc" ? ["x0", "x1"] : ["x0", "x1", "y0", "y1"]];
    if (c.word === "disc") { if (Math.abs(Math.hypot(x - mx, y - my) - (p.x1 - p.x0) / 2) < near) return [c, ["radius"]]; continue; }
    if (c.word === "through" || x < p.x0 - near || x > p.x1 + near || y > p.y0 + near || y < p.y1 - near) continue;
    const edges = ["x0", "x1", "y0", "y1"].filter((e) => Math.abs((e[0] === "x" ? x : y) - p[e]) < near && Number.isFinite(boxOf(c, chart)[e]));
    if (edges.length) return [c, edges];
  }
  return null;
}

function grab(event, x, y, f, kept) {
  const { chart, mode, plot } = kept, [ux, uy] = [f.unx(x), f.uny(y)];
  let [c, edges] = held(chart, x, y, f) || [null, null], before = JSON.stringify(state), range = null;
  if (!c && mode === "Zoom") return false;
  if (!c && mode === "Window") range = ux;
  else if (!c) {
    const word = MODES[chart.tool][mode];
    c = { word, name: fresh(mode.toLowerCase()), arguments: {} };
    if (chart.channel) c.arguments.channel = chart.channel;
    if (chart.output && word !== "dead_zone") c.arguments.output = chart.output;
    setBox(c, { x0: ux, x1: ux, y0: uy, y1: uy }, chart);
    edges = word === "through" ? ["x0", "x1", "y0", "y1"] : word === "disc" ? ["radius"] : ["x1", "y1"];
    state.constraints.push(c);
  }
  const start = c && boxOf(c, chart), svg = plot.svg, fixed = { ...f }, centre = c && (start.x0 + start.x1) / 2;
  if (c?.word === "disc" && edges[0] === "radius" && JSON.parse(before).constraints.length < state.constraints.length) Object.assign(start, { x0: ux, x1: ux });
  svg.setPointerCapture(event.pointerId);
  dragged = true;
  const follow = (e) => {
    const [px, py] = plot.place(e), [vx, vy] = [fixed.unx(px), fixed.uny(py)];
    if (!c) return;
    const b = { ...start };
    if (edges[0] === "radius") { const r = Math.hypot(vx - centre, vy); Object.assign(b, { x0: centre - r, x1: centre + r }); }
    else for (const e of edges) if (Number.isFinite(b[e])) b[e] += e[0] === "x" ? vx - ux : vy - uy;
    if (b.x0 > b.x1) [b.x0, b.x1] = [b.x1, b.x0];
    if (b.y0 > b.y1) [b.y0, b.y1] = [b.y1, b.y0];
    setBox(c, b, chart);
    plot.draw();
    if (ready(c)) refit();
  };
  const end = (e) => {
    svg.removeEventListener("pointermove", follow);
    svg.removeEventListener("pointerup", end);
    svg.removeEventListener("pointercancel", end);
    dragged = false;
    if (range !== null) {
      const ends = [range, fixed.unx(plot.place(e)[0])].sort((p, q) => p - q).map((v) => Math.round((v - BEGIN.origins[look.experiment]) / BEGIN.dt));
      if (ends[1] - ends[0] > 9) change((s) => { s.window = [Math.max(ends[0], 0), Math.min(ends[1], BEGIN.samples)]; });
      return;
    }
    if (!ready(c)) state = JSON.parse(before);
    else if (JSON.stringify(state) !== before) { past.push(before); future.length = 0; }
    settle();
  };
  svg.addEventListener("pointermove", follow);
  svg.addEventListener("pointerup", end);
  svg.addEventListener("pointercancel", end);
  return true;
}

// Whether a constraint is large enough to be intended.
function ready(c) {
  const a = c.arguments;
  return c.word === "through" || (c.word === "disc" ? a.radius > 0.01 : c.word === "dead_zone" ? a.low < a.high : c.word === "saturation" || (a.low < a.high && (c.word === "step_band" || a.first < a.last)));
}

function fresh(word) {
  let k = 1;
  while (state.constraints.some((c) => c.name === `${word} ${k}`)) k++;
  return `${word} ${k}`;
}

// ---- controls

function field(label, control) {
  const id = `field-${label.replace(/\W/g, "-")}`;
  control.id = id;
  return element("div", { class: "field" }, element("label", { for: id }, label), control);
}

function tick(label, on, act, disabled = false) { return element("label", {}, Object.assign(element("input", { type: "checkbox", disabled, onchange: (e) => act(e.target.checked) }), { checked: on }), label); }

// A list to choose from, where there are several.
function selection(label, options, chosen, act) {
  if (options.length < 2) return [];
  return [field(label, element("select", { onchange: (e) => act(e.target.value) }, ...options.map(([value, name]) => element("option", { value, selected: value === chosen }, name))))];
}

// The number in a field; an empty or invalid field returns to its last valid value.
function numberIn(box, last) {
  if (box.value === "" || !box.validity.valid) box.value = last;
  return Number(box.value);
}

function controls() {
  at("undo").disabled = !past.length;
  at("redo").disabled = !future.length;
  const names = [["inputs", "Input"], ["outputs", "Output"]];
  at("channels").replaceChildren(...names.map(([key, label]) => element("div", { class: "field" }, element("span", {}, label),
    element("div", { class: "ticks", style: "grid-template-columns: 1fr" }, ...BEGIN[key].map((name) => tick(name, state[key].includes(name), (on) =>
      change((s) => { s[key] = BEGIN[key].filter((n) => (n === name ? on : s[key].includes(n))); })))))));
  [["first", 0], ["last", 1]].forEach(([id, k]) => { at(id).value = state.window[k]; at(id).max = BEGIN.samples; });
  const [from, to] = state.window.map((sample, k) => BEGIN.origins[look.experiment] + (sample - k) * BEGIN.dt);
  at("dates").textContent = BEGIN.dated ? `${dateText(from)} to ${dateText(to)}` : "";
  at("every").value = state.dt ?? BEGIN.dt;
  at("detrend").setAttribute("aria-pressed", String(!!state.detrended));
  at("delay").disabled = !takes(state.formulation).includes("nk");
  notes("delays", []);
  if (!state.outputs.includes(look.output)) look.output = state.outputs[0];
  at("look").replaceChildren(
    ...selection("Experiment", BEGIN.origins.map((_, k) => [k, `${k + 1} of ${BEGIN.origins.length}`]), look.experiment, (k) => { look.experiment = Number(k); view = null; refit(); }),
    ...selection("Output drawn", state.outputs.map((name) => [name, name]), look.output, (name) => { look.output = name; refit(); }));
  const formulation = selection("Formulation", BEGIN.formulations.map((name) => [name, name]), state.formulation, (name) => change((s) => { s.formulation = name; s.arguments = fitting(s); }));
  at("model").replaceChildren(...formulation, ...takes(state.formulation).map((key) => {
    const value = state.arguments[key], box = element("input", { type: "text", value: value === undefined ? "" : Array.isArray(value) ? value.join(" ") : value, onchange: (e) => change((s) => { s.arguments[key] = read(e.target.value); }) });
    return field(ORDERS[key], box);
  }));
  at("ticks").replaceChildren(...TICKS.map(([label, word, given]) => {
    const same = (c) => c.word === word && (word !== "monotone" || c.arguments.direction === given.direction);
    return tick(label, state.constraints.some(same), (on) => change((s) => {
      s.constraints = s.constraints.filter((c) => !same(c));
      if (on) s.constraints.push({ word, name: label, arguments: given ? { ...given } : saturated() });
    }), !accepts(word) && !state.constraints.some(same));
  }));
  constraintList();
}

function saturated() {
  const [low, high] = shown?.charts.find((c) => c.tool === "static")?.interval || [-1, 1], part = 0.12 * (high - low);
  const channel = BEGIN.inputs.length > 1 && state.inputs.length > 1 ? { channel: state.inputs[0] } : {};
  return { low: round(low + part), high: round(high - part), ...channel };
}

const takes = (name) => TAKES[name === "arx" ? "arx" : name.includes("_ss") ? "ss" : "tf"];
function fitting(s) {
  const had = { na: 2, nb: 2, nk: 0, basis: "triangular:8", nx: 2, ...BEGIN.start.arguments, ...s.arguments };
  return Object.fromEntries(takes(s.formulation).filter((key) => had[key] !== undefined).map((key) => [key, had[key]]));
}
function read(text) {
  const parts = text.trim().split(/[\s,]+/).map((part) => (part !== "" && !Number.isNaN(Number(part)) ? Number(part) : part));
  return parts.length > 1 ? parts : parts[0];
}

function constraintList() {
  if (document.activeElement?.closest("#constraints") && document.activeElement.tagName === "INPUT") return;
  at("constraints").replaceChildren(...state.constraints.map((c, k) => {
    const price = priced(c), numbers = Object.entries(c.arguments).filter(([, value]) => typeof value === "number");
    const says = !price ? "" : !price.binding ? "not active" : price.price === null ? `active (${price.active} of ${price.rows})` : `active (${price.active} of ${price.rows}), ${significant(price.price, 3)} points per 1 %`;
    return element("div", { class: price?.binding ? "constraint binding" : "constraint", "data-name": c.name },
      element("header", {}, c.name, element("button", { type: "button", "aria-label": `Remove ${c.name}`, onclick: () => change((s) => s.constraints.splice(k, 1)) }, "×")),
      element("div", { class: "price" }, says),
      element("div", { class: "numbers" }, ...numbers.map(([key, value]) => element("label", {}, key, element("input", { type: "number", step: "any", value, onchange: (e) => {
        const typed = numberIn(e.target, value);
        e.target.blur();
        change((s) => { s.constraints[k].arguments[key] = typed; });
      } })))));
  }));
}

function pinList() {
  at("pinned").hidden = !pins.length;
  at("pins").replaceChildren(...pins.map((pin, k) => element("tr", {}, element("th", { scope: "row" }, pin.name), ...[pin.cards[0][1], pin.cards[1][1], significant(pin.objective, 5), String(JSON.parse(pin.asked).constraints.length)].map((v) => element("td", {}, v)),
    element("td", {}, element("button", { type: "button", class: "quiet", onclick: () => change(() => { state = JSON.parse(pin.asked); }) }, "Take"), " ",
      element("button", { type: "button", class: "quiet", "aria-label": `Unpin ${pin.name}`, onclick: () => { pins.splice(k, 1); pinList(); if (shown) show(shown); } }, "×")))));
  fitTables();
}

// ---- diagnosis

const without = new Set(), kinds = new Set(["bias", "loss", "spike"]), span = [0, BEGIN.samples];
let latest = 0;
async function diagnose() {
  at("diagnose").disabled = true;
  const number = ++latest, found = await ask("diagnose", { kinds: [...kinds], without: [...without], window: span });
  if (number !== latest) return; // a newer diagnosis has been requested
  at("diagnose").disabled = false;
  at("faults").hidden = false;
  at("found").replaceChildren(...(found.error ? [element("p", { role: "alert" }, found.error)] : [
    element("div", { class: `verdict ${found.tone}`, style: "padding: .7rem 1rem; border-radius: .5rem" }, element("p", { class: "word" }, found.word), ...found.sentences.map((s) => element("p", {}, s))),
    element("div", { class: "scroll" }, element("table", {}, element("thead", {}, element("tr", {}, ...["fault", "probability", "onset", "size"].map((h) => element("th", { scope: "col" }, h)))), element("tbody", {}, ...found.answers.map((one) => row(...one))))),
  ]));
  if (found.error) return;
  at("labels").replaceChildren(...found.labels.map((label) => tick(label, !without.has(label), (on) => { on ? without.delete(label) : without.add(label); diagnose(); })));
  drawAll(at("faultcharts"), found.charts);
  fitTables();
  document.documentElement.dataset.diagnosed = String(Number(document.documentElement.dataset.diagnosed || 0) + 1);
}

// ---- preparation of the record

function resample(dt) { change((s) => { s.dt = dt === BEGIN.dt ? null : dt; }); }

async function estimateDelay() {
  at("delay").disabled = true;
  const asked = JSON.stringify(state), found = await ask("delay");
  at("delay").disabled = false;
  at("trouble").textContent = found.error || "";
  if (found.error || JSON.stringify(state) !== asked) return;
  change((s) => { s.arguments.nk = found.nk.length > 1 ? found.nk : found.nk[0]; });
  notes("delays", found.sentences);
}

// ---- start

async function save(what) {
  const found = await ask("export", { what });
  if (found.error) { at("trouble").textContent = found.error; return; }
  const link = element("a", { href: URL.createObjectURL(new Blob([found.text])), download: found.name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

themeButton();
at("detrend").addEventListener("click", () => change((s) => { s.detrended = !s.detrended; }));
at("resample").addEventListener("click", () => resample(2 * (state.dt ?? BEGIN.dt)));
at("every").addEventListener("change", (e) => resample(numberIn(e.target, state.dt ?? BEGIN.dt)));
at("delay").addEventListener("click", estimateDelay);
at("undo").addEventListener("click", () => travel(past, future));
at("redo").addEventListener("click", () => travel(future, past));
at("pin").addEventListener("click", () => { if (!shown) return; pins.push({ ...shown, name: `pin ${pins.length + 1}`, charts: [...shown.charts, ...shown.time] }); pinList(); show(shown); });
[["first", 0], ["last", 1]].forEach(([id, k]) => at(id).addEventListener("change", (e) => change((s) => { s.window[k] = numberIn(e.target, s.window[k]); })));
[["from", 0], ["to", 1]].forEach(([id, k]) => { at(id).value = span[k]; at(id).addEventListener("change", (e) => { span[k] = numberIn(e.target, span[k]); }); });
document.querySelectorAll("[data-export]").forEach((one) => one.addEventListener("click", () => save(one.dataset.export)));
at("kinds").replaceChildren(...KINDS.map((kind) => tick(kind, kinds.has(kind), (on) => (on ? kinds.add(kind) : kinds.delete(kind)))));
at("diagnose").addEventListener("click", diagnose);
["from", "to", "kinds"].forEach((id) => at(id).addEventListener("change", () => at("faults").hidden || diagnose()));
addEventListener("keydown", (event) => {
  if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z" || event.target.tagName === "INPUT") return;
  event.preventDefault();
  event.shiftKey ? travel(future, past) : travel(past, future);
});
addEventListener("resize", fitTables);
controls();
refit();
