"""The hypothesis that is tested for one output: the best Hammerstein model of the record, or a given model.

A Hammerstein model has any static functions, and any filters near the poles and dead times of the process. It need not
be the best one to the last digit: the directions in which it can still move, its tangent space, are projected out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optid.arrays import Array
from optid.identify.informativity.signals import delay
from optid.identify.validation.score_tests import DISTINCT, LEAST, Regression, orthonormal, solve
from optid.identify.validation.structure_design import PULSES, Design
from optid.models.recursions import lfilter
from optid.statistics.coloured import short_autoregression
from optid.structures.bilinear import minimise
from optid.structures.rank_one import RankOne, matrices

NOISE_ORDER, KEPT = 12, 0.4  # of the autoregression, at most; share of the rows that it must leave
TURNS = 2  # noise models: that of the process, and that of what the hypothesis leaves
STEPS, ENOUGH = 20, 1e-9  # Gauss-Newton steps, until the sum of squares falls by a smaller share
SHARES = (1.0, 0.3, 0.1)  # of a step that are tried
RIDGE = 1e-7  # share of its length added to every column, for functions that the record does not tell apart
LAGS, SLOW = 16, (0.8, 0.9, 0.95, 0.98, 0.99)  # single lags and poles that complete the filters of f
ROOM = 20  # samples by input for every column of these
NOISE_ROOM = 50  # rows for every column that is told from the noise when this is estimated
CUT = 1e-4  # standard deviation of residuals, over that of the output, that filters of nearly right poles leave
ROUNDING = 1e-12  # standard deviation of residuals, over the largest output, that is rounding


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What a hypothesis says of an output, and what it leaves."""

    design: Design  # functions and filters
    regression: Regression  # whitens what is left
    predicted: Sequence[Array]  # (N,) per experiment, with level and decay
    directions: Sequence[Array]  # (N, n) per experiment, in which the hypothesis can move
    carriers: list[Array]  # signals whose products are tested, (N, q) per experiment; none of a given model
    ratios: list[float]  # second over first singular value of filters times functions, by input
    rounding: bool  # whether nothing but rounding, and what the filters cut off, is left

    @property
    def error(self) -> Array:
        """What is left of the output, whitened, (R,)."""
        return self.regression.reduce([y - p for y, p in zip(self.design.output, self.predicted)])

    @cached_property
    def tangent(self) -> Array:
        """(R, n) orthonormal basis of the directions, whitened."""
        return orthonormal(self.regression.reduce(self.directions))

    def beside(self, columns: Sequence[Array]) -> "Hypothesis":
        """Return the hypothesis with the noise that is left beside further columns, (N, k) per experiment.

        What an alternative explains is no noise: a gain that drifts leaves slow errors, and whitened by these it would
        not be seen. Of few rows it would explain the noise too.
        """
        moves, further = self.regression.reduce(self.directions), self.regression.reduce(columns)
        sizes = np.maximum(np.linalg.norm(further, axis=0), 1e-300)
        taken = solve(moves, further / sizes)
        left = further / sizes - moves @ taken
        distinct = np.linalg.norm(left, axis=0) > LEAST
        if self.regression.spare < NOISE_ROOM * np.sum(distinct):
            return self
        found = solve(left[:, distinct], self.error, DISTINCT**0.5)
        explained = [(c[:, distinct] / sizes[distinct] - d @ taken[:, distinct]) @ found
                     for c, d in zip(columns, self.directions)]
        regression, _ = _whiten(self.design, [p + more for p, more in zip(self.predicted, explained)])
        return replace(self, regression=regression)


@dataclass(frozen=True, eq=False)
class _Point:
    """Filters and functions of all inputs."""

    bs: Sequence[Array]
    mus: Sequence[Array]

    def response(self, banks: Sequence[Array]) -> Array:
        """Return the output for banks (N, J, P) of the inputs."""
        return np.sum([np.einsum("njp,j,p->n", bank, b, mu) for bank, b, mu in zip(banks, self.bs, self.mus)], axis=0)


def given_model(design: Design, simulated: Sequence[Array]) -> Hypothesis:
    """Return the hypothesis that an output is simulated, (N,) per experiment, plus noise."""
    predicted = [(y - design.centre) / design.spread for y in simulated]
    regression, whole = _whiten(design, predicted)
    return Hypothesis(design, regression, predicted, [np.zeros((len(y), 0)) for y in predicted], [],
                      [0.0] * len(design.banks), _is_rounding(design, whole))


def fit_hammerstein(design: Design, noise: Array) -> Hypothesis:
    """Fit filters and functions of every input by least squares, the noise white after this polynomial at first."""
    regression = replace(design.regression, noise=noise)
    point, free = _start(design, regression)
    whole = design.output
    for _ in range(TURNS):
        point = _descend(design, regression, point)
        regression, whole = _whiten(design, [point.response(banks) for banks in zip(*design.banks)])
    values, lines = zip(*(np.linalg.svd(theta)[1:] for theta in free))
    return Hypothesis(design, regression, whole, _directions(design, point), _carriers(design, regression, lines),
                      [float(v[1] / v[0]) if v.size > 1 and v[0] > 0 else 0.0 for v in values],
                      _is_rounding(design, whole))


def _start(design: Design, regression: Regression) -> tuple[_Point, list[Array]]:
    """Return the best rank-one fit with coarse functions, and the free coefficients (P, J) by input."""
    columns = [regression.reduce([x @ f.coarse for x in bank]) for bank, f in zip(design.banks, design.families)]
    blocks = tuple((x.shape[2], x.shape[1]) for x in columns)
    flat = np.hstack([x.reshape(len(x), -1) for x in columns])
    ridge = np.diag(RIDGE * np.maximum(np.linalg.norm(flat, axis=0), 1e-300))
    rows = np.vstack([np.column_stack([flat, regression.reduce(design.output)]), np.pad(ridge, ((0, 1), (0, 1)))])
    root = np.asarray(np.linalg.qr(rows, mode="r"))
    problem = RankOne(root[:-1, :-1], root[:-1, -1], float(root[-1, -1] ** 2), blocks)
    found = minimise(problem, count=3).point
    mus = [f.coarse @ mu for f, mu in zip(design.families, found.mus)]
    return _Point(found.bs, mus), matrices(np.linalg.solve(problem.root, problem.target), blocks)


def _descend(design: Design, regression: Regression, point: _Point) -> _Point:
    """Take Gauss-Newton steps over filters and functions together."""
    banks, output = [regression.reduce(bank) for bank in design.banks], regression.reduce(design.output)
    edges = np.cumsum([n for bank in banks for n in bank.shape[1:]])[:-1]
    error = output - point.response(banks)
    for _ in range(STEPS):
        columns = np.hstack([part for bank, b, mu in zip(banks, point.bs, point.mus)
                             for part in (bank @ mu, np.einsum("rjp,j->rp", bank, b))])
        step = np.split(solve(columns, error), edges)
        energy = float(error @ error)
        for share in SHARES:
            there = _Point([b + share * d for b, d in zip(point.bs, step[::2])],
                           [mu + share * d for mu, d in zip(point.mus, step[1::2])])
            left = output - there.response(banks)
            if left @ left < energy:
                point, error = there, left
                break
        if energy - float(error @ error) <= ENOUGH * energy:
            break
    return point


def _whiten(design: Design, predicted: Sequence[Array]) -> tuple[Regression, Sequence[Array]]:
    """Add level and decays to a prediction; return the regression that whitens what is left, and the sum."""
    whole = []
    for y, p, here, columns in zip(design.output, predicted, design.regression.present, design.regression.nuisance):
        whole.append(p + columns @ solve(columns[here], (y - p)[here]))
    total = sum(int(np.sum(here)) for here in design.regression.present)
    complete = total / sum(map(len, whole))
    most = min(NOISE_ORDER, total // 50)
    while most > 1 and complete ** (most + 1) < KEPT:  # a row is lost with any of its samples
        most -= 1
    left = [np.where(here, y - p, np.nan) for y, p, here in zip(design.output, whole, design.regression.present)]
    return replace(design.regression, noise=short_autoregression(left, most)), whole


def _is_rounding(design: Design, predicted: Sequence[Array]) -> bool:
    left = np.concatenate([(y - p)[here] for y, p, here in zip(design.output, predicted, design.regression.present)])
    return float(left.std()) <= max(CUT, ROUNDING * max(1.0, abs(design.centre) / design.spread))


def _directions(design: Design, point: _Point) -> list[Array]:
    """Return what moves filters and functions, and every f at single lags and through slow poles, (N, n) each."""
    room = design.data.n_samples // (ROOM * len(design.banks))
    lags, slow = min(LAGS, room // 2), SLOW[max(len(SLOW) - room // 4, 0) :]
    found = []
    for bank, b, mu in zip(design.banks, point.bs, point.mus):
        found += [[x @ mu for x in bank], [np.einsum("njp,j->np", x, b) for x in bank]]
        wider = [[delay(f, PULSES + lag) for lag in range(lags)] + [lfilter([1.0], [1.0, -p], f) for p in slow]
                 for f in (x[:, 0] @ mu for x in bank)]
        found += [[np.column_stack(columns) for columns in wider]] if lags else []
    return [np.hstack(parts) for parts in zip(*found)]


def _carriers(design: Design, regression: Regression, lines: Sequence[Array]) -> list[Array]:
    """Return the signals whose products are tested.

    The best linear approximation; per input the two leading filters (J,) of filters times functions, which include even
    functions, and the input itself at its first lag and at the next; of several inputs one of each.
    """
    linear = [[x[:, :, 0] for x in bank] for bank in design.banks]
    columns = np.hstack([regression.reduce(one) for one in linear])
    theta = solve(columns, regression.reduce(design.output))
    each = 2 if len(linear) == 1 else 1
    found = []
    for parts in zip(*linear):
        signals = [np.hstack(parts) @ theta]
        for x, line in zip(parts, lines):
            signals += [*(x @ line[:each].T).T, *x.T[1 : 1 + each]]
        found.append(np.column_stack(signals))
    return found
