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

DOCS = Path(__file__).parents[2] / "docs"
BLOCK = re.compile(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL)
"""Code of a page, and what it prints where that follows; "..." stands for lines that are left out."""
PAGES = [page for page in sorted(DOCS.glob("*.md")) if BLOCK.search(page.read_text(encoding="utf-8"))]


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_blocks_of_a_page_run_in_their_order_and_print_what_follows(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        for block, shown in BLOCK.findall(page.read_text(encoding="utf-8")):
            exec(compile(block, str(page), "exec"), space)
            printed = " ".join(capsys.readouterr().out.split())
            for part in re.split(r"^\.\.\.$", shown, flags=re.MULTILINE):
                assert " ".join(part.split()) in printed, part


def test_the_page_on_records_states_the_levels_that_are_used():
    text = " ".join((DOCS / "record.md").read_text(encoding="utf-8").split())
    for sentence in (f"Level {100 * feedback.LEVEL:g} % for each input", f"Level {100 * effect.LEVEL:g} %.",
                     f"more than {record.PAIRS} pairs"):
        assert sentence in text
    assert (excitation.ONE_MOVE, process.LATEST, process.LIKELY) == (4, 0.25, 3.84)


def test_the_page_on_the_verdict_names_every_line_and_the_thresholds_that_are_used():
    text = " ".join((DOCS / "verdict.md").read_text(encoding="utf-8").split())
    worst = verdict.GOOD_BLOCK - (verdict.GOOD_FIT - verdict.POOR_FIT)
    for sentence in (
            f"from {verdict.GOOD_FIT:g} % on, {verdict.GOOD_BLOCK:g} % in the worst block",
            f"| fair | fit from {verdict.POOR_FIT:g} % on", f"| poor | fit below {verdict.POOR_FIT:g} %",
            f"the fit is below {verdict.USELESS_FIT:g} %", f"is below {worst:g} %",
            f"exceeds {verdict.OVERFIT:g} points", f"exceeds {verdict.GAP:g} points",
            f"exceeds {100 * verdict.NOTED:g} % of the response; above {100 * verdict.WRONG:g} %",
            f"| it exceeds {100 * verdict.APART:g} % of the response", f"| it exceeds {100 * verdict.UNCERTAIN:g} % |",
            f"| more than {100 * verdict.OUTSIDE:g} % |", f"more than {100 * verdict.STRUCTURE:g} % of the residual"):
        assert sentence in text, sentence
    source = Path(verdict.__file__).read_text(encoding="utf-8")
    names = {name for name in re.findall(r'Finding\(\s*"([^"]+)"', source) if name != "residuals"}
    assert len(names) > 9 and [name for name in names if name not in text] == []


def test_the_links_of_the_pages_lead_somewhere():
    for page in DOCS.glob("*.md"):
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            file, _, anchor = target.partition("#")
            if file.startswith(("http", "generated/", "gallery/", "../generated", "../examples")):
                continue
            where = page if not file else page.parent / file
            assert where.exists(), f"{page.name}: {target}"
            if anchor:
                heads = re.findall(r"^#+ (.*)$", where.read_text(encoding="utf-8"), re.MULTILINE)
                known = {re.sub(r"[^\w\- ]", "", head).lower().replace(" ", "-") for head in heads}
                assert anchor in known, f"{page.name}: {target}"


def test_the_glossary_has_a_sentence_for_every_term():
    text = (DOCS / "glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^### (.*)\n(.*)$", text, re.MULTILINE)
    assert len(terms) >= 25 and all(len(sentence) > 30 for _, sentence in terms)
    asked = "fit|E_N|root SNR|VAF|ARL0|dead time|gauge|simulation|innovations|isolable".split("|")
    assert set(asked) <= {term for term, _ in terms}


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted((DOCS / "tutorials").glob("*.py")), ids=lambda path: path.stem)
def test_a_tutorial_runs(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings(action="ignore", category=DataWarning):
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
