// What pages with charts share: numbers, legends that switch curves, tables that become cards, the theme.

// Numbers come as lists, as {start, step, count}, or as bytes of 4 or 8 each.
function numbers(coded) {
  if (Array.isArray(coded)) return coded.map((v) => (v === null ? NaN : v));
  if (coded.count !== undefined) return Array.from({ length: coded.count }, (_, k) => coded.start + k * coded.step);
  const bytes = Uint8Array.from(atob(coded.bytes || coded.wide), (c) => c.charCodeAt(0));
  return coded.bytes ? new Float32Array(bytes.buffer) : new Float64Array(bytes.buffer);
}

function decoded(chart) {
  return chart.series.map((one) => ({ ...one, xs: numbers(one.xs), ys: numbers(one.ys), lows: one.lows ? numbers(one.lows) : null }));
}

// A button for every named curve, where there are several.
function addLegend(host, title, series, hidden, redraw) {
  const labels = series.filter((one) => one.name);
  if (labels.length < 2) return;
  host.before(element("div", { class: "legend", role: "group", "aria-label": `Curves of ${title}` }, ...labels.map((one) => {
    const swatch = element("svg:svg", { class: "swatch", viewBox: "0 0 26 10", "aria-hidden": "true" },
        ["area", "bars"].includes(one.kind) ? element("svg:rect", { width: 26, height: 10, fill: one.colour, "fill-opacity": 0.35 }) :
          element("svg:line", { x1: 0, x2: 26, y1: 5, y2: 5, stroke: one.colour, "stroke-width": 2.5, "stroke-dasharray": one.dash || null }));
      return element("button", { type: "button", "aria-pressed": "true", onclick: (event) => {
        hidden.has(one.name) ? hidden.delete(one.name) : hidden.add(one.name);
        event.currentTarget.setAttribute("aria-pressed", String(!hidden.has(one.name)));
        redraw();
      } }, swatch, element("span", {}, one.name));
    })));
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

function themeButton() {
  const theme = document.getElementById("theme"), dark = () => (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const name = () => { theme.textContent = dark() ? "Light" : "Dark"; theme.setAttribute("aria-label", `Switch to ${dark() ? "light" : "dark"} colours`); };
  theme.addEventListener("click", () => { document.documentElement.dataset.theme = dark() ? "light" : "dark"; name(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", name);
  theme.hidden = false;
  name();
}
