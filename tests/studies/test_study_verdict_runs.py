"""Which runs count in a verdict, and what may be given to it."""


import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from study_rows import rows as synthetic
from study_rows import run, table_of, times_of

from optid.backends import Answer
from optid.errors import DataError
from optid.program.solution import Residuals, Status
from optid.solving import claims
from optid.studies.storage.rows import columns
from optid.studies.verdicts.comparison import compare
from optid.studies.verdicts.outcomes import states_of_rows, tabulate
from optid.studies.verdicts.verdict import conclude

NAN = float("nan")


# ---- which runs count


@given(st.sampled_from([1e-3, 1e-6, 1e-8, 1e-12]), st.tuples(*[st.floats(-12.0, 1.0)] * 3))
def test_at_its_own_accuracy_a_run_counts_exactly_where_solving_says_so(accuracy, exponents):
    violation, stationarity, complementarity = (float(10**e) for e in exponents)
    residuals = Residuals(violation, "gain", stationarity, complementarity)
    status, _ = claims._status(Answer(Status.OPTIMAL, "solved"), residuals, accuracy, "a")
    row = run("a", accuracy=accuracy, violation=violation, stationarity=stationarity, complementarity=complementarity)
    assert (tabulate(columns([row])).state[0, 0] == "solved") == (status is Status.LOCAL)


@pytest.mark.parametrize(
    ("change", "state"),
    [
        ({}, "solved"),
        ({"status_verified": "locally optimal"}, "solved"),
        ({"outcome": "time limit", "status_verified": None, "objective": None}, "time limit"),
        ({"outcome": "crashed", "status_verified": None}, "crashed"),
        ({"outcome": "refused", "status_verified": None}, "refused"),
        ({"false_claim": True, "status_verified": "inaccurate"}, "false claim"),
        ({"false_claim": True}, "false claim"),
        ({"status_verified": "inaccurate"}, "inaccurate"),
        ({"status_verified": ""}, "failed"),
        ({"objective": NAN}, "non-finite"),
        ({"violation": 2e-6}, "less accurate"),
        ({"stationarity": 2e-6}, "solved"),  # gradients may be ten times as large
        ({"stationarity": 2e-5}, "less accurate"),
        ({"complementarity": 2e-6}, "less accurate"),
        ({"stationarity": NAN}, "solved"),
        ({"objective": 1.0 + 2e-6}, "worse minimum"),
        ({"objective": 1.0 + 5e-7}, "solved"),
        ({"status_verified": "infeasible", "objective": None}, "contradicted"),
        ({"status_verified": "unbounded", "objective": None}, "contradicted"),
        ({"outcome": ""}, "error"),
    ],
)
def test_a_run_counts_only_where_the_accuracy_was_verified_at_the_best_objective(change, state):
    found = tabulate(columns([run("good"), run("other", **change)]))
    assert found.solvers == ("good", "other")
    assert list(found.state[0]) == ["solved", state]
    assert np.isfinite(found.time[0, 1]) == (state == "solved")
    assert list(states_of_rows(columns([run("good"), run("other", **change)]), found)) == ["solved", state]


LIAR = run("liar", objective=0.5, false_claim=True, status_verified="inaccurate")


@pytest.mark.parametrize("rows, states", [
    ([run("a", objective=1e-14), run("b", objective=1e-9), run("c", objective=1e-6)],  # a hundredth of the scale, 10,
     ["solved", "solved", "worse minimum"]),  # is the yardstick of a vanishing objective
    ([run("good"), LIAR, run("loose", objective=0.6, violation=1e-3)],  # no worse run sets the objective to beat
     ["solved", "false claim", "less accurate"]),
])
def test_objectives_are_compared_with_the_best_verified_one_on_the_scale_of_the_problem(rows, states):
    assert list(tabulate(columns(rows)).state[0]) == states


def test_an_answer_to_a_looser_accuracy_of_its_own_is_held_to_the_common_one():
    rows = [run("a", p) for p in range(3)] + [run("loose", p, accuracy=1e-3, stationarity=1e-3) for p in range(2)]
    for accuracy, state in ((None, "less accurate"), (1e-3, "solved")):
        assert list(tabulate(columns(rows), accuracy).state[:, 1]) == [state, state, "not run"]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_of_several_requested_accuracies_one_counts_for_every_entry(seed):
    """Which one, counted by hand; the others change neither time nor state."""
    rng = np.random.default_rng(seed)
    common = float(rng.choice([1e-3, 1e-6, 1e-8]))
    rows = []
    for solver in "abc":
        asked = rng.choice([1e-2, 1e-3, 1e-5, 1e-6, 1e-8, 1e-10], size=rng.integers(1, 5), replace=False)
        strict = [value for value in asked if value <= common]
        suits = max(strict) if strict else min(asked)
        for value in asked:
            fate = {} if rng.random() < 0.7 else {"outcome": "crashed", "status_verified": None, "objective": None}
            rows.append(run(solver, seconds=float(np.exp(rng.normal())), accuracy=value, suits=value == suits, **fate))
    table = columns(rows)
    found = tabulate(table, accuracy=common)
    alone = tabulate(columns([row for row in rows if row["suits"]]), accuracy=common)
    np.testing.assert_array_equal(found.time, alone.time)
    np.testing.assert_array_equal(found.state, alone.state)
    other = states_of_rows(table, found) == "other accuracy"
    assert list(~other) == [row["suits"] for row in rows]


def test_a_study_of_several_accuracies_compares_at_one_and_says_so():
    rows = [run("a", p, seconds=s, accuracy=a, violation=v) for p in range(8)
            for s, a, v in ((0.1, 1e-8, 1e-9), (0.01, 1e-3, 1e-4))]  # fmt: skip
    rows += [run("b", p, seconds=0.3, accuracy=a) for p in range(8) for a in (1e-8, 1e-3)]
    strict, loose = conclude(rows), conclude(rows, accuracy=1e-3)
    assert strict.recommended == loose.recommended == ("a",)
    assert [v.overall.standing("a").time for v in (strict, loose)] == pytest.approx([0.1, 0.01])
    assert any("16 runs asked for 1e-03" in s.text for s in strict.statements)


def test_of_repetitions_every_one_must_count_and_the_median_time_does():
    times = (3.0, 1.0, 2.0)
    rows = [run("a", seconds=t, repetition=r) for r, t in enumerate(times)]
    rows += [run("b", seconds=1.0), run("b", seconds=1.0, repetition=1, status_verified="limit", reason="iterations")]
    found = tabulate(columns(rows))
    assert found.time[0, 0] == 2.0 and list(found.state[0]) == ["solved", "limit"]
    assert found.reason[0, 1] == "iterations"


def test_time_is_compile_and_solve_or_what_is_asked_for():
    row = run("a", seconds=2.0, compile_s=0.5, fit_s=9.0, warm_s=0.25, warm_status="optimal")
    assert [tabulate(columns([row]), time=t).time[0, 0] for t in ("solve", "fit", "warm")] == [2.5, 9.0, 0.25]
    assert tabulate(columns([run("a", seconds=0.0)])).time[0, 0] == 1e-6
    with pytest.raises(DataError, match="time is one of solve, fit, warm"):
        tabulate(columns([row]), time="build")


def test_a_warm_time_counts_only_where_the_warm_solve_was_verified():
    rows = [run("a", p, seconds=1.0, warm_s=0.1, warm_status="optimal" if p < 7 else "inaccurate") for p in range(9)]
    rows += [run("b", p, seconds=0.5, warm_s=0.2, warm_status="locally optimal") for p in range(9)]
    assert conclude(rows).recommended == ("b",)
    verdict = conclude(rows, time="warm")
    assert np.isfinite(verdict.found.time).sum(axis=0).tolist() == [7, 9]
    assert verdict.recommended == ("a",) and "b, solved 9 and takes" in verdict.headline.text
    a = verdict.overall.standing("a")
    assert (a.solved, a.problems, a.failures) == (7, 9, {"warm solve failed": 2})
    cold = conclude(table_of(times_of(1.0, 2.0)), time="warm")
    assert "warm = true" not in str(verdict)
    procedures = [run("a", p, formulation="steps", seconds=1.0) for p in range(9)]
    assert conclude(rows + procedures, time="warm").overall.standing("a").problems == 9  # a procedure is no failure
    assert cold.headline.word == "Cannot tell" and "warm = true" in cold.headline.text and not cold.recommended


def test_problems_that_all_agree_to_be_infeasible_are_taken_out_and_said():
    rows = [run(s, p) for s in "ab" for p in range(8)]
    rows += [run(s, 9, status_verified="infeasible", objective=None) for s in "ab"]
    verdict = conclude(rows)
    assert verdict.overall.infeasible == 1 and len(verdict.overall.found.data) == 8
    assert not verdict.false_claims and any(s.text.startswith("1 problem has no solution") for s in verdict.statements)


def infeasible(solver, problem):
    return run(solver, problem, status_verified="infeasible", objective=None, reason="said so")


def dead(solver, problem, outcome):
    return run(solver, problem, outcome=outcome, status_verified=None, objective=None, reason=outcome)


def test_one_claim_of_infeasibility_is_not_enough():
    rows = [row for p in range(10) for row in (infeasible("a", p), dead("b", p, "crashed"), dead("c", p, "time limit"))]
    verdict = conclude(rows)
    assert verdict.overall.infeasible == 0 and verdict.headline.tone == "bad"
    assert {s.solver: s.failures for s in verdict.overall.standings} == {
        "a": {"infeasible": 10}, "b": {"crashed": 10}, "c": {"time limit": 10}}  # fmt: skip
    doubted = [infeasible("a", 0), infeasible("b", 0), run("c", 0, status_verified="failed")]
    assert conclude(doubted).overall.infeasible == 0  # one that came to an answer does not say so


def test_who_crashes_on_a_problem_without_a_solution_has_failed_on_it_all_the_same():
    rows = [run(s, p) for s in "abc" for p in range(8)]
    rows += [infeasible("a", 8), infeasible("b", 8), dead("c", 8, "crashed")]
    verdict = conclude(rows)
    assert verdict.overall.infeasible == 1
    a, c = verdict.overall.standing("a"), verdict.overall.standing("c")
    assert (a.problems, a.solved, a.failures) == (8, 8, {})
    assert (c.problems, c.solved, c.failures) == (9, 8, {"crashed": 1})


# ---- what is given


def test_rows_come_as_dicts_columns_or_frames():
    import pandas
    import polars

    rows = synthetic(300, 2)
    expected = str(conclude(rows))
    names = list(rows[0])
    frame = pandas.DataFrame(rows)
    assert str(conclude({name: [row[name] for row in rows] for name in names})) == expected
    assert str(conclude(frame)) == expected
    assert str(conclude(frame.convert_dtypes())) == expected
    assert str(conclude(polars.DataFrame(rows, infer_schema_length=None))) == expected


def test_studies_of_one_database_are_kept_apart():
    rows = table_of(times_of(1.0, 3.0, problems=4)) + [
        {**row, "study": "other", "objective": 2.0} for row in table_of(times_of(1.0, 3.0, problems=4, seed=1))]
    verdict = conclude(rows)
    assert len(verdict.found.data) == 8 and verdict.found.solved.all()


@pytest.mark.parametrize(
    ("given_rows", "message"),
    [
        ({"solver": ["a"]}, "no column data, formulation"),
        ([{"what": 1}, 3], "one of them is not a dict"),
        (7, "not int"),
        ({**{name: ["a"] for name in ("data", "formulation", "solver", "outcome", "status_verified")},
          "objective": ["many"], "solve_s": [1.0]}, "'objective' holds something that is not a number"),
        ({"data": ["a", "b"], "solver": ["a"]}, "has 1 values, others have 2"),
    ],
)  # fmt: skip
def test_what_is_no_table_of_runs_is_refused(given_rows, message):
    with pytest.raises(DataError, match=message):
        conclude(given_rows)


@pytest.mark.parametrize("nothing", [[], {}])
def test_no_rows_at_all_say_so(nothing):
    verdict = conclude(nothing)
    assert verdict.headline.word == "Nothing to compare" and not verdict.recommended and not verdict.statements
    with pytest.raises(DataError, match="no rows to compare"):
        compare([])


def test_data_on_which_every_run_ends_with_an_error_are_named():
    broken = {"outcome": "error", "status_verified": None, "objective": None, "reason": "no column 'y' in b.csv"}
    rows = [run(s, p, "good") for s in "ab" for p in range(7)] + [run(s, 0, "bad", **broken) for s in "ab"]
    (said,) = [one for one in conclude(rows).statements if one.word == "Data that failed"]
    assert said.text == "Every run on bad ended with an error: no column 'y' in b.csv." and said.tone == "bad"
    refused = {"outcome": "refused", "status_verified": None, "objective": None, "reason": "not its class"}
    rows += [run("c", p, data, **refused) for data in ("good", "bad") for p in range(2)]
    assert any(one.word == "Data that failed" for one in conclude(rows).statements)
    some = [*rows, run("c", 5, "bad")]
    assert not any(one.word == "Data that failed" for one in conclude(some).statements)
    assert not any(one.word == "Data that failed" for one in conclude(rows[:14]).statements)
