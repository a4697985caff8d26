"""Starts with a noise model: extended least squares (ARMAX), and what a plant leaves of the output (Box-Jenkins)."""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.data.stretches import interpolated
from optid.errors import DataWarning, OptidError, RankError
from optid.identify.prediction_error.plant_starts import RADIUS, equation_error, plant_starts, with_poles
from optid.identify.prediction_error.search import search
from optid.identify.prediction_error.transfer_errors import TransferErrors
from optid.models import roots
from optid.models.layout import Layout
from optid.statistics.unknowns import TransferPoint, TransferUnknowns

PASSES = 8
"""Passes of extended least squares; they settle in fewer or not at all."""

MORE = 8
"""Lags that a long model has beyond those of the model whose innovations it is to show."""


def starts_of(criterion: TransferErrors, count: int, seed: int) -> Iterable[tuple[str, Array]]:
    """Return named starts of any of the four noise models.

    Raises:
        StructureError, RankError: the record does not determine the ARX model of an ARMAX fit.
    """
    unknowns = criterion.unknowns
    if unknowns.plain:
        return plant_starts(criterion, count, seed)
    found = _residual_models(criterion, count, seed) if unknowns.apart else extended_least_squares(criterion)
    return _other_zeros(found, unknowns, count, seed).items()


def _residual_models(criterion: TransferErrors, count: int, seed: int) -> dict[str, Array]:
    """Plants of an output-error and of an ARMAX fit, each with the noise model of what they leave of the output."""
    data, unknowns = criterion.data, criterion.unknowns
    plain = replace(criterion, unknowns=replace(unknowns, nc=0, nd=0))
    plants = {"output error": search(plain, lambda part: plant_starts(part, min(count, 4), seed))[0].x}
    if count > 1 and unknowns.layout.na:
        armax = _armax_plant(plain, max(unknowns.nc, unknowns.layout.na))
        plants |= {} if armax is None else {"ARMAX": armax}
    found = {}
    for name, x in plants.items():
        point = plain.unknowns.unpack(x)
        rest = [e.y[:, 0] - y for e, y in zip(data.experiments, plain.simulate(point))]
        c, d = arma(rest, unknowns.nc, unknowns.nd or 0)
        found[name] = unknowns.pack(replace(point, c=c, d=d))
    return found


def _armax_plant(plain: TransferErrors, nc: int) -> Array | None:
    """Return the plant of extended least squares, its states fitted."""
    unknowns = plain.unknowns
    armax = replace(plain, unknowns=replace(unknowns, nc=nc, nd=None))
    try:
        x = next(iter(extended_least_squares(armax).values()))
    except OptidError:  # a plant that least squares of the equation error does not determine has the other start
        return None
    states = np.zeros((unknowns.experiments, unknowns.memory))
    x = unknowns.pack(replace(armax.unknowns.unpack(x), x0=states))
    return with_poles(plain, plain.normalised(x), roots.contained(x[unknowns.slices["a"]], RADIUS), "ARMAX").x


def extended_least_squares(criterion: TransferErrors) -> dict[str, Array]:
    """Return starts of an ARMAX model: the equation error alone, and extended least squares with its innovations.

    The innovations of a long ARX model (Hannan and Rissanen 1982), later those of the estimate, stand as regressors for
    the noise (Ding and Chen 2005); every pass is the rank-one least-squares problem itself. The best pass counts: they
    do not descend by rule.

    Raises:
        StructureError, RankError: the orders are impossible, or the record does not determine the ARX model.
    """
    data, unknowns = criterion.data, criterion.unknowns
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # what gaps cost the starts is no finding about the fit
        arx = unknowns.pack(_arx(data, unknowns))
        best, least, e = None, np.inf, _long_innovations(criterion)
        for _ in range(PASSES if unknowns.nc else 0):
            try:
                extended = _with_channel(data, criterion.innovations(arx) if e is None else e)
                x = unknowns.pack(equation_error(extended, unknowns, unknowns.nc))
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
    return {"ARX": arx} if best is None else {"extended least squares": best, "ARX": arx}


def _arx(data: Data, unknowns: TransferUnknowns) -> TransferPoint:
    """Return the rank-one least squares of the equation error; where gaps leave too few rows, with filled gaps."""
    try:
        return equation_error(data, unknowns)
    except RankError:
        if not any(np.isnan(e.y).any() for e in data.experiments):
            raise
        return equation_error(_record(data, [e.u for e in data.experiments],
                                      [interpolated(e.y) for e in data.experiments], data.inputs), unknowns)


def _other_zeros(starts: dict[str, Array], unknowns: TransferUnknowns, count: int, seed: int) -> dict[str, Array]:
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


def _with_channel(data: Data, e: Sequence[Array]) -> Data:
    """Return the record with one more input."""
    name = "innovation"
    while name in (*data.inputs, *data.outputs):
        name += "'"
    us = [np.column_stack([one.u, extra]) for one, extra in zip(data.experiments, e)]
    return _record(data, us, [one.y for one in data.experiments], [*data.inputs, name])


def _record(data: Data, us: Sequence[Array], ys: Sequence[Array], inputs: Sequence[str]) -> Data:
    return Data(list(us), list(ys), data.dt, list(inputs), list(data.outputs))


def _long_innovations(criterion: TransferErrors) -> list[Array] | None:
    """Return the innovations of an ARX model with more lags; None where the record does not allow one."""
    unknowns, more = criterion.unknowns, MORE + criterion.unknowns.nc
    layout = unknowns.layout
    longer = Layout(layout.na + more, tuple(nb + more for nb in layout.nb), layout.nk, layout.bases, layout.outputs,
                    layout.inputs)
    long = TransferErrors(criterion.data, replace(unknowns, layout=longer, nc=0, nd=None), "none")
    try:
        return long.innovations(long.unknowns.pack(equation_error(long.data, long.unknowns))) if unknowns.nc else None
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
