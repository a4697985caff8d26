"""The outputs printed in the README and the documentation are what the commands print, whatever the processor."""

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from optid.cli.app import app
from optid.conformance.checks import check_formulation
from optid.examples import example
from optid.registry import FORMULATIONS, registered

HOME = Path(__file__).parent.parent
PAGES = [HOME / "README.md", *sorted((HOME / "docs").glob("*.md"))]
MEASURED = re.compile(r"(?<![\w.])[\d.]+(e[-+]\d+)? (ms|s|µs)\b|(?<=gap )\d\.\de-\d+")
"""Times, and the gap, which is a rounding error of the bound."""


def printed(command: str) -> str:
    """Return the block of a page that shows the output of a command, by its first words."""
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    blocks = [block for text in texts for block in re.findall(r"```text\n(.*?)```", text, re.DOTALL)]
    return next(block for block in blocks if command in block)


def figures(text: str) -> list[str]:
    """Return words and numbers, without times, file names and the way lines are filled."""
    text = re.sub(r"\s+", " ", re.sub(r"(report|diagnosis) written to \S+", "", text))
    return MEASURED.sub("#", text).split()


def output(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "thruster.json"
    output("fit", "--example", "thruster", "--formulation", "hammerstein_ss.exact", "--nx", 2, "--set",
           "criterion=prediction", "--model", path)
    return path


@pytest.mark.slow
def test_the_main_example_prints_the_figures_of_the_readme(tmp_path):
    shown = output("fit", "--example", "thruster", "--report", tmp_path / "thruster.html")
    assert figures(shown) == figures(printed("Hammerstein ARX model"))


@pytest.mark.slow
def test_the_sizes_of_isolable_faults_are_those_of_the_readme(model):
    assert figures(output("isolability", model)) == figures(printed("window 100 samples"))


def test_the_diagnosis_is_that_of_the_readme(model, tmp_path):
    shown = output("diagnose", model, "--example", "broken_thruster", "--identified", "thruster", "--out",
                   tmp_path / "d.json")
    assert figures(shown) == figures(printed("faulty: actuator:current loss"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*outside the interval")
def test_the_lines_of_python_in_the_readme_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = example("thruster").data
    np.savetxt("rig.csv", np.column_stack([data.u, data.y]), delimiter=",", header="current,thrust", comments="")
    (block,) = re.findall(r"```python\n(.*?)```", PAGES[0].read_text(encoding="utf-8"), re.DOTALL)
    exec(block, {})
    assert (tmp_path / "rig.html").stat().st_size > 10_000


def test_the_readme_is_short_and_its_links_lead_somewhere():
    text = PAGES[0].read_text(encoding="utf-8")
    assert text.count("\n") <= 150
    links = re.findall(r"\]\(([^)#]+)", text)
    assert len(links) > 8 and [link for link in links if not (HOME / link).exists()] == []
    assert f"{len(registered(FORMULATIONS))} formulations" in text


def test_the_formulation_of_the_contributing_guide_is_conformant():
    text = (HOME / "CONTRIBUTING.md").read_text()
    names: dict = {}
    exec(next(block for block in text.split("```python\n")[1:] if "def fir" in block).split("```")[0], names)
    check_formulation(names["fir"], example("dead_zone").data, nb=20)
