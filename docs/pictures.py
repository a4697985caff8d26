"""Write the pictures of the start page into `docs/pictures`: pages of the commands as a browser draws them.

    python docs/pictures.py

It needs a Chromium on PATH. The pictures are part of the project, so that building the site needs no browser.
"""

import sys
import tempfile
import threading
from pathlib import Path

from typer.testing import CliRunner

from optid.cli.app import app
from optid.examples import example
from optid.workbench.bench import BenchSource
from optid.workbench.request import suggest_state
from optid.workbench.server import Server

HOME = Path(__file__).parent
sys.path.insert(0, str(HOME.parent / "tests" / "helpers"))

from browser import Browser  # noqa: E402

SIZE = 1180, 720
PAGES = {
    "verdict": ["fit", "--example", "heater"],
    "fault": ["diagnose", "MODEL", "--example", "broken_thruster", "--identified", "thruster"],
}
MODEL = ["fit", "--example", "thruster", "--formulation", "hammerstein_ss.exact", "--nx", "2", "--set",
         "criterion=prediction", "--model"]


def run(*words: str) -> None:
    """Run a command of optid."""
    done = CliRunner().invoke(app, words)
    if done.exit_code:
        raise SystemExit(done.output)


def write_pages(browser: Browser, folder: Path) -> None:
    """Draw the first screen of the page of a fit, and of a diagnosis."""
    run(*MODEL, str(folder / "model.json"))
    for name, words in PAGES.items():
        page = folder / f"{name}.html"
        run(*[str(folder / "model.json") if word == "MODEL" else word for word in words], "--report", str(page))
        browser.open(page, "document.readyState === 'complete'")
        browser.run("document.querySelector('.verdict').scrollIntoView({behavior: 'instant'})")
        browser.picture(HOME / "pictures" / f"{name}.png")


def write_workbench(browser: Browser) -> None:
    """Draw the workbench with the record of the thruster."""
    chosen = example("thruster")
    server = Server(BenchSource(chosen.data, "", suggest_state(chosen.data, chosen.suggestion)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        browser.send("Page.navigate", url=server.address)
        browser.wait("document.documentElement?.dataset.ready && document.documentElement.dataset.judged")
        browser.picture(HOME / "pictures" / "workbench.png")
    finally:
        server.shutdown()


if __name__ == "__main__":
    (HOME / "pictures").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, Browser(Path(scratch) / "profile") as driven:
        driven.window(*SIZE)
        driven.send("Emulation.setScrollbarsHidden", hidden=True)
        write_pages(driven, Path(scratch))
        write_workbench(driven)
