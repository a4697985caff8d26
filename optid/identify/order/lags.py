"""Lags of ARX and Hammerstein-ARX models: every (na, nb, nk) from the statistics of the largest layout.

A smaller layout is a subset of the columns: its least squares follow from the triangular factor of the largest one.
With a basis, the nonlinearities are those of the rank-one fit of the largest layout; every lag of an input then has one
column, f(u(k - lag)).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from optid.arrays import Array, check_integer
from optid.bases.basis import Basis
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.order.states import criteria
from optid.statistics import Layout, Statistics, accumulate, collect
from optid.structures.lifted_regression import lifted_problem, positions

ROWS_PER_COLUMN = 3
CLOSE = 0.1


@dataclass(frozen=True)
class Lags:
    """One structure: na, and nb and nk by input, with its criteria (smaller is better) and its hold-out fit in %."""

    na: int
    nb: tuple[int, ...]
    nk: tuple[int, ...]
    aic: float
    aicc: float
    bic: float
    fit: float

    def __str__(self) -> str:
        nb, nk = (str(v[0]) if len(set(v)) == 1 else " ".join(map(str, v)) for v in (self.nb, self.nk))
        return f"na = {self.na}, nb = {nb}, nk = {nk}"


@dataclass(frozen=True)
class LagScan:
    """All structures compared, in the order of the scan, on common rows."""

    candidates: tuple[Lags, ...]
    rows: int

    @property
    def at_the_edge(self) -> tuple[str, ...]:
        """Which of na, nb and nk are the largest ones compared; larger ones may be better."""
        best = self.best()
        return tuple(name for name in ("na", "nb", "nk")
                     if np.max(getattr(best, name)) == max(np.max(getattr(c, name)) for c in self.candidates))

    def best(self, criterion: str = "bic") -> Lags:
        """Return the best by "aic", "aicc", "bic" or "fit"; of fits within 0.1 points the one with the least BIC."""
        if criterion == "fit":
            most = max(c.fit for c in self.candidates)
            return min((c for c in self.candidates if c.fit >= most - CLOSE), key=lambda c: c.bic)
        return min(self.candidates, key=lambda c: getattr(c, criterion))


def scan_lags(data: Data, bases: Sequence[Basis], *, na: int = 8, nb: int = 6, nk: int = 8, test: Data | None = None
             ) -> LagScan:
    """Compare all structures up to the given lags; the inputs share nb and nk first and are then refined one by one.

    Args:
        data: the record; NaN = missing. All candidates use the rows of the largest one.
        bases: one basis per input, with an interval; `Linear` for an ARX model.
        na: largest number of output lags; smaller where the record is short.
        nb: largest number of input lags; likewise.
        nk: largest delay; likewise.
        test: a part held out, predicted with the coefficients of `data`; None for none.

    Raises:
        StructureError: orders that are not integers, na, nk >= 0 and nb >= 1.
        RankError: too short a record, or one that does not excite the basis.
    """
    for name, value, least in (("na", na, 0), ("nb", nb, 1), ("nk", nk, 0)):
        check_integer(value, name, least)
    width, rows = sum(basis.size for basis in bases), data.n_samples
    while na * data.l + (nb + nk) * width + 1 > rows / ROWS_PER_COLUMN and na + nb + nk > 1:
        na, nb, nk = max(na - 1, 0), max(nb - 1, 1), max(nk - 1, 0)
    layout = Layout(na, (nb + nk,) * data.m, (0,) * data.m, tuple(bases), data.outputs, data.inputs)
    statistics = collect(data, layout)
    change, held_out = _contraction(statistics), None
    if test is not None:
        long = [i for i, e in enumerate(test.experiments) if e.n_samples > layout.first_row]
        if not long:
            raise RankError(f"The part held out is shorter than the {layout.first_row} lags: hold out more, or none.")
        part = accumulate(test.select(experiments=long), layout)  # it need not determine the parameters
        held_out = change.T @ part.gram @ change / part.rows
    judge = partial(_judge, layout, statistics.root @ change, statistics.rows, held_out)
    pairs = [(b, k) for k in range(nk + 1) for b in range(1, nb + 1)]
    found = [judge(a, (b,) * data.m, (k,) * data.m) for a in range(na + 1) for b, k in pairs]
    if data.m > 1:
        best = min(found, key=lambda c: c.bic)
        for c in range(data.m):
            found += [judge(best.na, (*best.nb[:c], b, *best.nb[c + 1 :]), (*best.nk[:c], k, *best.nk[c + 1 :]))
                      for b, k in pairs]
            best = min(found, key=lambda c: c.bic)
        found += [judge(a, best.nb, best.nk) for a in range(na + 1)]
    return LagScan(tuple(dict.fromkeys(found)), statistics.rows)


def _judge(layout: Layout, root: Array, rows: int, held_out: Array | None, na: int, nb: tuple[int, ...],
           nk: tuple[int, ...]) -> Lags:
    """Fit one structure by the root (n, n) of the largest one, judge it by the moments of the part held out."""
    l, lags = layout.l, layout.nb[0]  # noqa: E741
    past = layout.na * l
    inputs = [past + c * lags + lag for c in range(layout.m) for lag in range(nk[c], nk[c] + nb[c])]
    constant = past + layout.m * lags
    columns = np.array([*range(na * l), *inputs, constant])
    targets = np.arange(constant + 1, constant + 1 + l)
    theta, *_ = np.linalg.lstsq(root[:, columns], root[:, targets], rcond=1e-12)
    error = root[:, targets] - root[:, columns] @ theta
    energy = np.sum(root[:, targets] ** 2, axis=0)
    covariance = (error.T @ error + np.diag(1e-16 * energy)) / rows
    k = l * columns.size + sum(basis.size - 1 for basis in layout.bases)
    likelihood = rows * float(np.linalg.slogdet(covariance)[1])
    fit = float("nan")
    if held_out is not None:
        both, weights = np.concatenate([columns, targets]), np.vstack([-theta, np.eye(l)])
        spread = held_out[targets, targets] - held_out[constant, targets] ** 2
        errors = np.maximum(np.einsum("ij,ik,kj->j", weights, held_out[np.ix_(both, both)], weights), 0)
        fit = float(100 * np.mean(1 - np.sqrt(errors / np.maximum(spread, 1e-300))))
    aic, aicc, bic = criteria(likelihood, k, rows, l)
    return Lags(na, nb, nk, float(aic), float(aicc), float(bic), fit)


def _contraction(statistics: Statistics) -> Array:
    """Matrix that turns the columns of the layout into one per lag of every input, f_c from the rank-one fit."""
    from optid.structures.bilinear import minimise

    layout = statistics.layout
    shapes = [np.ones(1)] * layout.m
    if any(basis.size > 1 for basis in layout.bases):
        problem = lifted_problem(statistics, positions(layout), weights=residual_weights(statistics))
        shapes = list(minimise(problem, count=3).point.mus)
    past, lags = layout.na * layout.l, layout.nb[0]
    change = np.zeros((layout.n_columns + layout.l, past + layout.m * lags + 1 + layout.l))
    change[:past, :past] = np.eye(past)
    for c, mu in enumerate(shapes):
        block = layout.block(c)
        change[block, past + c * lags : past + (c + 1) * lags] = np.kron(np.eye(lags), np.reshape(mu, (-1, 1)))
    change[layout.offset :, past + layout.m * lags :] = np.eye(1 + layout.l)
    return change


def residual_weights(statistics: Statistics) -> Array:
    """Return the factors (l,) to units of the residual of every output; one for a single output."""
    n, root = statistics.layout.n_columns, statistics.root
    rest, energy = np.sum(root[n:, n:] ** 2, axis=0), np.sum(root[:, n:] ** 2, axis=0)
    size = np.maximum(np.maximum(rest / statistics.rows, 1e-24 * energy), 1e-300)
    return np.ones(1) if rest.size == 1 else 1 / np.sqrt(size)
