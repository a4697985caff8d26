"""Alternatives to the Hammerstein structure: groups of columns, functions of the inputs and of time alone.

Where the hypothesis holds, they are independent of the noise.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from optid.arrays import Array
from optid.identify.validation.structure_design import Design, Family, convolved, orthonormal_filters
from optid.models.recursions import lfilter

COURSES = 4  # degree of the polynomials in time that a gain may follow
# lags and poles by which the filters are completed; experiments up to which each has decays of its own
LAGS, SLOW, FEW_RECORDS = 16, (0.8, 0.9, 0.95, 0.98, 0.99), 3
MOST = 6  # groups of poles, over all inputs, that may come before a second nonlinearity, at most


def alternatives(design: Design, predicted: list[Array]) -> dict[str, list[Array]]:
    """Return groups of columns by their meaning, one array (rows, k) per experiment.

    The predicted outputs are those of the best Hammerstein model, from sample L - 1 of every experiment on.
    """
    reach = len(design.filters) - 1
    level, spread = _moments(predicted)
    outputs = [(y - level) / spread for y in predicted]
    after = orthonormal_filters(design.poles, 1, design.delay, reach + 1, squared=False)
    after = np.pad(after, ((0, max(reach + 1 - len(after), 0)), (0, 0)))[: reach + 1]
    before = [np.concatenate([np.zeros(reach), y]) for y in outputs]
    ends = np.cumsum([len(y) for y in outputs])
    times = [2 * np.arange(end - len(y), end) / ends[-1] - 1 for end, y in zip(ends, outputs)]  # since the record began
    found = {
        "functions of the output": [_curved(y) for y in outputs],
        "a gain that changes with time": [np.polynomial.legendre.legvander(t, COURSES)[:, 1:] * y[:, None]
                                          for t, y in zip(times, outputs)],
        "functions of the output that are fed back": [_through(_curved(y), after) for y in before],
    }
    for c, denominator, words in _parts(design):
        signals = [lfilter([1.0], denominator, (u[:, c] - design.families[c].centre) / design.families[c].spread)
                   for u in design.u]
        middle, size = _moments(signals)
        found[f"functions of {design.data.inputs[c]!r} behind {words}"] = [
            _through(_curved((x - middle) / size), after) for x in signals]
    return found


def wider(design: Design, functions: Sequence[tuple[Family, Array]]) -> list[Array]:
    """Return every f, (family, coefficients), at single lags and through slow poles, and decays of initial states.

    The filters may miss these parts of a Hammerstein system. There is one array (rows, k) per experiment.
    """
    reach = len(design.filters) - 1
    room = design.data.n_samples // (20 * design.data.m)
    lags, slow = min(LAGS, room // 2, reach), SLOW[max(len(SLOW) - room // 4, 0) :]
    found = []
    for u in design.u:
        columns = []
        for c, (family, part) in enumerate(functions):
            v = family.values(u[:, c]) @ part
            columns += [v[reach - lag : len(v) - lag] for lag in range(lags)]
            columns += [lfilter([1.0], [1.0, -pole], v - v.mean())[reach:] for pole in slow]
        if slow and len(design.u) <= FEW_RECORDS:
            decays = np.asarray([pole ** np.arange(len(u) - reach) for pole in slow]).T
            blocks = [decays if i == len(found) else 0 * decays for i in range(len(design.u))]
            columns += list(np.hstack(blocks).T)
        found.append(np.reshape(columns, (len(columns), len(u) - reach)).T)  # none of a short record
    return found


def _parts(design: Design) -> Iterator[tuple[int, Array, str]]:
    """Yield input, denominator and name of the dynamics before a nonlinearity: each pole, and all together."""
    poles = design.poles[design.poles.imag >= 0]
    groups = [[p] if p.imag == 0 else [p, p.conjugate()] for p in poles[np.argsort(-np.abs(poles))]]
    several = [list(design.poles)] if len(groups) > 1 else []
    for group in (groups + several)[: max(MOST // design.data.m, 1)]:
        for c in range(design.data.m):
            yield c, np.real(np.poly(group)), f"poles at {np.round(np.abs(group[0]), 2):g}"


def _curved(x: Array) -> Array:
    """Square, cube and modulus of a standardised signal, which saturates, (N, 3)."""
    bent = 2 * np.tanh(x / 2)
    return np.column_stack([bent**2, bent**3, np.abs(bent)])


def _through(values: Array, filters: Array) -> Array:
    found = convolved(values, filters)
    return found.reshape(len(found), -1)


def _moments(signals: list[Array]) -> tuple[float, float]:
    whole = np.concatenate(signals)
    return float(whole.mean()), float(max(whole.std(), 1e-300))
