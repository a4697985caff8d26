"""The page of a study of 10,000 rows.

    python benchmarks/studies/page.py [--rows 10000] [--repeat 3] [--keep study.html]

Printed: wall and processor seconds from rows to the verdict and its page (goal 20 s), its size (goal 15 MB), and the
seconds from the order to open it until it has drawn, in headless Chromium (goal 3 s, the slowest of the repeats). The
rows are synthetic: six solvers, three formulations, four data sets, with failures, refusals and false claims.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from optid.studies import conclude

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "helpers"))
from browser import CHROMIUM, NO_BROWSER, Browser
from study_rows import rows as synthetic

BUILT, SIZE, INTERACTIVE = 20.0, 15.0, 3.0  # s, MB, s


def main() -> None:
    """Build, open, and print the figures beside the goals."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--keep", type=Path, default=None, help="also write the page here")
    arguments = parser.parse_args()
    rows = synthetic(arguments.rows, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.keep or Path(folder) / "study.html"
        clock, worked = time.perf_counter(), time.process_time()
        conclude(rows).report(path)
        worked = time.process_time() - worked
        line("verdict and page", time.perf_counter() - clock, BUILT, "s", f", processor {worked:.2f} s")
        line("size", path.stat().st_size / 1e6, SIZE, "MB")
        if CHROMIUM is None:
            print(NO_BROWSER)
            return
        with Browser(Path(folder) / "profile") as browser:
            for word, phone, width in (("wide window", False, 1280), ("phone", True, 390)):
                browser.window(width, 900, phone=phone)
                line(f"drawn, {word}", max(browser.open(path) for _ in range(arguments.repeat)), INTERACTIVE, "s")
            print(f"complaints of the browser: {len(browser.complaints())}; requests: {len(browser.requests())}")


def line(name: str, value: float, goal: float, unit: str, more: str = "") -> None:
    met = "reached" if value <= goal else "MISSED"
    print(f"{name:<28}{value:>8.2f} {unit:<3} goal at most {goal:g} {unit}: {met}{more}")


if __name__ == "__main__":
    main()
