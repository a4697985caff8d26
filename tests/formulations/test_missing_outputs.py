"""Outputs missing at random, and a few inputs, in every formulation: fits close to those of complete records."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import scripts
from refusals import refuses
from sample_fits import quiet

import optid
from optid.data.record import Data
from optid.errors import DataWarning, RankError
from optid.identify.subspace.imputation import ROUNDS, impute
from optid.identify.validation import fit_percent
from optid.registry import find_entry_points

gaps = scripts.benchmark("gaps")

CELLS = {str(cell): cell for cell in gaps.CELLS}
CLOSE = {"subspace.nuclear": 3.0}
"""Points of simulation fit that a fifth of the outputs may cost; 2 where nothing is said."""


def score(cell, data):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return gaps.score(cell, data, 0, 600)


def test_every_identification_formulation_has_a_case():
    assert {cell.formulation for cell in CELLS.values()} == set(find_entry_points("optid.formulations"))
    assert len(CELLS) == len(gaps.CELLS)


@pytest.mark.slow
@pytest.mark.parametrize("name", CELLS)
def test_a_fifth_of_the_outputs_missing(name):
    cell = CELLS[name]
    whole = gaps.record(cell, 3000, 0)
    complete, close = score(cell, whole), CLOSE.get(cell.formulation, 2.0)
    assert complete > 90
    for share in (0.2,) if "exact" in name else (0.05, 0.2):
        assert score(cell, gaps.punctured(whole, share, 0)) > complete - close


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", [name for name, cell in CELLS.items() if cell.samples > 3000 and not (
    "exact" in name and cell.outputs == 2)])
def test_a_few_inputs_missing_besides(name):
    cell = CELLS[name]
    whole = gaps.record(cell, 3000, 0)
    data = gaps.punctured(whole, 0.1, 0)
    u = data.u.copy()
    u[[700, 701, 1500, 2200], 0] = np.nan
    assert score(cell, Data(u, data.y)) > score(cell, whole) - 2.0


@pytest.mark.sampled(4)
@pytest.mark.parametrize("experiments", [1, 3])
@pytest.mark.parametrize("formulation", ["hammerstein_ss.sid", "hammerstein_ss.asivid", "ss.exact"])
def test_two_fifths_missing_in_experiments(formulation, experiments):
    cell = CELLS["hammerstein_ss.sid 2y"]
    parts = [gaps.record(cell, 3000 // experiments, seed) for seed in range(experiments)]
    lost = [gaps.punctured(part, 0.4, seed) for seed, part in enumerate(parts)]
    structure = {"nx": 2, **({"basis": "linear"} if formulation.endswith("asivid") else {})}
    found = quiet(Data([p.u for p in lost], [p.y for p in lost]) if experiments > 1 else lost[0], formulation,
                  **structure).model
    clean = gaps.record(cell, 1000, 1000, noisy=False)
    assert np.min(fit_percent(clean.y, found.simulate(clean, x0="fit"))) > 98


def punctured(outputs=2, share=0.2, samples=3000):
    return gaps.punctured(gaps.record(CELLS[f"hammerstein_ss.sid {outputs}y"], samples, 0), share, 0)


def test_it_is_said_that_outputs_were_estimated():
    data = punctured()
    with pytest.warns(DataWarning, match="too few complete windows of 20 samples; .* estimated for the projections"):
        fit = optid.fit(data, "hammerstein_ss.sid", nx=2)
    missing = int(np.isnan(data.y).sum())
    assert fit.figures["missing outputs"].startswith(f"{missing} of {data.y.size} estimated for the projections by ")
    assert fit.figures["windows"] == 2981 and np.isnan(data.y).sum() == missing
    assert "estimated for the projections" in str(fit)
    assert "noise model" not in fit.figures and fit.model.noise is not None


@pytest.mark.parametrize("formulation", ["hammerstein_ss.sid", "hammerstein_ss.asivid", "ss.exact"])
def test_block_rows_that_were_asked_for_are_refused(formulation):
    with pytest.raises(RankError, match="2 complete windows of 20 samples .*fewer block rows"):
        quiet(punctured(), formulation, nx=2, block_rows=10)


def test_records_with_windows_enough_stay_as_they_are():
    fit = quiet(punctured(share=0.005), "hammerstein_ss.sid", nx=2)
    assert "missing outputs" not in fit.figures and fit.figures["windows"] < 2981


@pytest.mark.parametrize("name", ["hammerstein_ss.sid 2y", "hammerstein_ss.asivid 2y cubic feedback"])
def test_the_criterion_takes_the_samples_present_only(name):
    cell = CELLS[name]
    data = gaps.punctured(gaps.record(cell, 2000, 0), 0.2, 0)
    fit = quiet(data, cell.formulation, **{**cell.structure, "observer": "none", "noise": "white"})
    run = fit.model.simulate_measured_feedback if cell.fed else fit.model.simulate
    errors = (data.y - run(data, x0="fit")) / np.nanstd(data.y, axis=0)
    # the weights are the standard deviations over the windows; feedback of a missing output is that of its estimate
    assert fit.solution.objective == pytest.approx(np.nansum(errors**2), rel=0.05)
    assert fit.solution.objective == pytest.approx(0.8 * 2 * 2000 * np.nanmean(errors**2), rel=0.1)


def test_the_true_model_is_a_fixed_point():
    data = punctured(share=0.3, samples=500)
    plant = gaps.plant(CELLS["hammerstein_ss.sid 2y"])
    (found,), how = impute(data, lambda records: plant)
    lost = np.isnan(data.y)
    assert f"{lost.sum()} of" in how and "by 2 preliminary models" in how and "last change 0.0e+00" in how
    assert np.array_equal(found[:, :2], data.u) and np.array_equal(found[:, 2:][~lost], data.y[~lost])
    assert found[:, 2:][lost] == pytest.approx(plant.predict(data)[lost])


def test_the_estimation_ends_and_refuses_what_it_cannot_estimate():
    data, seeds = punctured(samples=200), iter(range(100))

    def restless(records):
        offset = np.random.default_rng(next(seeds)).normal(size=2)
        return replace(gaps.plant(CELLS["hammerstein_ss.sid 2y"]), offset_y=offset)

    assert f"by {ROUNDS} preliminary models" in impute(data, restless)[1]
    y = np.array(data.y)
    y[1:, 1] = np.nan
    refuses(RankError, "fewer than two samples", impute, Data(data.u, y), restless)


def test_the_nuclear_norm_names_the_form_that_takes_more_gaps():
    cell = next(cell for name, cell in CELLS.items() if name == "subspace.nuclear 2y")
    data = gaps.punctured(gaps.record(cell, 3000, 0), 0.4, 0)
    refuses(RankError, "usable windows .* or form='projection'", score, cell, data)
    other = replace(cell, structure={**cell.structure, "form": "projection"})
    assert score(other, data) > 80
