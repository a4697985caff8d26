"""Time from a movement of the mouse to the fit on the page: a record of 100,000 samples, dragged in headless Chromium.

Prints the median and the extremes over refits by constraints drawn on the plots, from the script's question to the next
frame of the page that shows the answer; beside them the processor time of the server alone, which a busy machine
lengthens less.
"""

import sys
import tempfile
import threading
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from browser import Browser  # noqa: E402

from optid.examples import example  # noqa: E402
from optid.workbench.bench import BenchSource  # noqa: E402
from optid.workbench.request import suggest_state  # noqa: E402
from optid.workbench.server import Server  # noqa: E402

GESTURES = (("static", "Corridor", (0.4, 0.55), (0.6, 0.7)), ("static", "Point", (0.8, 0.4), (0.8, 0.45)),
            ("poles", "Disc", (0.6, 0.47), (0.75, 0.47)), ("step", "Band", (0.4, 0.9), (0.9, 0.4)))


def main(samples: int = 100_000, moves: int = 12) -> None:
    warnings.simplefilter("ignore")
    chosen = example("thruster", n=samples)
    server = Server(BenchSource(chosen.data, "", suggest_state(chosen.data, chosen.suggestion)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory() as profile, Browser(Path(profile)) as browser:
        browser.window(1300, 900)
        browser.send("Page.navigate", url=server.address)
        browser.wait("document.documentElement?.dataset.judged")
        print(f"{samples} samples; milliseconds from question to picture (median, least, most; processor time)")
        for tool, mode, start, end in GESTURES:
            browser.run("state.constraints.length = 0; settle()")
            browser.wait("!document.documentElement.dataset.busy")
            browser.run("timings.length = 0; globalThis.servers = []; show = ((old) => (found) => { "
                        "servers.push(1000 * found.seconds); old(found); })(show)")
            browser.run(f"[...document.querySelector('[data-tool={tool}]').closest('figure').querySelectorAll("
                        f"'.modes button')].find((b) => b.textContent === '{mode}').click()")
            place = browser.where(f"[data-tool={tool}] svg")
            at = [(place["x"] + a * place["width"], place["y"] + b * place["height"]) for a, b in (start, end)]
            browser.mouse("mousePressed", *at[0], button="left", clickCount=1)
            for share in np.linspace(0.3, 1, moves):
                x, y = (p + share * (q - p) for p, q in zip(*at))
                browser.mouse("mouseMoved", x, y, button="left")
                browser.wait("!document.documentElement.dataset.busy")
            browser.mouse("mouseReleased", *at[1], button="left", clickCount=1)
            browser.wait("!document.documentElement.dataset.busy")
            found, own = browser.run("timings"), browser.run("servers")
            print(f"  {mode:9s} {np.median(found):6.0f} {min(found):6.0f} {max(found):6.0f}   {np.median(own):6.0f}   "
                  f"({len(found)} refits)")
    server.shutdown()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
