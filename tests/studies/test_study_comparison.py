"""Solvers side by side on one record: the sentence, the lines, and the page that says the same."""

import pytest
from study_rows import FAILED, LOCAL, row

from optid.studies.verdicts.comparison import compare, verdict_on_one_record
from optid.studies.verdicts.verdict import conclude

COUNT = "(verified residuals up to 1e-06 count)"
REACHED = f"reached the accuracy of 1e-08 {COUNT} in"


@pytest.mark.parametrize("rows, words", [
    ([row("a"), row("b", solve_s=0.03), row("c", solve_s=0.05)],
     f"Use a: it {REACHED} 10 ms, proved globally optimal; next is b with 30 ms."),
    ([row("a"), row("b", solve_s=0.0105)],
     f"Use a or b: they {REACHED} 10 ms, equal within 10%, proved globally optimal."),
    ([row("a", **LOCAL), row("b", solve_s=0.03)],
     f"Use b: it {REACHED} 30 ms, proved globally optimal; next is a with 10 ms (without a proof)."),
    ([row("a", **LOCAL), row("b", solve_s=0.03, **LOCAL)],
     f"Use a: it {REACHED} 10 ms, not proved globally optimal; next is b with 30 ms."),
    ([row("a", objective=1.01, **LOCAL), row("b", solve_s=3.0)],
     f"Use b: it {REACHED} 3 s, proved globally optimal; a did not."),
    ([row("a", **FAILED), row("b", **FAILED)],
     "No solver reached the accuracy of 1e-08: verified residuals up to 1e-06 count; failed: a and b."),
    ([row("a")], f"Use a: it {REACHED} 10 ms, proved globally optimal; there is no other to compare it with."),
    ([row("a", outcome="refused", status_verified=None, reached=False, proved=False, reason="not its class")],
     "No solver takes this formulation: choose others (optid solvers)."),
    ([row("a", false_claim=True), row("b", solve_s=9.0)],
     f"Use b: it {REACHED} 9 s, proved globally optimal; a did not."),
])
def test_recommendations(rows, words):
    assert compare(rows).recommendation == words


def test_lines_have_the_numbers_of_the_rows():
    rows = [row("a", compile_s=0.02, repetition=k, solve_s=s) for k, s in enumerate((0.01, 0.03, 0.02))]
    found = compare([*rows, row("b", objective=1.5, one_step_fit=90.0), row("c", **FAILED), row("d", **FAILED)])
    a, b = (next(line for line in found.lines if line.solver == name) for name in "ab")
    assert a.cold == pytest.approx(0.04) and a.above == 0 and a.warm == 0.005
    assert b.above == pytest.approx(0.5) and b.state == "worse minimum" and b.one_step == 90.0
    assert found.reasons == {"it broke": ["c", "d"]}


def test_the_page_heads_with_the_sentence_of_the_command():
    rows = [row("a", **LOCAL), row("b", solve_s=0.03)]  # the page's own order is by time alone
    verdict, said = verdict_on_one_record(rows), compare(rows)
    assert f"{verdict.headline.word}: {verdict.headline.text}".replace(": It", ": it") == said.recommendation
    assert verdict.headline.word == "Use b" and verdict.headline.tone == "good"
    assert "at least 6 problems" in verdict.statements[0].text and "Use b" in str(verdict)


def test_what_counts_is_said_beside_the_accuracy_and_so_is_its_floor():
    """A residual up to 100 times the accuracy counts, and one of 1e-07 whatever is asked."""
    rows = [row("a", accuracy=1e-15, stationarity=9e-7), row("b", accuracy=1e-15, solve_s=0.03)]
    floor = "the accuracy of 1e-15 (verified residuals up to 1e-07 count; asking for less than 1e-09 changes nothing)"
    assert floor in compare(rows).recommendation
    study = [{**one, "place": f"{one['solver']} {seed}", "seed": seed} for one in rows for seed in range(7)]
    assert "up to 1e-07 count; asking for less than 1e-09 changes nothing)" in conclude(study).headline.text
    loose = conclude([{**one, "accuracy": 1e-9} for one in study]).headline.text
    assert "all 7 problems" in loose and "up to 1e-07 count)" in loose
    failed = [{**one, **FAILED, "formulation": name} for one in study for name in "fg"]
    assert "up to 1e-07 count; asking" in conclude(failed).headline.text
