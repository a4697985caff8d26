"""Diagnosis: every verdict, every kind of fault, intervals, and refusals that name what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from fault_plants import LOAD, levels, noisy, refused
from matplotlib.figure import Figure
from test_fault_injection import small

from optid import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.faults import Fault, diagnose, dictionary, inject, load_diagnosis, model_uncertainty, nuisance, thresholds

COUNT = 120


@pytest.fixture(scope="module")
def found():
    return dictionary(small(), process={"load": LOAD})


@pytest.fixture(scope="module")
def limits(found):
    return thresholds(found, COUNT, 0.009, draws=6000)


@pytest.fixture(scope="module")
def with_losses():
    return dictionary(small(), kinds=["bias", "loss", "stuck"])


@pytest.fixture(scope="module")
def loss_limits(with_losses):
    return thresholds(with_losses, COUNT, 0.009, u=inputs(), draws=6000)


def inputs(count=COUNT, seed=0):
    return levels(count, seed)


def record(*faults, seed=1, model=None, u=None, **how):
    u = inputs() if u is None else u
    return u, inject(small() if model is None else model, u, faults, seed=seed, process={"load": LOAD}, **how)


# -- verdicts ----------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("fault", "label", "size"),
    [
        (Fault.step("sensor:y1", 60, 0.6), "sensor:y1", 0.6),
        (Fault.step("sensor:y2", 60, -0.6), "sensor:y2", -0.6),
        (Fault.step("actuator:u1", 60, 0.6), "actuator:u1", 0.6),
        (Fault.step("actuator:u2", 60, 0.8), "actuator:u2", 0.8),
        (Fault.step("process:load", 60, 0.9), "process:load", 0.9),
    ],
)
def test_offsets_are_named_with_their_onset_and_size(found, limits, fault, label, size):
    answer = diagnose(small(), record(fault), found, thresholds=limits)
    assert answer.verdict == "faulty" and answer.detected and label in [a.label for a in answer.candidates]
    assert answer.p_value < 1e-6 and answer.best is answer.candidates[0]
    named = next(a for a in answer.candidates if a.label == label).faults[0]
    assert named.onset_interval[0] <= 60 <= named.onset_interval[1] and abs(named.onset - 60) <= 3
    low, high = named.size_interval[0]
    assert low < size < high and high - low < 1.2 * abs(size)
    assert answer.certificate.basis == "exhaustive" and answer.certificate.value > 0
    assert answer.remaining.p_value > 1e-3
    assert sum(a.posterior for a in answer.candidates) <= 1 + 1e-12


def test_a_jump_of_the_state_is_named_with_all_its_magnitudes(found, limits):
    jump = np.array([1.5, -1.0, 2.0])
    answer = diagnose(small(), record(Fault.jump("state", 60, jump)), found, thresholds=limits)
    fault = answer.best.faults[0]
    assert fault.label == "state" and fault.onset == 60 and fault.size.shape == (3,)
    assert np.all(fault.size_interval[:, 0] < fault.size) and np.all(fault.size < fault.size_interval[:, 1])
    assert np.all(np.abs(fault.size - jump) < 5 * np.sqrt(np.diag(fault.covariance)))


def test_losses_and_stuck_actuators_are_told_apart(with_losses, loss_limits):
    for fault, label, size in (
        (Fault.loss("actuator:u1", 50, 0.6), "actuator:u1 loss", [0.6]),
        (Fault.hard_over("actuator:u1", 50), "actuator:u1 loss", [1.0]),
        (Fault.stuck("actuator:u1", 50, value=0.7), "actuator:u1 stuck", [1.0, 0.7]),
    ):
        answer = diagnose(small(), record(fault), with_losses, thresholds=loss_limits)
        assert answer.best.label == label
        interval = answer.size_interval
        assert np.all(interval[:, 0] <= size) and np.all(size <= interval[:, 1])


def test_a_healthy_record_is_healthy_with_a_p_value(found, limits):
    answers = [diagnose(small(), record(seed=seed), found, thresholds=limits) for seed in range(40)]
    p_values = np.array([answer.p_value for answer in answers])
    assert np.sum(p_values <= 0.01) <= 3 and p_values.max() > 0.3
    healthy = next(answer for answer in answers if answer.verdict == "healthy")
    assert healthy.best is None and healthy.candidates == () and not healthy.detected and healthy.onset is None
    assert "healthy" in healthy.explain() and healthy.certificate.basis == "none" and not healthy.unique


@pytest.mark.slow
def test_what_fits_no_candidate_is_unknown_with_direction_and_frequency(found, limits):
    u, y = record()
    tone = 0.6 * np.sin(2 * np.pi * 0.15 * np.arange(COUNT)) * (np.arange(COUNT) > 40)
    answer = diagnose(small(), (u, y + tone[:, None] * [0.0, 1.0]), found, thresholds=limits)
    assert answer.verdict == "unknown" and answer.detected and answer.candidates == () and answer.best is None
    assert answer.remaining.frequency == pytest.approx(0.15, abs=0.02) and answer.remaining.p_value < 1e-3
    assert abs(answer.remaining.direction[1]) > 0.8
    assert "cycles per sample" in " ".join(str(answer).split())
    assert "no fault of the dictionary fits" in answer.explain()
    forced = diagnose(small(), (u, y + tone[:, None] * [0.0, 1.0]), replace(found, unknown=False), thresholds=limits)
    assert forced.verdict == "faulty" and forced.candidates


@pytest.mark.slow
def test_an_actuator_that_does_not_move_is_untestable():
    u = inputs().copy()
    u[:, 0] = 0.4
    faults = dictionary(small(), sensors=[], kinds=["loss"], state_jump=False)
    healthy = diagnose(small(), record(u=u), faults)
    assert list(healthy.untestable) == ["actuator:u1 loss"] and healthy.verdict == "healthy"
    assert "Gram eigenvalue" in healthy.untestable["actuator:u1 loss"]
    only = dictionary(small(), sensors=[], actuators=["u1"], kinds=["loss", "stuck"], state_jump=False)
    silent = diagnose(small(), record(u=u), only)
    assert silent.verdict == "untestable" and not silent.detected
    assert "does not excite" in silent.explain()
    broken = diagnose(small(), record(Fault.loss("actuator:u1", 60, 1.0), u=u), only)
    # a part that stops where it was and a constant disturbance do the same; the part is said to be untested
    assert broken.verdict == "faulty" and broken.best.faults[0].name == "process"
    assert set(broken.untestable) == {"actuator:u1 loss", "actuator:u1 stuck"}


def one_output(**how):
    A, B = np.array([[0.7, 0.2], [0.0, 0.5]]), np.array([[1.0, 0.2], [0.5, 0.8]])
    return noisy(A, B, np.array([[1.0, 0.4]]), 0.01 * np.eye(2), np.array([[0.02]]), **how)


def test_with_one_output_arbitrary_courses_are_refused_and_known_ones_allowed_with_a_note():
    model = one_output()
    u = inputs()
    y = inject(model, u, Fault.step("sensor:y", 60, 0.8), seed=2)
    parametric = diagnose(model, (u, y), dictionary(model, kinds=["bias"], state_jump=False))
    assert parametric.verdict == "faulty" and "sensor:y" in [a.label for a in parametric.candidates]
    assert "one output" in parametric.status
    frozen = dictionary(model, actuators=[], kinds=["frozen"], state_jump=False)
    answer = diagnose(model, (u, y), frozen)
    assert answer.verdict == "not isolable" and answer.detected and answer.candidates == ()
    assert "one output" in answer.untestable["sensor:y frozen"] and "one output" in answer.explain()
    calm = diagnose(model, (u, inject(model, u, seed=3)), frozen)
    assert calm.verdict == "healthy"


# -- frozen sensors, noise, outliers ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_sensor_that_repeats_its_reading_is_a_finding_and_the_rest_is_judged(found):
    u, y = record(Fault.frozen("sensor:y1", 70))
    answer = diagnose(small(), (u, y), found)
    assert answer.verdict == "faulty" and answer.best.labels == ("sensor:y1 frozen",) and answer.onset == 70
    assert answer.size[0] == y[70, 0] and answer.certificate.basis == "flat line"
    assert "are identical" in str(answer)
    u, y = record(Fault.frozen("sensor:y1", 70), Fault.step("sensor:y2", 40, 0.8))
    both = diagnose(small(), (u, y), found)
    assert both.best.labels == ("sensor:y2", "sensor:y1 frozen")
    constant = diagnose(small(), (u, np.where([False, True], 0.25, record()[1])), found)
    assert constant.best.labels == ("sensor:y2 frozen",) and constant.best.faults[0].onset_censored
    assert "at or before" in str(constant)


def test_a_sensor_without_readings_is_dead(found, tmp_path):
    u, y = record()
    for other in (y, record(Fault.step("sensor:y2", 40, 0.8))[1]):
        lost = other.copy()
        lost[70:, 0] = np.nan
        answer = diagnose(small(), (u, lost), found)
        assert answer.verdict == "faulty" and answer.best.labels[-1] == "sensor:y1 dead"
        assert answer.best.faults[-1].onset == 70 and answer.p_value == 0
        assert f"no reading in {COUNT - 70} samples from sample 70 on" in answer.status
        assert load_diagnosis(answer.save(tmp_path / "d.json")).to_dict() == answer.to_dict()
    assert answer.best.labels == ("sensor:y2", "sensor:y1 dead")
    several = diagnose(small(), Data([u, u], [y, lost], inputs=("u1", "u2"), outputs=("y1", "y2")), found)
    assert [one.detected for one in several] == [False, True]
    lost[1:, 0] = np.nan
    whole = diagnose(small(), (u, lost), found)
    assert whole.best.faults[0].onset_censored and "sensor:y1 dead" in str(whole)
    gaps = y.copy()
    gaps[50:59, 1] = gaps[80, 0] = np.nan
    assert diagnose(small(), (u, gaps), found).verdict == "healthy"


def test_a_sensor_at_its_limit_is_saturated(found):
    u, y = record(u=inputs(400))
    limit = np.quantile(y[:, 1], 0.7)
    answer = diagnose(small(), (u, np.column_stack([y[:, 0], np.minimum(y[:, 1], limit)])), found)
    assert answer.best.label == "sensor:y2 saturated" and answer.size[0] == limit
    assert "reading" in str(answer) and answer.best.faults[0].onset_interval[1] == answer.onset


@pytest.mark.slow
def test_a_sensor_that_stands_still_in_its_noise_and_noise_that_grows_are_named():
    faults = dictionary(small(), kinds=["bias", "frozen", "noise"])
    u, y = record(Fault.frozen("sensor:y1", 70))
    y = y.copy()
    y[70:, 0] += 0.1 * np.random.default_rng(0).standard_normal(COUNT - 70)
    answer = diagnose(small(), (u, y), faults)
    assert answer.best.label == "sensor:y1 frozen" and abs(answer.onset - 70) <= 2
    noise = diagnose(small(), record(Fault.sensor_noise("sensor:y2", 50, scale=3.0)), faults)
    assert noise.best.label == "sensor:y2 noise"
    low, high = noise.size_interval[0]
    assert low < np.sqrt(8 * 0.03) < high  # std added: the variance grows ninefold
    assert diagnose(small(), record(seed=5), faults).verdict == "healthy"


@pytest.mark.slow
def test_a_record_that_is_too_long_for_a_kind_says_so():
    faults = dictionary(small(), kinds=["bias", "frozen"], state_jump=False)
    u = inputs(1600)
    answer = diagnose(small(), (u, inject(small(), u, Fault.step("sensor:y2", 800, 0.5), seed=1)), faults)
    assert answer.best.label == "sensor:y2" and "cut it" in answer.untestable["sensor:y1 frozen"]


def test_an_outlier_does_not_become_a_step(found, limits):
    u, y = record()
    y = y.copy()
    y[60, 0] += 3.0
    plain = diagnose(small(), (u, y), found, thresholds=limits)
    assert plain.best.labels == ("sensor:y1 spike",) and plain.onset == 60
    assert plain.size[0] == pytest.approx(3.0, abs=1.0)
    robust = diagnose(small(), (u, y), found, thresholds=limits, robust=True)
    assert robust.verdict == "healthy" and "y1 at sample 60" in robust.status


def test_robust_estimates_see_through_outliers(found, limits):
    fault = Fault.step("sensor:y2", 50, 0.8)
    u, y = record(fault)
    clean = diagnose(small(), (u, y), found, thresholds=limits)
    wild = y.copy()
    wild[[20, 65, 90], [0, 1, 1]] += [4.0, -5.0, 4.0]
    robust = diagnose(small(), (u, wild), found, thresholds=limits, robust=True)
    assert robust.best.label == clean.best.label == "sensor:y2" and robust.onset == clean.onset
    assert robust.size[0] == pytest.approx(clean.size[0], abs=0.1)
    assert "y1 at sample 20, y2 at sample 65, y2 at sample 90" in robust.status
    same = diagnose(small(), (u, y), found, thresholds=limits, robust=True)
    assert same.best.label == "sensor:y2" and same.size[0] == pytest.approx(clean.size[0], abs=0.1)


def test_robust_takes_out_neighbours_and_spikes_that_are_candidates():
    u, y = record()
    wild = y.copy()
    wild[[30, 70, 71, 110], 0] += [30.0, -40.0, 20.0, 30.0]
    with_spikes = dictionary(small(), kinds=["bias", "spike"])
    answer = diagnose(small(), (u, wild), with_spikes, robust=True)
    assert answer.verdict == "healthy"
    assert "y1 at sample 30, y1 at sample 70, y1 at sample 71, y1 at sample 110" in answer.status


def test_a_second_fault_is_not_bounded_as_if_it_were_outliers(found, limits):
    data = record(Fault.step("sensor:y2", 40, 1.5), Fault.step("actuator:u1", 80, 2.0))
    plain, robust = (diagnose(small(), data, found, thresholds=limits, max_faults=2, robust=r) for r in (False, True))
    assert set(robust.best.labels) == set(plain.best.labels) == {"sensor:y2", "actuator:u1"}
    for first, second in zip(plain.best.faults, robust.best.faults):
        assert second.size[0] == pytest.approx(first.size[0], rel=0.1)


@pytest.mark.slow
def test_a_scheduled_change_of_the_plant_is_a_candidate():
    other = small().A.copy()
    other[0, 0] = 0.6
    faults = dictionary(small(), kinds=["bias"], schedules={"aged": Fault.schedule(A=other)})
    answer = diagnose(small(), record(Fault.schedule(60, A=other)), faults)
    assert answer.best.label == "process:aged schedule" and answer.size_interval[0, 0] < 1 < answer.size_interval[0, 1]
    assert "share of the change" in str(answer)
    assert answer.onset_interval[0] <= 60 <= answer.onset_interval[1]


# -- several faults ----------------------------------------------------------------------------------------------------


def test_two_faults_that_cross_are_searched_although_one_was_asked_for(found, limits):
    crossing = record(Fault.step("sensor:y2", 50, 0.9), Fault.step("actuator:u1", 56, 0.9))
    answer = diagnose(small(), crossing, found, thresholds=limits)
    assert answer.verdict == "faulty" and "two were searched" in answer.status
    assert {"sensor:y2", "actuator:u1"} in [set(a.labels) for a in answer.candidates]
    asked = diagnose(small(), crossing, found, thresholds=limits, max_faults=2)
    assert set(asked.best.labels) == {"sensor:y2", "actuator:u1"} and [f.onset for f in asked.best.faults] == sorted(
        f.onset for f in asked.best.faults)
    for fault in asked.best.faults:
        assert fault.size_interval[0, 0] < 0.9 < fault.size_interval[0, 1]


def test_one_fault_stays_one_when_two_are_allowed(found, limits):
    answer = diagnose(small(), record(Fault.step("sensor:y2", 60, 0.6)), found, thresholds=limits, max_faults=2)
    assert answer.best.labels == ("sensor:y2",)


@pytest.mark.parametrize("method", ["sparse", "sparse+polish"])
def test_the_programme_and_the_exact_search_agree(found, limits, method):
    data = record(Fault.step("sensor:y2", 40, 0.9), Fault.step("actuator:u1", 80, 0.9))
    exact = diagnose(small(), data, found, thresholds=limits, max_faults=2)
    found_so = diagnose(small(), data, found, thresholds=limits, max_faults=2, method=method)
    assert found_so.method == method and found_so.certificate.basis == "duality gap"
    assert found_so.certificate.value < 1e-6
    assert set(found_so.best.labels) == set(exact.best.labels)


def test_an_answer_without_a_certificate_is_not_called_the_best(found, limits):
    def sloppy(program, settings):
        from optid.backends import find

        answer = find("clarabel").run(program, replace(settings, accuracy=1e-2))
        return replace(answer, values={name: 0.7 * np.asarray(value) for name, value in answer.values.items()})

    data = record(Fault.step("sensor:y2", 60, 0.9))
    answer = diagnose(small(), data, found, thresholds=limits, method="sparse+polish", solver=sloppy)
    assert answer.detected and answer.best is None and answer.candidates
    assert "ot certified" in answer.status or "no point" in answer.status


def test_bounds_of_the_noise_prove_a_large_fault_and_not_health(found, limits):
    data = record(Fault.step("sensor:y2", 50, 3.0))
    answer = diagnose(small(), data, found, thresholds=limits, method="set")
    assert answer.certificate.basis == "infeasible healthy" and answer.certificate.value > 1
    assert answer.certificate.parity_vector.shape == (COUNT, 2) and "sensor:y2" in [a.label for a in answer.candidates]
    calm = diagnose(small(), record(), found, thresholds=limits, method="set")
    assert calm.verdict == "healthy" and "No proof" in calm.status
    faint = diagnose(small(), record(Fault.step("sensor:y2", 50, 0.7)), found, thresholds=limits, method="set")
    assert faint.verdict == "faulty" and faint.certificate.basis == "exhaustive" and "No proof" in faint.status


# -- edges of the record -------------------------------------------------------------------------------------------


def test_at_the_edge_of_the_record_only_the_interval_of_the_size_is_reported(found, limits):
    early = diagnose(small(), record(Fault.step("sensor:y2", 2, 0.8)), found, thresholds=limits).best.faults[0]
    assert early.onset_censored and early.onset_interval[0] == 0 and np.isnan(early.size[0])
    assert early.size_interval[0, 0] < 0.8 < early.size_interval[0, 1] and "at or before" in str(early)
    late = diagnose(small(), record(Fault.step("sensor:y2", COUNT - 3, 2.0)), found, thresholds=limits).best.faults[0]
    assert not late.onset_censored and np.isnan(late.size[0]) and "between" in str(late)


@pytest.mark.slow
def test_missing_readings_and_several_experiments(found):
    fault = Fault.step("sensor:y2", 60, 0.8)
    u, y = record(fault)
    holes = y.copy()
    holes[[10, 30, 61, 62, 90], [0, 1, 1, 0, 1]] = np.nan
    answer = diagnose(small(), (u, holes), found)
    assert answer.best.label == "sensor:y2" and abs(answer.onset - 60) <= 2
    longer = inputs(150, 3)
    several = Data([u, longer], [holes, inject(small(), longer, seed=4)])
    first, second = diagnose(small(), several, found)
    assert first.to_dict() == answer.to_dict() and second.verdict == "healthy" and second.window == 150


# -- the healthy model and its noise ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_healthy_record_with_other_noise_is_refused(found, limits):
    long = inputs(600, 7)
    sound = Data(long, inject(small(), long, seed=8))
    faulty = record(Fault.step("sensor:y2", 60, 0.8))
    assert diagnose(small(), faulty, found, thresholds=limits, healthy=sound).best.label == "sensor:y2"
    loud = replace(small(), noise=replace(small().noise, Q=4 * small().noise.Q, R=4 * small().noise.R,
                                          innovation=4 * small().noise.innovation))
    noisier = Data(long, inject(loud, long, seed=8))
    with pytest.raises(DataError, match="rescale=True"):
        diagnose(small(), faulty, found, healthy=noisier)
    rescaled = diagnose(small(), record(model=loud), found, healthy=noisier, rescale=True)
    assert rescaled.verdict == "healthy"
    assert diagnose(small(), record(model=loud, seed=3), found).verdict != "healthy"
    other = replace(small(), A=small().A * 0.6)
    with pytest.raises(DataError, match="not white"):
        diagnose(other, faulty, healthy=sound)


@pytest.mark.slow
def test_swapped_outputs_and_units_that_jump_are_named(found):
    long = inputs(300, 7)
    y = inject(small(), long, seed=8)
    jump = y.copy()
    jump[150:, 1] *= 1000
    refused(
        (DataError, "y1, y2 look swapped", lambda: diagnose(small(), record(), found, healthy=(long, y[:, ::-1]))),
        (DataError, "look swapped", lambda: diagnose(small(), (long, y[:, ::-1]), found)),
        (DataError, "output 'y2' seems to change at sample 150", lambda: diagnose(small(), (long, jump), found)),
    )


def test_the_uncertainty_of_an_identified_model_counts_or_is_refused(found, limits):
    long = inputs(300, 7)
    origin = Data(long, inject(small(), long, seed=8))
    faulty = record(Fault.step("sensor:y2", 60, 0.8))
    exact = diagnose(small(), faulty, found, thresholds=limits, model_uncertainty="ignore")
    unsure = diagnose(small(), faulty, found, model_uncertainty=model_uncertainty(small(), origin))
    assert unsure.best.label == "sensor:y2"
    widths = [float(np.diff(answer.size_interval[0])[0]) for answer in (exact, unsure)]
    assert widths[1] > widths[0]

    class Fitted:
        """What a fit looks like from here."""

        model, data = small(), origin

    used = diagnose(Fitted(), faulty, found)
    assert "uncertainty of the identified model" in used.status
    np.testing.assert_allclose(used.size_interval, unsure.size_interval, rtol=1e-9)


def test_where_outputs_leave_the_identified_range_the_model_is_less_certain(found, monkeypatch):
    long = inputs(300, 7)
    known = model_uncertainty(small(), Data(long, inject(small(), long, seed=8)))
    low, high = known.levels
    faulty = record(Fault.step("sensor:y2", 60, 2 * high[1]))
    inside = replace(known, levels=10 * known.levels)
    sure, rough = (diagnose(small(), faulty, found, model_uncertainty=one) for one in (inside, known))
    assert "outside" not in sure.status and "y2 is outside the identified range" in rough.status
    assert sure.best.label == rough.best.label == "sensor:y2"
    widths = [float(np.diff(answer.size_interval[0])[0]) for answer in (sure, rough)]
    assert widths[1] > widths[0]
    assert len(rough.candidates) >= len(sure.candidates)

    y = np.tile((low + high) / 2, (40, 1))
    y[10, 0], y[20:25, 1], y[22, 0] = 9 * high[0], high[1] + 3 * (high[1] - low[1]) / 2, np.nan
    expected = np.ones(y.shape)
    expected[21:24, 1] = 4.0  # an outlier and a missing reading are at no distance
    np.testing.assert_allclose(known.distance(y), expected)
    assert [note.partition(" in ")[2] for note in known.output_range_notes(y)] == [
        "3 samples, first in sample 21: the model is less certain there."]
    monkeypatch.setattr(nuisance, "BEYOND", np.inf)  # the same likelihoods, at their full power
    full = diagnose(small(), faulty, found, model_uncertainty=known)
    assert rough.certificate.runner_up_margin == pytest.approx(full.certificate.runner_up_margin / 2)


# -- bad input -------------------------------------------------------------------------------------------------------


def test_bad_records_are_named(found):
    u, y = record()
    holes, infinite = u.copy(), y.copy()
    holes[17, 1], infinite[5, 0] = np.nan, np.inf
    refused(
        (DataError, "input 'u2' is missing at sample 17", lambda: diagnose(small(), (holes, y), found)),
        (DataError, "y1.*5|5.*y1", lambda: diagnose(small(), (u, infinite), found)),
        (DataError, "channel|column|input", lambda: diagnose(small(), (u[:, :1], y), found)),
        (DataError, "samples", lambda: diagnose(small(), (u[:7], y[:7]), found)),
        (DataError, "sampled every", lambda: diagnose(small(), Data(u, y, dt=0.5), found)),
        (DataError, "outputs", lambda: diagnose(small(), Data(u, y, outputs=["y2", "y1"]), found)),
        (DataError, "pair", lambda: diagnose(small(), (u, None), found)),
    )


def test_bad_arguments_are_named(found, limits):
    data = record()
    refused(
        *((StructureError, words, lambda how=how: diagnose(small(), data, **({"faults": found} | how)))
          for how, words in (
            ({"false_alarm": 0.0}, "false_alarm"), ({"coverage": 1.0}, "coverage"), ({"method": "exakt"}, "exact"),
            ({"max_faults": 0}, "max_faults"), ({"max_faults": 3}, "sparse\\+polish"), ({"faults": "b"}, "dictionary"),
            ({"rescale": True}, "healthy="), ({"model_uncertainty": "use"}, "covariance of the model"),
            ({"model_uncertainty": "perhaps"}, "'ignore'"))),
        (StructureError, "another model", lambda: diagnose(replace(small(), A=small().A * 0.9), data, found)),
        (StructureError, "windows of 120 samples; the record has 100",
         lambda: diagnose(small(), (data[0][:100], data[1][:100]), found, thresholds=limits)),
        (DataError, "simulated windows", lambda: diagnose(small(), data, found, false_alarm=1e-9)),
        (StructureError, "noise covariances", lambda: diagnose(replace(small(), noise=None), data)),
        (StructureError, "state-space model", lambda: diagnose("model.json", data)),
    )


def test_collinear_faults_are_answered_as_a_group():
    model = replace(small(), D=np.array([[0.0, 0.0], [0.0, 0.3]]))
    with pytest.warns(DataWarning, match="same signature"):
        faults = dictionary(model, process={"B1": model.B[:, 0]}, state_jump=False)
    u, y = record(Fault.step("actuator:u1", 60, 0.8), model=model)
    answer = diagnose(model, (u, y), faults)
    assert answer.best.label == "actuator:u1 | process:B1"


# -- presentation ----------------------------------------------------------------------------------------------------


def test_the_course_of_the_fault_is_estimated_on_request(found, limits, tmp_path):
    answer = diagnose(small(), record(Fault.ramp("sensor:y2", 60, 0.03)), found, thresholds=limits)
    assert set(answer.best.labels) == {"sensor:y2"}  # two steps in place of the drift, which is no candidate
    course = answer.profile("trend").course
    truth = 0.03 * np.maximum(np.arange(len(course)) - 59, 0)
    assert np.linalg.norm(course - truth) < 0.15 * np.linalg.norm(truth)
    healthy, stored = diagnose(small(), record(), found, thresholds=limits), load_diagnosis(answer.save(tmp_path / "d"))
    refused((StructureError, "names none", healthy.profile), (StructureError, "read from a file", stored.profile))


def test_every_verdict_has_words_and_a_picture(found, limits):
    answers = [
        diagnose(small(), record(), found, thresholds=limits),
        diagnose(small(), record(Fault.step("sensor:y2", 60, 0.6)), found, thresholds=limits),
        diagnose(small(), record(Fault.frozen("sensor:y1", 60)), found),
    ]
    for answer in answers:
        assert max(map(len, str(answer).splitlines())) <= 80
        assert answer.explain().endswith(".") and isinstance(answer.plot(), Figure)
        assert answer.to_dict() == type(answer).from_dict(answer.to_dict()).to_dict()


def test_frames_and_the_default_dictionary(found):
    pandas = pytest.importorskip("pandas")
    u, y = record(Fault.step("sensor:y2", 60, 0.8))
    frame = pandas.DataFrame(np.hstack([u, y]), columns=["u1", "u2", "y1", "y2"])
    answer = diagnose(small(), frame)
    assert answer.best.label == "sensor:y2"
    assert set(answer.evidence.labels) >= {"actuator:u1 loss", "sensor:y1 spike", "state"}
