"""Bytes, milliseconds and keyboard access of plots inside a page: optid's own against libraries from npm.

    npm pack uplot plotly.js-basic-dist-min vega vega-lite @bokeh/bokehjs   # unpack each into FOLDER/NAME-VERSION
    python benchmarks/page_plots.py FOLDER

Every page draws the same three curves of 10,000 samples; the time is that from the start of the page to the end of the
drawing, the median of five openings in headless Chromium, at 1300 px.
"""

import json
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

SAMPLES = 10_000

DRAW = {
    "optid": """makePlot(h, {label: 'a', title: 'a', x: {title: 't'}, y: {title: 'y'}, cursor: true,
        series: Y.map((ys, k) => ({name: 's' + k, colour: '#1063b5', kind: 'curve', xs: X, ys}))}, new Set());
        done();""",
    "uplot": """new uPlot({width: 1200, height: 400,
        series: [{}, ...Y.map((_, k) => ({label: 's' + k, stroke: 'blue'}))]}, [X, ...Y], h);
        done();""",
    "plotly": "Plotly.newPlot(h, Y.map((y) => ({x: X, y, mode: 'lines'}))).then(done);",
    "vega": """const v = X.flatMap((t, i) => Y.map((y, k) => ({t, y: y[i], s: 's' + k})));
        const s = vegaLite.compile({data: {values: v}, width: 1100, height: 400, mark: 'line',
            params: [{name: 'z', select: 'interval', bind: 'scales'}], encoding: {x: {field: 't', type: 'quantitative'},
            y: {field: 'y', type: 'quantitative'}, color: {field: 's'}}}).spec;
        new vega.View(vega.parse(s), {renderer: 'canvas', container: h}).runAsync().then(done);""",
    "bokeh": """const p = Bokeh.Plotting.figure({width: 1200, height: 400}); Y.forEach((y) => p.line({x: X, y}));
        Bokeh.Plotting.show(p, h).then(done);""",
}


def scripts(folder: Path) -> dict[str, list[Path]]:
    """Return the files of every library that is there."""
    patterns = {"uplot": ["uplot*/package/dist/uPlot.iife.min.js"],
                "plotly": ["plotly*/package/plotly-basic.min.js"],
                "vega": ["vega-[0-9]*/package/build/vega.min.js", "vega-lite*/package/build/vega-lite.min.js"],
                "bokeh": ["bokeh*/package/build/js/bokeh.min.js", "bokeh*/package/build/js/bokeh-api.min.js"]}
    found = {name: [path for one in several for path in folder.glob(one)] for name, several in patterns.items()}
    return {"optid": [ROOT / "optid/show/templates/plot.js"], **{name: paths for name, paths in found.items() if paths}}


def main(folder: Path) -> None:
    """Print a table."""
    from browser import Browser

    rng = np.random.default_rng(0)
    curves = np.cumsum(rng.standard_normal((3, SAMPLES)), axis=1).round(4).tolist()
    data = f"const X = {json.dumps(list(range(SAMPLES)))}, Y = {json.dumps(curves)};"
    print(f"{'plot':<8}{'kB of script':>14}{'ms':>8}{'focusable':>11}{'in SVG':>8}")
    with tempfile.TemporaryDirectory() as place, Browser(Path(place) / "profile") as browser:
        browser.window(1300, 900)
        for name, paths in scripts(folder).items():
            library = "\n".join(path.read_text(encoding="utf-8") for path in paths)
            page = Path(place) / f"{name}.html"
            end = "const done = () => { document.documentElement.dataset.ready = performance.now(); };"
            script = f"{data}{end}const h = document.getElementById('h');{DRAW[name]}"
            page.write_text(f"<!DOCTYPE html><meta charset=utf-8><body><div id=h></div><script>{library}</script>"
                            f"<script>{script}</script>", encoding="utf-8")
            times = []
            for _ in range(5):
                browser.open(page)
                times.append(float(browser.run("document.documentElement.dataset.ready")))
            keys = browser.run("[...document.querySelectorAll('button, a[href], [tabindex]')].filter((e) => "
                               "e.tabIndex >= 0).length")
            drawn = browser.run("document.querySelectorAll('svg path').length > 0")
            print(f"{name:<8}{sum(map(len, map(Path.read_bytes, paths))) / 1e3:>14.0f}{statistics.median(times):>8.0f}"
                  f"{keys:>11}{'yes' if drawn else 'no':>8}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
