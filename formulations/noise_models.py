"""What the prediction-error formulations with a noise filter share: the criterion, its programmes and its starts.

The errors and their sensitivities are those of `optid.statistics.noise_sensitivities`; descents and programmes are
those of `formulations.prediction_error`. The programmes have the named variables of the output-error ones and ``c``
(and ``d`` for Box-Jenkins); C stays invertible at every iterate.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from formulations.output_error import STABLE, OutputError
from formulations.output_error_programme import Posing
from formulations.prediction_error import Descent, agreement, best_of, descend, refine
from optid.bases import Linear
from optid.data.record import Data
from optid.errors import DataWarning, OptidError, RankError
from optid.identify.arguments import enough_rows
from optid.identify.equation_error import compress
from optid.models import HammersteinARX, HammersteinTF, roots
from optid.program.program import Values
from optid.program.units import energy_unit
from optid.solving.solve import Procedure
from optid.statistics import Layout
from optid.statistics.linearised import Linearised
from optid.statistics.noise_sensitivities import NoisePoint, NoiseUnknowns, linearise, predict
from optid.statistics.sensitivities import PlantPoint
from optid.structures.bilinear import minimise

Array = np.ndarray

PASSES = 8
"""Passes of extended least squares; they settle in fewer or not at all."""

MORE = 8
"""Lags that a long model has beyond those of the model whose innovations it is to show."""

RADIUS = 0.98
"""Zeros of C of a start lie inside this radius."""


@dataclass(frozen=True, eq=False)
class PredictionErrors(OutputError):
    """One-step prediction errors as a function of the unknowns; a `formulations.prediction_error.Criterion`."""

    unknowns: NoiseUnknowns  # type: ignore[assignment]

    @property
    def errors(self) -> str:
        """What they are called."""
        return "prediction errors"

    def linearise(self, x: Array) -> Linearised:
        """Return the errors near x."""
        return linearise(self.data, self.unknowns, self.unknowns.unpack(x), gauge=self.gauge_rows(x))

    def admissible(self, x: Array) -> bool:
        """Whether the predictor is stable: C invertible and, where the noise has poles of its own, the plant stable."""
        if not np.all(np.isfinite(x)) or roots.radius(x[self.unknowns.slices["c"]]) >= STABLE:
            return False
        return not self.unknowns.apart or roots.radius(x[self.unknowns.slices["a"]]) < STABLE

    def with_noise(self, plant: HammersteinARX, values: Values) -> HammersteinTF:
        """Give a plant the noise model of the programme's values."""
        c, d = (np.asarray(values.get(name, np.zeros(0)), dtype=float) for name in ("c", "d"))
        return replace(plant, c=c, d=d if self.unknowns.apart else None)

    def innovations(self, x: Array) -> list[Array]:
        """Return the innovations (N,) of every experiment, NaN where there is none."""
        found = []
        for i, e in enumerate(self.data.experiments):
            one = predict(e.u, e.y[:, 0], self.unknowns, self.unknowns.unpack(x), i)
            found.append(np.where(one.state == 0, one.innovations, np.nan))
        return found


def procedure(name: str, criterion: PredictionErrors, starts: Mapping[str, Array], constraints: Sequence[Any],
              gauge: str) -> Procedure:
    """Descend from every start, then bring the best optimum to a point that a back end confirms.

    Args:
        name: of the formulation.
        criterion: the errors.
        starts: admissible starts by name.
        constraints: the user's.
        gauge: of the reported model.

    Raises:
        RankError: too few innovations for the unknowns.
    """
    found = best_of(criterion, starts.items())
    if not found:
        raise RankError("no start has a stable predictor; use other orders")
    enough_rows(found[0].at.rows, "prediction errors", criterion.unknowns.size, "lags")
    agreed, sentence = agreement(found, 1e-12 * criterion.energy)
    best = descend(criterion, found[0].x, start=found[0].start)
    best = replace(best, steps=best.steps + found[0].steps)
    figures = {"starts": sentence, "starts that agree": agreed,
               "prediction errors of the starts":
                   energy_unit(criterion.units) * np.array(sorted((one.value for one in found), reverse=True))}
    return _refined(name, criterion, best, constraints, gauge, figures)


def _refined(name: str, criterion: PredictionErrors, best: Descent, constraints: Sequence[Any], gauge: str,
             figures: dict[str, Any]) -> Procedure:
    posing = Posing(name, replace(criterion, gauge=gauge), tuple(constraints))
    best = replace(best, x=posing.signed(best.x))
    evidence = yield from refine(posing.posed(), best, figures=figures)
    return evidence


# -- starts ----------------------------------------------------------------------------------------------------------


def extended_least_squares(criterion: PredictionErrors) -> dict[str, Array]:
    """Return starts of an ARMAX model: the equation error alone, and extended least squares with its innovations.

    The innovations of a long ARX model (Hannan and Rissanen 1982), later those of the estimate, stand as regressors for
    the noise (Ding and Chen 2005); every pass is the rank-one least-squares problem itself. The best pass counts: they
    do not descend by rule.

    Raises:
        StructureError, RankError: the orders are impossible, or the record does not determine the ARX model.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # what gaps cost the starts is no finding about the fit
        arx = _arx(criterion)
        found = {"ARX": arx}
        best, least, e = None, np.inf, _long_innovations(criterion.data, criterion.unknowns)
        for _ in range(PASSES if criterion.unknowns.nc else 0):
            try:
                x = _regressed(criterion, criterion.innovations(arx) if e is None else e)
            except OptidError:  # innovations of zero, as without noise, are no regressors
                break
            e = criterion.innovations(x)
            value = float(sum(np.nansum(one**2) for one in e))
            if not np.isfinite(value):
                break
            settled = abs(value - least) <= 1e-4 * least
            if value < least:
                best, least = x, value
            if settled:
                break
    return found if best is None else {"extended least squares": best, **found}


def _arx(criterion: PredictionErrors) -> Array:
    """Return the rank-one least squares of the equation error; where gaps leave too few rows, with filled gaps."""
    try:
        return _regressed(criterion, None)
    except RankError:
        if not any(np.isnan(e.y).any() for e in criterion.data.experiments):
            raise
        return _regressed(replace(criterion, data=_interpolated(criterion.data)), None)


def _interpolated(data: Data) -> Data:
    """Return the record with straight lines in the gaps of the output; an experiment without outputs gets zeros."""
    ys = []
    for e in data.experiments:
        there = np.flatnonzero(np.isfinite(e.y[:, 0]))
        ys.append(np.interp(np.arange(e.n_samples), there, e.y[there, 0]) if there.size else np.zeros(e.n_samples))
    return Data([e.u for e in data.experiments], ys, data.dt, list(data.inputs), list(data.outputs))


def other_zeros(starts: dict[str, Array], unknowns: NoiseUnknowns, count: int, seed: int) -> dict[str, Array]:
    """Add starts with other zeros of C, up to a number of starts."""
    rng, nc, found = np.random.default_rng(seed), unknowns.nc, dict(starts)
    first = next(iter(starts.values()))
    for i in range(1, (count - len(starts) if nc else 0) + 1):
        pairs = RADIUS * np.sqrt(rng.random(nc // 2)) * np.exp(1j * np.pi * rng.random(nc // 2))
        zeros = np.concatenate([pairs, pairs.conj(), RADIUS * rng.uniform(-1, 1, nc % 2)])
        moved = first.copy()
        moved[unknowns.slices["c"]] = roots.with_roots(zeros, nc)
        found[f"other zeros {i}"] = moved
    return dict(list(found.items())[:count])


def _regressed(criterion: PredictionErrors, e: Sequence[Array] | None) -> Array:
    """Solve the rank-one least squares in A, B, f and, where innovations are given, C."""
    data, unknowns, layout = criterion.data, criterion.unknowns, criterion.unknowns.layout
    arguments: dict[str, Any] = {"na": layout.na, "nb": layout.nb, "nk": layout.nk, "basis": layout.bases}
    if e is not None:
        data = _with_channel(data, e)
        arguments |= {"nb": (*layout.nb, unknowns.nc), "nk": (*layout.nk, 1), "basis": (*layout.bases, Linear())}
    problem = compress(data, own=False, **arguments)
    point = minimise(problem.problem, count=4).point
    values = problem.linear_part(point.w)
    c = np.zeros(unknowns.nc)
    if e is not None:
        c = roots.contained(point.mus[-1][0] * np.ravel(point.bs[-1]), RADIUS)
    pairs = [(np.array(mu, dtype=float), np.array(b, dtype=float).ravel()) for mu, b in zip(point.mus, point.bs)]
    pairs = [(mu, b) if free else (np.ones(1), b * mu[0]) for free, (mu, b) in zip(unknowns.free, pairs)]
    a = values.get("a", np.zeros(0))
    x0 = np.zeros((unknowns.experiments, layout.first_row))
    plant = PlantPoint(a, tuple(mu for mu, _ in pairs), tuple(b for _, b in pairs), float(values["offset"][0]), x0)
    return unknowns.pack(NoisePoint(plant, c, a))


def _with_channel(data: Data, e: Sequence[Array]) -> Data:
    """Return the record with one more input."""
    name = "innovation"
    while name in (*data.inputs, *data.outputs):
        name += "'"
    us = [np.column_stack([one.u, extra]) for one, extra in zip(data.experiments, e)]
    return Data(us, [one.y for one in data.experiments], data.dt, [*data.inputs, name], list(data.outputs))


def _long_innovations(data: Data, unknowns: NoiseUnknowns) -> list[Array] | None:
    """Return the innovations of an ARX model with more lags; None where the record does not allow one."""
    layout, more = unknowns.layout, MORE + unknowns.nc
    longer = Layout(layout.na + more, tuple(nb + more for nb in layout.nb), layout.nk, layout.bases, layout.outputs,
                    layout.inputs)
    plant = replace(unknowns.plant, layout=longer)
    criterion = PredictionErrors(data, NoiseUnknowns(plant, 0), "none")
    try:
        return criterion.innovations(_regressed(criterion, None)) if unknowns.nc else None
    except OptidError:
        return None


def arma(signals: Sequence[Array], nc: int, nd: int) -> tuple[Array, Array]:
    """Estimate C and D of ``v = (C/D) e`` by two regressions (Hannan and Rissanen 1982).

    Args:
        signals: (N,) one for each experiment, NaN = missing.
        nc: order of C.
        nd: order of D.

    Returns:
        (c, d), zeros where the signals do not determine them; C is invertible and D stable.
    """
    long = nc + nd + MORE
    if nc == 0:
        e = [np.zeros(len(v)) for v in signals]
    else:
        ar = _regression([([v] * long, range(1, long + 1), v) for v in signals])
        e = [v + sum(-w * _lagged(v, i) for i, w in enumerate(ar, start=1)) for v in signals]
    lags = [*range(1, nd + 1), *range(1, nc + 1)]
    theta = _regression([([v] * nd + [one] * nc, lags, v) for v, one in zip(signals, e)])
    return roots.contained(theta[nd:], RADIUS), roots.contained(-theta[:nd], RADIUS)


def _regression(parts: Sequence[tuple[Sequence[Array], Sequence[int], Array]]) -> Array:
    """Regress targets on lagged signals over the rows in which nothing is missing, lag by lag."""
    size = len(parts[0][0])
    gram, right = np.zeros((size, size)), np.zeros(size)
    for signals, lags, target in parts:
        columns = [_lagged(signal, lag) for signal, lag in zip(signals, lags)]
        whole = np.isfinite(target) & np.logical_and.reduce([np.isfinite(c) for c in columns] or [np.isfinite(target)])
        columns = [np.where(whole, c, 0.0) for c in columns]
        goal = np.where(whole, target, 0.0)
        gram += np.array([[a @ b for b in columns] for a in columns]).reshape(size, size)
        right += np.array([a @ goal for a in columns])
    return np.linalg.lstsq(gram, right, rcond=1e-12)[0] if size else np.zeros(0)


def _lagged(signal: Array, lag: int) -> Array:
    return np.concatenate([np.full(min(lag, len(signal)), np.nan), signal[: max(len(signal) - lag, 0)]])
