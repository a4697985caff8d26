// The figures of a page of results: data from the page itself, legends that switch curves, linked axes, the theme.

const DATA = JSON.parse(document.getElementById("charts-data").textContent);

const groups = new Map();

function drawChart(host) {
  const chart = DATA[Number(host.dataset.chart)], hidden = new Set(), group = chart.group || "";
  const series = decoded(chart);
  let plot = null;
  addLegend(host, chart.title, series, hidden, () => plot.draw());
  if (chart.equal) host.style.maxWidth = "25rem";
  const moved = group ? (low, high) => groups.get(group).forEach((other) => other !== plot && other.setX(low, high)) : null;
  plot = makePlot(host, { ...chart, label: `${chart.title}. ${chart.caption}`, series, moved }, hidden);
  if (group) groups.set(group, [...(groups.get(group) || []), plot]);
}

function start() {
  themeButton();
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
