"""The verdict on a model, and the advice that goes with it, on records with known mistakes."""

import numpy as np
import pytest

import optid
from optid.identify.verdict import FAIR, GOOD, POOR, USELESS, verdict


def simulated(samples=600, *, delay=1, order=2, f=lambda u: u, noise=0.02, seed=0, offset=0.0, coloured=False):
    """A second-order plant (poles 0.7 +- 0.2i, or 0.8) after a static function of a white input."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2, 2, samples)
    a = np.poly([0.7 + 0.2j, 0.7 - 0.2j]).real if order == 2 else np.array([1.0, -0.8])
    drive, x = f(u), np.zeros(samples)
    for k in range(samples):
        x[k] = (drive[k - delay] if k >= delay else 0.0) - sum(
            a[i] * x[k - i] for i in range(1, len(a)) if k >= i)
    e = rng.normal(size=samples)
    if coloured:
        e = np.convolve(e, 0.9 ** np.arange(60))[:samples]
    return u, x + offset + noise * x.std() * e / e.std()


def told(fit):
    return [(advice.sentence, advice.step) for advice in fit.advice]


def test_models_of_the_true_structure_are_good_and_need_no_advice():
    """One test of the structure in a hundred rejects what is true; it does not count in the verdict."""
    fits = [optid.fit(optid.Data(*simulated(seed=seed)), "oe.exact", na=2, nb=1, nk=1) for seed in range(3)]
    assert all(fit.verdict.word == GOOD for fit in fits)
    failed = [finding.name for fit in fits for finding in fit.verdict.failed]
    assert len(failed) <= 1 and set(failed) <= {"structure"}
    assert "simulation fit" in str(fits[1].verdict) and "PASS" in str(fits[1].verdict)
    assert all(told(fit) == [] for fit in fits if not fit.verdict.failed)


def test_the_verdict_does_not_depend_on_units():
    u, y = simulated(noise=0.3)
    words = [optid.fit(optid.Data(a * u, b * y + c), "arx", na=2, nb=1, nk=1).verdict
             for a, b, c in ((1.0, 1.0, 0.0), (1e5, 1e-6, 0.0), (1e-4, 1e3, 1e4))]
    assert len({v.word for v in words}) == 1
    assert [v.score for v in words] == pytest.approx([words[0].score] * 3, abs=1e-3)


def test_words_follow_the_numbers():
    data = optid.Data(*simulated(noise=0.5))
    model = optid.fit(data, "oe.exact", na=2, nb=1, nk=1).model
    assert verdict(model, data).word == POOR  # half the output is noise
    assert verdict(model, data, [60.0] * 4, 60.0).word == POOR
    clean = optid.Data(*simulated(noise=0.01))
    model = optid.fit(clean, "oe.exact", na=2, nb=1, nk=1).model
    assert verdict(model, clean, [90.0, 91.0, 76.0, 92.0], 88.0).word == GOOD
    assert verdict(model, clean, [90.0, 91.0, 70.0, 92.0], 88.0).word == FAIR  # its worst block
    assert verdict(model, clean, [80.0] * 4, 80.0).word == POOR  # 18 points below the record itself
    assert verdict(model, clean, [10.0] * 4, 10.0).word == USELESS


def test_a_wrong_delay_is_useless_whatever_is_proved():
    fit = optid.fit(optid.Data(*simulated(delay=7)), "hammerstein_arx.exact", na=1, nb=2, basis="polynomial:2")
    assert fit.solution.proof and fit.verdict.word in (POOR, USELESS)
    assert any(part.name == "delay" for part in fit.verdict.failed)
    assert "--nk 7" in [step for _, step in told(fit)] and "raises the simulation fit from" in fit.advice[0].sentence


@pytest.mark.sampled(2)
@pytest.mark.parametrize("plant, formulation, arguments, steps", [
    ({"delay": 1}, "oe.exact", {"nb": 2, "nk": 4}, ("--nk 0", "--nk 1")),
    ({}, "oe.exact", {"na": 1}, ("--na 2",)),
    ({"offset": 30.0}, "oe.exact", {"offset": False}, ("--set offset=true",)),
    ({"f": lambda u: np.maximum(u, 0.0) ** 2}, "oe.exact", {}, ("--formulation hammerstein_oe.exact",)),
    ({"noise": 0.4, "samples": 2000}, "arx", {}, ("--formulation oe.exact",)),
], ids=["too large a delay", "too low an order", "a missing constant", "a missing function", "output noise"])
def test_what_is_wrong_with_a_structure_is_named(plant, formulation, arguments, steps):
    fit = optid.fit(optid.Data(*simulated(**plant)), formulation, **{"na": 2, "nb": 1, "nk": 1, **arguments})
    assert any(step.startswith(steps) for _, step in told(fit))
    assert any(part.name in ("one-step minus simulation fit", "simulation fit") for part in fit.verdict.parts)


def test_a_needless_function_is_named():
    fit = optid.fit(optid.Data(*simulated()), "hammerstein_oe.exact", na=2, nb=1, nk=1, basis="triangular:6")
    assert ("a linear function of the input fits as well", "--formulation oe.exact") in told(fit)


def test_swapped_columns_are_named():
    u, y = simulated()
    fit = optid.fit(optid.Data(y, u), "arx", na=2, nb=2)
    assert any("swapped" in sentence for sentence, _ in told(fit))
    assert not any("swapped" in sentence for sentence, _ in told(optid.fit(optid.Data(u, y), "arx", na=2, nb=2)))


@pytest.mark.parametrize("channel", ["u", "y"])
def test_units_that_change_within_the_record_are_named(channel):
    u, y = simulated()
    changed = {"u": u.copy(), "y": y.copy()}
    changed[channel][300:] *= 1000
    fit = optid.fit(optid.Data(changed["u"], changed["y"]), "arx", na=2, nb=2)
    found = [sentence for sentence, _ in told(fit) if "times as much" in sentence]
    assert found and f"'{channel}'" in found[0] and "sample 3" in found[0].replace("sample 2", "sample 3")


def test_a_gain_that_changes_within_the_record_is_named():
    u, y = simulated()
    y[300:] *= -1.0  # of the same size, so that no channel shows it
    fit = optid.fit(optid.Data(u, y), "arx", na=2, nb=1, nk=1)
    assert any("the plant changes within the record" in sentence for sentence, _ in told(fit))


def test_outliers_are_named():
    u, y = simulated()
    y[[50, 200, 333]] += 100 * y.std()
    with pytest.warns(optid.errors.DataWarning, match="outlier"):
        fit = optid.fit(optid.Data(u, y), "arx", na=2, nb=1, nk=1)
    assert any("huber" in step for _, step in told(fit))


def test_samples_outside_the_range_of_a_function_are_named():
    u, y = simulated(f=np.tanh)
    with pytest.warns(optid.errors.DataWarning, match="outside the interval"):
        fit = optid.fit(optid.Data(u, y), "hammerstein_oe.exact", na=2, nb=1, nk=1,
                        basis=optid.Triangular(6, interval=(-1.0, 1.0)))
    assert any("interval=-" in step for _, step in told(fit))
    assert any("range" in part.name for part in fit.verdict.failed)


def test_a_record_too_short_for_its_coefficients_is_named():
    u, y = simulated(60)
    fit = optid.fit(optid.Data(u, y), "arx", na=4, nb=6, nk=1)
    assert any("few for" in sentence for sentence, _ in told(fit))


def test_there_are_at_most_five_steps_and_none_for_a_stream(tmp_path):
    u, y = simulated(delay=7, noise=0.4, f=lambda u: np.maximum(u, 0) ** 2)
    y[[50, 200]] += 100 * y.std()
    with pytest.warns(optid.errors.DataWarning):
        fit = optid.fit(optid.Data(u, y), "arx", na=1, nb=1)
    assert 1 <= len(fit.advice) <= 5
    np.savetxt(tmp_path / "r.csv", np.column_stack([u, y]), delimiter=",", header="u,y", comments="")
    stream = optid.open_stream(tmp_path / "r.csv")
    fit = optid.fit(stream, "arx", na=1, nb=1)
    assert fit.advice == () and fit.verdict is None


def test_a_fit_is_repeated_with_changes():
    fit = optid.fit(optid.Data(*simulated()), "arx", na=1, nb=1)
    again = fit.refit(na=2)
    assert again.model.na == 2 and fit.model.na == 1 and again.formulation == "arx"
    other = fit.refit(formulation="oe.exact", nk=1)
    assert other.formulation == "oe.exact" and other.model.nk == (1,)
