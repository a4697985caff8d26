"""The verdict of a study as a whole: formulations by their models, data sets, and its invariances."""

import numpy as np
import pytest
import scipy.stats
from study_rows import rows as synthetic
from study_rows import run, share

from optid.studies.verdicts.choice import CANNOT_TELL, DEPENDS, FIRST, TIE
from optid.studies.verdicts.verdict import conclude

NAN = float("nan")


# ---- formulations by their models


def models(fits, problems=12, truth=True):
    rng = np.random.default_rng(0)
    level = 80 + 5 * rng.normal(size=problems)
    return [run("a", p, formulation=name, simulation_fit=level[p] + fit + 0.05 * rng.normal(), one_step_fit=90.0,
                parameter_error=0.02 if truth else None, nonlinearity_error=0.03 if truth else None)
            for p in range(problems) for name, fit in fits.items()]  # fmt: skip


def test_formulations_are_compared_by_simulation_fit_record_by_record():
    verdict = conclude(models({"exact": 0.0, "relaxed": -1.5, "linear": -9.0}))
    choice = verdict.models.choice
    assert choice.kind == FIRST and choice.first == "exact"
    assert choice.against["relaxed"].value == pytest.approx(1.5, abs=0.1)
    assert verdict.headline.word == "Best models: exact"  # a single solver: the formulations are what is compared
    value = choice.against["relaxed"].value
    assert f"the next, relaxed, is behind by {value:.2f} points (95 %:" in verdict.headline.text
    blind = models({"exact": 0.0, "relaxed": -1.5})
    for k, row in enumerate(blind):
        size = 0.01 if row["formulation"] == "exact" else 0.03
        row |= {"simulation_fit": None, "parameter_error": (1 + k % 5) * size}
    verdict = conclude(blind)
    assert verdict.models.measure == "parameter_error" and verdict.headline.word == "Best models: exact"
    value = verdict.models.choice.against["relaxed"].value
    assert f"relaxed, has {value:.3g} times the error" in verdict.headline.text and value > 2
    tie = conclude(models({"exact": 0.0, "relaxed": -0.02}))
    assert tie.models.choice.kind == TIE and tie.headline.word.startswith("Equal models")
    few = conclude(models({"exact": 0.0, "relaxed": -5.0}, problems=3))
    assert few.models.choice.kind == CANNOT_TELL


def test_the_model_of_the_best_verified_objective_speaks_for_a_formulation():
    rows = []
    for p in range(7):
        rows += [run("a", p, simulation_fit=80.0), run("b", p, simulation_fit=70.0, objective=1.5),
                 run("lie", p, simulation_fit=99.0, objective=0.1, false_claim=True)]  # fmt: skip
    assert conclude(rows).models.figures["simulation_fit"]["exact"] == 80.0


def test_models_are_compared_whatever_clock_is_asked_for():
    rows = models({"exact": 0.0, "relaxed": -1.5})
    cold, warm = conclude(rows), conclude(rows, time="warm")
    assert not warm.overall.standings and warm.models.choice == cold.models.choice
    assert any(s.word == "Best models: exact" for s in warm.statements)


def test_a_formulation_that_is_solved_less_often_is_compared_where_it_is_solved():
    rows = models({"exact": 0.0, "linear": -9.0})
    for row in rows:
        if row["formulation"] == "exact" and row["seed"] < 3:
            row |= {"status_verified": "limit"}
    choice = conclude(rows).models.choice
    assert choice.kind == FIRST and choice.first == "exact" and choice.against["linear"].n == 9
    for row in rows:
        if row["formulation"] == "exact" and row["seed"] < 11:
            row |= {"status_verified": "limit"}
    assert conclude(rows).models.choice.candidates == ("linear",)
    assert "no other has one on half as many records" in conclude(rows).headline.text


def test_models_are_compared_by_what_most_formulations_have_on_most_records():
    rows = [run("a", p, formulation=f, parameter_error=(1 + p) * e, simulation_fit=90.0 if (f, p) == ("g", 0) else None)
            for p in range(8) for f, e in (("f", 0.01), ("g", 0.05))]  # fmt: skip
    quality = conclude(rows).models
    assert (quality.measure, quality.choice.kind, quality.choice.first) == ("parameter_error", FIRST, "f")
    both = [{**row, "simulation_fit": 80.0 + 5 * (row["formulation"] == "g")} for row in rows]
    assert conclude(both).models.measure == "simulation_fit"


def test_one_simulation_that_runs_away_does_not_decide():
    rows = models({"exact": 0.0, "relaxed": -1.5})
    next(r for r in rows if r["formulation"] == "exact")["simulation_fit"] = -1e9
    figures = conclude(rows).models.figures["simulation_fit"]
    assert figures["exact"] == pytest.approx((11 * 80 - 100) / 12, abs=5)


def sets(losses, records, noise=0.05):
    """Rows of one solver: losses {data set: {formulation: points}}, records {data set: how many}."""
    rng = np.random.default_rng(1)
    return [run("a", p, data=data, formulation=f, simulation_fit=80.0 - loss + noise * rng.normal())
            for data, of_set in losses.items() for p in range(records[data]) for f, loss in of_set.items()]  # fmt: skip


def test_records_of_one_system_do_not_outvote_another_data_set():
    """Twelve seeds of a simulated system and one measured record are two data sets, not thirteen."""
    rows = sets({"saturation": {"exact": 9, "oe": 0}, "valve": {"exact": 0, "oe": 2}}, {"saturation": 12, "valve": 1})
    verdict = conclude(rows)
    assert verdict.models.choice.kind == DEPENDS and verdict.headline.word == "Models depend on the data"
    assert "on saturation oe" in verdict.headline.text and "on valve exact so far" in verdict.headline.text
    assert verdict.models.figures["simulation_fit"]["oe"] == pytest.approx(79.0, abs=0.2)  # not of 13 records
    agreeing = conclude(sets({"saturation": {"exact": 9, "oe": 0}, "valve": {"exact": 2, "oe": 0}},
                             {"saturation": 12, "valve": 1}))  # fmt: skip
    assert agreeing.models.choice.kind == CANNOT_TELL
    assert "at least 6 data sets, or 6 records of each" in agreeing.headline.text


def test_of_few_data_sets_each_speaks_for_itself():
    both = {"one": {"x": 0, "y": 3}, "two": {"x": 0, "y": 9}}
    verdict = conclude(sets(both, {"one": 8, "two": 8}))
    assert verdict.headline.word == "Best models: x" and verdict.models.choice.tied == ()
    half = conclude(sets({**both, "two": {"x": 0, "y": 0}}, {"one": 8, "two": 8}))
    assert half.headline.word == "Best models: x"
    against = conclude(sets({**both, "two": {"x": 9, "y": 0}}, {"one": 8, "two": 80}))
    assert against.models.choice.kind == DEPENDS and "Best models" not in str(against)


def test_of_many_data_sets_each_counts_once():
    losses = {f"set {d}": {"x": 0, "y": 3 + d / 10} for d in range(8)} | {"odd": {"x": 20, "y": 0}}
    records = {name: 2 for name in losses}
    few = conclude(sets(losses, records)).models.choice
    assert few.against["y"].n == 9
    many = conclude(sets(losses, records | {"odd": 300})).models.choice
    assert many.kind == few.kind and many.against["y"].value == pytest.approx(few.against["y"].value, abs=0.1)
    del losses["odd"]
    verdict = conclude(sets(losses, records))
    assert verdict.headline.word == "Best models: x" and "8 data sets)" in verdict.headline.text
    reversed_one = conclude(sets(losses | {"set 7": {"x": 1, "y": 0}}, records | {"set 7": 9}))
    assert reversed_one.headline.word == "Best models: x"


# ---- as a whole


@pytest.mark.parametrize("seed", range(5))
def test_the_verdict_depends_neither_on_the_order_of_the_rows_nor_on_the_unit_of_time(seed):
    rows = synthetic(600, seed)
    rng = np.random.default_rng(seed)
    verdict = conclude(rows)
    shuffled = conclude([rows[i] for i in rng.permutation(len(rows))])
    assert str(shuffled) == str(verdict)
    assert shuffled.headline.word == verdict.headline.word
    assert [s.choice.first for s in shuffled.sections] == [s.choice.first for s in verdict.sections]
    fast = [{**row, **{c: row[c] / 1024 for c in ("solve_s", "compile_s") if row[c] is not None}} for row in rows]
    for one, two in zip(verdict.sections, conclude(fast).sections):
        assert one.choice.first == two.choice.first and one.choice.kind == two.choice.kind
        for name, profile in one.profiles.items():
            np.testing.assert_allclose(profile[0], two.profiles[name][0], rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_dominated_solver_changes_no_choice(seed):
    rows = synthetic(720, seed)
    bad = [{**row, "solver": "zzz", "outcome": "error", "status_verified": None, "false_claim": False}
           for row in rows if row["solver"] == "clarabel"]  # fmt: skip
    before, after = conclude(rows), conclude(rows + bad)
    for one, two in zip(before.sections, after.sections):
        assert (one.choice.first, one.choice.tied) == (two.choice.first, two.choice.tied)
        assert "zzz" not in (two.choice.first, *two.choice.tied, *two.choice.candidates)
    assert "zzz" not in after.recommended


def test_every_sentence_has_its_evidence_in_numbers():
    verdict = conclude(synthetic(3000, 3))
    for statement in (verdict.headline, *verdict.statements):
        assert any(character.isdigit() for character in statement.text)
        assert statement.tone in ("good", "fair", "bad") and statement.word


def test_the_counts_add_up():
    rows = synthetic(2000, 5)
    verdict = conclude(rows)
    for section in (verdict.overall, *verdict.sections):
        for s in section.standings:
            assert s.solved + sum(s.failures.values()) == s.problems
            assert share(section.profiles[s.solver], 1e9) == pytest.approx(s.solved / len(section.found.data))
    assert sum(f.count for f in verdict.failures) == (verdict.found.state != "solved").sum() - (
        verdict.found.state == "not run").sum()  # fmt: skip


def test_the_standings_equal_those_of_a_data_frame():
    """The same figures by grouping and pivoting in pandas."""
    import pandas

    rows = [row for row in synthetic(1800, 8) if row["system"]]  # one repetition each
    frame = pandas.DataFrame(rows)
    good = (frame.outcome == "done") & frame.status_verified.isin(["optimal", "locally optimal"]) & ~frame.false_claim
    frame["t"] = (frame.compile_s + frame.solve_s).where(good)
    at = ["data", "formulation", "samples", "noise", "seed"]
    wide = frame.pivot_table(index=at, columns="solver", values="t", dropna=False, sort=False)
    wide = wide.dropna(how="all").loc[:, lambda w: w.notna().any()]
    section = conclude(rows).overall
    ran = frame[frame.outcome != "refused"].groupby("solver").size()
    for s in section.standings:
        t = wide[s.solver].dropna()
        assert (s.solved, s.problems) == (len(t), ran[s.solver])
        assert s.time == pytest.approx(scipy.stats.gmean(t + 0.01) - 0.01)
        if (against := section.choice.against.get(s.solver)) is not None and against.n:
            both = (wide[s.solver] / wide[section.choice.first]).dropna()
            assert against.n == len(both) and against.value == pytest.approx(scipy.stats.gmean(both))
    for section in conclude(rows).sections:
        part = wide.xs(section.name, level="formulation")
        known, n = part.notna(), len(section.found.data)
        best = known[known.sum().idxmax()]
        behind = {c: ((best & ~known[c]).sum(), (known[c] & ~best).sum()) for c in part}
        able = [c for c, (lost, won) in behind.items() if known[c].any() and not (lost - won > int(0.01 * n) and
                scipy.stats.binomtest(lost, lost + won, alternative="greater").pvalue < 0.05)]  # fmt: skip
        logs = np.log(part[able])

        def beaten(c, logs=logs):
            ratios = [(logs[c] - logs[o]).dropna() for o in logs if o != c]
            return any(len(d) > 5 and d.mean() > np.log(1.1) and
                       scipy.stats.ttest_1samp(d, 0).confidence_interval().low > 0 for d in ratios)  # fmt: skip

        unbeaten = [c for c in able if not beaten(c)]
        most = max(known[c].sum() for c in unbeaten)
        leaders = [c for c in unbeaten if known[c].sum() >= most - int(0.01 * n)]
        assert section.choice.first == logs[leaders].dropna().mean().idxmin()
        assert set(section.choice.candidates) == set(able)
