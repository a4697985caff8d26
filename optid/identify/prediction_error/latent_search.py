"""Starts for functions of latent signals, one after another: directions of z by the gain of one Gauss-Newton step.

With Ez and Fz at zero the errors are linear in both, for every direction of z. The rank-one part of the step that the
best directions promise starts a short descent; the best of those descends further.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, RankError
from optid.identify.prediction_error.descent import Descent, descend
from optid.identify.prediction_error.state_errors import StateErrors
from optid.statistics.state_unknowns import Latent, StatePoint

RANKED = 8_000
"""Samples on which directions are ranked and short descents made."""

STAGE = 20_000
"""Samples of the descent before the one on the whole record."""

MARGIN = 1.15
"""Interval of a basis, as a multiple of the range of z at the start."""

SHORT = 12
SIZES = (1.0, 0.3, 0.05)
"""Shares of the Gauss-Newton step from which a descent may start."""

SHARES = (0.9, 0.7, 0.5, 0.3, 0.1, 0.0)
"""What a function is shrunk to where a longer record would take the run out of its range."""


def add_channels(errors: StateErrors, best: Descent, channels: tuple[Latent, ...], *, candidates: int = 16,
                 finalists: int = 4, seed: int = 0, iterations: int = 60
                 ) -> tuple[StateErrors, Descent, dict[str, Any]]:
    """Give a model functions of latent signals and descend to an optimum with all of them.

    Args:
        errors: the criterion of the model without them.
        best: its optimum.
        channels: the functions, each on the interval [-1, 1] of its argument.
        candidates: directions of z that are ranked, at least.
        finalists: of them that are tried in descents.
        seed: of the random directions.
        iterations: of a descent at most.

    Returns:
        The criterion with the functions, its optimum, and figures of the search.

    Raises:
        RankError: no direction of z leads to a model whose run stays finite.
    """
    rng, figures = np.random.default_rng(seed), {}
    end, steps = best, best.steps
    for number, latent in enumerate(channels, start=1):
        errors, x = whitened(errors, end.x)
        part = _first(errors, RANKED)
        ranked = sorted(_ranked(part, x, latent, candidates, rng), key=lambda one: -one[0])
        ends = [one for _, *chosen in ranked[:finalists] if (one := _short(part, x, latent, *chosen)) is not None]
        if not ends:
            raise RankError(f"no direction of latent signal {number} leads to a model that stays finite: use fewer "
                            "latent signals, another basis, or latent='states'.")
        errors = _widened(errors, (latent,))
        starts = [one.x for one in sorted(ends, key=lambda one: one.value)]
        for size in sorted({min(STAGE, errors.data.n_samples), errors.data.n_samples}):
            stage = _first(errors, size)
            end = descend(stage, _finite(stage, starts), iterations=iterations, start=best.start)
            steps, starts = steps + end.steps, [end.x]
        figures[f"gain promised by latent signal {number}"] = ranked[0][0]
    return errors, replace(end, steps=steps), figures


def add_output_functions(errors: StateErrors, best: Descent, functions: tuple[Latent, ...], iterations: int = 60
                         ) -> tuple[StateErrors, Descent, dict[str, Any]]:
    """Let every output be a function of what it was: y_o = h_o(z_o) + constant, z_o the output of the model so far.

    Arguments and errors as `add_channels`; ``functions`` has one for every output, of basis functions as they are.
    """
    point, n = errors.unknowns.unpack(best.x), errors.unknowns.n
    signals = np.hstack([np.vstack(errors.visited(point)), np.vstack([e.u for e in errors.data.experiments])])
    measured, offsets, cs, rows = np.vstack([e.y for e in errors.data.experiments]), [], [], []
    for o, one in enumerate(functions):
        v = np.concatenate([point.C[o], point.d[o]])
        z, here = signals @ v, ~np.isnan(measured[:, o])
        factor = 2 / (MARGIN * max(np.ptp(z), 1e-300))
        rows.append(np.concatenate([factor * v, [-factor * (z.max() + z.min()) / 2]]))
        values = np.hstack([one.basis.values(factor * z + rows[-1][-1]) @ one.vectors, np.ones((len(z), 1))])
        found = np.linalg.lstsq(values[here], measured[here, o])[0]
        cs.append(found[:-1])
        offsets.append(found[-1])
    Ez, Fz = np.zeros((n, len(functions))), np.eye(errors.unknowns.l)
    unknowns = replace(errors.unknowns, linear_output=False, feedthrough=(False,) * len(errors.unknowns.feedthrough))
    errors = _widened(replace(errors, unknowns=unknowns), functions)
    start = _with(replace(point, offset=np.array(offsets)), np.array(rows), tuple(cs), Ez, Fz)
    found = descend(errors, errors.unknowns.pack(start), iterations=iterations, start=best.start)
    return errors, replace(found, steps=best.steps + found.steps), {}


def whitened(errors: StateErrors, x: Array) -> tuple[StateErrors, Array]:
    """Return the same model in states of unit covariance over the record."""
    point = errors.unknowns.unpack(x)
    runs = errors.visited(point)
    covariance = np.atleast_2d(np.cov(np.vstack(runs).T))
    values, vectors = np.linalg.eigh(covariance + 1e-9 * np.trace(covariance) * np.eye(len(covariance)))
    turn = (vectors / np.sqrt(values)).T
    back = np.linalg.inv(turn)
    moved = replace(point, A=turn @ point.A @ back, C=point.C @ back, K=turn @ point.K, b=turn @ point.b,
                    e=turn @ point.e, Ez=turn @ point.Ez, Cz=point.Cz @ back, x0=point.x0 @ turn.T)
    return errors, errors.normalised(errors.unknowns.pack(moved))


def _first(errors: StateErrors, size: int) -> StateErrors:
    """The criterion on the first samples of a long record."""
    data = errors.data
    if data.n_samples <= size or data.n_experiments > 1:
        return errors
    return replace(errors, data=data.window(0, size))


def _finite(errors: StateErrors, starts: list[Array]) -> Array:
    """Return the first start whose run stays in its range; the best with a smaller last function where none does.

    More samples may take a signal to where a function was not known.
    """
    at, last = errors.unknowns.slices, len(errors.unknowns.latent) - 1
    for share in (1.0, *SHARES):
        for start in starts:
            x = np.array(start)
            x[at[f"g{last}"]] *= share
            if np.isfinite(errors.value(x)):
                return x
    raise RankError("a model that stays finite on the first samples of the record leaves its range on the rest, "
                    "however small its last latent function: use fewer latent signals, or another basis.")


def _widened(errors: StateErrors, latent: tuple[Latent, ...]) -> StateErrors:
    return replace(errors, unknowns=replace(errors.unknowns, latent=(*errors.unknowns.latent, *latent)))


def _with(point: StatePoint, rows: Array, cs: tuple[Array, ...], Ez: Array, Fz: Array) -> StatePoint:
    """The point with further latent functions; ``rows`` (k, n + m + 1) are those of their arguments."""
    n = len(point.A)
    return replace(point, cs=(*point.cs, *cs), Ez=np.hstack([point.Ez, Ez]), Fz=np.hstack([point.Fz, Fz]),
                   Cz=np.vstack([point.Cz, rows[:, :n]]), Dz=np.vstack([point.Dz, rows[:, n:-1]]),
                   offset_z=np.concatenate([point.offset_z, rows[:, -1]]))


def _directions(errors: StateErrors, point: StatePoint, latent: Latent, count: int, rng: np.random.Generator
                ) -> Iterator[Array]:
    """Yield rows [Cz, Dz, constant] whose z fills [-1, 1] on the record: states, inputs, outputs, random ones."""
    n, m = errors.unknowns.n, errors.unknowns.expansion.m
    states = np.vstack(errors.visited(point))
    signals = np.hstack([states, np.vstack([e.u for e in errors.data.experiments])])
    moving = np.concatenate([np.ones(n), np.full(m, float(latent.moved))])
    known = [*np.eye(n + m)[moving > 0], *np.hstack([point.C, np.zeros((len(point.C), m))])]
    spread = signals.std(axis=0)
    weight = moving / np.where(spread > 0, spread, 1.0)
    for number in range(max(count, len(known))):
        v = known[number] if number < len(known) else weight * rng.normal(size=n + m)
        z = signals @ v
        low, high = float(z.min()), float(z.max())
        if high - low > 1e-9 * np.abs(signals).max() * np.abs(v).max():
            factor = 2 / (MARGIN * (high - low))
            yield np.concatenate([factor * v, [-factor * (low + high) / 2]])


def _ranked(errors: StateErrors, x: Array, latent: Latent, count: int, rng: np.random.Generator
            ) -> Iterator[tuple[float, Array, Array]]:
    """Yield (share of the errors that a Gauss-Newton step takes away, row of z, matrix [Ez; Fz] (n + l, r) of it)."""
    point, n = errors.unknowns.unpack(x), errors.unknowns.n
    r, outputs = latent.size, errors.unknowns.l
    for row in _directions(errors, point, latent, count, rng):
        single = [replace(latent, vectors=latent.vectors[:, [j]], row=row) for j in range(r)]
        trial = _widened(errors, tuple(single))
        start = _with(point, np.tile(row, (r, 1)), (np.ones(1),) * r, np.zeros((n, r)), np.zeros((outputs, r)))
        at = trial.linearise(trial.unknowns.pack(start))
        if not np.isfinite(at.value):
            continue
        size = np.linalg.norm(at.root, axis=0)
        used = at.root / np.where(size > 0, size, 1.0)
        step = np.linalg.lstsq(np.vstack([used, np.sqrt(1e-3) * np.eye(len(size))]),
                               np.concatenate([-at.pull, np.zeros(len(size))]))[0]
        left = float(np.sum((used @ step + at.pull) ** 2)) + at.remainder
        found = trial.unknowns.unpack(np.concatenate([step / np.where(size > 0, size, 1.0), np.zeros(
            trial.unknowns.size - len(size))]))
        yield 1 - left / at.value, row, np.vstack([found.Ez[:, -r:], found.Fz[:, -r:]])


def _short(errors: StateErrors, x: Array, latent: Latent, row: Array, matrix: Array) -> Descent | None:
    """Descend a little from the rank-one part of a Gauss-Newton step; None where no share of it stays finite."""
    point, trial, n = errors.unknowns.unpack(x), _widened(errors, (latent,)), errors.unknowns.n
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    before = errors.linearise(x).value
    for share in SIZES:
        size = np.sqrt(values[0] * share)
        start = trial.unknowns.pack(
            _with(point, row[None], (size * right[0],), size * left[:n, :1], size * left[n:, :1]))
        if trial.admissible(start) and trial.linearise(start).value < 10 * before:
            break
    else:
        return None
    try:
        return descend(trial, start, iterations=SHORT)
    except (DataError, np.linalg.LinAlgError):
        return None
