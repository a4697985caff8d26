"""Every code block of the documentation runs, every tutorial runs, and the site builds without a warning."""

import os
import re
import runpy
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from optid.errors import DataWarning
from optid.identify import verdict
from optid.identify.informativity import effect, excitation, feedback, process, record

DOCS = Path(__file__).parent.parent / "docs"
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)
PAGES = [page for page in sorted(DOCS.glob("*.md")) if BLOCK.search(page.read_text(encoding="utf-8"))]


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_blocks_of_a_page_run_in_their_order(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        for block in BLOCK.findall(page.read_text(encoding="utf-8")):
            exec(compile(block, str(page), "exec"), space)


def test_the_page_on_records_states_the_levels_and_thresholds_that_are_used():
    text = " ".join((DOCS / "record.md").read_text(encoding="utf-8").split())
    for sentence in (f"Level {100 * feedback.LEVEL:g} % for each input", f"Level {100 * effect.LEVEL:g} %.",
                     f"more than {record.PAIRS} pairs", f"fit is below {verdict.USELESS_FIT:g} %",
                     f"*poor* below {verdict.POOR_FIT:g} %", f"*good* from {verdict.GOOD_FIT:g} % on, with "
                     f"{verdict.GOOD_BLOCK:g} % in the worst block"):
        assert sentence in text
    assert (excitation.ONE_MOVE, process.LATEST, process.LIKELY) == (4, 0.25, 3.84)


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted((DOCS / "tutorials").glob("*.py")), ids=lambda path: path.stem)
def test_a_tutorial_runs(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        runpy.run_path(str(script))


@pytest.mark.slow
def test_the_site_builds_offline_without_a_warning(tmp_path):
    pytest.importorskip("sphinx_gallery")
    pytest.importorskip("latex2mathml")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d", str(tmp_path / "trees"),
               str(DOCS), str(tmp_path / "html")]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "MPLBACKEND": "agg"})
    assert done.returncode == 0, done.stderr[-3000:]
    home = (tmp_path / "html" / "index.html").read_text(encoding="utf-8")
    assert "Tutorials" in home
    loaded = re.findall(r'(?:src|href)="(https?://[^"]+)"', (tmp_path / "html" / "mathematics.html").read_text())
    assert [url for url in loaded if url.endswith((".js", ".css"))] == []
    assert "<math" in (tmp_path / "html" / "mathematics.html").read_text(encoding="utf-8")
