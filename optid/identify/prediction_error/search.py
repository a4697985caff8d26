"""A fit of a transfer function: the search for the best optimum over starts of many kinds, and its confirmation.

Starts of the plant: equation error, Steiglitz-McBride, refined instruments, subspace, perturbed poles. Poles outside
the unit circle are reflected into it, and the other unknowns fitted by a few steps with A fixed. With a noise model:
extended least squares (ARMAX), the residuals of a plant (Box-Jenkins).
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, count, islice
from typing import Any

import numpy as np

from optid.arrays import LARGEST_INTEGER, Array, check_integer
from optid.bases import Linear, fitted_bases
from optid.core.problem import Problem
from optid.data.record import Data
from optid.data.stretches import interpolate_missing
from optid.errors import DataWarning, OptidError, RankError
from optid.identify.arguments import enough_rows
from optid.identify.prediction_error.criterion import excess
from optid.identify.prediction_error.descent import Descent, agreement, best_of, descend, with_poles
from optid.identify.prediction_error.signs import with_required_signs
from optid.identify.prediction_error.tangent_descent import refine
from optid.identify.prediction_error.transfer_errors import TransferErrors
from optid.identify.subspace.projection import project, realise
from optid.models.layout import Layout
from optid.models.roots import contain_roots, roots_of, with_integrator, with_roots
from optid.solving.solve import Procedure
from optid.statistics.expansion import expand
from optid.statistics.experiments import collect_by_experiment
from optid.statistics.hankel import hankel_statistics
from optid.statistics.regression import collect
from optid.statistics.unknowns import TransferPoint, TransferUnknowns
from optid.structures.bilinear import minimise
from optid.structures.lifted_regression import lifted_problem, positions

SEARCH = 5_000  # samples, from the middle of the record, on which starts are compared
SUFFICIENT = 3  # starts of different methods that may suffice without a noise filter, see `descent.best_of`
# radii tried to bring the poles of a start into the region of the constraints
PULLS = (0.999, 0.99, 0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.3, 0.1, 0.0)
ENTRIES = 3  # different optima from which the constrained iteration may start
PASSES = 8  # passes of Steiglitz-McBride and of the instruments
WIDE = 6  # functions, over all inputs, up to which the subspace start is used
RADIUS = 0.98  # largest modulus of the poles of a start
MORE = 8  # lags of a long model beyond those of the model whose innovations it approximates
PLANTS = 4  # starts, at most, of the output-error fit whose plant is the start of a Box-Jenkins model


def fit_transfer(errors: TransferErrors, starts: int, seed: int, pose: Callable[[Array], Problem]) -> Procedure:
    """Search for the best optimum in a gauge that is always reached, and continue from there in that of the errors.

    Args:
        errors: the criterion.
        starts: number of starts.
        seed: of the random ones.
        pose: states the problem of the fit from the optimum, whose values have usual sizes.

    Raises:
        StructureError: numbers that are none.
        RankError: too few samples for the unknowns.
    """
    check_integer(starts, "starts")
    check_integer(seed, "seed", 0, LARGEST_INTEGER)
    free = errors if errors.gauge == "none" else replace(errors, gauge="norm")
    best, others, figures = search(free, lambda part: starts_of(part, starts, seed))
    enough_rows(best.at.rows, errors.errors, errors.unknowns.size, "lags")
    problem = pose(errors.normalise(best.x))
    return (yield from refine(problem, best, figures, entry(problem, free, [best, *others])))


def search(criterion: TransferErrors, starts: Callable[[TransferErrors], Iterable[tuple[str, Array]]]
           ) -> tuple[Descent, list[Descent], dict[str, Any]]:
    """Descend from every start and return the best optimum, the other ones, and the figures of the comparison.

    On long records the starts (name, point) are compared on a part, and the best one descends on the whole. No start
    with a stable predictor is a `RankError`.
    """
    part, filtered = _part(criterion), criterion.unknowns.innovations
    found = best_of(part, starts(part), enough=None if filtered else SUFFICIENT)
    if not found:
        raise RankError(f"no start has a stable {'predictor' if filtered else 'simulation'}; use other orders")
    while True:  # on the whole record the best start may end at the border of stability
        best, x = found[0], np.zeros(criterion.unknowns.size)
        x[: criterion.unknowns.shared] = best.x[: criterion.unknowns.shared]
        final = descend(criterion, best.x if part is criterion else x, start=best.start)
        found[0] = replace(best, border=best.border or final.border)
        if found[0].rank <= min(one.rank for one in found):
            break
        found.sort(key=lambda one: one.rank)
    agreed, sentence = agreement(found, 1e-12 * part.energy)
    values = criterion.unit * np.sort([one.value for one in found])[::-1]
    figures = {"starts": sentence, **({"starts that agree": agreed} if filtered else {}),
               f"{criterion.errors} of the starts": values}
    others = [one for one in found[1:] if abs(one.value - best.value) > 1e-3 * best.value] if part is criterion else []
    return replace(final, steps=final.steps + best.steps), others, figures


def _part(criterion: TransferErrors) -> TransferErrors:
    """The middle of a long record, or the record itself where it is short or the middle is mostly missing."""
    data = criterion.data
    if data.n_samples <= 2 * SEARCH:
        return criterion
    sizes = [e.n_samples for e in data.experiments]
    if max(sizes) < SEARCH:  # many short experiments
        cut = data.select(experiments=list(range(int(np.searchsorted(np.cumsum(sizes), SEARCH)) + 1)))
    else:
        first = (max(sizes) - SEARCH) // 2
        cut = data.select(experiments=[int(np.argmax(sizes))]).window(first, first + SEARCH)
    if 2 * _complete(cut) < _complete(data):
        return criterion
    return replace(criterion, data=cut, unknowns=replace(criterion.unknowns, experiments=cut.n_experiments))


def _complete(data: Data) -> float:
    """Share of the samples of which no channel is missing."""
    return float(np.mean(np.concatenate([np.isfinite(record).all(axis=1) for record in data.records])))


def entry(fit: Problem, criterion: TransferErrors, found: Sequence[Descent]) -> Array:
    """Return the start under the constraints: the best of the optima with their poles moved into the region.

    The other unknowns are fitted again; without constraints on the poles alone they stay. Where a pole must lie at 1,
    the nearest one is moved there.
    """
    if not fit.builders:
        return with_required_signs(fit, found[0].x)
    at, ends = criterion.unknowns.slices["a"], []
    for one in found[:ENTRIES]:
        x = with_required_signs(fit, one.x)
        first = with_integrator if criterion.integrates and criterion.unknowns.layout.na else np.array
        moves: list[Callable[[Array], Array]] = [first, *(partial(contain_roots, limit=radius) for radius in PULLS)]
        for move in moves:
            pulled = move(x[at])
            if excess(fit, np.concatenate([pulled, x[at.stop :]]), frozenset({"a"})) <= 1e-9:
                again = one if np.array_equal(pulled, x[at]) else with_poles(criterion, x, pulled)
                ends.append((again.value, again.x))
                break
    return with_required_signs(fit, min(ends, key=lambda end: end[0])[1] if ends else found[0].x)


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
    return with_poles(plain, plain.normalise(x), contain_roots(x[unknowns.slices["a"]], RADIUS)).x


def extended_least_squares(criterion: TransferErrors) -> dict[str, Array]:
    """Return starts of an ARMAX model: the equation error alone, and extended least squares with its innovations.

    The innovations of a long ARX model (Hannan and Rissanen 1982), later those of the estimate, are regressors for the
    noise (Ding and Chen 2005); every pass is the rank-one least-squares problem, and the best pass is returned. Errors
    are those of `equation_error`.
    """
    unknowns = criterion.unknowns
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # rows lost in a start
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
        return equation_error(replace(criterion, data=criterion.data.map_signals(np.asarray, interpolate_missing)))


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
    """Yield points with other zeros of C without end; nothing without zeros."""
    rng, nc = np.random.default_rng(seed), unknowns.nc
    for i in count(1) if nc else ():
        pairs = RADIUS * np.sqrt(rng.random(nc // 2)) * np.exp(1j * np.pi * rng.random(nc // 2))
        zeros = np.concatenate([pairs, pairs.conj(), RADIUS * rng.uniform(-1, 1, nc % 2)])
        moved = x.copy()
        moved[unknowns.slices["c"]] = with_roots(zeros, nc)
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
    return contain_roots(theta[nd:], RADIUS), contain_roots(-theta[:nd], RADIUS)


def _regression(records: Sequence[Array], terms: Sequence[tuple[int, int]]) -> Array:
    """Regress channel 0 of records (N, channels) on terms (channel, lag) over complete rows, or raise a `RankError`."""
    rows, n = 1 + max((lag for _, lag in terms), default=0), len(terms)
    statistics = hankel_statistics([record for record in records if len(record) >= rows], rows)
    order = [statistics.at([channel], [rows - 1 - lag])[0] for channel, lag in [*terms, (0, 0)]]
    triangle = statistics.triangle(order)
    return np.linalg.lstsq(triangle[:n, :n], triangle[:n, n], rcond=1e-12)[0]


def plant_starts(criterion: TransferErrors, seed: int) -> Iterator[tuple[str, Array]]:
    """Yield starts, each estimated on demand: those of other methods, then perturbed poles without end."""
    base = arx_start(criterion)
    yield "ARX", base.x
    for name in ("Steiglitz-McBride", "instruments"):
        if (one := iterate_passes(criterion, base.x, name)) is not None:
            yield name, one.x
    if (a := _subspace(criterion.data, criterion.unknowns.layout)) is not None:
        yield "subspace", with_poles(criterion, base.x, a).x
    rng = np.random.default_rng(seed)
    for i in count(1) if criterion.unknowns.layout.na else ():
        a = _perturbed(rng, base.x[criterion.unknowns.slices["a"]])
        yield f"perturbed {i}", with_poles(criterion, base.x, a).x


def arx_start(criterion: TransferErrors) -> Descent:
    """Return the model of the equation error with its poles contained, a guess where the rows do not suffice."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # rows lost in a start
            point = equation_error(criterion)
    except OptidError:
        point = _guess(criterion.unknowns)
    x = criterion.normalise(criterion.unknowns.pack(point))
    return with_poles(criterion, x, contain_roots(point.a, RADIUS))


def equation_error(criterion: TransferErrors, innovations: Sequence[Array] | None = None) -> TransferPoint:
    """Return the rank-one least squares of the equation error (ARX), initial states zero.

    The coefficients of given innovations (N,) are those of C. What the record does not determine, and innovations of
    zero, are refused (`StructureError`, `RankError`, `DataError`).
    """
    data, unknowns, layout = criterion.data, criterion.unknowns, criterion.unknowns.layout
    if innovations is not None:
        names = [*data.inputs, " ".join(["innovation", *data.inputs, *data.outputs])]  # a name that no channel has
        us = [np.column_stack([one.u, e]) for one, e in zip(data.experiments, innovations)]
        data = Data(us, [one.y for one in data.experiments], data.dt, names, list(data.outputs))
        layout = replace(layout, nb=(*layout.nb, unknowns.nc), nk=(*layout.nk, 1), inputs=tuple(names),
                         bases=fitted_bases(data, (*layout.bases, Linear())))
    statistics, means = collect_by_experiment(data, layout) if unknowns.levels else (collect(data, layout), None)
    na, point = layout.na, minimise(lifted_problem(statistics, positions(layout)), count=4).point
    x0, a = np.zeros((unknowns.experiments, unknowns.memory)), np.array(point.w[:na])
    if means is not None:
        thetas = [np.ravel(np.outer(mu, b), order="F") for mu, b in zip(point.mus, point.bs)]
        x0[:, -1:] = means.constants(np.concatenate([point.w, *thetas])[positions(layout)])
    pairs = [(np.array(mu, dtype=float), np.ravel(np.array(b, dtype=float))) for mu, b in zip(point.mus, point.bs)]
    c = pairs.pop() if innovations is not None else (np.ones(1), np.zeros(unknowns.nc))
    pairs = [(mu, b) if free else (np.ones(1), b * mu[0]) for free, (mu, b) in zip(unknowns.free, pairs)]
    return TransferPoint(a, tuple(mu for mu, _ in pairs), tuple(b for _, b in pairs), float(point.w[na]), x0,
                         contain_roots(c[0][0] * c[1], RADIUS), a)


def iterate_passes(criterion: TransferErrors, x: Array, method: str) -> Descent | None:
    """Return the best pass of "Steiglitz-McBride" or of the refined instrumental variable ("instruments").

    Both are Gauss-Newton steps with columns of the measured output for a: as regressors in the first case, with
    simulated instruments in the second (Steiglitz and McBride 1965; Young 1976). None without poles.
    """
    unknowns = criterion.unknowns
    p, na = unknowns.shared, unknowns.layout.na
    at, best = unknowns.slices["a"], None
    for _ in range(PASSES if na else 0):
        gram = criterion.instruments(unknowns.unpack(x))
        regressors = np.arange(p)
        regressors[at] = p + np.arange(na)
        tested = regressors if method == "Steiglitz-McBride" else np.arange(p)
        normal, right = gram[np.ix_(tested, regressors)], -gram[tested, -1]
        rows = criterion.gauge_rows(x)
        size = np.sqrt(np.maximum(np.diag(gram)[regressors], 1e-300))
        system = np.vstack([normal / np.outer(size, size), rows])
        step = np.linalg.lstsq(system, np.concatenate([right / size, np.zeros(len(rows))]), rcond=1e-12)[0] / size
        x = x.copy()
        x[:p] += step
        if not np.all(np.isfinite(x)):
            break
        found = with_poles(criterion, x, contain_roots(x[at], 0.9999))
        settled = best is not None and abs(found.value - best.value) <= 1e-3 * best.value
        best = found if best is None or found.value < best.value else best
        if settled:
            break
        x = found.x
    return best


def _subspace(data: Data, layout: Layout) -> Array | None:
    """Return A from the subspace of the expanded inputs (past instruments); None where it is wide or fails."""
    if not layout.na or sum(basis.size for basis in layout.bases) > WIDE:
        return None
    records = data.records
    try:
        expansion = expand(data, layout.bases)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            found = project(records, expansion, expansion.block_rows(records, layout.na), instruments="past")
        poles = np.linalg.eigvals(realise(found.gamma(layout.na), 1)[0])
    except (OptidError, np.linalg.LinAlgError):
        return None
    a = with_roots(poles, layout.na)
    return contain_roots(a, RADIUS) if np.all(np.isfinite(a)) else None


def _guess(unknowns: TransferUnknowns) -> TransferPoint:
    """Return a start without any estimate: real poles, nearly linear nonlinearities."""
    layout, mus = unknowns.layout, []
    for basis, free in zip(layout.bases, unknowns.free):
        points = basis.grid()
        mus.append(np.linalg.lstsq(basis.values(points), points - points.mean())[0] if free else np.ones(1))
    bs = tuple(np.full(nb, 1 / np.sqrt(nb)) for nb in layout.nb)
    a = with_roots(np.full(layout.na, 0.5), layout.na)
    return TransferPoint(a, tuple(mus), bs, 0.0, np.zeros((unknowns.experiments, unknowns.memory)))


def _perturbed(rng: np.random.Generator, a: Array) -> Array:
    """Return coefficients of A with its poles moved at random: nearby, or anywhere in the disc in conjugate pairs."""
    roots = roots_of(contain_roots(a, RADIUS))
    if rng.random() < 0.5:
        upper = roots[np.imag(roots) >= 0]
        radius = 1 - np.clip((1 - np.abs(upper)) * np.exp(rng.normal(0, 1.0, upper.size)), 1 - RADIUS, 1.0)
        angle = np.abs(np.angle(upper) + rng.normal(0, 0.1, upper.size))
        moved = radius * np.exp(1j * np.where(np.imag(upper) > 0, angle, np.angle(upper)))
        return with_roots(np.concatenate([moved, np.conj(moved[np.imag(upper) > 0])]), len(a))
    pairs = len(a) // 2
    moved = RADIUS * np.sqrt(rng.random(pairs)) * np.exp(1j * np.pi * rng.random(pairs) ** 2)
    real = RADIUS * np.sqrt(rng.random(len(a) - 2 * pairs))
    return with_roots(np.concatenate([moved, np.conj(moved), real]), len(a))
