"use strict";
// A small plot: lines, steps, bands, stems, bars and dots as SVG. It zooms by dragging, by buttons, keys, pinching, and the
// wheel with Ctrl. Of a long curve the extremes of every pixel are drawn, at every zoom.

const SVG = "http://www.w3.org/2000/svg";

function element(name, attributes = {}, ...children) {
  const made = name.startsWith("svg:") ? document.createElementNS(SVG, name.slice(4)) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

function significant(value, digits = 3) {
  if (value === null || value === undefined) return "-";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e-3 || size >= 1e6) return value.toExponential(Math.max(0, digits - 1)).replace("e+", "e").replace(/\.0+e/, "e");
  return String(Number(value.toPrecision(digits)));
}

function duration(value) {
  if (value === null || value === undefined) return "-";
  if (value < 9.995e-4) return significant(value * 1e6) + " µs";
  return value < 0.9995 ? significant(value * 1e3) + " ms" : significant(value) + " s";
}

function niceStep(span, most) {
  const rough = span / most, power = 10 ** Math.floor(Math.log10(rough));
  return power * [1, 2, 5, 10].find((m) => m * power >= rough * 0.999);
}

// Dates are seconds since 1970.
const DAY = 86400, MONTHS = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];
const DATE_STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, DAY, 2 * DAY, 7 * DAY, 14 * DAY];

function dateText(seconds, digits = 6) {
  const whole = Math.floor(Number(seconds.toFixed(digits))), part = (seconds - whole).toFixed(digits).replace(/^-?0|\.?0+$/g, "");
  return new Date(whole * 1000).toISOString().replace("T", " ").slice(0, -5) + part;
}

// Step of date ticks in seconds: below a second, of seconds to days, of months (negative).
function dateStep(span, most) {
  if (span / most < 0.5) return niceStep(span, most);
  const found = DATE_STEPS.find((step) => step * most >= span);
  return found || -([1, 2, 3, 6, 12].find((n) => n * 30 * DAY * most >= span) || 12 * niceStep(span / (365 * DAY), most));
}

function dateTicks(low, high, most) {
  const step = dateStep(high - low, most), found = [];
  if (step < 0) {
    const from = new Date(low * 1000), months = -step;
    for (let m = Math.floor((from.getUTCFullYear() * 12 + from.getUTCMonth()) / months) * months; ; m += months) {
      const at = new Date(0).setUTCFullYear(Math.floor(m / 12), ((m % 12) + 12) % 12, 1) / 1000;
      if (at > high || !Number.isFinite(at)) return found;
      if (at >= low) found.push([at, months % 12 ? `${MONTHS[((m % 12) + 12) % 12]} ${Math.floor(m / 12)}` : String(Math.floor(m / 12))]);
    }
  }
  const origin = step >= 7 * DAY ? 4 * DAY : 0, digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)); // weeks begin on Mondays
  for (let k = Math.ceil((low - origin) / step - 1e-9); origin + k * step <= high; k++) {
    const at = origin + k * step, text = dateText(at, digits), day = Number(text.slice(8, 10)), clock = text.slice(11);
    const midnight = clock === "00:00:00";
    found.push([at, step >= DAY || midnight ? `${day} ${MONTHS[Number(text.slice(5, 7)) - 1]}` : step >= 60 ? clock.slice(0, 5) : step >= 1 ? clock : clock.slice(6) + " s"]);
  }
  return found;
}

// The title of an axis of dates adds what its ticks leave out.
function dateTitle(title, low, high, most) {
  const step = dateStep(high - low, most), size = step < 0 ? 0 : step >= DAY ? 4 : step >= 1 ? 10 : 16;
  const [from, to] = [low, high].map((v) => dateText(v).slice(0, size));
  return size ? `${title}, ${from === to ? from : `${from} to ${to}`}` : title;
}

// Where a value lies on an axis, in words; of a record with the number of the sample.
function placeText(axis, value) {
  const sample = axis.step ? Math.round((value - axis.start) / axis.step) : null;
  const text = axis.dates ? dateText(value) : `${axis.title}: ${axis.step ? Number(value.toPrecision(10)) : significant(value, 5)}`;
  return sample === null || axis.title.includes("sample") ? text : `${text}, sample ${sample}`;
}

// Ticks of an axis between two transformed ends: [transformed place, label].
function ticksOf(axis, low, high, most) {
  if (axis.dates) return dateTicks(low, high, most);
  if (axis.categories) return axis.categories.map((name, k) => [k, name]).filter(([k]) => k >= low && k <= high);
  const fixed = (axis.ticks || []).filter((v) => v >= low && v <= high);
  if (fixed.length > 1 && fixed.length <= 2.5 * most) return fixed.map((v) => [v, String(v)]);
  const digits = Math.max(3, 2 + Math.floor(Math.log10(Math.max(Math.abs(low), Math.abs(high)) / (niceStep(high - low, most) || 1))));
  const write = axis.format || ((v) => significant(v, axis.log ? 3 : Math.min(digits, 12)));
  if (axis.log && high - low >= 0.7) {
    const factors = high - low < 2.2 && most > 4 ? [1, 2, 5] : [1], step = Math.max(1, Math.ceil((high - low) / most)), found = [];
    for (let d = Math.floor(low); d <= high; d++) {
      if (d % step === 0) for (const f of factors) found.push([d + Math.log10(f), write(f * 10 ** d)]);
    }
    return found.filter(([at]) => at >= low - 1e-9 && at <= high + 1e-9);
  }
  const from = axis.log ? 10 ** low : low, to = axis.log ? 10 ** high : high, step = niceStep(to - from, most), found = [];
  if (!(step > 0)) return [];
  for (let k = Math.ceil(from / step - 1e-9); k * step <= to * (1 + 1e-12) + 1e-12; k++) {
    const value = Number((k * step).toPrecision(12));
    if (!axis.log || value > 0) found.push([axis.log ? Math.log10(value) : value, write(value)]);
  }
  return found;
}

// First index of an ascending list whose value is not below another.
function firstFrom(values, value) {
  let low = 0, high = values.length;
  while (low < high) { const middle = (low + high) >> 1; if (values[middle] < value) low = middle + 1; else high = middle; }
  return low;
}

// Indices of a curve to draw between two: all, or first, extremes and last of each of so many bins.
function extremes(values, from, to, bins) {
  if (to - from <= 4 * bins) return [...Array(Math.max(0, to - from)).keys()].map((k) => k + from);
  const kept = [];
  for (let b = 0; b < bins; b++) {
    const a = from + Math.floor((b * (to - from)) / bins), z = from + Math.floor(((b + 1) * (to - from)) / bins);
    let low = a, high = a, gap = -1;
    for (let i = a; i < z; i++) {
      if (!Number.isFinite(values[i])) { gap = i; continue; }
      if (!(values[i] >= values[low])) low = i;
      if (!(values[i] <= values[high])) high = i;
    }
    kept.push(...[...new Set([low, high, ...(gap < 0 ? [] : [gap])])].sort((p, q) => p - q));
  }
  return kept;
}

let plots = 0;

// spec: label, x and y axes {title, log, categories, ticks, format, low, high}, series [{name, colour, dash, kind, xs, ys, halves}],
// rules [{y, label}], tip(series, i), open(series, i); hidden: set of the names that are switched off. Curves may have lows
// (bands), `held` ones are steps; `aside` keeps a series out of the extent, `equal` makes both units as long, `cursor` shows
// every curve at a place, and `moved(low, high)` hears of another extent of x. `below(frame)` returns what a tool draws
// under the curves, `places(axis)` where on an axis it does so, and `grab(event, x, y, frame)` may take a press of the mouse
// for it, and then returns true.
function makePlot(host, spec, hidden) {
  const id = "plot" + ++plots, box = element("div", { class: "plot" });
  const svg = element("svg:svg", { class: "chart", role: "img", tabindex: "0", "aria-label": spec.label, "aria-describedby": id + "-keys" });
  const tip = element("div", { class: "tip", hidden: true, role: spec.cursor ? "status" : null });
  const keys = element("span", { id: id + "-keys", hidden: true },
    "Keys: plus and minus zoom, arrows move, 0 shows everything." + (spec.cursor ? " Comma and full stop read the values." : " The numbers stand below the figure."));
  const buttons = [["+", "Zoom in", () => zoom(0.6)], ["\u2212", "Zoom out", () => zoom(1 / 0.6)], ["\u21ba", "Show everything", reset]];
  const bar = element("div", { class: "zoom" }, ...buttons.map(([text, label, act]) =>
    element("button", { type: "button", "aria-label": `${label}: ${spec.title}`, title: label, onclick: act }, text)));
  box.append(bar, svg, tip, keys);
  host.append(box);

  const axes = [spec.x, spec.y];
  const prepared = (all) => all.map((one) => ({ ...one, tx: transformed(one.xs, spec.x), ty: transformed(one.ys, spec.y), tl: one.lows && transformed(one.lows, spec.y) }));
  let series = prepared(spec.series), whole = extent(), view = [...whole], frame = null, drag = null;
  const touches = new Map();

  function transformed(values, axis) {
    return axis.log ? values.map((v) => (v > 0 ? Math.log10(v) : NaN)) : values;
  }

  function extent() {
    return axes.flatMap((axis, a) => {
      if (axis.categories) return [-0.6, axis.categories.length - 0.4];
      let low = Infinity, high = -Infinity;
      for (const one of series.filter((one) => !one.aside)) {
        if (a && one.tl) one.tl.forEach((v) => { if (Number.isFinite(v)) low = Math.min(low, v); });
        const values = a ? one.ty : one.tx;
        values.forEach((v, i) => {
          if (!Number.isFinite(v)) return;
          const half = a === 0 && one.halves ? one.halves[i] : 0;
          low = Math.min(low, v - half); high = Math.max(high, v + half);
        });
      }
      for (const rule of a ? spec.rules || [] : []) { low = Math.min(low, Math.log10(rule.y)); high = Math.max(high, Math.log10(rule.y)); }
      for (const place of spec.places ? spec.places(a).filter(Number.isFinite) : []) { low = Math.min(low, place); high = Math.max(high, place); }
      if (low > high) [low, high] = [0, 1];
      const room = (high - low) * 0.04 || 0.5, above = a && spec.rules ? 2 * room : room;
      const at = (v) => (axis.log ? Math.log10(v) : v);
      return [axis.low === undefined ? low - room : at(axis.low), axis.high === undefined ? high + above : Math.max(at(axis.high), low + 1e-6)];
    });
  }

  function measure() {
    const width = Math.max(280, Math.round(box.clientWidth || 560));
    if (spec.equal) return { width, height: width - 32, left: 72, right: 14, top: 10, bottom: 44 };
    const rows = spec.y.categories ? 70 + 30 * spec.y.categories.length : spec.height || Math.min(380, Math.max(260, 0.56 * width));
    const longest = spec.y.categories ? Math.max(...spec.y.categories.map((n) => n.length)) : 0;
    return { width, height: Math.round(rows), left: spec.y.categories ? Math.min(0.4 * width, 16 + 7 * longest) : 72, right: spec.x.dates ? 30 : 14, top: 10, bottom: 44 };
  }

  function draw() {
    const f = (frame = measure());
    const inner = { w: f.width - f.left - f.right, h: f.height - f.top - f.bottom };
    f.x = (v) => f.left + ((v - view[0]) / (view[1] - view[0])) * inner.w;
    f.y = (v) => f.top + (1 - (v - view[2]) / (view[3] - view[2])) * inner.h;
    f.unx = (p) => view[0] + ((p - f.left) / inner.w) * (view[1] - view[0]);
    f.uny = (p) => view[2] + (1 - (p - f.top) / inner.h) * (view[3] - view[2]);
    svg.setAttribute("viewBox", `0 0 ${f.width} ${f.height}`);
    const parts = [], bottom = f.top + inner.h, right = f.left + inner.w;
    const most = Math.max(3, Math.floor(inner.w / 75));
    for (const [at, label] of ticksOf(spec.x, view[0], view[1], most)) {
      const x = f.x(at);
      parts.push(element("svg:line", { class: "line", x1: x, x2: x, y1: f.top, y2: bottom }),
        element("svg:text", { x, y: bottom + 16, "text-anchor": "middle" }, label));
    }
    for (const [at, label] of ticksOf(spec.y, view[2], view[3], Math.max(3, Math.floor(inner.h / 38)))) {
      const y = f.y(at), room = Math.floor((f.left - 10) / 7);
      const cut = label.length > room ? label.slice(0, room - 1) + "…" : label;
      parts.push(element("svg:line", { class: "line", x1: f.left, x2: right, y1: y, y2: y }),
        element("svg:text", { x: f.left - 7, y: y + 4, "text-anchor": "end", class: spec.y.categories ? "name" : null }, cut));
    }
    parts.push(element("svg:text", { x: f.left + inner.w / 2, y: f.height - 8, "text-anchor": "middle" }, spec.x.dates ? dateTitle(spec.x.title, view[0], view[1], most) : spec.x.title));
    if (spec.y.title) parts.push(element("svg:text", { transform: `translate(13 ${f.top + inner.h / 2}) rotate(-90)`, "text-anchor": "middle" }, spec.y.title));
    const clip = element("svg:clipPath", { id: id + "-clip" }, element("svg:rect", { x: f.left, y: f.top - 4, width: inner.w + 4, height: inner.h + 8 }));
    const body = element("svg:g", { "clip-path": `url(#${id}-clip)` });
    for (const rule of spec.rules || []) {
      const y = f.y(Math.log10(rule.y));
      body.append(element("svg:line", { class: "rule", x1: f.left, x2: right, y1: y, y2: y }),
        element("svg:text", { x: right - 4, y: y - 5, "text-anchor": "end" }, rule.label));
    }
    if (spec.below) body.append(...spec.below(f));
    for (const one of series) if (!hidden.has(one.name)) body.append(...drawn(one, f, right));
    svg.replaceChildren(element("svg:defs", {}, clip), ...parts, body);
  }

  function drawn(one, f, right) {
    const style = { fill: "none", stroke: one.colour, "stroke-dasharray": one.dash, "data-series": one.name };
    if (["curve", "area", "stems", "bars", "diamonds", "poles", "line-only"].includes(one.kind)) return shaped(one, f, style);
    const seen = [...one.tx.keys()].filter((i) => Number.isFinite(one.tx[i]) && Number.isFinite(one.ty[i]));
    const px = (i) => f.x(one.tx[i]).toFixed(1), py = (i) => f.y(one.ty[i]).toFixed(1);
    if (one.kind === "step") {
      const path = seen.map((i, k) => (k ? `H${px(i)}V${py(i)}` : `M${px(i)} ${f.y(0).toFixed(1)}V${py(i)}`)).join("");
      return seen.length ? [element("svg:path", { ...style, "stroke-width": 2, d: `${path}H${right}` })] : [];
    }
    const dots = (d, width) => element("svg:path", { ...style, "stroke-dasharray": null, "stroke-width": width, "stroke-linecap": "round", d });
    if (one.kind === "interval") {
      return seen.flatMap((i) => {
        const [a, b] = [f.x(one.tx[i] - one.halves[i]), f.x(one.tx[i] + one.halves[i])];
        return [element("svg:path", { ...style, "stroke-dasharray": null, "stroke-width": 6, "stroke-opacity": 0.35, d: `M${a} ${py(i)}H${b}` }), dots(`M${px(i)} ${py(i)}h0`, 11)];
      });
    }
    if (one.kind === "crosses") {
      const d = seen.map((i) => `M${px(i) - 3} ${py(i) - 3}l6 6m0 -6l-6 6`).join("");
      return [element("svg:path", { ...style, "stroke-dasharray": null, "stroke-width": 1.5, d })];
    }
    const points = dots(seen.map((i) => `M${px(i)} ${py(i)}h0`).join(""), one.kind === "dots" ? 5 : 7);
    if (one.kind === "dots") { points.setAttribute("stroke-opacity", "0.55"); return [points]; }
    return [element("svg:path", { ...style, "stroke-width": 2, d: seen.map((i, k) => `${k ? "L" : "M"}${px(i)} ${py(i)}`).join("") }), points];
  }

  function shaped(one, f, style) {
    const x = (i) => f.x(one.tx[i]).toFixed(1), y = (v) => f.y(v).toFixed(1), marks = (d, width) => element("svg:path", { ...style, "stroke-dasharray": null, "stroke-width": width, d });
    if (one.kind === "bars") {
      const foot = f.height - f.bottom, tall = 0.16 * (foot - f.top), wide = Math.abs(f.x(one.tx[1]) - f.x(one.tx[0])) || 8;
      const d = [...one.ys].map((v, i) => (v > 0 ? `M${x(i)} ${foot}v${(-tall * v).toFixed(1)}h${wide.toFixed(1)}V${foot}z` : "")).join("");
      return [element("svg:path", { d, fill: one.colour, "fill-opacity": 0.35, "data-series": one.name })];
    }
    if (one.kind === "stems" || one.kind === "diamonds" || one.kind === "poles") {
      const seen = [...one.tx.keys()].filter((i) => Number.isFinite(one.ty[i]) && Number.isFinite(one.tx[i]));
      if (one.kind === "poles") return [marks(seen.map((i) => `M${x(i) - 5} ${y(one.ty[i]) - 5}l10 10m0 -10l-10 10`).join(""), 2.2)];
      const foot = f.y(0).toFixed(1), r = one.kind === "stems" ? 2.4 : 3.6;
      const heads = seen.map((i) => `M${x(i)} ${y(one.ty[i]) - r}l${r} ${r}l${-r} ${r}l${-r} ${-r}z`).join("");
      return [marks(seen.map((i) => `M${x(i)} ${foot}V${y(one.ty[i])}`).join(""), 1.4), element("svg:path", { ...style, fill: one.colour, d: heads })];
    }
    const sorted = one.kind !== "line-only", all = one.tx.length;
    const from = sorted ? Math.max(0, firstFrom(one.tx, view[0]) - 1) : 0, to = sorted ? Math.min(all, firstFrom(one.tx, view[1]) + 1) : all;
    const kept = sorted ? extremes(one.ty, from, to, Math.round(f.width - f.left - f.right)) : [...Array(all).keys()];
    if (one.kind === "area") {
      const there = kept.filter((i) => Number.isFinite(one.ty[i]) && Number.isFinite(one.tl[i]));
      const d = [...there.map((i) => `${x(i)} ${y(one.ty[i])}`), ...there.reverse().map((i) => `${x(i)} ${y(one.tl[i])}`)].join("L");
      return d ? [element("svg:path", { d: `M${d}z`, fill: one.colour, "fill-opacity": 0.2, "data-series": one.name })] : [];
    }
    let d = "", pen = false;
    for (const i of kept) {
      if (!Number.isFinite(one.ty[i])) { pen = false; continue; }
      d += pen && one.held ? `H${x(i)}V${y(one.ty[i])}` : `${pen ? "L" : "M"}${x(i)} ${y(one.ty[i])}`;
      pen = true;
    }
    return [element("svg:path", { ...style, "stroke-width": one.width || 1.6, "stroke-linejoin": "round", d })];
  }

  function setView(next, quiet = false) {
    if (spec.equal) {
      const half = Math.max(next[1] - next[0], next[3] - next[2]) / 2, cx = (next[0] + next[1]) / 2, cy = (next[2] + next[3]) / 2;
      next = [cx - half, cx + half, cy - half, cy + half];
    }
    const tiny = axes.some((_, a) => !(next[2 * a + 1] - next[2 * a] > 1e-6 * (whole[2 * a + 1] - whole[2 * a])));
    const huge = axes.some((_, a) => next[2 * a + 1] - next[2 * a] > 20 * (whole[2 * a + 1] - whole[2 * a]));
    if (tiny || huge) return;
    view = next;
    svg.dataset.view = view.map((v) => v.toPrecision(spec.x.dates ? 13 : 6)).join(" ");
    hideTip();
    draw();
    if (spec.moved && !quiet) spec.moved(view[0], view[1]);
  }
  function reset() { setView([...whole]); }
  function zoom(factor, cx = (view[0] + view[1]) / 2, cy = (view[2] + view[3]) / 2) {
    const ends = (low, high, c) => [c + (low - c) * factor, c + (high - c) * factor];
    setView([...ends(view[0], view[1], cx), ...(spec.y.categories ? view.slice(2) : ends(view[2], view[3], cy))]);
  }
  function move(dx, dy) {
    const [w, h] = [(view[1] - view[0]) * dx, spec.y.categories ? 0 : (view[3] - view[2]) * dy];
    setView([view[0] + w, view[1] + w, view[2] + h, view[3] + h]);
  }
  function place(event) {
    const area = svg.getBoundingClientRect(), scale = frame.width / area.width;
    return [(event.clientX - area.left) * scale, (event.clientY - area.top) * scale];
  }
  function hideTip() { tip.hidden = true; svg.querySelector(".cursor")?.remove(); }

  function nearest(x, y) {
    let best = null, least = 24 * 24;
    for (const one of series) {
      if (hidden.has(one.name)) continue;
      for (let i = 0; i < one.tx.length; i++) {
        const d = (f_x(one, i) - x) ** 2 + (frame.y(one.ty[i]) - y) ** 2;
        if (d < least) { least = d; best = [one, i]; }
      }
    }
    return best;
  }
  function f_x(one, i) { return frame.x(one.tx[i]); }

  // Values of every curve at a place, with a line there.
  let at = null;
  function showValues(x) {
    const value = Math.min(Math.max(frame.unx(x), view[0]), view[1]), lines = [], unit = spec.y.unit ? " " + spec.y.unit : "";
    let here = value;
    for (const one of series) {
      if (hidden.has(one.name) || !["curve", "area"].includes(one.kind)) continue;
      let i = Math.min(firstFrom(one.tx, value), one.tx.length - 1);
      if (i > 0 && value - one.tx[i - 1] < one.tx[i] - value) i--;
      here = one.tx[i];
      if (one.kind === "area" && Number.isFinite(one.ys[i])) lines.push(`${one.name}: ${significant(one.lows[i], 4)} to ${significant(one.ys[i], 4)}${unit}`);
      else if (Number.isFinite(one.ys[i])) lines.push(`${one.name}: ${significant(one.ys[i], 4)}${unit}`);
    }
    if (!lines.length) return hideTip();
    at = frame.x(here);
    svg.querySelector(".cursor")?.remove();
    svg.append(element("svg:line", { class: "cursor", x1: at, x2: at, y1: frame.top, y2: frame.height - frame.bottom }));
    tip.textContent = [placeText(spec.x, spec.x.log ? 10 ** here : here), ...lines].join("\n");
    tip.hidden = false;
    const place = (at * box.clientWidth) / frame.width, room = box.clientWidth - tip.offsetWidth;
    tip.style.left = Math.max(0, Math.min(room, place + 12 > room ? place - tip.offsetWidth - 12 : place + 12)) + "px";
    tip.style.top = "12px";
  }

  function showTip(x, y) {
    if (spec.cursor) return showValues(x);
    const found = spec.tip && nearest(x, y);
    if (!found) return hideTip();
    const scale = box.clientWidth / frame.width, [one, i] = found;
    tip.textContent = spec.tip(one, i);
    tip.hidden = false;
    const left = f_x(one, i) * scale, room = box.clientWidth - tip.offsetWidth;
    tip.style.left = Math.max(0, Math.min(room, left - tip.offsetWidth / 2)) + "px";
    const above = frame.y(one.ty[i]) * scale - tip.offsetHeight - 10;
    tip.style.top = (above > -10 ? above : frame.y(one.ty[i]) * scale + 12) + "px";
  }

  svg.addEventListener("pointerdown", (event) => {
    touches.set(event.pointerId, place(event));
    if (spec.grab && spec.grab(event, ...place(event), frame)) return touches.delete(event.pointerId);
    if (event.pointerType === "touch") return;
    drag = { from: place(event), box: null };
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    const at = place(event);
    if (touches.size === 2 && touches.has(event.pointerId)) {
      const [one, two] = [...touches.values()], before = Math.hypot(one[0] - two[0], one[1] - two[1]);
      touches.set(event.pointerId, at);
      const [a, b] = [...touches.values()], after = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (after > 5) zoom(before / after, frame.unx((a[0] + b[0]) / 2), frame.uny((a[1] + b[1]) / 2));
      return;
    }
    if (!drag) return showTip(...at);
    const [x0, y0] = drag.from;
    if (!drag.box && Math.hypot(at[0] - x0, at[1] - y0) > 5) svg.append((drag.box = element("svg:rect", { class: "select" })));
    if (drag.box) {
      const [x, y, w, h] = [Math.min(x0, at[0]), Math.min(y0, at[1]), Math.abs(at[0] - x0), Math.abs(at[1] - y0)];
      const high = spec.y.categories ? { y: frame.top, height: frame.height - frame.top - frame.bottom } : { y, height: h };
      for (const [key, value] of Object.entries({ x, width: w, ...high })) drag.box.setAttribute(key, value);
    }
  });
  svg.addEventListener("pointerup", (event) => {
    touches.delete(event.pointerId);
    const done = drag, at = place(event);
    drag = null;
    if (event.pointerType === "touch") return showTip(...at);
    if (!done) return;
    if (!done.box) {
      const found = spec.open && nearest(...at);
      if (found) spec.open(...found);
      return;
    }
    done.box.remove();
    const xs = [frame.unx(done.from[0]), frame.unx(at[0])].sort((a, b) => a - b);
    const ys = spec.y.categories ? view.slice(2) : [frame.uny(done.from[1]), frame.uny(at[1])].sort((a, b) => a - b);
    setView([...xs, ...ys]);
  });
  svg.addEventListener("pointercancel", (event) => { touches.delete(event.pointerId); drag = null; draw(); });
  svg.addEventListener("pointerleave", hideTip);
  svg.addEventListener("dblclick", reset);
  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    const [x, y] = place(event);
    zoom(event.deltaY > 0 ? 1.25 : 0.8, frame.unx(x), frame.uny(y));
  }, { passive: false });
  svg.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const acts = { "+": () => zoom(0.6), "=": () => zoom(0.6), "-": () => zoom(1 / 0.6), 0: reset, Escape: reset,
      ArrowLeft: () => move(-0.15, 0), ArrowRight: () => move(0.15, 0), ArrowUp: () => move(0, 0.15), ArrowDown: () => move(0, -0.15),
      ...(spec.cursor ? { ",": () => showValues((at ?? frame.left) - 6), ".": () => showValues((at ?? frame.left) + 6) } : {}) };
    if (!acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  });
  new ResizeObserver(() => { if (frame && Math.abs(measure().width - frame.width) > 1) draw(); }).observe(box);
  draw();
  // Other curves at the same view; one that shows everything goes on to do so, unless it is `held`.
  function setSeries(next, held) {
    const all = view.every((v, k) => v === whole[k]);
    series = prepared(next);
    if (held) return draw();
    whole = extent();
    if (all) view = [...whole];
    draw();
  }
  return { draw, svg, place, setSeries, reset, setX: (low, high) => setView([low, high, view[2], view[3]], true) };
}
