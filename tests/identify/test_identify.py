"""The search for a structure: blocks, exact sums, the ladder, the choice, and what stops it."""

import re
import signal
import warnings
from contextlib import closing
from dataclasses import replace
from time import process_time
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refuses
from scipy.signal import lfilter
from tasks import anonymous, die_of_one, fail, hang, slow_square

import optid
from optid.errors import DataError, DataWarning, OptidError, RankError, SolverFailed, StructureError
from optid.identify.blocks import Blocks, join_parts, pooled_fit
from optid.identify.informativity import Informativity
from optid.identify.lag_sums import LagSums, scan
from optid.identify.search import identify
from optid.identify.search import search as searching
from optid.identify.search import trial as trying
from optid.identify.search.cpu_limit import OutOfTime, cpu_limit
from optid.identify.search.determined import determined_bases
from optid.identify.search.ladder import RUNGS, Ladder
from optid.identify.search.pool import TrialPool
from optid.identify.search.trial import (
    CLEAR,
    FEEDBACK,
    INPUTS,
    KINDS,
    LATENT,
    LINEAR,
    StructureCandidate,
    Trial,
    free_parameters,
    run_trial,
)
from optid.models.layout import Layout
from optid.statistics import collect

FOREVER = np.inf


def plant(samples=400, *, delay=0, cubic=0.0, noise=0.02, seed=0, start=0.0):
    """y = x + e with x(k) = 0.8 x(k-1) + f(u(k - 1 - delay)), f(u) = u + cubic u^3."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2, 2, samples)
    f, x, y = u + cubic * u**3, start, np.zeros(samples)
    for k in range(samples):
        y[k] = x
        x = 0.8 * x + (f[k - delay] if k >= delay else 0.0)
    y += noise * y.std() * rng.standard_normal(samples)
    return optid.Data(u, y)


@pytest.fixture
def short(monkeypatch):
    """A ladder of a few structures."""

    def lines(ladder):
        yield [StructureCandidate(LINEAR, "arx", {"na": 1, "nb": 1, "nk": [1]}),
               StructureCandidate(LINEAR, "oe.exact", {"na": 1, "nb": 1, "nk": [1]})]

    def functions(ladder):
        yield [StructureCandidate(INPUTS, "hammerstein_oe.exact", {"na": 1, "nb": 1, "nk": [1], "basis": basis})
               for basis in ("polynomial:3", "triangular:4")]

    monkeypatch.setitem(RUNGS, LINEAR, lines)
    monkeypatch.setitem(RUNGS, INPUTS, functions)


@pytest.mark.parametrize("lengths", [(103,), (60, 43, 80), (50, 50, 50, 50), (20,) * 9])
def test_every_sample_is_left_out_once(lengths):
    rng = np.random.default_rng(1)
    data = optid.Data([rng.normal(size=n) for n in lengths], [rng.normal(size=n) for n in lengths])
    blocks = Blocks.of(data, 4)
    seen = [np.zeros(n, dtype=int) for n in lengths]
    for b in range(4):
        for part in blocks.parts[b]:
            seen[part.experiment][part.first : part.last] += 1
        inside, outside = join_parts(data, blocks.parts[b]), blocks.without(b)
        assert inside.n_samples + outside.n_samples <= data.n_samples
        left = np.concatenate([e.y.ravel() for e in outside.experiments])
        assert not np.isin(left, np.concatenate([e.y.ravel() for e in inside.experiments])).any()
    assert all(np.max(counts) == 1 for counts in seen)
    assert sum(counts.sum() for counts in seen) >= 0.9 * data.n_samples


def test_borders_of_experiments_are_borders_of_blocks_where_they_are_near():
    lengths = (52, 48, 51, 49)
    data = optid.Data([np.arange(n) % 7 * 1.0 for n in lengths], [np.arange(n) % 5 * 1.0 for n in lengths])
    assert all(len(parts) == 1 for parts in Blocks.of(data, 4).parts)


def test_a_record_too_short_for_the_blocks_is_refused():
    refuses(RankError, "30 samples are too few for cross-validation in 4 blocks", lambda: Blocks.of(plant(30), 4))


@pytest.mark.parametrize("block, first", [(0, 0), (1, 50), (3, 200)])
def test_the_errors_of_a_block_are_those_of_a_free_run_through_it(block, first):
    data = plant(400, start=5.0)
    blocks = Blocks.of(data, 4)
    model = optid.fit(data, "oe.exact", na=1, nb=1, nk=1).model
    energy, measure = blocks.errors(model, block)
    around, inside = data.window(first, first + 200), slice(100 * block - first, 100 * block - first + 100)
    error = (np.ravel(model.simulate(around, x0="fit")) - around.y.ravel())[inside]
    squares = np.sum(error**2) / (0.99 if block == 0 else 1.0)  # of a run that begins here, one sample fits the state
    assert energy[0] == pytest.approx(squares, rel=1e-9)
    assert measure[0] == pytest.approx(100 * np.var(data.y))
    assert pooled_fit(energy[None], measure[None]) == pytest.approx(100 * (1 - np.sqrt(squares / measure[0])))


def test_states_of_short_experiments_take_no_errors_away():
    """Of white noise around the plant, models of all orders leave the same on average, though states fit some of it."""
    rng = np.random.default_rng(0)
    us, ys = [], []
    for _ in range(15):
        us.append(np.where(np.arange(30) < 3, 0.0, rng.uniform(0.5, 2)))
        ys.append(lfilter([0, 0.4], [1, -0.8], us[-1]) + 0.05 * rng.normal(size=30))
    data = optid.Data(us, ys)
    blocks = Blocks.of(data)
    scores = [blocks.fit(optid.fit(data, "oe.exact", na=n, nb=1, nk=1, prove=False).model) for n in (1, 4)]
    assert np.ptp(scores) < 0.03 * (100 - scores[0])


def test_errors_leave_out_what_is_missing():
    data = plant(400)
    u, y = np.array(data.u), np.array(data.y)
    u[140:145], y[170:180] = np.nan, np.nan
    model = optid.fit(data, "oe.exact", na=1, nb=1, nk=1).model
    energy, measure = Blocks.of(optid.Data(u, y), 4).errors(model, 1)
    runs = [(data.window(50, 140), slice(50, 90)), (data.window(145, 250), slice(0, 55))]
    expected = 0.0
    for around, inside in runs:
        gone = np.array(around.y)
        gone[25:35] = np.nan if len(around) == 105 else gone[25:35]
        x0 = model.initial_state(optid.Data(around.u, gone))
        expected += np.nansum((model.simulate(around, x0=x0) - gone)[inside] ** 2)
    assert energy[0] == pytest.approx(expected, rel=1e-8)
    assert measure[0] == pytest.approx(85 * np.nanvar(y))


@pytest.mark.parametrize("channel", ["u", "y"])
def test_an_experiment_without_a_reading_of_a_channel_is_left_out(channel):
    one, dead, other = plant(200), plant(60, seed=1), plant(200, seed=2)
    us, ys = [one.u, np.array(dead.u), other.u], [one.y, np.array(dead.y), other.y]
    (us if channel == "u" else ys)[1][:] = np.nan
    blocks, model = Blocks.of(optid.Data(us, ys), 4), optid.fit(one, "oe.exact", na=1, nb=1, nk=1).model
    found = [blocks.errors(model, b) for b in range(4)]
    assert pooled_fit(*map(np.array, zip(*found))) > 90
    assert sum(measure for _, measure in found) == pytest.approx(400 * blocks.outputs[0])


def test_errors_do_not_depend_on_units():
    data = plant(300)
    other = optid.Data(1e-4 * data.u, 1e5 * data.y)
    found = []
    for one in (data, other):
        model = optid.fit(one, "oe.exact", na=1, nb=1, nk=1).model
        found.append(pooled_fit(*(np.array([v]) for v in Blocks.of(one, 4).errors(model, 2))))
    assert found[1] == pytest.approx(found[0], abs=1e-5)


def test_a_run_that_leaves_the_range_counts_as_infinite():
    data = plant(200)
    model = optid.fit(data, "arx", na=1, nb=1, nk=1).model
    wild = type(model)(np.array([-1.2]), model.b, model.nonlinearities, model.nk, model.offset)
    with pytest.warns(DataWarning, match="unstable"):
        energy, _ = Blocks.of(data, 4).errors(wild, 0)
    assert np.isinf(energy).all()


def test_the_sums_without_a_block_are_those_of_the_record_without_it():
    data = plant(300, noise=0.1)
    blocks = Blocks.of(data, 3)
    sums = LagSums(blocks, na=3, lags=4)
    for b, block in enumerate(sums.blocks):
        direct = collect(blocks.without(b), sums.layout)
        np.testing.assert_allclose(sums.whole.gram - block.gram, direct.gram, rtol=1e-9, atol=1e-8)
        assert sums.whole.rows - block.rows == direct.rows


def test_errors_of_smaller_structures_are_those_of_fits_without_the_blocks():
    data = plant(400, delay=1, noise=0.1)
    blocks = Blocks.of(data, 4)
    sums = LagSums(blocks, na=4, lags=6)
    na, nb, nk = 2, 3, (1,)
    total, rows = 0.0, 0
    reach = sums.layout.first_row
    for b in range(4):
        model = optid.fit(blocks.without(b), "arx", na=na, nb=nb, nk=1).model
        part = blocks.parts[b][0]
        window = data.window(max(part.first - reach, 0), min(part.last + reach, 400))
        predicted = np.ravel(model.predict(window))[reach:]
        total += np.sum((predicted - window.y.ravel()[reach:]) ** 2)
        rows += predicted.size
    used = data.y.ravel()[reach:]
    assert sums.error(na, nb, nk) == pytest.approx(total / rows / used.var(), rel=0.02)
    best = scan(sums, [(0,), (1,)])[0]
    assert best.error <= sums.error(na, nb, nk)


def test_a_trial_is_given_up_early_and_says_why():
    data = plant(400, cubic=0.5)
    blocks = Blocks.of(data)
    good = run_trial(StructureCandidate(INPUTS, "hammerstein_oe.exact",
                                        {"na": 1, "nb": 1, "nk": [1], "basis": "polynomial:3"}),
                     blocks, None, {}, (), None)
    assert good.complete and good.score > 95 and len(good.by_block) == 4 and good.parameters == 5
    poor = run_trial(StructureCandidate(LINEAR, "arx", {"na": 1, "nb": 1, "nk": [1]}), blocks, good, {}, (), None)
    assert not poor.complete and "below the cross-validated fit of the best" in poor.reason and poor.score == -np.inf
    late = run_trial(good.candidate, blocks, good, {}, (), None, 1e-3)
    assert late.reason == "out of time"
    refused = run_trial(StructureCandidate(LINEAR, "arx", {"na": 300, "nb": 300}), blocks, None, {}, (), None)
    assert refused.reason.startswith("RankError") and refused.status == "refused"


def test_a_richer_structure_that_follows_the_record_no_better_is_not_cross_validated():
    data = plant(400, noise=0.05)
    blocks = Blocks.of(data)
    plain = run_trial(StructureCandidate(LINEAR, "oe.exact", {"na": 1, "nb": 1, "nk": [1]}), blocks, None, {}, (), None)
    rich = StructureCandidate(INPUTS, "hammerstein_oe.exact", {"na": 1, "nb": 1, "nk": [1], "basis": "polynomial:3"})
    found = run_trial(rich, blocks, plain, {}, (), None)
    assert found.fits == 1 and "less error energy than the best linear model" in found.reason
    assert found.estimation > plain.estimation
    assert run_trial(rich, blocks, replace(plain, candidate=replace(rich, kind=INPUTS)), {}, (), None).fits == 5


def test_functions_keep_the_range_of_the_record_where_a_block_is_left_out():
    """The last block holds the largest inputs: without it the function would end before them."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 800) * np.where(np.arange(800) < 600, 0.6, 1.0)
    y = np.convolve(u + 0.5 * u**3, 0.8 ** np.arange(60))[:800]
    blocks = Blocks.of(optid.Data(u, y + 0.01 * rng.normal(size=800)))
    arguments = {"na": 1, "nb": 1, "basis": "polynomial:3"}
    found = run_trial(StructureCandidate(INPUTS, "hammerstein_oe.exact", arguments), blocks, None, {}, (), None)
    assert found.by_block.min() > 98
    narrow = optid.fit(blocks.without(3), "hammerstein_oe.exact", **arguments).model
    energy, measure = blocks.errors(narrow, 3)
    assert 100 * (1 - np.sqrt(energy / measure)).item() < 95


@pytest.mark.filterwarnings("ignore:The functions of latent signals")
@pytest.mark.sampled(2)
@pytest.mark.parametrize("formulation, arguments", [
    ("wiener_ss.exact", {}), ("hammerstein_ss.exact", {"basis": "polynomial:2", "feedback_basis": "polynomial:3"}),
    ("lfr.exact", {"channels": 1, "latent_basis": "polynomial:3"}),
])
def test_fits_without_a_block_go_on_from_the_whole_record(formulation, arguments):
    """Warm fits reach what cold ones do."""
    rng = np.random.default_rng(1)
    u, x = rng.normal(size=600), np.zeros(600)
    for k in range(1, 600):
        x[k] = 0.7 * x[k - 1] - 0.1 * np.tanh(x[k - 1]) ** 3 + u[k - 1]
    y = x + 0.2 * x**2 if formulation == "wiener_ss.exact" else x
    blocks = Blocks.of(optid.Data(3 + 2 * u, 40 + 7 * y + 0.05 * rng.normal(size=600)))
    found = run_trial(StructureCandidate(LATENT, formulation, {"nx": 1, **arguments}), blocks, None, {}, (), None)
    assert found.complete, found.reason
    cold = [optid.fit(blocks.without(b), formulation, nx=1, prove=False, **arguments).model for b in range(4)]
    errors = np.array([blocks.errors(model, b)[0] for b, model in enumerate(cold)])
    warm = found.energy[np.argsort(found.order)]
    assert np.sum(warm) < 1.05 * np.sum(errors)


def stuck_on_the_whole(monkeypatch, module, data, good, before=0):
    """Let fits of a module end in a poor optimum on the whole record and from there, in a good one elsewhere.

    Without the first few blocks, so many before it shows, it is as poor as on the whole record.
    """
    calls = []

    def scripted(given, formulation_name=None, *, initial=None, **arguments):
        calls.append((given is data, initial))
        from_poor = initial is not None and initial is not good.model
        lost = from_poor or (initial is None and given is data)
        shown = from_poor and sum(not whole for whole, _ in calls) > before
        scale = 9.0 if shown else 1.2  # without a block it is much worse there
        model = replace(good.model, B=scale * good.model.B) if lost else good.model
        return SimpleNamespace(model=model, solution=SimpleNamespace(
            objective=2.0 if lost else 1.0, status=good.solution.status))

    monkeypatch.setattr(module, "fit", scripted)
    return calls


@pytest.mark.parametrize("before", [0, 1, 3])
def test_a_better_optimum_without_a_block_is_where_the_whole_fit_goes_on(monkeypatch, before):
    """Functions of latent signals have many optima; what is chosen is fitted in the same way."""
    data = plant(400)
    good = optid.fit(data, "hammerstein_ss.sid", nx=1, basis="linear")
    candidate, blocks = StructureCandidate(LATENT, "lfr.exact", {"nx": 1, "channels": 1}), Blocks.of(data)
    calls = stuck_on_the_whole(monkeypatch, trying, blocks.data, good, before)
    found = run_trial(candidate, blocks, None, {}, (), None)
    order = (*blocks.moving[::2], *blocks.moving[1::2])
    assert found.complete and found.restarted == order[before] and found.order == order
    expected = [blocks.errors(good.model, b)[0] for b in range(4)]
    np.testing.assert_allclose(found.energy[np.argsort(found.order)], expected, rtol=1e-12)
    assert found.estimation == pytest.approx(blocks.fit(good.model))
    # the whole record, a block warm and cold, the whole record from there, four blocks
    assert [whole for whole, _ in calls] == [True, *[False] * (2 + before), True, False, False, False, False]
    assert all(initial is good.model for _, initial in calls[3 + before :])

    calls = stuck_on_the_whole(monkeypatch, searching, data, good)
    settings = {"constraints": (), "solver": "auto"}
    assert searching._refitted(found, data, blocks, None, settings).model is good.model
    assert [whole for whole, _ in calls] == [True, False, True] and calls[2][1] is good.model


@pytest.mark.parametrize("formulation, arguments, count", [
    ("arx", {"na": 2, "nb": 3}, 6), ("hammerstein_arx.exact", {"na": 2, "nb": 2, "basis": "polynomial:3"}, 7),
    ("ss.exact", {"nx": 2, "feedthrough": False}, 5),
])
def test_free_parameters_are_counted_without_those_that_repeat_others(formulation, arguments, count):
    assert free_parameters(optid.fit(plant(300), formulation, **arguments).model) == count


def trial(kind, energies, parameters=3):
    energy = np.array(energies, dtype=float)[:, None]
    candidate = StructureCandidate(kind, f"of {kind}", {"n": parameters})
    return Trial(candidate, 99.0, energy, np.ones_like(energy), tuple(range(len(energy))), parameters, 5, 5, 0.1,
                 "optimal")


def ladder_of(*trials):
    return Ladder(plant(100), 4, Informativity(("u",), ("y",)), [(0,)], [], {t.candidate.key: t for t in trials})


def test_a_richer_class_has_to_win_clearly_in_the_median_block():
    simple = trial(LINEAR, [0.1, 0.1, 0.1, 0.5])
    lucky = trial(INPUTS, [0.1, 0.1, 0.1, 0.1])  # better in one block only
    clear = trial(INPUTS, [0.05, 0.05, 0.07, 0.4], 5)
    assert simple.gain(lucky) < CLEAR < simple.gain(clear)
    assert ladder_of(simple, lucky).choice() is simple
    assert ladder_of(simple, clear).choice() is clear
    worse = trial(INPUTS, [0.01, 0.01, 0.01, 3.0])  # clearly better in the median, worse in all
    assert ladder_of(simple, worse).choice() is simple


def test_of_structures_that_are_as_good_the_smaller_is_best():
    large, small = trial(LINEAR, [0.1] * 4, 9), trial(LINEAR, [0.101] * 4, 3)
    assert ladder_of(large, small).best(LINEAR) is small
    assert ladder_of(large, trial(LINEAR, [0.12] * 4, 3)).best(LINEAR) is large


def test_a_model_whose_run_diverges_in_a_block_is_never_chosen():
    simple, wild = trial(LINEAR, [0.5] * 4), trial(INPUTS, [0.001, 0.001, 0.001, np.inf])
    assert ladder_of(simple, wild).choice() is simple and ladder_of(wild).choice() is None


def test_a_model_that_got_stuck_on_the_whole_record_is_worth_what_it_fits_there():
    sound = trial(LINEAR, [0.1] * 4)
    stuck = replace(trial(INPUTS, [0.01] * 4), estimation=30.0)
    assert stuck.score == 30.0 and sound.score == pytest.approx(100 * (1 - np.sqrt(0.1)))
    assert ladder_of(sound, stuck).choice() is sound


def test_a_refit_that_got_worse_is_made_again_as_on_trial(monkeypatch, short):
    """More starts may end elsewhere: the model that is handed over is never worse than what was chosen."""
    asked = []

    def worse(data, formulation, **arguments):
        asked.append(arguments)
        return optid.fit(data, formulation, **{**arguments, **({} if "starts" in arguments else {"nk": [9]})})

    monkeypatch.setattr(searching, "fit", worse)
    found = identify(plant(300), classes=[LINEAR], workers=1)
    assert len(asked) == 2 and "starts" in asked[1] and found.fit.simulation_fit[0] > 90


@pytest.mark.slow
@pytest.mark.parametrize("cubic, expected", [(0.0, LINEAR), (0.5, INPUTS)])
def test_the_class_of_a_simulated_plant_is_found(cubic, expected):
    told = []
    found = identify(plant(500, delay=3, cubic=cubic, noise=0.05), classes=KINDS[:2], workers=1, progress=told.append)
    assert found.chosen.candidate.kind == expected and found.chosen.score > 93
    assert found.fit.simulation_fit[0] > 93 and found.verdict.word in ("good", "fair")
    assert 0 < len(told) <= len(found.trials)
    delays = np.asarray(found.model.nk) if hasattr(found.model, "nk") else np.array([4])
    assert delays[0] in (0, 3, 4)
    text = str(found)
    assert "Search over" in text and f"* {expected}" in text and "The model on this record" in text
    assert found.reasons[0].startswith("linear: ") and any("input functions" in reason for reason in found.reasons)


@pytest.mark.slow
def test_processes_find_the_same(short):
    data = plant(300, cubic=0.5, noise=0.05)
    alone, together = (identify(data, classes=KINDS[:2], workers=count) for count in (1, 2))
    assert alone.chosen.candidate.kind == together.chosen.candidate.kind == INPUTS
    assert together.chosen.score == pytest.approx(alone.chosen.score, abs=2.0)


def test_an_interrupt_gives_the_best_so_far(short):
    def stop(sentence):
        if "oe.exact" in sentence:
            raise KeyboardInterrupt

    found = identify(plant(300), classes=KINDS[:2], workers=1, progress=stop)
    assert found.stopped == "an interrupt" and found.chosen.complete
    assert "ended by an interrupt" in str(found)


def test_a_spent_effort_ends_the_search_after_the_low_orders(short):
    found = identify(plant(400, cubic=0.4), effort=1e-3, workers=1)
    assert found.stopped == "its effort of 0.001 units" and {t.candidate.kind for t in found.trials} == set(KINDS[:2])
    assert found.units > 0.001


@pytest.mark.skipif(not hasattr(signal, "ITIMER_PROF"), reason="no timer of CPU time here")
def test_a_limit_that_ends_within_the_last_words_of_an_object_is_told_a_moment_later():
    class Slow:
        def __del__(self):
            while process_time() < until:
                pass

    until = process_time() + 0.2
    with pytest.raises(OutOfTime), cpu_limit(0.05):
        Slow()
        while process_time() < until + 5:
            pass
    assert process_time() < until + 5


def test_a_budget_of_cpu_time_ends_the_search_wherever_it_is(short):
    found = identify(plant(400, cubic=0.4), budget=1e-3, workers=1)
    assert found.stopped == "the budget of 0.001 CPU s" and found.chosen.complete


@pytest.mark.slow
def test_constraints_hold_for_what_is_chosen(short):
    data = plant(400, cubic=0.5, noise=0.05)
    found = identify(data, classes=[INPUTS], constraints=["monotone:increasing", "gain:20"], workers=1)
    assert {price.name.partition(":")[0].partition(" ")[0] for price in found.fit.prices} == {"monotone", "gain"}
    assert found.model.nonlinearities[0].basis.size > 1


def test_inputs_of_two_levels_allow_no_functions_of_them(short):
    rng = np.random.default_rng(3)
    u = np.sign(rng.normal(size=300))
    y = np.convolve(u, 0.8 ** np.arange(40))[:300] + 0.1 * rng.normal(size=300)
    found = identify(optid.Data(u, y), classes=KINDS[:2], workers=1)
    assert INPUTS not in {t.candidate.kind for t in found.trials} and "two levels" in found.reasons[-1]
    refuses(StructureError, "add 'linear'", lambda: identify(optid.Data(u, y), classes=[INPUTS]))


@pytest.mark.filterwarnings("ignore:too few levels")
def test_a_basis_has_no_more_functions_than_the_samples_determine():
    rng = np.random.default_rng(0)
    three, gap = rng.choice([-1.0, 0.2, 1.0], 500), np.concatenate([rng.uniform(0, 1, 250), rng.uniform(5, 6, 250)])
    smooth, one = rng.normal(size=500), rng.choice([0.0, 1.0], 500)
    data = optid.Data(np.column_stack([three, gap, smooth, one]), rng.normal(size=500))
    assert determined_bases(data, "polynomial:3") == ["polynomial:2", "polynomial:3", "polynomial:3", "linear"]
    words = determined_bases(data, "triangular:10")
    assert words[0] in ("triangular:2", "linear") and words[3] == "linear" and words[1] != "triangular:10"
    fit = optid.fit(data, "hammerstein_oe.exact", na=1, nb=1, basis=words, prove=False)  # no cell is empty
    assert fit.solution.status.value == "locally optimal"


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("changes, error, words", [
    ({"budget": 0}, StructureError, "budget must be a positive number"), ({"effort": "much"}, StructureError, "effort"),
    ({"effort": 0}, StructureError, "effort=0"), ({"effort": np.nan}, StructureError, "effort"),
    ({"blocks": 1}, StructureError, "blocks"),
    ({"classes": ["wiener"]}, StructureError, "wiener"), ({"horizon": 0}, StructureError, "horizon"),
    ({"workers": 10**5000}, StructureError, "workers"), ({"horizon": 10**5000}, StructureError, "horizon"),
    ({"budget": "x"}, StructureError, "budget"), ({"budget": np.nan}, StructureError, "budget"),
    ({"budget": 10**400}, StructureError, "budget"), ({"budget": np.array([1, 2])}, StructureError, "budget"),
    ({"accuracy": 0}, StructureError, "^accuracy=0"), ({"accuracy": np.nan}, StructureError, "^accuracy=nan"),
    ({"blocks": np.inf}, StructureError, "blocks"), ({"blocks": 10**5000}, StructureError, "blocks"),
    ({"workers": 0}, StructureError, "workers"), ({"solver": "nothing"}, OptidError, "nothing"),
    ({"constraints": ["monotonous"]}, OptidError, "monotonous"),
])
def test_arguments_that_cannot_be_are_refused(changes, error, words):
    refuses(error, words, lambda: identify(plant(200), **{"workers": 1, **changes}))


def test_bad_records_are_refused(short):
    refuses(DataError, "identify takes optid.Data", lambda: identify(np.zeros(10)))
    refuses(RankError, "too few for cross-validation", lambda: identify(plant(25)))
    u = np.random.default_rng(0).normal(size=200)
    refuses((DataError, SolverFailed), "constant", lambda: identify(optid.Data(u, np.ones(200)), workers=1))
    refuses((DataError, SolverFailed), "constant", lambda: identify(optid.Data(np.ones(200), u), workers=1))


def test_missing_samples_are_left_out(short):
    data = plant(500, noise=0.05)
    u, y = np.array(data.u).ravel(), np.array(data.y).ravel()
    y[100:140] = np.nan
    u[300:303] = np.nan
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        found = identify(optid.Data(u, y), classes=[LINEAR], workers=1)
    assert found.chosen.score > 90


def test_a_horizon_compares_predictions(short):
    found = identify(plant(300), classes=[LINEAR], horizon=3, workers=1)
    assert found.horizon == 3 and "3 samples ahead" in str(found)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*stopped with status 'limit':optid.errors.DataWarning")  # of the noise model
def test_two_outputs():
    one, two = plant(300, seed=4), plant(300, seed=4, cubic=0.2)
    found = identify(optid.Data(one.u, np.column_stack([one.y, two.y])), classes=[LINEAR], workers=1)
    assert found.model.l == 2 and found.chosen.score > 50


@pytest.mark.parametrize("count", [1, 3])
def test_a_pool_returns_results_in_order_and_stops_at_its_deadline(count):
    told = []
    with closing(TrialPool(slow_square, count)) as pool:
        assert pool.run(range(7), lambda: FOREVER, told.append) == [x * x for x in range(7)]
        assert sorted(told) == [x * x for x in range(7)]
        assert pool.run(range(3), lambda: -1.0, told.append) == [None] * 3


def test_a_pool_survives_the_death_of_a_process():
    with closing(TrialPool(die_of_one, 2)) as pool:
        found = pool.run([0, 1, 2, 3], lambda: FOREVER, lambda result: None)
        assert found[1] is None and [x for x in found if x is not None] == [0, 2, 3]


@pytest.mark.slow
def test_what_hangs_ends_with_the_time(monkeypatch):
    monkeypatch.setattr("optid.identify.search.pool.GRACE", 3.0)
    with closing(TrialPool(hang, 2)) as pool:
        assert pool.run([0, 1], lambda: 1e-6, lambda result: None) == [0, None]


@pytest.mark.parametrize("count", [1, 2])
def test_what_a_trial_raises_in_a_process_is_raised_here(count):
    with closing(TrialPool(fail, count)) as pool:
        refuses(ZeroDivisionError, "of 7", pool.run, [7], lambda: FOREVER, lambda result: None)


def test_a_constraint_that_no_process_can_import_is_refused_by_its_name_or_leaves_the_search_alone(monkeypatch, short):
    monkeypatch.setattr(searching, "available_cores", lambda number, name: number or 2)
    words = "constraint '<lambda>': tasks.anonymous.*define it in a module that can be imported"
    with pytest.raises(StructureError, match=f"workers=2: {words}, or use workers=1"):
        identify(plant(300), classes=[LINEAR], constraints=[anonymous()], workers=2)
    found = identify(plant(300), classes=[LINEAR], constraints=[anonymous()], effort=0.5)
    assert re.search(f"the search worked in one process: {words}", found.reasons[-1])
    assert "the search worked in one process" in str(found)


def test_the_search_tells_nothing_of_processes_where_they_do(short, monkeypatch):
    monkeypatch.setattr(searching, "available_cores", lambda number, name: number or 2)
    found = identify(plant(300), classes=[LINEAR], constraints=["stable"], effort=0.5)
    assert not any("process" in reason for reason in found.reasons)


def test_nothing_that_can_be_fitted_is_an_error_with_the_most_frequent_reason(monkeypatch):
    def refuse(candidate, *_):
        return Trial(candidate, reason="RankError: too short")

    monkeypatch.setattr(searching, "run_trial", refuse)
    refuses(SolverFailed, "most often: RankError: too short", lambda: identify(plant(200), workers=1))


def test_layouts_of_the_sums_hold_every_lag():
    data = plant(200)
    sums = LagSums(Blocks.of(data), na=2, lags=3)
    assert isinstance(sums.layout, Layout)
    assert sums.columns(1, 2, (1,)).tolist() == [0, 3, 4, 5]


@pytest.mark.usefixtures("short")
def test_a_search_goes_on_from_the_file_of_its_trials(tmp_path, monkeypatch):
    data, file = plant(400, cubic=0.4), tmp_path / "trials.json"
    first = identify(data, classes=KINDS[:2], effort=1e-3, workers=1, trials=file)
    made = []
    monkeypatch.setattr(searching, "run_trial", lambda one, *more: made.append(one.key) or run_trial(one, *more))
    second = identify(data, classes=KINDS[:2], workers=1, trials=file)
    whole = identify(data, classes=KINDS[:2], workers=1)
    assert not {t.candidate.key for t in first.trials if t.fits} & set(made[: len(second.trials) - len(first.trials)])
    assert [(t.candidate.key, t.score, t.reason) for t in second.trials] == [
        (t.candidate.key, t.score, t.reason) for t in whole.trials]
    assert str(second.fit.model) == str(whole.fit.model)
    with pytest.raises(DataError, match="of another record"):
        identify(plant(400, seed=1), classes=KINDS[:2], workers=1, trials=file)
    file.write_text("{}")
    refuses(OptidError, "trials.json", identify, data, classes=KINDS[:2], workers=1, trials=file)


@pytest.mark.slow
def test_the_trials_do_not_depend_on_the_number_of_processes(short):
    data = plant(400, cubic=0.4)
    one, two = (identify(data, classes=KINDS[:2], workers=count) for count in (1, 2))
    assert [(t.candidate.key, t.score, t.energy.tolist()) for t in one.trials] == [
        (t.candidate.key, t.score, t.energy.tolist()) for t in two.trials]
    assert one.units == two.units and one.fit.model.to_dict() == two.fit.model.to_dict()


def test_a_model_that_leaves_the_range_when_the_inputs_come_otherwise_is_dropped(monkeypatch):
    data = plant(400)
    blocks = Blocks.of(data)
    fit = optid.fit(data, "arx", na=1, nb=1, nk=1)
    assert blocks.excursion(fit.model) < 0.2
    u = np.concatenate([data.u, data.u[::-1], np.roll(data.u, 200, axis=0)])  # of a state at rest
    state = fit.model.initial_state(data.window(0, 132))
    run, y = fit.model.simulate(u, x0=state)[400:], data.y
    expected = max(y.min() - run.min(), run.max() - y.max()) / (y.max() - y.min())
    assert blocks.excursion(fit.model) == pytest.approx(max(expected, 0.0), abs=1e-12)
    candidate = StructureCandidate(LATENT, "wiener_ss.exact", {"nx": 1, "output_basis": "polynomial:3"})
    assert run_trial(candidate, blocks, None, {}, (), None).complete
    monkeypatch.setattr(Blocks, "excursion", lambda *_: 0.6)
    assert "leaves the range of the outputs" in run_trial(candidate, blocks, None, {}, (), None).reason
    assert run_trial(candidate, blocks, None, {}, (), 1).complete  # predictions do not run freely
    assert run_trial(StructureCandidate(LINEAR, "arx", {"na": 1, "nb": 1, "nk": [1]}), blocks, None, {}, (),
                     None).complete


def test_functions_of_states_have_one_level_for_all_experiments():
    data = optid.Data.join(plant(200), plant(200, seed=1).map_signals(lambda u: u, lambda y: y + 3))
    ladder = Ladder.of(Blocks.of(data), several=True)
    assert ladder.levels_differ
    for kind, formulation, word in ((LINEAR, "oe.exact", "each"), (INPUTS, "hammerstein_oe.exact", "each"),
                                    (LATENT, "wiener_ss.exact", None), (FEEDBACK, "hammerstein_ss.exact", None)):
        assert ladder.with_levels(StructureCandidate(kind, formulation, {"nx": 2})).arguments.get("offset") == word
