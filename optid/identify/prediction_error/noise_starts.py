"""Starts with a noise model: extended least squares (ARMAX), and what a plant leaves of the output (Box-Jenkins)."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, count, islice

import numpy as np

from optid.arrays import Array
from optid.data.stretches import interpolated
from optid.errors import DataWarning, OptidError, RankError
from optid.identify.prediction_error.plant_starts import PASSES, RADIUS, equation_error, plant_starts, with_poles
from optid.identify.prediction_error.search import search
from optid.identify.prediction_error.transfer_errors import TransferErrors
from optid.models import roots
from optid.statistics.hankel import hankel_statistics
from optid.statistics.unknowns import TransferPoint, TransferUnknowns

MORE = 8  # lags that a long model has beyond those of the model whose innovations it is to show
PLANTS = 4  # starts, at most, of the output-error fit whose plant is the start of a Box-Jenkins model


def starts_of(criterion: TransferErrors, number: int, seed: int) -> Iterable[tuple[str, Array]]:
    """Return named starts of any of the four noise models, up to a number; errors as `extended_least_squares`."""
    unknowns = criterion.unknowns
    if not unknowns.innovations:
        return islice(plant_starts(criterion, seed), number)
    found = _residual_models(criterion, number, seed) if unknowns.apart else extended_least_squares(criterion)
    return islice(chain(found.items(), _other_zeros(unknowns, next(iter(found.values())), seed)), number)


def _residual_models(criterion: TransferErrors, number: int, seed: int) -> dict[str, Array]:
    """Plants of an output-error and of an ARMAX fit, each with the noise model of what they leave of the output."""
    data, unknowns = criterion.data, criterion.unknowns
    plain = replace(criterion, unknowns=replace(unknowns, nc=0, nd=0))
    plants = {"output error": search(plain, lambda part: islice(plant_starts(part, seed), min(number, PLANTS)))[0].x}
    if number > 1 and unknowns.layout.na:
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
    return with_poles(plain, plain.normalised(x), roots.contained(x[unknowns.slices["a"]], RADIUS)).x


def extended_least_squares(criterion: TransferErrors) -> dict[str, Array]:
    """Return starts of an ARMAX model: the equation error alone, and extended least squares with its innovations.

    The innovations of a long ARX model (Hannan and Rissanen 1982), later those of the estimate, stand as regressors for
    the noise (Ding and Chen 2005); every pass is the rank-one least-squares problem itself. The best pass counts: they
    do not descend by rule. What the record does not determine is refused as in `equation_error`.
    """
    unknowns = criterion.unknowns
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # what gaps cost the starts is no finding about the fit
        arx = unknowns.pack(_arx(criterion))
        best, least, e = None, np.inf, _long_innovations(criterion)
        for _ in range(PASSES if unknowns.nc else 0):
            try:
                x = unknowns.pack(equation_error(criterion, criterion.innovations(arx) if e is None else e))
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


def _arx(criterion: TransferErrors) -> TransferPoint:
    """Return the rank-one least squares of the equation error; where gaps leave too few rows, with filled gaps."""
    try:
        return equation_error(criterion)
    except RankError:
        if not any(np.isnan(e.y).any() for e in criterion.data.experiments):
            raise
        return equation_error(replace(criterion, data=criterion.data.mapped(np.asarray, interpolated)))


def _long_innovations(criterion: TransferErrors) -> list[Array] | None:
    """Return the innovations of an ARX model with more lags; None where the record does not allow one."""
    unknowns, more = criterion.unknowns, MORE + criterion.unknowns.nc
    layout = replace(unknowns.layout, na=unknowns.layout.na + more, nb=tuple(nb + more for nb in unknowns.layout.nb))
    long = replace(criterion, unknowns=replace(unknowns, layout=layout, nc=0, nd=None), gauge="none")
    try:
        return long.innovations(long.unknowns.pack(equation_error(long))) if unknowns.nc else None
    except OptidError:
        return None


def _other_zeros(unknowns: TransferUnknowns, x: Array, seed: int) -> Iterator[tuple[str, Array]]:
    """Yield a point with other zeros of C, again and again; nothing without zeros."""
    rng, nc = np.random.default_rng(seed), unknowns.nc
    for i in count(1) if nc else ():
        pairs = RADIUS * np.sqrt(rng.random(nc // 2)) * np.exp(1j * np.pi * rng.random(nc // 2))
        zeros = np.concatenate([pairs, pairs.conj(), RADIUS * rng.uniform(-1, 1, nc % 2)])
        moved = x.copy()
        moved[unknowns.slices["c"]] = roots.with_roots(zeros, nc)
        yield f"other zeros {i}", moved


def arma(signals: Sequence[Array], nc: int, nd: int) -> tuple[Array, Array]:
    """Estimate C and D of ``v = (C/D) e``, (N,) per experiment, by two regressions (Hannan and Rissanen 1982).

    Return (c, d), zeros where the signals do not determine them; C is invertible and D stable.
    """
    long, records = nc + nd + MORE, [v[:, None] for v in signals]
    try:
        if nc:
            whitening = np.concatenate([[1.0], -_regression(records, [(0, i) for i in range(1, long + 1)])])
            e = [np.convolve(v, whitening)[: len(v)] for v in signals]
            records = [np.column_stack([v, np.where(np.arange(len(v)) < long, np.nan, one)])
                       for v, one in zip(signals, e)]
        theta = _regression(records, [(0, i) for i in range(1, nd + 1)] + [(1, i) for i in range(1, nc + 1)])
    except RankError:
        theta = np.zeros(nd + nc)
    return roots.contained(theta[nd:], RADIUS), roots.contained(-theta[:nd], RADIUS)


def _regression(records: Sequence[Array], terms: Sequence[tuple[int, int]]) -> Array:
    """Regress channel 0 of records (N, channels) on terms (channel, lag) over complete rows, or raise a `RankError`."""
    rows, n = 1 + max((lag for _, lag in terms), default=0), len(terms)
    statistics = hankel_statistics([record for record in records if len(record) >= rows], rows)
    order = [statistics.at([channel], [rows - 1 - lag])[0] for channel, lag in [*terms, (0, 0)]]
    triangle = statistics.triangle(order)
    return np.linalg.lstsq(triangle[:n, :n], triangle[:n, n], rcond=1e-12)[0]
