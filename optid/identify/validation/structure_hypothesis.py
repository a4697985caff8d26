"""The hypothesis that is tested for one output: the best Hammerstein model of the record, or a given model.

A Hammerstein model has any static functions, and any filters near the poles and dead times of the process. It need not
be the best one to the last digit: the directions in which it can still move, its tangent space, are projected out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optid.arrays import Array
from optid.identify.informativity.signals import delayed
from optid.identify.validation.score_tests import Regression, orthonormal
from optid.identify.validation.structure_design import PULSES, Design
from optid.models.recursions import lfilter
from optid.statistics.coloured import autoregression
from optid.structures.bilinear import minimise
from optid.structures.rank_one import RankOne, matrices

NOISE_ORDER, KEPT = 12, 0.4  # of the autoregression, at most; share of the rows that it must leave
TURNS = 2  # noise models: that of the process, and that of what the hypothesis leaves
STEPS, ENOUGH = 20, 1e-9  # Gauss-Newton steps, until the sum of squares falls by a smaller share
RIDGE = 1e-7  # share of its length added to every column, for functions that the record does not tell apart
LAGS, SLOW = 16, (0.8, 0.9, 0.95, 0.98, 0.99)  # single lags and poles that complete the filters of f
ROOM = 20  # samples by input for every column of these
LEAST, SURE = 1e-3, 3.0  # share that a column must keep beside the tangent space; the same in errors of the prediction
ROUNDING = 1e-12  # standard deviation of residuals, over the largest output, that is rounding


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What a hypothesis says of an output, and what it leaves.

    Attributes:
        design: functions and filters.
        regression: whitens what is left.
        predicted: (N,) per experiment, with level and decay.
        error: (R,) what is left, whitened.
        tangent: (R, n) orthonormal basis of the directions in which the hypothesis can move.
        least: share of its length that a further column must keep beside the tangent space.
        carriers: signals whose products are tested, (N, q) per experiment; none of a given model.
        ratios: second over first singular value of filters times functions, by input.
        rounding: whether nothing but rounding is left.
    """

    design: Design
    regression: Regression
    predicted: list[Array]
    error: Array
    tangent: Array
    least: float
    carriers: list[Array]
    ratios: list[float]
    rounding: bool


@dataclass(frozen=True, eq=False)
class _Point:
    """Filters and functions of all inputs, and the sum of squares that they leave."""

    bs: list[Array]
    mus: list[Array]
    error: Array

    @property
    def energy(self) -> float:
        return float(self.error @ self.error)


def given_model(design: Design, simulated: Sequence[Array]) -> Hypothesis:
    """Return the hypothesis that an output is simulated, (N,) per experiment, plus noise."""
    predicted = [design.scaled(y) for y in simulated]
    regression, whole = _whiten(design, predicted)
    error = regression.reduce([y - p for y, p in zip(design.output, predicted)])
    return Hypothesis(design, regression, predicted, error, np.zeros((error.size, 0)), LEAST, [],
                      [0.0] * len(design.banks), _is_rounding(design, whole))


def fit_hammerstein(design: Design, noise: Array) -> Hypothesis:
    """Fit filters and functions of every input by least squares, the noise white after this polynomial at first."""
    regression, point, free = replace(design.regression, noise=noise), None, []
    predicted, whole = design.output, design.output
    for _ in range(TURNS):
        banks = [regression.reduce(bank) for bank in design.banks]
        output = regression.reduce(design.output)
        if point is None:
            point, free = _start(design, banks, output)
        point = _descend(banks, output, point)
        predicted = [sum(np.einsum("njp,j,p->n", bank[i], b, mu) for bank, b, mu in zip(
            design.banks, point.bs, point.mus)) for i in range(len(design.output))]
        regression, whole = _whiten(design, predicted)
    shapes = [np.linalg.svd(theta)[1:] for theta in free]
    tangent = np.hstack([regression.reduce(columns) for columns in _tangent(design, point)])
    tangent = orthonormal(tangent)
    error = regression.reduce([y - p for y, p in zip(design.output, predicted)])
    signal = float(np.linalg.norm(regression.reduce(predicted)))
    spread = float(np.linalg.norm(error)) / np.sqrt(max(regression.spare, 1))
    least = max(LEAST, SURE * np.sqrt(tangent.shape[1]) * spread / max(signal, 1e-300))
    return Hypothesis(design, regression, whole, error, tangent, least, _carriers(design, regression, point, shapes),
                      [float(v[1] / v[0]) if v.size > 1 and v[0] > 0 else 0.0 for v, _ in shapes],
                      _is_rounding(design, whole))


def _start(design: Design, banks: list[Array], output: Array) -> tuple[_Point, list[Array]]:
    """Return the best rank-one fit with coarse functions, and the free coefficients (P, J) by input."""
    columns = [np.einsum("rjp,pk->rjk", bank, f.coarse) for bank, f in zip(banks, design.families)]
    blocks = tuple((x.shape[2], x.shape[1]) for x in columns)
    flat = np.hstack([x.reshape(len(x), -1) for x in columns])
    n = flat.shape[1]
    ridge = np.diag(RIDGE * np.maximum(np.linalg.norm(flat, axis=0), 1e-300))
    rows = np.vstack([np.column_stack([flat, output]), np.pad(ridge, ((0, 1), (0, 1)))])
    root = np.asarray(np.linalg.qr(rows, mode="r"))
    problem = RankOne(root[:n, :n], root[:n, n], float(root[n, n] ** 2), blocks)
    found = minimise(problem, count=3).point
    bs = [np.asarray(b, dtype=float) for b in found.bs]
    mus = [f.coarse @ np.asarray(mu, dtype=float) for f, mu in zip(design.families, found.mus)]
    return _Point(bs, mus, output - _response(banks, bs, mus)), matrices(np.linalg.solve(problem.root, problem.target),
                                                                         blocks)


def _response(banks: Sequence[Array], bs: Sequence[Array], mus: Sequence[Array]) -> Array:
    return sum((np.einsum("rjp,j,p->r", bank, b, mu) for bank, b, mu in zip(banks, bs, mus)), np.zeros(len(banks[0])))


def _descend(banks: list[Array], output: Array, point: _Point) -> _Point:
    """Take Gauss-Newton steps over filters and functions together."""
    here = _Point(point.bs, point.mus, output - _response(banks, point.bs, point.mus))
    edges = np.cumsum([n for bank in banks for n in bank.shape[1:]])[:-1]
    for _ in range(STEPS):
        columns = np.hstack([part for bank, b, mu in zip(banks, here.bs, here.mus)
                             for part in (bank @ mu, np.einsum("rjp,j->rp", bank, b))])
        sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        step = np.split(np.linalg.lstsq(columns / sizes, here.error, rcond=1e-10)[0] / sizes, edges)
        for share in (1.0, 0.3, 0.1):
            bs = [b + share * d for b, d in zip(here.bs, step[::2])]
            mus = [mu + share * d for mu, d in zip(here.mus, step[1::2])]
            found = _Point(bs, mus, output - _response(banks, bs, mus))
            if found.energy < here.energy:
                break
        else:
            break
        fall, here = here.energy - found.energy, found
        if fall <= ENOUGH * here.energy:
            break
    return here


def _whiten(design: Design, predicted: list[Array]) -> tuple[Regression, list[Array]]:
    """Add level and decays to a prediction; return the regression that whitens what is left, and the sum."""
    whole = []
    for y, p, here, columns in zip(design.output, predicted, design.regression.present, design.regression.nuisance):
        sizes = np.linalg.norm(columns[here], axis=0) + 1e-300
        whole.append(p + columns @ (np.linalg.lstsq(columns[here] / sizes, (y - p)[here], rcond=1e-7)[0] / sizes))
    total = sum(int(np.sum(here)) for here in design.regression.present)
    complete = total / sum(map(len, whole))
    most = min(NOISE_ORDER, total // 50)
    while most > 1 and complete ** (most + 1) < KEPT:  # a row is lost with any of its samples
        most -= 1
    left = [np.where(here, y - p, np.nan) for y, p, here in zip(design.output, whole, design.regression.present)]
    return replace(design.regression, noise=autoregression(left, most)), whole


def _is_rounding(design: Design, predicted: list[Array]) -> bool:
    left = np.concatenate([(y - p)[here] for y, p, here in zip(design.output, predicted, design.regression.present)])
    return float(left.std()) <= ROUNDING * max(1.0, abs(design.centre) / (design.spread or 1.0))


def _tangent(design: Design, point: _Point) -> list[list[Array]]:
    """Return what moves filters and functions, and every f at single lags and through slow poles."""
    room = design.data.n_samples // (ROOM * len(design.banks))
    lags, slow = min(LAGS, room // 2), SLOW[max(len(SLOW) - room // 4, 0) :]
    found = []
    for c, (b, mu) in enumerate(zip(point.bs, point.mus)):
        bank, wider = design.banks[c], []
        own = [x[:, 0] @ mu for x in bank]  # f, from the first lag on
        found += [[x @ mu for x in bank], [np.einsum("njp,j->np", x, b) for x in bank]]
        for v in own:
            more = [delayed(v, PULSES + lag) for lag in range(lags)] + [lfilter([1.0], [1.0, -pole], v) for pole in slow]
            wider.append(np.reshape(more, (len(more), len(v))).T)
        found.append(wider)
    return found


def _carriers(design: Design, regression: Regression, point: _Point, shapes: list[tuple[Array, Array]]) -> list[Array]:
    """Return the signals whose products are tested.

    The best linear approximation; per input the two leading filters of filters times functions, which include even
    functions, and the input itself at its first lag and at the next; of several inputs one of each.
    """
    linear = [[x[:, :, 0] for x in bank] for bank in design.banks]
    reduced = np.hstack([regression.reduce(one) for one in linear])
    theta = np.linalg.lstsq(reduced, regression.reduce(design.output), rcond=1e-10)[0]
    parts = np.split(theta, np.cumsum([one[0].shape[1] for one in linear])[:-1])
    each = 2 if len(linear) == 1 else 1
    found = []
    for i in range(len(design.output)):
        signals = [sum(one[i] @ part for one, part in zip(linear, parts))]
        for one, (_, right) in zip(linear, shapes):
            signals += [one[i] @ line for line in right[:each]]
            signals += [one[i][:, 1 + k] for k in range(each)]
        found.append(np.column_stack(signals))
    return found
