import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from optid import signals
from optid.errors import StructureError

MAKERS = {
    "multisine": lambda n, lo, hi: signals.multisine(n, lo, hi),
    "prbs": lambda n, lo, hi: signals.prbs(n, lo, hi, hold=2),
    "sinusoid": lambda n, lo, hi: signals.sinusoid(n, lo, hi, frequency=0.07, phase=1.0),
    "chirp": lambda n, lo, hi: signals.chirp(n, lo, hi, f0=0.01, f1=0.3),
    "band_limited_noise": lambda n, lo, hi: signals.band_limited_noise(n, lo, hi, cutoff=0.2),
    "uniform_levels": lambda n, lo, hi: signals.uniform_levels(n, lo, hi, hold=3, levels=7),
    "steps": lambda n, lo, hi: signals.steps(n, lo, hi, levels=4),
}


@pytest.mark.parametrize("name", MAKERS)
@given(n=st.integers(20, 400), low=st.floats(-50, 50), width=st.floats(0.1, 100))
def test_every_signal_has_its_length_and_stays_in_range(name, n, low, width):
    u = MAKERS[name](n, low, low + width)
    assert u.shape == (n,) and u.dtype == np.float64 and np.isfinite(u).all()
    assert u.min() >= low - 1e-9 * (1 + abs(low) + width) and u.max() <= low + width + 1e-9 * (1 + abs(low) + width)


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize(("arguments", "part"), [((0, -1, 1), "n must.*got 0"), ((9.5, -1, 1), "n must.*got 9.5"),
                                                 ((50, 1, 1), "low must be below high"),
                                                 ((50, 0, np.inf), "low must be below high")])
def test_every_signal_refuses_bad_length_and_range(name, arguments, part):
    refuses(StructureError, part, MAKERS[name], *arguments)


def test_random_signals_depend_on_the_seed_alone():
    for make in (
        lambda seed: signals.multisine(64, phases="random", seed=seed),
        lambda seed: signals.prbs(200, seed=seed),
        lambda seed: signals.band_limited_noise(64, cutoff=0.1, seed=seed),
        lambda seed: signals.uniform_levels(64, seed=seed),
    ):
        np.testing.assert_array_equal(make(3), make(3))
        assert not np.array_equal(make(3), make(4))


@pytest.mark.parametrize("phases", ["schroeder", "random"])
@pytest.mark.parametrize("crest_steps", [0, 50])
def test_multisine_has_the_lines_and_amplitudes_asked_for(phases, crest_steps):
    lines = np.array([1, 4, 5, 9, 20])
    amplitudes = np.array([1.0, 2.0, 0.5, 1.5, 3.0])
    u = signals.multisine(600, -2, 3, lines=lines, spectrum=amplitudes, phases=phases, periods=3,
                          crest_steps=crest_steps)
    np.testing.assert_array_equal(u[:200], u[200:400])
    spectrum = np.abs(np.fft.rfft(u[:200]))
    np.testing.assert_allclose(spectrum[lines] / spectrum[1], amplitudes, rtol=1e-9)
    others = np.delete(np.arange(101), [0, *lines])
    assert spectrum[others].max() < 1e-9 * spectrum.max()
    assert u.min() == pytest.approx(-2) and u.max() == pytest.approx(3)


def test_multisine_band_and_spectrum_are_in_frequency():
    u = signals.multisine(1000, dt=0.01, band=(1.0, 5.0), spectrum=lambda f: 1 / f)
    spectrum = np.abs(np.fft.rfft(u))
    f = np.fft.rfftfreq(1000, 0.01)
    inside = (f >= 1.0) & (f <= 5.0)
    np.testing.assert_allclose(spectrum[inside] * f[inside], spectrum[inside][0] * 1.0, rtol=1e-8)
    assert spectrum[~inside][1:].max() < 1e-9 * spectrum.max()


def test_schroeder_and_clipping_lower_the_crest_factor():
    random = np.median([signals.crest_factor(signals.multisine(512, lines=range(1, 31), phases="random", seed=s))
                        for s in range(9)])
    schroeder = signals.crest_factor(signals.multisine(512, lines=range(1, 31)))
    clipped = signals.crest_factor(signals.multisine(512, lines=range(1, 31), crest_steps=200))
    assert clipped < schroeder < 1.9 < random
    assert signals.crest_factor(np.array([1.0, -1.0, 1.0, -1.0])) == 1.0
    # Schroeder's phases by the definition, a double sum.
    p = np.array([1.0, 4.0, 9.0, 1.0]) / 15
    expected = [-2 * np.pi * sum((k - i) * p[i] for i in range(k)) for k in range(4)]
    np.testing.assert_allclose(signals._phases("schroeder", np.sqrt(p), 0), expected)


def test_prbs_has_the_correlation_of_a_maximum_length_sequence():
    u = signals.prbs(127, -1, 1, bits=7, seed=5)
    correlation = np.fft.irfft(np.abs(np.fft.rfft(u)) ** 2, 127)
    np.testing.assert_allclose(correlation, [127.0] + [-1.0] * 126, atol=1e-9)
    held = signals.prbs(381, 2, 5, bits=7, hold=3, seed=5)
    np.testing.assert_array_equal(held[::3], 3.5 + 1.5 * u)
    assert (held.reshape(-1, 3) == held[::3, None]).all()
    once = signals.prbs(100)
    assert not any(np.array_equal(once[k:], once[:-k]) for k in range(1, 60))
    assert set(signals.prbs(1, seed=2)) <= {-1.0, 1.0}


def test_chirp_sweeps_through_its_frequencies():
    u = signals.chirp(4000, -1, 3, f0=1.0, f1=4.0, dt=0.01, repeats=2)
    np.testing.assert_array_equal(u[:2000], u[2000:])
    t = 0.01 * np.arange(2000)
    expected = 1 + 2 * np.sin(2 * np.pi * (1.0 * t + 0.5 * (3.0 / 20.0) * t**2))
    np.testing.assert_allclose(u[:2000], expected, atol=1e-9)


def test_band_limited_noise_keeps_to_its_band_and_is_stationary():
    dt, cutoff = 0.01, 4.0
    many = np.array([signals.band_limited_noise(400, cutoff=cutoff, dt=dt, clip=6.0, seed=s) for s in range(300)])
    # Standard deviation 1/clip from the first sample on, so the filter had run in.
    np.testing.assert_allclose(many.std(axis=0)[[0, 1, 200, 399]], 1 / 6, rtol=0.15)
    u = signals.band_limited_noise(20000, cutoff=(2.0, 4.0), dt=dt, clip=8.0)
    power = np.abs(np.fft.rfft(u)) ** 2
    f = np.fft.rfftfreq(u.size, dt)
    assert power[(f > 2) & (f < 4)].sum() > 0.8 * power.sum() and power[(f < 0.8) | (f > 10)].sum() < 1e-3 * power.sum()
    clipped = signals.band_limited_noise(5000, 0, 1, cutoff=4.0, dt=dt, clip=1.0)
    assert 0.1 < np.mean((clipped == 0) | (clipped == 1)) < 0.5


def test_uniform_levels_hold_and_spread():
    u = signals.uniform_levels(5000, 2, 6, hold=5, levels=9)
    assert (u.reshape(-1, 5) == u[::5, None]).all()
    np.testing.assert_allclose(np.unique(u), np.linspace(2, 6, 9))
    white = signals.uniform_levels(20000, -1, 1)
    assert abs(white.mean()) < 0.02 and white.var() == pytest.approx(1 / 3, rel=0.03)
    assert signals.uniform_levels(7, hold=3).shape == (7,)


def test_steps_go_up_and_down():
    np.testing.assert_array_equal(signals.steps(5, 0, 2, levels=3), [0, 1, 2, 1, 0])
    np.testing.assert_array_equal(signals.steps(10, 0, 2, levels=3)[::2], [0, 1, 2, 1, 0])
    np.testing.assert_array_equal(signals.steps(11, 0, 2, levels=3, hold=2), [0, 0, 1, 1, 2, 2, 1, 1, 0, 0, 1])


@pytest.mark.parametrize(("call", "part"), [
        (lambda: signals.multisine(100, periods=3), "whole periods"),
        (lambda: signals.multisine(100, lines=[0, 3]), "from 1 to 49"),
        (lambda: signals.multisine(100, lines=[50]), "from 1 to 49"),
        (lambda: signals.multisine(100, lines=[1.5]), "integers"),
        (lambda: signals.multisine(100, lines=[1], band=(0, 1)), "not both"),
        (lambda: signals.multisine(100, band=(0.001, 0.002)), "multiples of 0.01 up to 0.49"),
        (lambda: signals.multisine(100, lines=[1, 2], spectrum=[1.0]), "2 amplitudes"),
        (lambda: signals.multisine(100, lines=[1, 2], spectrum=[1.0, -1.0]), "not negative"),
        (lambda: signals.multisine(100, phases="zero"), "'zero': use one of schroeder, random"),
        (lambda: signals.prbs(100, hold=0), "hold must.*got 0"),
        (lambda: signals.prbs(100, bits=40), "bits must be .* from 2 to 32; got 40"),
    (lambda: signals.prbs(100, bits=2.5), "bits must be"),
    (lambda: signals.steps(100, levels=2.5), "levels must be"),
        (lambda: signals.chirp(100, f0=0.1, f1=0.6), "0.6 is not between 0 and half the sampling rate, 0.5"),
        (lambda: signals.chirp(100, f0=0.0, f1=0.4, method="logarithmic"), "chirp from 0.0 to 0.4"),
        (lambda: signals.chirp(101, f0=0.0, f1=0.4, repeats=2), "whole sweeps"),
        (lambda: signals.band_limited_noise(100, cutoff=0.5), "below half the sampling rate, 0.5"),
        (lambda: signals.band_limited_noise(100, cutoff=(0.3, 0.2)), "rising order"),
        (lambda: signals.band_limited_noise(100, cutoff=0.2, clip=0.0), "clip = 0.0"),
        (lambda: signals.uniform_levels(100, levels=1), "levels must be .* at least 2"),
        (lambda: signals.steps(5, levels=4), "cannot hold 7 steps")])
def test_bad_arguments(call, part):
    refuses(StructureError, part, call)
