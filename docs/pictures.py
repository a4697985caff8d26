"""Write the pictures of the documentation into `docs/pictures`: pages of the commands as a browser draws them.

    python docs/pictures.py

It needs a Chromium on PATH. The pictures are part of the project, so that building the site needs no browser.
"""

import os
import re
import shlex
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
FAULTS = {"diagnosis": "fault", "repair": "repair"}
"""Pictures of the pages that the commands of `faults.md` write."""


def run(*words: str) -> None:
    """Run a command of optid."""
    done = CliRunner().invoke(app, words)
    if done.exit_code:
        raise SystemExit(done.output)


def draw(browser: Browser, page: Path, name: str) -> None:
    """Draw the first screen of a page."""
    browser.open(page, "document.readyState === 'complete'")
    browser.run("(document.querySelector('.verdict') || document.body).scrollIntoView({behavior: 'instant'})")
    browser.picture(HOME / "pictures" / f"{name}.png")


def write_pages(browser: Browser, folder: Path) -> None:
    """Draw the page of a fit, and those of a diagnosis and a repair by the script and the commands of `faults.md`."""
    run("fit", "--example", "heater", "--report", str(folder / "verdict.html"))
    draw(browser, folder / "verdict.html", "verdict")
    text = (HOME / "faults.md").read_text()
    os.chdir(folder)
    exec(text.split("```python\n")[1].split("```")[0], {})
    for command in re.findall(r"^    optid ((?:fit|diagnose|reformulate) (?:.*\\\n)*.*)$", text, re.MULTILINE):
        run(*shlex.split(command.replace("\\\n", " ")))
    for page, name in FAULTS.items():
        draw(browser, folder / f"{page}.html", name)


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
