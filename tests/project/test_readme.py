"""The outputs printed in the README and the documentation are what the commands print, whatever the processor."""

import re
from contextlib import chdir
from pathlib import Path

import pytest
from typer.testing import CliRunner

from optid.cli.app import app
from optid.conformance.checks import check_formulation
from optid.examples import example
from optid.registry import FORMULATIONS, find_entry_points

HOME = Path(__file__).parents[2]
PAGES = [HOME / "README.md", *sorted((HOME / "docs").glob("*.md"))]
MEASURED = re.compile(r"(?<![\w.])[\d.]+(e[-+]\d+)? (ms|s|µs)\b|(?<=gap )\d\.\de-\d+|\de-\d{3}\b")
"""Times, the gap, which is a rounding error of the bound, and probabilities that are rounding errors."""


def blocks(words: str) -> list[str]:
    """Return the blocks of the pages that show the output of a command, by words of it."""
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    return [block for text in texts for block in re.findall(r"```text\n(.*?)```", text, re.DOTALL) if words in block]


def printed(words: str) -> str:
    return blocks(words)[0]


def figures(text: str) -> list[str]:
    """Return words and numbers, without times, file names and the way lines are filled."""
    text = re.sub(r"\s+", " ", re.sub(r"(report|diagnosis) written to \S+", "", text))
    return MEASURED.sub("#", text).split()


def output(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def tanks(tmp_path_factory):
    """The folder of the page on faults after its script and its first command."""
    folder, text = tmp_path_factory.mktemp("tanks"), (HOME / "docs" / "faults.md").read_text(encoding="utf-8")
    with chdir(folder):
        exec(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0], {})
        output(*re.findall(r"^    optid (fit (?:.*\\\n)*.*)$", text, re.M)[0].replace("\\\n", " ").split())
    return folder


@pytest.fixture(scope="module")
def heater(tmp_path_factory):
    path = tmp_path_factory.mktemp("heater") / "heater.csv"
    output("look", "--example", "heater", "--csv", path)
    return path


def commands() -> list[list[str]]:
    """Return the command lines of the README, without the programme."""
    text = PAGES[0].read_text(encoding="utf-8").replace("\\\n", " ")
    return [line.split()[1:] for line in re.findall(r"^    (optid .*)", text, re.M)]


def test_the_table_of_the_guide_is_the_record_of_the_heater(heater):
    assert heater.read_text().startswith(printed("time,heater,temperature"))


@pytest.mark.slow
@pytest.mark.parametrize(("command", "marks"), [
    ("look", {"dead time from 'heater'": 2}), ("fit", {"monotone:increasing  active": 1}),
    ("identify", {"Chosen:": 1, "* input functions:": 1, "cross-validated": 1})])
def test_excerpts_about_the_heater_are_what_the_commands_of_the_readme_print(command, marks, heater, monkeypatch):
    monkeypatch.chdir(heater.parent)
    # richer classes are not chosen, and where the time for them ends depends on the machine
    more = ["--classes", "linear", "--classes", "input functions", "--effort", "large"] if command == "identify" else []
    shown = output(*next(line for line in commands() if line[0] == command), *more)
    assert "The model on this record: good" in shown or command == "look"
    for words, count in marks.items():
        assert len(blocks(words)) == count
        for part in (part for block in blocks(words) for part in re.split(r"^\.\.\.$", block, flags=re.M)):
            assert " ".join(figures(part)) in " ".join(figures(shown)), part


def test_the_first_command_of_the_readme_prints_that_the_model_is_good(tmp_path):
    (first,) = re.findall(r"pip install \. && optid (.*)", PAGES[0].read_text(encoding="utf-8"))
    ci = (HOME / ".ci" / "run").read_text()
    assert f"optid {first} " in ci and ci.count(first.partition(" --report")[0]) == 2
    shown = output(*first.replace("heater.html", str(tmp_path / "heater.html")).split())
    assert "The model on this record: good" in shown and (tmp_path / "heater.html").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize(("command", "words"), [
    ("isolability", "window 100 samples"), ("diagnose", "faulty: actuator:pump")])
def test_the_outputs_of_the_page_on_faults_are_those_of_its_commands(command, words, tanks):
    text = (HOME / "docs" / "faults.md").read_text(encoding="utf-8")
    with chdir(tanks):
        shown = output(*re.findall(rf"^    optid ({command} .*)$", text, re.M)[0].split())
    assert figures(shown) == figures(printed(words))


@pytest.mark.slow
def test_the_lines_of_python_in_the_readme_run(heater, monkeypatch):
    monkeypatch.chdir(heater.parent)
    (block,) = re.findall(r"```python\n(.*?)```", PAGES[0].read_text(encoding="utf-8"), re.DOTALL)
    exec(block, {})
    assert (heater.parent / "heater.html").stat().st_size > 10_000


def test_the_readme_is_short_and_its_links_lead_somewhere():
    text = PAGES[0].read_text(encoding="utf-8")
    assert text.count("\n") <= 150
    links = re.findall(r"\]\(([^)#]+)", text)
    assert len(links) > 8 and [link for link in links if not (HOME / link).exists()] == []
    assert f"{len(find_entry_points(FORMULATIONS))} formulations" in text


def test_the_formulation_of_the_contributing_guide_is_conformant():
    text = (HOME / "CONTRIBUTING.md").read_text()
    names: dict = {}
    exec(next(block for block in text.split("```python\n")[1:] if "def fir" in block).split("```")[0], names)
    check_formulation(names["fir"], example("dead_zone").data, nb=20)


def test_the_citation_file_has_the_version_and_the_licence_of_the_project():
    cited = dict(re.findall(r"^([\w-]+): (\S.*)$", (HOME / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE))
    project = (HOME / "pyproject.toml").read_text(encoding="utf-8")
    assert f'version = "{cited["version"]}"' in project and f'license = "{cited["license"]}"' in project
    assert cited["cff-version"] == "1.2.0" and cited["type"] == "software"
