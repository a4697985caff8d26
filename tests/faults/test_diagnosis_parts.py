"""Parts of a diagnosis: marginal likelihoods, mixtures, what is left, files, each against an independent route."""

import json
from dataclasses import replace

import numpy as np
import pytest
from fault_plants import LOAD, refused
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import norm
from test_fault_injection import small

from optid.errors import ModelFileError, StructureError
from optid.faults import Certificate, Diagnosis, Estimate, FaultAnswer, dictionary, load_diagnosis, scan, thresholds
from optid.faults.diagnosis.answers import Remaining
from optid.faults.diagnosis.leftover import alarm_probability, remainder_test
from optid.faults.diagnosis.posterior import (
    SPREADS,
    marginal,
    mixture_intervals,
    onset_range,
    several,
    single,
    smallest_set,
)
from optid.faults.search.subsets import best_subsets
from optid.faults.search.sweeps import sweep
from optid.faults.whitening import Whitened


@pytest.fixture(scope="module")
def found():
    return dictionary(small(), process={"load": LOAD}, kinds=["bias", "loss"])


def noise(found, count=60, seed=0):
    """A window of white innovations."""
    r = np.random.default_rng(seed).standard_normal((count, 2))
    return Whitened(r, r, np.ones((count, 2), dtype=bool), found.predictor, ("y1", "y2"))


# -- posterior ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@given(st.floats(0.0, 60.0), st.floats(0.05, 20.0))
def test_the_marginal_likelihood_is_the_integral_over_the_magnitude(energy, gram):
    """l = b^2 / G; the integrand is exp(b nu - G nu^2 / 2) N(nu; 0, g / G)."""
    b = np.sqrt(energy * gram)

    def integral(g):
        width = np.sqrt(g / gram)
        centre, spread = b / gram * g / (1 + g), np.sqrt(g / (1 + g) / gram)
        value = quad(lambda nu: np.exp(b * nu - gram * nu**2 / 2 - energy / 2) * norm.pdf(nu, 0, width),
                     centre - 12 * spread, centre + 12 * spread, limit=200)[0]
        return value

    expected = np.mean([integral(g) for g in SPREADS])
    assert np.exp(float(marginal(np.array([energy]), 1)[0]) - energy / 2) == pytest.approx(expected, rel=1e-6)


def test_more_magnitudes_are_paid_for():
    energies = np.array([30.0])
    values = [float(marginal(energies, d)[0]) for d in (1, 2, 4)]
    assert values[0] > values[1] > values[2]
    assert marginal(np.array([0.0]), 1)[0] < 0 < marginal(np.array([40.0]), 4)[0]


def test_the_smallest_set_holds_the_coverage_with_fewest_members():
    posterior = np.array([0.04, 0.6, 0.3, 0.06])
    assert smallest_set(posterior, 0.95).tolist() == [1, 2, 3]
    assert smallest_set(posterior, 0.6).tolist() == [1]
    assert smallest_set(posterior, 0.9999).tolist() == [1, 2, 3, 0]


def test_two_candidates_together_are_dense_least_squares(found):
    whitened = noise(found)
    u = np.repeat(np.random.default_rng(1).uniform(-1, 1, (12, 2)), 5, axis=0)
    search = scan(found, whitened, u)
    limits = thresholds(found, 60, u=u, draws=5000)
    best = best_subsets(search, limits).best_of(2)
    candidates = [found[label] for label in best.labels]
    together = several(search, candidates, best.onsets, 4)
    assert together.energies.max() == pytest.approx(best.energy, rel=1e-8)
    for row in (0, len(together.logs) // 2, len(together.logs) - 1):
        G = np.concatenate([search.signature(c, int(k)) for c, k in zip(candidates, together.onsets[row])], axis=2)
        G = G.reshape(120, -1)
        nu, *_ = np.linalg.lstsq(G, whitened.r.ravel(), rcond=None)
        np.testing.assert_allclose(together.sizes[row], nu, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(together.covariances[row], np.linalg.inv(G.T @ G), rtol=1e-6, atol=1e-9)
        assert together.energies[row] == pytest.approx(whitened.r.ravel() @ G @ nu, rel=1e-8)


def test_the_same_candidate_twice_is_counted_in_one_order(found):
    whitened = noise(found)
    search = scan(dictionary(small(), state_jump=False), whitened)
    candidate = search.dictionary.candidates[0]
    twice = several(search, [candidate, candidate], [20, 30], 8)
    assert np.all(twice.onsets[:, 0] < twice.onsets[:, 1])


def test_a_share_lost_below_zero_speaks_against_a_loss(found):
    u = np.repeat(np.random.default_rng(1).uniform(-1, 1, (12, 2)), 5, axis=0)
    loss = found["actuator:u1 loss"]
    trace = found.signature(loss, 60, 20, u=u)[:, :, 0]
    evidence = []
    for share in (0.4, -0.4):
        whitened = noise(found)
        search = scan(found, replace(whitened, r=whitened.r + share * trace), u)
        evidence.append(single(search, loss).log_evidence - search.statistic[search.index(loss)].max() / 2)
    assert evidence[0] > evidence[1] + 2


# -- intervals ---------------------------------------------------------------------------------------------------------


@given(st.integers(1, 6), st.floats(0.5, 0.999), st.integers(0, 10_000))
def test_intervals_cut_equal_tails_from_the_mixture(parts, coverage, seed):
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.ones(parts))
    means, stds = rng.normal(size=(parts, 2)) * 5, rng.uniform(0.1, 3, (parts, 2))
    found = mixture_intervals(weights, means, stds, coverage)
    for d in range(2):
        for value, tail in zip(found[d], ((1 - coverage) / 2, (1 + coverage) / 2)):
            def excess(x, d=d, tail=tail):
                return weights @ norm.cdf(x, means[:, d], stds[:, d]) - tail

            expected = brentq(excess, -200, 200)
            assert value == pytest.approx(expected, abs=1e-6)


def test_an_interval_of_what_nothing_is_known_of_is_everything():
    found = mixture_intervals(np.ones(1), np.array([[1.0, 2.0]]), np.array([[0.0, 1.0]]), 0.95)
    assert found[0].tolist() == [-np.inf, np.inf] and found[1] == pytest.approx([2 - 1.96, 2 + 1.96], abs=1e-3)


def test_the_onset_interval_is_the_hull_of_the_most_probable_onsets():
    onsets, weights = np.array([10, 11, 12, 30]), np.array([0.2, 0.5, 0.26, 0.04])
    assert onset_range(onsets, weights, 0.95, 11) == (10, 12)
    assert onset_range(onsets, weights, 0.99, 11) == (10, 30)
    assert onset_range(onsets, weights, 0.5, 30) == (11, 30)


def test_intervals_hold_the_size_although_the_onset_is_searched():
    """In signature space, many windows: coverage at nominal 90 %."""
    faults = dictionary(small(), sensors=["y1"], actuators=[], state_jump=False)
    rng, inside = np.random.default_rng(5), 0
    candidate = faults.candidates[0]
    size = 6.0 / np.linalg.norm(faults.signature(candidate, 60, 30))
    runs = 400
    for run in range(runs):
        onset = int(rng.integers(15, 45))
        white = noise(faults, seed=run)
        search = scan(faults, replace(white, r=white.r + size * faults.signature(candidate, 60, onset)[:, :, 0]))
        course = single(search, candidate)
        low, high = mixture_intervals(
            course.weights, course.sizes, np.sqrt(course.covariances[:, :, 0]), 0.9)[0]
        inside += low <= size <= high
    assert abs(inside / runs - 0.9) < 0.045


# -- what is left ------------------------------------------------------------------------------------------------------


def test_the_tests_of_the_rest_keep_their_level(found):
    p_values = np.array([
        remainder_test(noise(found, 100, seed), noise(found, 100, seed).r, 0).p_value for seed in range(1500)])
    for level in (0.02, 0.1):
        assert np.mean(p_values <= level) < level + 3 * np.sqrt(level / 1500)


def test_a_line_in_the_rest_is_found_with_its_frequency_and_direction(found):
    white = noise(found, 200)
    tone = np.outer(np.sin(2 * np.pi * 0.2 * np.arange(200)), [1.2, 0.0])
    rest = replace(white, r=white.r + tone)
    seen = remainder_test(rest, rest.r, 0)
    assert seen.test == "period" and seen.p_value < 1e-6
    assert seen.frequency == pytest.approx(0.2, abs=0.006) and seen.share > 0.2
    along = np.linalg.solve(found.predictor.root, [1.0, 0.0])
    assert abs(seen.direction @ along) / np.linalg.norm(along) > 0.98
    assert np.linalg.norm(seen.direction) == pytest.approx(1)


def test_a_burst_in_the_rest_is_found(found):
    white = noise(found, 300)
    r = white.r.copy()
    r[120:123] += [3.0, -3.5]
    assert remainder_test(white, r, 0).test == "burst"
    assert remainder_test(white, r, 0).p_value < 1e-4


def test_the_p_value_of_an_alarm_is_its_level_at_the_threshold_and_fits_a_simulation():
    assert alarm_probability(0.0, 0.01) == pytest.approx(0.01)
    faults = dictionary(small(), state_jump=False)
    windows = np.random.default_rng(1).standard_normal((10_000, 60, 2))
    gains = (sweep(faults, 60).largest(windows) - thresholds(faults, 60, 0.02, draws=10_000).q).max(axis=1)
    for level in (0.005, 0.02, 0.08):
        share = np.mean([alarm_probability(float(gain), 0.02) <= level for gain in gains])
        assert abs(share - level) < 0.2 * level + 3 * np.sqrt(level / 10_000)


# -- files -------------------------------------------------------------------------------------------------------------


def example(kind="loss", **changes):
    """A diagnosis by hand."""
    candidate = dictionary(small(), kinds=["bias", "loss"])["actuator:u1 loss"]
    fault = Estimate(candidate.label, candidate.name, kind, candidate, 100, (98, 103), False, np.array([0.5]),
                     np.array([[0.4, 1.1]]), np.array([[0.01]]), 12.0)
    answer = FaultAnswer((fault,), 0.97, 101.25)
    how = dict(
        verdict="faulty", detected=True, best=answer, candidates=(answer,), p_value=1e-12,
        certificate=Certificate("exhaustive", 101.25, float("inf")), untestable={"actuator:u2 loss": "no excitation"},
        window=200, false_alarm=0.01, coverage=0.95, method="exact", status="", model="Linear state-space model",
        outputs=("y1", "y2"), dt=0.5,
        remaining=Remaining(401.0, 399, 0.7, "energy", np.array([0.6, 0.8]), 0.1, 0.02),
    )
    return Diagnosis(**(how | changes))


def test_a_saved_diagnosis_is_read_back_to_the_last_bit(tmp_path):
    original = example()
    again = load_diagnosis(original.save(tmp_path / "d.json"))
    assert again.to_dict() == original.to_dict() and str(again) == str(original)
    fault = again.best.faults[0]
    np.testing.assert_array_equal(fault.candidate.into_state, original.best.faults[0].candidate.into_state)
    assert again.best is again.candidates[0] and again.unique and again.certificate.runner_up_margin == np.inf
    assert again.onset == 100 and again.onset_interval == (98, 103) and again.size[0] == 0.5


def test_numbers_that_json_does_not_know_survive(tmp_path):
    fault = replace(example().best.faults[0], size=np.array([np.nan]), size_interval=np.array([[-np.inf, np.inf]]))
    answer = FaultAnswer((fault,), 1.0, float("inf"))
    again = load_diagnosis(example(best=answer, candidates=(answer,)).save(tmp_path / "d.json"))
    assert np.isnan(again.size[0]) and again.size_interval[0].tolist() == [-np.inf, np.inf]
    vector = np.arange(6.0).reshape(3, 2)
    proof = Certificate("infeasible healthy", 1.3, 2.0, vector)
    again = load_diagnosis(example(certificate=proof).save(tmp_path / "e.json"))
    np.testing.assert_array_equal(again.certificate.parity_vector, vector)


def test_damaged_files_are_named(tmp_path):
    path = example().save(tmp_path / "d.json")
    text = path.read_text()
    for damaged, words in (
        ("", "empty"), (text[: len(text) // 2], "truncated"), ("[1, 2]", "not a diagnosis"), ("abc", "not a diagnosis"),
        (text.replace('"version": 1', '"version": 7'), "version 7"), (text.replace('"onset"', '"on"'), "lacks"),
        (text.replace('"best": 0', '"best": 3'), "damaged"), (text.replace('"faulty"', '"broken"'), "damaged"),
    ):
        path.write_text(damaged)
        with pytest.raises(ModelFileError, match=words):
            load_diagnosis(path)
    with pytest.raises(FileNotFoundError):
        load_diagnosis(tmp_path / "none.json")
    small().save(path)
    with pytest.raises(ModelFileError, match="not a diagnosis"):
        load_diagnosis(path)
    assert json.loads(path.read_text())["format"] == "optid model"


def test_impossible_diagnoses_are_refused():
    refused(
        (StructureError, "verdict", lambda: example(verdict="fine")),
        (StructureError, "candidates", lambda: example(candidates=())),
        (StructureError, "record is not in", lambda: example().plot()),
    )


def test_words_stay_within_eighty_columns_and_cut_shares_to_what_is_possible():
    text = str(example(status="A sentence that is rather long. " * 5))
    assert max(map(len, text.splitlines())) <= 80
    assert "share lost 0.5 (0.4 to 1)" in text and "98 to 103" in text
    assert "cannot judge actuator:u2 loss" in example().explain()
