// The figures of a page of results: data from the page itself, legends that switch curves, linked axes, the theme.

const DATA = JSON.parse(document.getElementById("charts-data").textContent);

// Numbers come as lists, as {start, step, count}, or as bytes of 4 or 8 each.
function numbers(coded) {
  if (Array.isArray(coded)) return coded.map((v) => (v === null ? NaN : v));
  if (coded.count !== undefined) return Array.from({ length: coded.count }, (_, k) => coded.start + k * coded.step);
  const bytes = Uint8Array.from(atob(coded.bytes || coded.wide), (c) => c.charCodeAt(0));
  return coded.bytes ? new Float32Array(bytes.buffer) : new Float64Array(bytes.buffer);
}

const groups = new Map();

function drawChart(host) {
  const chart = DATA[Number(host.dataset.chart)], hidden = new Set(), group = chart.group || "";
  const series = chart.series.map((one) => ({ ...one, xs: numbers(one.xs), ys: numbers(one.ys), lows: one.lows ? numbers(one.lows) : null }));
  const labels = series.filter((one) => one.name);
  let plot = null;
  if (labels.length > 1) {
    host.before(element("div", { class: "legend", role: "group", "aria-label": `Curves of ${chart.title}` }, ...labels.map((one) => {
      const swatch = element("svg:svg", { class: "swatch", viewBox: "0 0 26 10", "aria-hidden": "true" },
        ["area", "bars"].includes(one.kind) ? element("svg:rect", { width: 26, height: 10, fill: one.colour, "fill-opacity": 0.35 }) :
          element("svg:line", { x1: 0, x2: 26, y1: 5, y2: 5, stroke: one.colour, "stroke-width": 2.5, "stroke-dasharray": one.dash || null }));
      return element("button", { type: "button", "aria-pressed": "true", onclick: (event) => {
        hidden.has(one.name) ? hidden.delete(one.name) : hidden.add(one.name);
        event.currentTarget.setAttribute("aria-pressed", String(!hidden.has(one.name)));
        plot.draw();
      } }, swatch, element("span", {}, one.name));
    })));
  }
  if (chart.equal) host.style.maxWidth = "25rem";
  const moved = group ? (low, high) => groups.get(group).forEach((other) => other !== plot && other.setX(low, high)) : null;
  plot = makePlot(host, { ...chart, label: `${chart.title}. ${chart.caption}`, series, moved }, hidden);
  if (group) groups.set(group, [...(groups.get(group) || []), plot]);
}

// A table that does not fit becomes cards, one a row.
function fitTables() {
  for (const box of document.querySelectorAll(".scroll")) {
    const table = box.querySelector("table");
    if (!table) continue;
    table.classList.remove("wide");
    if (box.clientWidth && table.scrollWidth > box.clientWidth + 1) table.classList.add("wide");
  }
}

function start() {
  const theme = document.getElementById("theme"), dark = () => (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const name = () => { theme.textContent = dark() ? "Light" : "Dark"; theme.setAttribute("aria-label", `Switch to ${dark() ? "light" : "dark"} colours`); };
  theme.addEventListener("click", () => { document.documentElement.dataset.theme = dark() ? "light" : "dark"; name(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", name);
  theme.hidden = false;
  name();
  fitTables();
  addEventListener("resize", fitTables);
  document.querySelectorAll("details").forEach((one) => one.addEventListener("toggle", fitTables));
  const waiting = [...document.querySelectorAll("[data-chart]")];
  const watch = new IntersectionObserver((entries) => entries.forEach((entry) => {
    if (entry.isIntersecting) { watch.unobserve(entry.target); drawChart(entry.target); }
  }), { rootMargin: "600px" });
  waiting.forEach((host) => watch.observe(host));
  addEventListener("beforeprint", () => waiting.forEach((host) => { if (!host.querySelector("svg")) { watch.unobserve(host); drawChart(host); } }));
  document.documentElement.dataset.ready = performance.now().toFixed(0);
}

start();
