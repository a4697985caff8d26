// The page: standings, figures, failures, agreement and runs from the values that stand in it.

const DATA = JSON.parse(document.getElementById("payload").textContent);
const COLUMN = Object.fromEntries(DATA.columns.map((column) => [column.name, column]));
const BAD = new Set(["false claim", "contradicted", "crashed", "memory limit", "non-finite", "failed", "error"]);
const ASIDE = new Set(["refused", "other accuracy", "no time"]);
const DASHES = [null, "8 3", "2 3", "9 3 2 3"];
const STYLE = Object.fromEntries(DATA.solvers.map((name, k) => [name, { colour: `var(--c${k % 10})`, dash: DASHES[Math.floor(k / 10) % 4] }]));
const hidden = new Set();
const byId = (id) => document.getElementById(id);
const plural = (n, noun) => `${n.toLocaleString("en")} ${noun}${n === 1 ? "" : "s"}`;
const tone = (state) => (state === "solved" ? "good" : ASIDE.has(state) ? "none" : BAD.has(state) ? "bad" : "fair");
let section = DATA.sections[0], drawn = [], standings = null;

function cell(name, row) {
  const column = COLUMN[name];
  if (!column) return null;
  const value = column.values[row];
  return column.kind === "text" ? column.words[value] : value;
}

function swatch(name) {
  const { colour, dash } = STYLE[name];
  return element("svg:svg", { class: "swatch", viewBox: "0 0 26 10", "aria-hidden": "true" },
    element("svg:line", { x1: 1, x2: 25, y1: 5, y2: 5, stroke: colour, "stroke-width": 4, "stroke-dasharray": dash, "stroke-linecap": dash ? "butt" : "round" }));
}

// ---- standings

const times = (pair) => (pair[0] === null ? "-" : `${significant(pair[0])} ×`);

function shareBar(one) {
  const share = one.share || 0, made = element("i");
  made.style.width = `${100 * share}%`;
  const text = `${one.solved.toLocaleString("en")} of ${one.problems.toLocaleString("en")}`;
  return element("span", {}, text, element("span", { class: `bar ${share >= 0.95 ? "" : share >= 0.5 ? "fair" : "bad"}`, "aria-hidden": "true" }, made));
}

function drawStandings() {
  const growth = (one) => one.growth.slope === null ? "-" : element("span", {}, `N^${one.growth.slope.toFixed(2)}`,
    element("span", { class: "faint" }, ` (${one.growth.low.toFixed(2)} to ${one.growth.high.toFixed(2)})`));
  const columns = [
    { name: "solver", title: "solver", hint: "★ the first choice; tied: no significant difference from it", head: true, value: (s) => s.solver, node: (s) => element("span", {}, swatch(s.solver), " ", s.solver,
      section.first === s.solver && section.kind === "first" ? element("span", { class: "mark" }, " ★") : section.kind === "tie" && (section.first === s.solver || section.tied.includes(s.solver)) ? element("span", { class: "faint" }, " tied") : null) },
    { name: "solved", title: "accuracy reached on", hint: "problems it was run on, and where it reached the verified accuracy", number: true, descending: true, value: (s) => s.share, node: shareBar },
    { name: "time", title: "time", hint: "shifted geometric mean on what it solved: compares only where others solved the same", number: true, value: (s) => s.time, text: (s) => duration(s.time) },
    { name: "against", title: section.first ? `against ${section.first.length > 24 ? section.first.slice(0, 23) + "…" : section.first}` : "against", hint: "ratio of times on the problems both solved, with its 95 % interval", number: true, value: (s) => (s.against ? s.against[0] : section.first === s.solver ? 1 : null),
      node: (s) => !s.against ? (section.first === s.solver ? "1" : "-") : element("span", {}, times(s.against), element("span", { class: "faint" }, s.against[3] > 1 && s.against[0] !== null ? ` (${significant(s.against[1])} to ${significant(s.against[2])})` : "")) },
    { name: "fit", title: "whole fit", hint: "the same mean of the whole fit: building, judging and proving, too", number: true, value: (s) => s.fit, text: (s) => duration(s.fit) },
    { name: "proved", title: "proved", hint: "problems on which its answer is proved globally optimal", number: true, descending: true, value: (s) => s.proved, text: (s) => s.proved.toLocaleString("en") },
    { name: "fastest", title: "fastest on", hint: "problems on which nobody was faster", number: true, descending: true, value: (s) => s.fastest, text: (s) => s.fastest.toLocaleString("en") },
    { name: "penalised", title: "time, failures at limit", hint: "shifted geometric mean with every failure counted as the time limit", number: true, value: (s) => s.penalised, text: (s) => duration(s.penalised) },
    { name: "rank", title: "mean rank", hint: "over the data sets, 1 is best; a failure or a refusal is last, so that who takes more problems ranks better", number: true, value: (s) => s.rank, text: (s) => significant(s.rank) },
    { name: "growth", title: "time grows as", hint: "exponent of the record length N, with its 95 % interval", number: true, value: (s) => s.growth.slope, node: growth },
    { name: "residual", title: "residual", hint: "median on what it solved of the largest of violation, complementarity and a tenth of the stationarity", number: true, value: (s) => s.residual, text: (s) => significant(s.residual, 2) },
    { name: "false", title: "false claims", hint: "problems on which a claim of success or infeasibility was false", number: true, descending: true, value: (s) => s.false, node: (s) => s.false ? element("a", { href: "#failures", class: "state-bad" }, String(s.false)) : "0" },
  ];
  const idle = section.idle.length ? `Not run on any of these problems: ${section.idle.join(", ")}.` : null;
  standings = makeGrid(byId("standings"), { label: "Standings of the solvers", columns, rows: section.standings, caption: idle });
  byId("standings").append(element("details", {}, element("summary", {}, "What the columns say"), element("dl", { class: "words" }, ...columns.flatMap((c) => [element("dt", {}, c.title), element("dd", {}, c.hint)]))));
  const word = (name) => element("b", {}, name + ". ");
  byId("said").replaceChildren(...(DATA.sections.length > 2 ? section.said.map(([mood, title, text]) => element("p", { class: `chosen ${mood}` }, word(title), text)) : []));
}

// ---- figures

function numbersBelow(head, rows) {
  const line = (cells, tag) => element("tr", {}, ...cells.map((text, k) => element(k && tag === "td" ? "td" : "th", { scope: tag === "th" ? "col" : k ? null : "row" }, text)));
  return element("details", {}, element("summary", {}, "Numbers"), element("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Numbers" },
    element("table", {}, element("thead", {}, line(head, "th")), element("tbody", {}, ...rows.map((row) => line(row, "td"))))));
}

function figure(id, title, caption, spec, numbers) {
  const host = byId(id);
  host.replaceChildren(element("h3", {}, title));
  if (spec) drawn.push(makePlot(host, { title, label: `${title}. ${caption}`, ...spec }, hidden));
  host.append(element("figcaption", {}, caption));
  if (numbers) host.append(numbers);
}

function styled(name) { return { name, ...STYLE[name] }; }

function profileFigure() {
  const series = section.standings.filter((s) => s.solved).map(({ solver }) => {
    const [xs, ys] = section.profiles[solver];
    return { ...styled(solver), kind: "step", xs, ys: ys.map((y) => 100 * y) };
  });
  const far = Math.max(2, ...series.flatMap((one) => one.xs));
  const at = (one, factor) => { const k = one.xs.findLastIndex((x) => x <= factor * (1 + 1e-9)); return k < 0 ? "0 %" : `${significant(one.ys[k])} %`; };
  figure("profile", "Performance profile", "Share of the problems solved within a factor of the fastest solver: higher and further left is better. It compares each with the fastest, not two others with each other." + (section.standings.some((s) => s.refused) ? " A refusal counts as not solved." : ""), series.length ? {
    x: { title: "times the fastest", log: true, low: 1, high: far * 1.05 }, y: { title: "problems solved (%)", low: 0, high: 102 }, series,
    tip: (one, i) => `${one.name}\n${significant(one.ys[i])} % within ${significant(one.xs[i])} × the fastest`,
  } : null, series.length ? numbersBelow(["solver", "1 ×", "2 ×", "5 ×", "10 ×", "any"], series.map((one) => [one.name, ...[1, 2, 5, 10, Infinity].map((f) => at(one, f))])) : null);
}

function accuracyFigure() {
  const rows = [...Array(DATA.count).keys()].filter((i) => !section.name || cell("formulation", i) === section.name);
  const floor = 1e-17, groups = {};
  for (const i of rows) {
    const [t, r] = [cell("time_s", i), cell("residual", i)];
    if (t === null || t === undefined || r === null) continue;
    const key = (cell("state", i) === "solved" ? "a" : "b") + cell("solver", i);
    (groups[key] = groups[key] || { rows: [], xs: [], ys: [] }).rows.push(i);
    groups[key].xs.push(Math.max(t, 1e-6));
    groups[key].ys.push(Math.max(r, floor));
  }
  const series = Object.keys(groups).sort().map((key) => ({ ...styled(key.slice(1)), kind: key[0] === "a" ? "dots" : "crosses", ...groups[key] }));
  const median = (v) => { const s = [...v].sort((a, b) => a - b); return s.length ? s[Math.floor((s.length - 1) / 2)] : null; };
  figure("accuracy", "Accuracy against time", "Every run with a point: lower is more accurate, further left is faster. Crosses do not count as solved. A click opens the run.", series.length ? {
    x: { title: "time", log: true, format: duration }, y: { title: "verified residual", log: true, format: (v) => v.toExponential(0).replace("e+", "e") }, series,
    rules: [{ y: DATA.tolerance, label: "counts up to here" }],
    tip: (one, i) => `${one.name}: ${cell("state", one.rows[i])}\n${cell("data", one.rows[i])}, ${cell("formulation", one.rows[i])}\n${duration(one.xs[i])}, residual ${significant(one.ys[i], 2)}`,
    open: (one, i) => openRun(one.rows[i]),
  } : null, series.length ? numbersBelow(["solver", "runs", "median time", "median residual"], series.filter((one) => one.kind === "dots").map((one) => [one.name, plural(one.rows.length, "run"), duration(median(one.xs)), significant(median(one.ys), 2)])) : null);
}

function ranksFigure() {
  const r = section.ranking;
  const names = [...r.names].reverse();
  const drawnHere = r.n > 0 && names.length > 1;
  const series = drawnHere ? r.names.map((name, k) => ({ ...styled(name), kind: "interval", xs: [r.ranks[k]], ys: [names.indexOf(name)], halves: [0] })) : [];
  const caption = r.missing ? `Whether a difference carries over to other data sets cannot be told: the test ${r.missing}.`
    : `Sign tests over ${plural(r.n, "data set")}: ` + (r.behind.length ? `${r.behind.join(", ")} ${r.behind.length > 1 ? "are" : "is"} behind ${r.names[0]} beyond chance.` : `nobody is behind ${r.names[0]} beyond chance.`);
  figure("ranks", "Mean rank over the data sets", `${caption} A failure or a refusal ranks last.` + (r.left_out.length ? ` Left out, because they did not run or solve everywhere: ${r.left_out.slice(0, 4).join(", ")}${r.left_out.length > 4 ? ` and ${r.left_out.length - 4} more` : ""}.` : ""), drawnHere ? {
    x: { title: "mean rank (1 is best)", low: 0.85, high: names.length + 0.15, ticks: names.map((_, k) => k + 1) }, y: { categories: names }, series,
    tip: (one) => `${one.name}: mean rank ${significant(one.xs[0])}`,
  } : null, drawnHere ? numbersBelow(["solver", "mean rank"], r.names.map((name, k) => [name, significant(r.ranks[k])])) : null);
}

function growthFigure() {
  const known = section.standings.filter((s) => s.growth.n.length > 1);
  const series = known.map((s) => ({ ...styled(s.solver), kind: "line", xs: s.growth.n, ys: s.growth.t }));
  const words = (g) => g.missing ? `cannot tell: ${g.missing}` : `${significant(g.slope, 3)} (${significant(g.low, 3)} to ${significant(g.high, 3)})`;
  const told = known.some((s) => !s.growth.missing);
  const none = section.standings.length ? section.standings[0].growth.missing : "";
  figure("growth", "Time against record length", series.length ? `Geometric mean time of what was solved, over the samples that were fitted. ${told ? "The slope is the exponent of N: “time grows as” in the table of the solvers." : `Its slope cannot be told: it ${none}.`}` : `Cannot be told: it ${none || "needs a run"}.`, series.length ? {
    x: { title: "samples fitted, N", log: true, format: (v) => v.toLocaleString("en") }, y: { title: "time", log: true, format: duration }, series,
    tip: (one, i) => `${one.name}\n${duration(one.ys[i])} at N = ${one.xs[i].toLocaleString("en")}`,
  } : null, series.length ? numbersBelow(["solver", "exponent of N (95 %)"], known.map((s) => [s.solver, words(s.growth)])) : null);
}

function drawLegend() {
  byId("legend").replaceChildren(...section.standings.map(({ solver }) => element("button", { type: "button", "aria-pressed": String(!hidden.has(solver)), title: solver, onclick: (event) => {
    hidden.has(solver) ? hidden.delete(solver) : hidden.add(solver);
    event.currentTarget.setAttribute("aria-pressed", String(!hidden.has(solver)));
    drawn.forEach((plot) => plot.draw());
  } }, swatch(solver), element("span", {}, solver))));
}

// ---- failures and agreement

function drawFailures() {
  const states = new Map();
  for (const s of section.standings) for (const [state, count] of Object.entries(s.failures)) states.set(state, (states.get(state) || 0) + count);
  const columns = [
    { name: "solver", title: "solver", head: true, value: (s) => s.solver, node: (s) => element("span", {}, swatch(s.solver), " ", s.solver) },
    { name: "solved", title: "solved", number: true, descending: true, value: (s) => s.solved, node: (s) => countLink(s.solver, "solved", s.solved) },
    ...[...states.entries()].sort((a, b) => b[1] - a[1]).map(([state]) => ({ name: state, title: state, number: true, descending: true, value: (s) => s.failures[state] || 0, node: (s) => countLink(s.solver, state, s.failures[state] || 0) })),
    { name: "refused", title: "refused", number: true, descending: true, value: (s) => s.refused, node: (s) => countLink(s.solver, "refused", s.refused) },
  ];
  makeGrid(byId("failure-matrix"), { label: "Failures by solver and kind", columns, rows: section.standings, caption: "Problems by how they ended. A number lists its runs." });
}

function countLink(solver, state, count) {
  if (!count) return element("span", { class: "faint" }, "0");
  return element("button", { type: "button", class: `link${state === "false claim" || state === "contradicted" ? " state-bad" : ""}`, "aria-label": `${count} ${state}, ${solver}: list the runs`, onclick: () => {
    setFilters({ solver, state, formulation: section.name });
    byId("runs").scrollIntoView();
    byId("filter-text").focus({ preventScroll: true });
  } }, count.toLocaleString("en"));
}

function drawReasons() {
  const columns = [["solver", 0], ["how it ended", 1], ["reason", 2]].map(([title, k]) => ({ name: title, title, head: !k, value: (f) => f[k], node: (f) => element("span", {}, f[k] || "-") }));
  columns.push({ name: "problems", title: "problems", number: true, descending: true, value: (f) => f[3], text: (f) => f[3].toLocaleString("en") });
  makeGrid(byId("reasons"), { label: "Reasons of failures", columns, rows: DATA.failures, size: 25 });
}

function drawAgreement() {
  const a = DATA.agreement, order = DATA.solvers.filter((name) => { const k = a.solvers.indexOf(name); return k >= 0 && a.common[k].some((n) => n); });
  const host = byId("agreement-matrix");
  if (order.length < 2) return host.replaceChildren(element("p", {}, "Cannot be told: no two solvers verified the same problem."));
  const at = (name) => a.solvers.indexOf(name);
  const share = (i, j) => {
    const n = a.common[i][j], m = a.compared[i][j];
    if (i === j || !n) return element("td", { class: "faint" }, i === j ? "" : element("span", { title: "no problem in common" }, "-"));
    const part = a.objective[i][j] / n, model = m ? a.model[i][j] / m : null, percent = (v) => (v === 1 ? "100 %" : `${(Math.floor(1000 * v) / 10).toFixed(1)} %`);
    const made = element("td", {}, element("b", {}, percent(part)), element("br"), element("span", {}, n.toLocaleString("en") + (model === 1 ? "" : `; models ${model === null ? "-" : percent(model)}`)));
    const low = Math.min(part, model === null ? 1 : model);
    made.style.setProperty("--heat", part >= 0.99 ? (low >= 0.99 ? "var(--green)" : "var(--orange)") : "var(--red)");
    made.style.setProperty("--much", `${part >= 0.99 ? 16 : 12 + 40 * (1 - part)}%`);
    return made;
  };
  const pairs = order.flatMap((one, k) => order.slice(k + 1).map((other) => [at(one), at(other)])).filter(([i, j]) => a.common[i][j]);
  const numbers = numbersBelow(["pair", "common problems", "equal objectives", "largest difference", "equal models", "largest difference"], pairs.map(([i, j]) => [
    `${a.solvers[i]} and ${a.solvers[j]}`, a.common[i][j].toLocaleString("en"), a.objective[i][j].toLocaleString("en"), significant(a.worst_objective[i][j], 2), `${a.model[i][j].toLocaleString("en")} of ${a.compared[i][j].toLocaleString("en")}`, significant(a.worst_model[i][j], 2)]));
  const head = element("tr", {}, element("th", { scope: "col" }, ""), ...order.map((name) => element("th", { scope: "col" }, name)));
  const body = order.map((one) => element("tr", {}, element("th", { scope: "row" }, one), ...order.map((other) => share(at(one), at(other)))));
  host.replaceChildren(element("div", { class: "grid heat", tabindex: "0", role: "region", "aria-label": "Agreement of pairs of solvers" }, element("table", {}, element("thead", {}, head), element("tbody", {}, ...body))),
    element("p", { class: "lead small" }, "In bold the share with equal objectives; below it the common problems, and the share with equal models where it is not all. Red: other minima or a wrong answer. Orange: the same objective from different models."), numbers);
}

// ---- runs

const SHOWN = ["open", "state", "solver", "formulation", "data", "n_estimation", "noise", "seed", "time_s", "objective", "residual", "gap", "simulation_fit", "reason"];
const TITLES = { state: "result", time_s: "time", n_estimation: "N fitted", simulation_fit: "simulation fit" };
const FACETS = { state: "Result", solver: "Solver", formulation: "Formulation", data: "Data" };
let runs = null;
const filters = {};

function written(column, value) {
  if (value === null) return "-";
  if (column.unit === "s") return duration(value);
  const digits = { objective: 7, bound: 7, accuracy: 2, residual: 2, violation: 2, stationarity: 2, complementarity: 2, gap: 2 }[column.name] || 4;
  return (Number.isInteger(value) && Math.abs(value) < 1e9 ? String(value) : significant(value, digits)) + (column.unit === "%" ? " %" : column.unit === "MB" ? " MB" : "");
}

function makeRuns() {
  const columns = [{ name: "open", title: "run", head: true, number: true, value: (i) => i, node: (i) => element("button", { type: "button", class: "link", "aria-label": `Everything about run ${i + 1}`, onclick: () => openRun(i) }, String(i + 1)) }];
  for (const column of DATA.columns) {
    const number = column.kind === "number";
    columns.push({
      name: column.name, title: TITLES[column.name] || column.name.replaceAll("_", " "), hint: column.meaning, number,
      value: number ? (i) => column.values[i] : (i) => (column.words[column.values[i]] === "" ? null : column.values[i]),
      text: number ? (i) => written(column, column.values[i]) : (i) => column.words[column.values[i]] || "-",
      ...(column.name === "state" ? { node: (i) => { const state = cell("state", i); return element("span", { class: `state-${tone(state)}` }, state); } } : {}),
    });
  }
  runs = makeGrid(byId("runs-table"), { label: "All runs", columns, rows: [...Array(DATA.count).keys()] });
  runs.show(SHOWN.filter((name) => name === "open" || COLUMN[name]));

  const fields = [];
  for (const [name, title] of Object.entries(FACETS)) {
    if (!COLUMN[name]) continue;
    const there = new Set(COLUMN[name].values);
    const options = COLUMN[name].words.map((word, k) => [word, k]).filter(([, k]) => there.has(k));
    const select = element("select", { id: `filter-${name}`, onchange: (event) => { filters[name] = event.target.value; applyFilters(); } },
      element("option", { value: "" }, "all"), ...options.map(([word, k]) => element("option", { value: k }, word.length > 60 ? word.slice(0, 60) + "…" : word)));
    fields.push(element("label", {}, title, select));
  }
  let waiting = 0;
  const text = element("input", { type: "search", id: "filter-text", placeholder: "words, or time_s > 0.1", autocomplete: "off", spellcheck: "false", oninput: (event) => {
    filters.text = event.target.value;
    clearTimeout(waiting);
    waiting = setTimeout(applyFilters, 120);
  } });
  const every = element("input", { type: "checkbox", onchange: (event) => runs.show(event.target.checked ? null : SHOWN.filter((name) => name === "open" || COLUMN[name])) });
  byId("filters").replaceChildren(element("label", { class: "wide" }, "Search", text), ...fields,
    element("label", { class: "check" }, every, "every column"),
    element("button", { type: "button", id: "filter-reset", onclick: () => setFilters({}) }, "Clear filters"),
    element("button", { type: "button", id: "download", onclick: download }, "Download CSV"));
}

let haystack = null;
function searchable(i) {
  if (!haystack) haystack = new Array(DATA.count);
  if (haystack[i] === undefined) haystack[i] = DATA.columns.filter((c) => c.kind === "text").map((c) => c.words[c.values[i]]).join("\n").toLowerCase();
  return haystack[i];
}

// A search is words that must all occur, and conditions such as `time_s > 0.1` or `solver = scs`.
function conditionsOf(text) {
  const tests = [];
  const rest = (text || "").replace(/([a-z_]+)\s*(<=|>=|!=|<|>|=)\s*(\S+)/gi, (all, name, sign, value) => {
    if (!Object.hasOwn(COLUMN, name.toLowerCase())) return all;
    const column = COLUMN[name.toLowerCase()];
    const want = column.kind === "number" ? Number(value) : value.toLowerCase();
    if (column.kind === "number" && Number.isNaN(want)) return all;
    tests.push((i) => {
      const have = column.kind === "number" ? column.values[i] : column.words[column.values[i]].toLowerCase();
      if (have === null) return false;
      return { "<": have < want, ">": have > want, "<=": have <= want, ">=": have >= want, "=": have === want, "!=": have !== want }[sign];
    });
    return " ";
  });
  for (const word of rest.toLowerCase().split(/\s+/).filter(Boolean)) tests.push((i) => searchable(i).includes(word));
  return tests;
}

function applyFilters() {
  const tests = conditionsOf(filters.text);
  for (const name of Object.keys(FACETS)) {
    if (filters[name] === undefined || filters[name] === "") continue;
    const want = Number(filters[name]), values = COLUMN[name].values;
    tests.unshift((i) => values[i] === want);
  }
  const rows = [...Array(DATA.count).keys()].filter((i) => tests.every((test) => test(i)));
  runs.update(rows);
  byId("runs-count").textContent = `${rows.length.toLocaleString("en")} of ${plural(DATA.count, "run")}`;
}

function setFilters(chosen) {
  filters.text = byId("filter-text").value = "";
  for (const name of Object.keys(FACETS)) {
    const select = byId(`filter-${name}`);
    if (!select) continue;
    const code = chosen[name] ? COLUMN[name].words.indexOf(chosen[name]) : -1;
    filters[name] = select.value = code < 0 ? "" : String(code);
  }
  applyFilters();
}

// A value that a spreadsheet would take for a formula gets an apostrophe.
function quoted(value) {
  if (value === null || value === undefined) return "";
  if (typeof value === "number") return String(value);
  return `"${(/^[=+\-@\t\r]/.test(value) ? "'" : "") + value.replaceAll('"', '""')}"`;
}

function download() {
  const lines = [DATA.columns.map((c) => c.name).join(","), ...runs.rows().map((i) => DATA.columns.map((c) => quoted(cell(c.name, i))).join(","))];
  const link = element("a", { href: URL.createObjectURL(new Blob([lines.join("\r\n") + "\r\n"], { type: "text/csv" })), download: "runs.csv" });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function openRun(i) {
  const dialog = byId("detail"), facts = [];
  for (const column of DATA.columns) {
    const value = cell(column.name, i);
    if (value === null || value === "") continue;
    facts.push(element("dt", { title: column.meaning }, column.name), element("dd", {}, column.kind === "number" ? `${value}${column.unit && column.unit !== "data" ? " " + column.unit : ""}` : value, element("small", {}, column.meaning)));
  }
  const close = element("button", { type: "button", class: "quiet close", onclick: () => dialog.close() }, "Close");
  dialog.replaceChildren(element("h3", { id: "detail-title" }, `Run ${i + 1}: ${cell("solver", i)} on ${cell("data", i)}, ${cell("formulation", i)}`), close, element("dl", {}, ...facts));
  dialog.showModal();
  dialog.scrollTop = 0;
}

// ---- the page

function drawSection() {
  drawn = [];
  drawStandings();
  drawLegend();
  profileFigure();
  accuracyFigure();
  ranksFigure();
  growthFigure();
  drawFailures();
  byId("scope-note").textContent = `${plural(section.problems, "problem")} · ${plural(section.standings.length, "solver")}; tables and figures below follow`;
}

function start() {
  const select = byId("section");
  select.append(...DATA.sections.map((one, k) => element("option", { value: k }, one.name || "all formulations")));
  select.addEventListener("change", () => { section = DATA.sections[Number(select.value)]; drawSection(); });
  byId("scope").hidden = DATA.sections.length < 3;
  const theme = byId("theme"), dark = () => (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const name = () => { theme.textContent = dark() ? "Light" : "Dark"; theme.setAttribute("aria-label", `Switch to ${dark() ? "light" : "dark"} colours`); };
  theme.addEventListener("click", () => { document.documentElement.dataset.theme = dark() ? "light" : "dark"; name(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", name);
  theme.hidden = false;
  name();
  drawSection();
  drawReasons();
  drawAgreement();
  makeRuns();
  applyFilters();
  document.documentElement.dataset.ready = performance.now().toFixed(0);
}

start();
