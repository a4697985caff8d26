"""What a record tells: dead time, feedback, effects of inputs, excitation; each on plants whose truth is known."""

from typing import Any

import numpy as np
import pytest
import scripts

import optid
from optid.errors import DataError
from optid.examples import example
from optid.identify.informativity import informativity, processes
from optid.identify.informativity.descent import Drive, Term
from optid.identify.informativity.process import _searched
from optid.identify.informativity.signals import RecordSignals, WhitenedRegression, respond
from optid.models.recursions import lfilter


def staircase(rng, samples, held=25, levels=None):
    count = samples // held + 1
    chosen = rng.uniform(0, 1, count) if levels is None else rng.choice(levels, count)
    return np.repeat(chosen, held)[:samples]


def driven(u, *, dead=7, gain=2.0, poles=(0.93,), noise=0.03, colour=0.0, seed=0, level=71.3):
    """A plant of unit-gain poles that answers dead + 1 samples later, with white or AR(1) noise."""
    rng = np.random.default_rng(seed)
    a = np.real(np.poly(poles))
    x = lfilter(np.r_[np.zeros(dead + 1), gain * a.sum()], a, u - u[0])
    e = lfilter([1.0], [1.0, -colour], rng.standard_normal(len(u) + 200))[200:]
    return level + x + noise * x.std() * e / e.std()


def loop(samples=800, *, moved=True, seed=0, proportional=2.0, integral=0.15, dead=2):
    """A PI loop around a first-order plant of gain 1.5 with an AR(1) disturbance: input, output, set-point."""
    rng = np.random.default_rng(seed)
    r = staircase(rng, samples, 60, [-1.0, 0.0, 1.0, 2.0]) if moved else np.zeros(samples)
    v = lfilter([0.1], [1.0, -0.9], rng.standard_normal(samples))
    u, y, x, total = np.zeros(samples), np.zeros(samples), 0.0, 0.0
    for k in range(samples):
        x = 0.9 * x + 0.15 * (u[k - dead - 1] if k > dead else 0.0)
        y[k] = x + v[k] + 0.02 * rng.standard_normal()
        total += integral * (r[k] - y[k])
        u[k] = proportional * (r[k] - y[k]) + total
    return u, y, r


@pytest.mark.parametrize("poles", [(0.9,), (0.94, 0.8)])
@pytest.mark.parametrize("dead", [0, 5, 23])
@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_a_dead_time_is_found_within_a_sample(poles, dead, colour):
    u = staircase(np.random.default_rng(3), 800)
    found = processes(optid.Data(u, driven(u, dead=dead, poles=poles, colour=colour)))[0].responses[0]
    assert abs(found.nk - dead - 1) <= 1 and found.lag_interval[0] <= dead + 1 <= found.lag_interval[1]
    assert found.gain == pytest.approx(2.0, rel=0.05)


def test_a_single_outlier_does_not_move_the_dead_time():
    u = staircase(np.random.default_rng(3), 800)
    y = driven(u, dead=5)
    y[400] += 60 * np.std(y)
    assert processes(optid.Data(u, y))[0].responses[0].nk == 6


@pytest.mark.parametrize("seed", range(3))
def test_the_responses_to_rare_pulses_are_no_outliers(seed):
    rng, u = np.random.default_rng(seed), np.zeros(1000)
    u[rng.choice(np.arange(20, 980), 10, replace=False)] = rng.uniform(0.5, 1.5, 10)
    y = np.convolve(u, np.concatenate([np.zeros(3), 0.2 ** np.arange(5)]))[:1000] + 0.01 * rng.standard_normal(1000)
    found = processes(optid.Data(u, y))[0].responses[0]
    assert found.nk in (2, 3) and found.gain == pytest.approx(1.25, rel=0.1)


def test_a_step_has_its_gain_time_constant_and_dead_time():
    u = np.where(np.arange(200) < 20, 0.0, 1.0)
    found = processes(optid.Data(u, driven(u, dead=12, poles=(0.95,), noise=0.02)))[0].responses[0]
    assert found.poles.size == 1 and abs(found.nk - 13) <= 1
    assert -1 / np.log(found.poles[0].real) == pytest.approx(-1 / np.log(0.95), rel=0.1)


def test_a_dead_time_of_a_hundred_samples_is_found():
    u = staircase(np.random.default_rng(1), 3000, 100)
    assert abs(processes(optid.Data(u, driven(u, dead=100)))[0].responses[0].nk - 101) <= 1


def test_the_scan_does_not_depend_on_units_or_levels():
    u = staircase(np.random.default_rng(3), 500)
    y = driven(u)
    one = processes(optid.Data(u, y))[0].responses[0]
    other = processes(optid.Data(1e-4 * u + 7, 1e5 * y - 3e6))[0].responses[0]
    assert other.nk == one.nk and other.poles == pytest.approx(one.poles, rel=1e-5)
    assert other.gain == pytest.approx(1e9 * one.gain, rel=1e-5)


def test_the_order_of_experiments_does_not_matter():
    rng = np.random.default_rng(0)
    us = [staircase(rng, n) for n in (150, 200, 260)]
    ys = [driven(u, dead=4, seed=i, level=10.0 * i) for i, u in enumerate(us)]
    found = [processes(optid.Data([us[i] for i in order], [ys[i] for i in order]))[0].responses[0]
             for order in ((0, 1, 2), (2, 0, 1))]
    assert [one.nk for one in found] == [5, 5]
    assert found[0].gain == pytest.approx(found[1].gain, rel=1e-6) and found[0].gain == pytest.approx(2, rel=0.03)


def test_missing_samples_do_not_move_a_dead_time():
    u = staircase(np.random.default_rng(2), 600)
    y = driven(u, dead=5, noise=0.01)
    u, y = u.copy(), y.copy()
    y[np.random.default_rng(0).choice(600, 60, replace=False)] = np.nan
    u[250] = np.nan  # at a move: the value before it is the wrong one
    found = processes(optid.Data(u, y))[0].responses[0]
    assert found.nk == 6 and found.gain == pytest.approx(2, rel=0.02)


def test_a_saturation_is_seen_and_does_not_hide_the_dead_time():
    u = staircase(np.random.default_rng(4), 1000)
    found = processes(optid.Data(u, driven(np.minimum(u, 0.6), dead=6)))[0].responses[0]
    assert abs(found.nk - 7) <= 1 and found.nodes is not None
    assert found.values is not None
    f = np.interp([0.1, 0.5, 0.7, 0.95], found.nodes + u.mean(), found.values)
    assert abs(f[3] - f[2]) < 0.2 * abs(f[1] - f[0])


@pytest.mark.parametrize("seed", [0, 4])
def test_a_saturation_found_once_is_kept_when_the_noise_model_changes(seed):
    (response,) = processes(example("heater", seed=seed).data)[0].responses
    assert (response.nk, response.lag_interval, response.values is None) == (5, (5, 5), False)
    np.testing.assert_allclose(response.poles, np.exp(-5 / 120), atol=5e-4)


def test_an_integrator_is_told_and_its_slope():
    rng = np.random.default_rng(5)
    u = 20 + np.repeat(rng.choice([-3.0, 0.0, 3.0], 30), 20)
    y = 50 + np.r_[0, np.cumsum(0.02 * (u - 20))[:-1]] + 0.02 * rng.standard_normal(600)
    told = informativity(optid.Data(u, y))
    response = told.processes[0].responses[0]
    assert response.integrates and response.b.sum() == pytest.approx(0.02, rel=0.02)
    assert any("integrates input 'u'" in finding for finding in told.findings)


@pytest.mark.parametrize("seed", [0, 3])
def test_an_integrator_is_found_where_the_slowest_pole_takes_half_the_record(seed):
    """Pulses both ways: a pole of 630 of 1,350 samples is nearly as good (seed 3), and not what the plant has."""
    found = processes(scripts.benchmark("search_plants").record("integrator", seed).train)[0].responses[0]
    assert found.integrates and found.poles.size <= 3


@pytest.mark.parametrize("seed", range(3))
def test_a_plant_that_first_goes_the_wrong_way_has_its_own_dead_time(seed):
    u = staircase(np.random.default_rng(seed), 500, 20)
    y = driven(u, dead=5, gain=3.0, poles=(0.96,), noise=0.0) + driven(u, dead=5, gain=-1.5, poles=(0.88,), colour=0.9)
    (response,) = processes(optid.Data(u, y))[0].responses
    assert abs(response.nk - 6) <= 1 and response.gain == pytest.approx(1.5, rel=0.05)
    np.testing.assert_allclose(np.sort(response.poles.real), [0.88, 0.96], atol=0.02)
    assert np.sign(response.b[0]) != np.sign(response.gain)


@pytest.mark.parametrize("seed", range(4))
def test_a_pair_that_decays_within_a_sample_is_left_out_again(seed):
    u = staircase(np.random.default_rng(seed), 800)
    y = driven(u, poles=(0.93, 0.7), seed=seed)
    regression = WhitenedRegression((y,), (np.full(800, True),), np.ones(1))
    start = Term.of([0.93, 0.7, 0.004 + 0.002j, 0.004 - 0.002j], 8)
    found = _searched(regression, Drive((u,)), 0, 200, start)
    assert not found.term.pairs and found.term.order <= 2


def test_a_pair_without_effect_has_no_dead_time():
    rng = np.random.default_rng(3)
    u = np.column_stack([staircase(rng, 800, 20), staircase(rng, 800, 35)])
    y = np.column_stack([driven(u[:, c], dead=dead, seed=c) for c, dead in enumerate((4, 9))])
    told = informativity(optid.Data(u, y))
    assert [[told.acts(c, y) for c in range(2)] for y in told.outputs] == [[True, False], [False, True]]
    assert sum("dead time" in finding for finding in told.findings) == 2 and told.lags == (5, 10)


def test_two_inputs_have_responses_of_their_own():
    rng = np.random.default_rng(6)
    u = np.column_stack([staircase(rng, 1000, 20), staircase(rng, 1000, 35)])
    y = driven(u[:, 0], dead=3, noise=0.01) + driven(u[:, 1], dead=15, poles=(0.97,), gain=-1.0, noise=0.0)
    first, second = processes(optid.Data(u, y))[0].responses
    assert abs(first.nk - 4) <= 1 and abs(second.nk - 16) <= 1
    assert (first.gain, second.gain) == pytest.approx((2.0, -1.0), rel=0.05)


@pytest.mark.parametrize("poles", [(), (0.5,), (0.9, 0.9), (0.8 + 0.3j, 0.8 - 0.3j)])
def test_a_response_has_unit_static_gain(poles):
    assert respond(poles, np.r_[0.0, np.ones(400)])[-1] == pytest.approx(1.0)


def test_least_squares_with_missing_rows_agree_with_plain_ones():
    rng = np.random.default_rng(7)
    x, y = rng.normal(size=(80, 2)), rng.normal(size=80)
    there = rng.random(80) > 0.2
    energy, theta, _, free = WhitenedRegression((y,), (there,), np.ones(1)).solve([x], 0.9)
    whole = np.column_stack([x, np.ones(80), 0.9 ** np.arange(80)])[there]
    plain, rest, *_ = np.linalg.lstsq(whole, y[there])
    assert theta == pytest.approx(plain[:2]) and energy == pytest.approx(rest[0]) and free == 2


@pytest.mark.parametrize("seed", range(3))
def test_open_records_are_called_open(seed):
    rng = np.random.default_rng(seed)
    for u in (staircase(rng, 600), staircase(rng, 600, 8, [-1.0, 1.0]),
              lfilter([0.02], [1, -1.8, 0.82], rng.standard_normal(600)), np.where(np.arange(200) < 20, 0.0, 1.0)):
        assert informativity(optid.Data(u, driven(u, colour=0.9, seed=seed))).loop.word == "open"


@pytest.mark.parametrize("seed", range(3))
def test_a_loop_that_a_set_point_moves_is_named(seed):
    u, y, _ = loop(seed=seed)
    told = informativity(optid.Data(u, y))
    assert told.loop.word == "closed" and told.least == 1 and not told.reason
    assert told.lags[0] >= 1 and "closed loop: output 'y' acts on input 'u'" in told.findings[0]
    assert told.processes[0].responses[0].gain == pytest.approx(1.5, rel=0.25)


@pytest.mark.parametrize("seed", range(3))
def test_a_loop_that_nothing_moves_cannot_be_identified(seed):
    u, y, _ = loop(moved=False, seed=seed)
    data = optid.Data(u, y)
    told = informativity(data)
    assert told.loop.word == "regulated" and "nothing moved it from outside" in told.reason
    fit = optid.fit(data, "arx", na=2, nb=2)  # the inverse of the controller
    assert fit.verdict.word == "useless" and "nothing moved it from outside" in fit.advice[0].sentence


def test_a_set_point_beside_its_input_is_named():
    u, y, r = loop()
    told = informativity(optid.Data(np.column_stack([u, r]), y, inputs=["valve", "sp"]))
    assert "input 'sp' is the set-point" in told.reason


def test_a_proportional_controller_is_no_copied_column():
    y = driven(np.zeros(400) + np.r_[0, np.ones(399)])
    told = informativity(optid.Data(-3.0 * y + 5.0, y))
    assert told.loop.word == "regulated" and "-3 times output 'y'" in told.reason


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_an_input_without_effect_is_named(colour):
    rng = np.random.default_rng(9)
    u = np.column_stack([staircase(rng, 600), staircase(rng, 600, 15, [0.0, 1.0])])
    y = driven(u[:, 0], colour=colour)
    told = informativity(optid.Data(u, y, inputs=["a", "b"]))
    assert not told.without_effect(0) and told.without_effect(1) and not told.reason
    assert "input 'b' has no visible effect on any output: leave it out" in told.findings
    decay = np.exp(-np.arange(400) / 60) + 0.01 * rng.standard_normal(400)
    alone = informativity(optid.Data(u[:400, 1], decay, inputs=["b"]))
    assert "input 'b' has no visible effect" in alone.reason


def test_a_weak_input_is_kept():
    u = staircase(np.random.default_rng(2), 1000, 10, [-1.0, 1.0])
    assert not informativity(optid.Data(u, driven(u, noise=np.sqrt(10)))).without_effect(0)


u0 = staircase(np.random.default_rng(1), 400)
y0 = driven(u0)


@pytest.mark.parametrize("u, words", [
    (np.r_[np.zeros(3), y0[:-3]], "is output 'y', 3 samples later"),
    (np.r_[y0[3:], np.zeros(3)], "is output 'y', 3 samples before"),
    (np.arange(400.0), "rises evenly with time"),
    (np.r_[np.zeros(399), 1.0], "moves for the first time 1 sample before the end"),
    (np.column_stack([u0, 2 * u0 + 3]), "always move together (the second is 2 times the first"),
], ids=["copied", "copied from later", "time", "last sample", "together"])
def test_records_from_which_nothing_can_be_learned_say_why(u, words):
    data = optid.Data(u, y0)
    told = informativity(data)
    assert words in told.reason and told.findings == (told.reason,) and words.split(" (")[0] in str(told)


def test_sinusoids_determine_two_numbers_each():
    k = np.arange(600)
    u = np.sin(0.2 * k) + 0.5 * np.sin(0.61 * k)
    told = informativity(optid.Data(u, driven(u, dead=0, noise=0.01)))
    assert told.excitations[0].lines == 2 and told.excitations[0].numbers == 4
    one = optid.Data(np.sin(0.2 * k), driven(np.sin(0.2 * k), dead=0, noise=0.01))
    with pytest.raises(DataError, match="determines 2 numbers of a linear response. na 2 and nb 2 ask for 4"):
        optid.fit(one, "oe.exact", na=2, nb=2)
    assert optid.fit(one, "oe.exact", na=1, nb=1, nk=1).model.na == 1


def test_one_step_determines_no_richer_structure():
    u = np.where(np.arange(200) < 20, 0.0, 1.0)
    data = optid.Data(u, driven(u, dead=2, noise=0.01))
    asked: list[tuple[str, dict[str, Any]]] = [("arx", {"na": 3, "nb": 3}), ("oe.exact", {"na": 2, "nb": 4}),
                                               ("ss.exact", {"nx": 4})]
    for formulation, orders in asked:
        with pytest.raises(DataError, match="moves once: a step determines gain, time constants and dead time"):
            optid.fit(data, formulation, **orders)
    found = optid.identify(data, workers=1, progress=lambda sentence: None)
    assert found.verdict.word == "good" and "moves once" in " ".join(found.reasons)
    assert found.model.dead_times[0] == pytest.approx(2.0, abs=0.2)


def test_a_record_is_examined_once_and_large_ones_say_that_they_are_not():
    data = optid.Data(u0, y0)
    assert informativity(data) is informativity(data) is optid.fit(data, "arx", na=1, nb=1, nk=8).informativity
    many = optid.Data(np.random.default_rng(0).normal(size=(80, 5)), np.random.default_rng(1).normal(size=(80, 4)))
    assert "more than 16 pairs" in str(informativity(many))
    assert informativity(optid.Data(u0[:8], y0[:8])).untested


def test_findings_of_a_record_lead_the_printed_fit_and_the_search():
    data = optid.Data(u0, y0, 5.0, inputs=["heater"], outputs=["temperature"])
    sentence = "dead time from 'heater' to 'temperature': 35 s (7 samples)"
    assert sentence in " ".join(str(optid.fit(data, "arx", na=1, nb=1, nk=8)).split())
    found = optid.identify(data, workers=1, classes=["linear"], effort=1, progress=lambda sentence: None)
    assert " ".join(str(found).split()).index(sentence) < 200


def test_signals_keep_the_first_of_many_experiments():
    data = optid.Data([u0[:50]] * 60, [y0[:50]] * 60)
    assert len(RecordSignals.of(data).y) == 40
