"""The page of a study of 10,000 rows.

    python benchmarks/studies/page.py [--rows 10000] [--repeat 3] [--keep study.html]

Printed: wall and processor seconds to build the page, from rows to file and from a database to file (goal 20 s), its
size (goal 15 MB), and the seconds from the order to open it to a page that sorts and filters, in headless Chromium
(goal 3 s, the slowest of the repeats); then how long a sorting, a filtering and a zoom take until they are drawn. The
rows are synthetic: six solvers, three formulations, four data sets, with failures, refusals and false claims.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from optid.studies.page import write_page
from optid.studies.storage.store import append

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from browser import CHROMIUM, NO_BROWSER, Browser
from study_rows import rows as synthetic

BUILT, SIZE, INTERACTIVE = 20.0, 15.0, 3.0  # s, MB, s
DRAWN = "new Promise((done) => requestAnimationFrame(() => setTimeout(done)))"
ACTS = {
    "sort by objective": "document.querySelector('#runs-table [data-column=objective]').click()",
    "sort by reason": "document.querySelector('#runs-table [data-column=reason]').click()",
    "search in every text": "(() => { const e = document.getElementById('filter-text'); e.value = 'stationary scs'; "
                            "e.dispatchEvent(new Event('input')); applyFilters(); })()",
    "zoom all points": "document.querySelector('#accuracy .zoom button').click()",
    "next formulation": "(() => { const e = document.getElementById('section'); e.value = 1; "
                        "e.dispatchEvent(new Event('change')); })()",
}  # fmt: skip


def main() -> None:
    """Build, open, act, and print the figures beside the goals."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--keep", type=Path, default=None, help="also write the page here")
    arguments = parser.parse_args()
    rows = synthetic(arguments.rows, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.html"
        build("built from rows", rows, path)
        append(Path(folder) / "study.sqlite", rows)
        build("built from a database", Path(folder) / "study.sqlite", path)
        line("size", path.stat().st_size / 1e6, SIZE, "MB")
        if arguments.keep:
            arguments.keep.write_bytes(path.read_bytes())
        if CHROMIUM is None:
            print(NO_BROWSER)
            return
        with Browser(Path(folder) / "profile") as browser:
            for word, phone, width in (("wide window", False, 1280), ("phone", True, 390)):
                browser.window(width, 900, phone=phone)
                slowest = max(opened(browser, path) for _ in range(arguments.repeat))
                line(f"interactive, {word}", slowest, INTERACTIVE, "s")
            browser.window(1280, 900)
            browser.open(path)
            for name, act in ACTS.items():
                print(f"{name:<28}{act_time(browser, act):>8.0f} ms")
            print(f"complaints of the browser: {len(browser.complaints())}; requests: {len(browser.requests())}")


def build(name: str, source: Any, path: Path) -> None:
    """Write the page and print how long that took."""
    clock, worked = time.perf_counter(), time.process_time()
    write_page(source, path)
    worked = time.process_time() - worked
    line(name, time.perf_counter() - clock, BUILT, "s", f", processor {worked:.2f} s")


def opened(browser: Browser, path: Path) -> float:
    """Seconds from the order to open the page until it is ready and has drawn once."""
    seconds = browser.open(path)
    clock = time.perf_counter()
    browser.run(DRAWN)
    return seconds + time.perf_counter() - clock


def act_time(browser: Browser, act: str) -> float:
    """Milliseconds of one act until the next picture is drawn."""
    timed = f"const t = performance.now(); {act}; await {DRAWN}; return performance.now() - t;"
    return browser.run(f"(async () => {{ {timed} }})()")


def line(name: str, value: float, goal: float, unit: str, more: str = "") -> None:
    met = "reached" if value <= goal else "MISSED"
    print(f"{name:<28}{value:>8.2f} {unit:<3} goal at most {goal:g} {unit}: {met}{more}")


if __name__ == "__main__":
    main()
