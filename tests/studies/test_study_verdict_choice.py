"""Who is recommended, and in which words."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from study_rows import run, table_of, times_of

from optid.studies.verdicts.averages import paired_mean, time_ratios
from optid.studies.verdicts.choice import CANNOT_TELL, FIRST, NOBODY, ONLY_ONE, TIE, choose, join_names
from optid.studies.verdicts.verdict import conclude

NAN = float("nan")


def unsolved(times, *entries):
    """Times (P, S) of which some entries, as index expressions, are not solved."""
    for entry in entries:
        times[entry] = NAN
    return times


def in_a_circle():
    times = np.full((30, 3), NAN)
    for k, (one, other) in enumerate([(0, 1), (1, 2), (2, 0)]):
        times[10 * k : 10 * k + 10, one], times[10 * k : 10 * k + 10, other] = 1.0, 2.0
    return times


def some_solved(problems, **limits):
    """Rows of solvers that solve so many of the problems, on two formulations."""
    return [run(s, p, formulation=f, status_verified="optimal" if p < limit else "failed")
            for f in "fg" for p in range(problems) for s, limit in limits.items()]


def refusing(limit):
    """Rows of 60 problems on half of which one of two solvers refuses."""
    refused = {"outcome": "refused", "status_verified": None, "objective": None}
    return [row | refused if row["seed"] < 30 and (row["solver"] == "a") == (row["seed"] < limit) else row
            for row in table_of(times_of(1.0, 3.0, problems=60))]


WIDE = np.column_stack([np.ones(8), [0.05, 40.0, 0.1, 20.0, 9.0, 0.2, 30.0, 5.0]])
NOBODY_SOLVES = np.full((8, 2), NAN)


@pytest.mark.parametrize("rows, kind, word, said", [
    (times_of(1.0, 3.0, 2.0), FIRST, "Use a", "the next, c, solved 20 and takes"),
    (unsolved(times_of(1.0, 0.2), np.s_[:5, 1]), FIRST, "Use a", "the next, b, solved 15 and takes 0.2"),  # 1/32
    (unsolved(times_of(1.0, 0.002), np.s_[0, 1]), FIRST, "Use b",
     "b solved 19 of 20 problems; the next, a, solved 20 and takes"),  # one failure is no lack of reliability
    (refusing(14), FIRST, "Use a where it runs", ""), (refusing(16), FIRST, "Use a where it runs", ""),
    (unsolved(times_of(1.0, 1.0), np.s_[:, 1]), FIRST, "Use a", "no other solved any problem"),
    (some_solved(20, a=6, b=4), TIE, "No solver can be recommended", "12 of 40 problems"),
    (some_solved(100, a=1, b=0), FIRST, "No solver can be recommended", "2 of 200 problems"),
    (times_of(1.0, 1.0, 4.0), TIE, "A tie: ", "does not differ"),
    (times_of(1.0, 1.05, spread=1e-3), TIE, "A tie: a and b", ""),  # certain, but below 10 %
    *((times_of(1.0, 9.0, problems=few), CANNOT_TELL, "Cannot tell", "at least 6 problems") for few in (1, 2, 5)),
    (times_of(1.0, 9.0, problems=6), FIRST, "Use a", ""),
    (WIDE, CANNOT_TELL, "Cannot tell", "needs more than 8 problems to tell a and b apart"),
    (in_a_circle(), CANNOT_TELL, "Cannot tell", "each of a, b and c is beaten by another one"),
    (NOBODY_SOLVES, NOBODY, "No solver reached the accuracy", "failed 16"),
    (times_of(1.0), ONLY_ONE, "Only one solver", "there is nothing to compare it with"),
])
def test_the_headline_names_the_choice_with_its_evidence(rows, kind, word, said):
    verdict = conclude(rows if isinstance(rows, list) else table_of(rows))
    head, choice = verdict.headline, verdict.overall.choice
    assert choice.kind == kind and head.word.startswith(word) and said in head.text, head
    assert verdict.recommended == (choice.leaders if word.startswith(("Use", "A tie")) else ())
    assert head.tone == {"No": "bad", "Ca": "fair"}.get(word[:2], head.tone)
    assert all(not section.recommended for section in verdict.sections) or verdict.recommended
    assert {s.solver for s in verdict.overall.standings if not s.solved}.isdisjoint(choice.candidates)


def test_failures_by_chance_do_not_decide_and_those_beyond_it_do():
    rng = np.random.default_rng(5)

    def first(fail_slow, fail_fast):
        times = np.exp(0.1 * rng.normal(size=(40, 2))) * [5.0, 0.1]
        times[rng.random((40, 2)) < [fail_slow, fail_fast]] = NAN
        return choose(times, ("slow", "fast")).first

    assert sum(first(0.05, 0.05) == "slow" for _ in range(300)) / 300 <= 0.05
    assert sum(first(0.02, 0.35) == "slow" for _ in range(100)) / 100 >= 0.95


def test_who_is_faster_than_the_leader_of_the_common_problems_is_not_called_tied():
    """The mean on the problems that all solve misleads where they are few and unlike the others."""
    rng = np.random.default_rng(0)
    times = np.full((100, 3), NAN)
    times[:60, 0] = 1.0
    times[:10, 1], times[10:50, 1], times[50:60, 1] = 1.2, 0.6, 1.2
    times[:10, 2] = times[52:100, 2] = 3.0
    times *= np.exp(0.05 * rng.normal(size=times.shape))
    choice = choose(times, ("a", "b", "c"))
    assert paired_mean(times[:, 1], times[:, 0]).high < 0.9
    assert (choice.kind, choice.first, choice.tied) == (FIRST, "b", ())


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_nobody_is_ahead_of_the_first(seed):
    rng = np.random.default_rng(seed)
    times = np.exp(rng.normal(size=(40, 4)) * 0.2 + rng.normal(size=4) * 0.3)
    times[rng.random(times.shape) < rng.choice([0.02, 0.2, 0.5])] = NAN
    choice = choose(times, tuple("abcd"))
    for name in choice.candidates:
        if choice.first and name != choice.first:
            pair = choice.against[name]
            assert not (pair.enough and pair.high < 1 and pair.value < 1 / 1.1)
            assert (name in choice.tied) == (not (pair.enough and pair.low > 1 and pair.value > 1.1))


def test_the_tone_of_one_solver_for_every_formulation_is_that_of_its_figures():
    times = times_of(1.0, 3.0, problems=40)
    times[:8, 0], times[:16, 1] = NAN, NAN
    headline = conclude(table_of(times) + table_of(times, formulation="linear")).headline
    assert (headline.word, headline.tone) == ("Use a", "fair") and "64 of 80 problems" in headline.text
    only = table_of(times) + table_of(times[:, ::-1], formulation="linear")
    assert conclude(only).headline.tone == "fair"


def test_too_few_problems_in_common_cannot_tell():
    times = times_of(1.0, 9.0, problems=400)
    times[:2, 0] = times[2:, 1] = NAN
    choice = conclude(table_of(times)).overall.choice
    assert choice.kind == FIRST and choice.first == "a"  # b is not as reliable
    split = np.full((20, 2), NAN)
    split[:10, 0] = split[10:, 1] = 1.0
    choice = conclude(table_of(split)).overall.choice
    assert choice.kind == CANNOT_TELL and "a problem that a and b all solve" in choice.missing


def test_a_lie_is_a_failure_and_is_listed():
    rows = table_of(times_of(1.0, 3.0))
    for row in rows:
        if row["solver"] == "a" and row["seed"] < 15:
            row |= {"false_claim": True, "status_verified": "inaccurate", "reason": f"violation {row['seed']}e-3"}
    verdict = conclude(rows)
    assert verdict.recommended == ("b",)
    (claim,) = verdict.false_claims
    assert (claim.solver, claim.count, claim.claimed) == ("a", 15, "optimal")
    assert verdict.overall.standing("a").false_claims == 15 and verdict.overall.standing("a").solved == 5
    (failure,) = verdict.failures
    assert failure.count == 15 and failure.reason == "violation …"
    for row in rows:
        if row["solver"] == "a" and row["seed"] > 0:
            row |= {"false_claim": False, "status_verified": "optimal", "reason": ""}
    assert conclude(rows).headline.text.endswith("Claims of a were false on 1 problem.")


def test_a_claim_of_infeasibility_that_a_verified_point_contradicts_is_listed():
    rows = table_of(times_of(1.0, 3.0))
    rows[1] |= {"status_verified": "infeasible", "status_claimed": "primal infeasible", "objective": None}
    verdict = conclude(rows)
    (claim,) = verdict.false_claims
    assert claim.solver == "b" and claim.reason == "a has a verified point"
    assert verdict.overall.standing("b").false_claims == 1


def test_a_proof_that_another_point_contradicts_is_reported():
    rows = [run(s, p, bound=1.0) for s in "ab" for p in range(7)]
    assert not any(s.word == "A proof is contradicted" for s in conclude(rows).statements)
    rows.append(run("c", 0, objective=0.9))
    assert any(s.word == "A proof is contradicted" for s in conclude(rows).statements)


def test_it_depends_on_the_formulation_where_it_does():
    rows = table_of(times_of(1.0, 5.0), formulation="exact") + table_of(times_of(5.0, 1.0), formulation="linear")
    for row in rows:
        if row["formulation"] == "exact" and row["solver"] == "b":
            row |= {"outcome": "refused", "status_verified": None, "objective": None}
        if row["formulation"] == "linear" and row["solver"] == "a":
            row |= {"outcome": "refused", "status_verified": None, "objective": None}
    verdict = conclude(rows)  # nothing differs but the models: every formulation has one solver
    assert [section.choice.kind for section in verdict.sections] == [ONLY_ONE, ONLY_ONE]
    assert verdict.headline.word == "Models: cannot tell"
    short = table_of(times_of(1.0, 5.0)) + table_of(times_of(NAN, 1.0, 2.0, problems=3), formulation="linear")
    headline = conclude(short).headline
    assert headline.word == "a for exact" and "For 1 of 2 formulations the comparison cannot tell" in headline.text
    ahead = table_of(times_of(1.0, 9.0, problems=90)) + table_of(times_of(2.0, 1.0, problems=9), formulation="linear")
    assert conclude(ahead).overall.choice.first == "a"  # on the whole, but not everywhere
    assert conclude(ahead).headline.word == "a for exact; b for linear"
    same = conclude(table_of(times_of(1.0, 5.0)) + table_of(times_of(1.0, 5.0), formulation="linear"))
    assert same.headline.word == "Use a" and same.recommended == ("a",)


def test_the_time_of_the_whole_fit_is_compared_where_it_is_asked_for():
    rows = table_of(times_of(1.0, 7.0, problems=26))
    for row in rows:
        row |= {"fit_s": 2.0 + row["solve_s"] / 100, "proved": row["solver"] == "b" or row["seed"] >= 2}
    rows = [{**row, "fit_s": 3.0} if row["solver"] == "b" else row for row in rows]
    verdict = conclude(rows)
    a, b = (verdict.overall.standing(name) for name in "ab")
    assert (a.proved, b.proved) == (24, 26)
    whole = conclude(rows, time="fit")
    assert [whole.overall.standing(name).time for name in "ab"] == pytest.approx([2.0, 3.0], rel=0.05)
    assert "takes 1.4" in whole.headline.text


def test_a_solver_that_ties_everywhere_but_once_heads_the_verdict():
    """Those that come first by a hair in a tie are not each named for their own formulation."""
    order = {"f": (1.0, 1.01, 5.0), "g": (1.0, 5.0, 1.01), "h": (1.01, 1.0, 5.0), "i": (7.0, 7.0, 1.0)}
    rows = [row for k, (name, factors) in enumerate(order.items())
            for row in table_of(times_of(*factors, seed=k, spread=0.01), formulation=name)]  # fmt: skip
    headline = conclude(rows).headline
    assert headline.word == "a for f, g and h; c for i"
    everywhere = [row for row in rows if row["formulation"] != "i"]
    assert conclude(everywhere).headline.word in ("Use a", "A tie: a and b")
    few = [row for row in rows if row["formulation"] != "h" or row["seed"] < 3]
    assert conclude(few).headline.word == "c for g and i; a for f"  # h cannot be told, and c ties in g


@pytest.mark.parametrize("problems", [6, 12, 60])
def test_equal_solvers_are_seldom_told_apart_and_others_are(problems):
    rng = np.random.default_rng(problems)
    kinds = []
    for _ in range(400):
        times = np.exp(rng.normal(size=(problems, 1)) + 0.4 * rng.normal(size=(problems, 2)))
        kinds.append(choose(times, ("a", "b")).kind)
    assert kinds.count(FIRST) / 400 <= 0.075
    assert kinds.count(TIE) / 400 >= {6: 0.35, 12: 0.85, 60: 0.925}[problems]  # of few problems some cannot be told
    assert kinds.count(FIRST) + kinds.count(TIE) + kinds.count(CANNOT_TELL) == 400
    apart = [choose(np.exp(0.4 * rng.normal(size=(30, 2)) + [0.0, 0.5]), ("a", "b")) for _ in range(200)]
    firsts = [choice.first for choice in apart if choice.kind == FIRST]
    assert firsts.count("a") / 200 > 0.9 and "b" not in firsts


def test_numbers_of_one_thing_are_singular():
    rows = [run("a", 0, status_verified="failed"), run("b", 0, status_verified="failed")]
    assert "on 1 problem (1 formulation, 1 data set)" in conclude(rows).headline.text
    rows = [run("a", bound=1.0), run("b", objective=0.9)]
    assert any(s.text.startswith("On 1 problem a proved") for s in conclude(rows).statements)


def test_names_are_listed_as_in_a_sentence():
    texts = [join_names(list("abcdef"[:k])) for k in (0, 1, 2, 4, 6)]
    assert texts == ["", "a", "a and b", "a, b, c and d", "a, b, c and 3 more"]
    assert join_names(["free", "monotone, odd"]) == "\u201cfree\u201d and \u201cmonotone, odd\u201d"


def test_choose_alone_has_nothing_to_choose_from_nothing():
    assert choose(np.zeros((0, 0)), ()).kind == NOBODY
    np.testing.assert_array_equal(time_ratios(np.array([[NAN, NAN]])), [[np.inf, np.inf]])
