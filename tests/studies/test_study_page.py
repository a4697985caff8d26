"""The document of a study: the same on the page and as text, quiet, true, and safe against hostile names."""

import re

import pytest
from browser import CHROMIUM, NO_BROWSER, Browser
from html_page import Page
from study_rows import rows as synthetic
from study_rows import run, share

from optid.errors import DataError
from optid.show.studies import profile_chart, study_document
from optid.studies.verdicts.verdict import conclude

HOSTILE = '</script><script>window.hacked = 1</script><img src=x onerror="window.hacked = 2">"\'&amp;\u2028{{ 7 * 7 }}'


@pytest.fixture(scope="module")
def verdict():
    return conclude(synthetic(1500, 1))


@pytest.fixture(scope="module")
def page(verdict, tmp_path_factory):
    return verdict.report(tmp_path_factory.mktemp("study") / "study.html", command="optid study report x.sqlite")


def test_the_page_says_what_the_text_says_and_loads_nothing(page, verdict):
    source = page.read_text(encoding="utf-8")
    text = " ".join(Page(source).text.split())
    for word in (verdict.headline.word, " ".join(verdict.headline.text.split()), "optid study report x.sqlite"):
        assert word in text
    printed = " ".join(str(verdict).split())
    for standing in verdict.overall.standings:
        assert standing.solver in text and standing.solver in printed
        assert f"{standing.solved:,} of {standing.problems:,}" in text
    for claim in verdict.false_claims:
        assert claim.reason in text
    for attribute in ("src", "href", "data", "action", "srcset"):
        assert all(value.startswith("#") or value == "data:," for value in Page(source).values(attribute))


def test_a_profile_is_a_step_function_through_its_points(verdict):
    chart = profile_chart(verdict.overall)
    for series in chart.series:
        profile = verdict.overall.profiles[series.name]
        assert series.xs.shape == series.ys.shape and series.ys[0] == 0.0 and series.ys[-1] == share(profile, 1e9)
        for factor, height in zip(*profile):
            here = series.ys[series.xs == factor]
            assert here[-1] == height and here[0] == pytest.approx(share(profile, factor - 1e-9))


def test_every_word_for_how_a_run_ended_is_explained(page, verdict):
    words = {state for one in (verdict.overall, *verdict.sections) for s in one.standings for state in s.failures}
    assert {"failed", "false claim", "crashed"} <= words
    explained = page.read_text(encoding="utf-8").split("Words for how a run ended")[1]
    assert words <= set(re.findall(r"<dt>([^<]+)</dt>", explained))


def test_nothing_that_a_study_may_hold_breaks_its_document():
    cases = [[], synthetic(40, 3), [run("a")], [run(s, p, objective=None, status_verified="infeasible")
                                                for s in "ab" for p in range(3)],
             [run(s, p, outcome="refused", status_verified=None, objective=None) for s in "ab" for p in range(3)],
             [run(HOSTILE, p, HOSTILE, formulation=HOSTILE, reason=HOSTILE, study=HOSTILE) for p in range(8)]]
    for rows in cases:
        verdict = conclude(rows)
        document = study_document(verdict)
        assert str(verdict) and all(section.content() for section in document.sections)


def test_what_is_no_study_is_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(DataError):
        conclude([{"solver": "a"}])
    with pytest.raises(OSError):
        conclude(synthetic(20, 1)).report(tmp_path / "no" / "such" / "page.html")


@pytest.mark.skipif(CHROMIUM is None, reason=NO_BROWSER)
def test_hostile_names_run_nothing_in_a_browser(tmp_path):
    rows = [run(name, p, HOSTILE, formulation=HOSTILE, study=HOSTILE) for p in range(8) for name in (HOSTILE, "b")]
    path = conclude(rows).report(tmp_path / "hostile.html")
    with Browser(tmp_path / "profile") as browser:
        browser.window(390, 800)
        browser.open(path)
        assert browser.run("window.hacked === undefined && document.body.scrollWidth <= 390")
        assert browser.complaints() == [] and browser.requests() == []
