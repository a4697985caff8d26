"""Starts of the plant: equation error, Steiglitz-McBride, refined instruments, subspace, perturbed poles.

All of them give coefficients of a stable A; poles outside the unit circle are reflected into it. The numerators and
nonlinearities that belong to a given A follow by a few steps in which A is held.
"""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from optid.arrays import Array
from optid.bases import Linear, fitted_bases
from optid.data.record import Data
from optid.errors import DataWarning, OptidError
from optid.identify.prediction_error.descent import Descent, descend
from optid.identify.prediction_error.transfer_errors import TransferErrors
from optid.identify.subspace.projection import project, realise
from optid.models.layout import Layout
from optid.models.roots import contained, roots_of, with_roots
from optid.statistics.expansion import expand
from optid.statistics.regression import collect
from optid.statistics.unknowns import TransferPoint, TransferUnknowns
from optid.structures.bilinear import minimise
from optid.structures.lifted_regression import lifted_problem, positions

PASSES = 8  # passes of Steiglitz-McBride and of the instruments; they settle in fewer or not at all
WIDE = 6  # functions, over all inputs, up to which the subspace start is worth its cost
RADIUS = 0.98  # poles of a start lie inside this radius, so that its simulation forgets within the record


def plant_starts(criterion: TransferErrors, seed: int) -> Iterator[tuple[str, Array]]:
    """Yield starts, each estimated when it is asked for: those of other methods, then moved poles again and again."""
    base = arx_start(criterion)
    yield "ARX", base.x
    for name in ("Steiglitz-McBride", "instruments"):
        if (one := iterated(criterion, base.x, name)) is not None:
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
            warnings.simplefilter("ignore", DataWarning)  # rows lost here are not lost to the simulation error
            point = equation_error(criterion)
    except OptidError:
        point = _guess(criterion.unknowns)
    x = criterion.normalised(criterion.unknowns.pack(point))
    return with_poles(criterion, x, contained(point.a, RADIUS))


def equation_error(criterion: TransferErrors, innovations: Sequence[Array] | None = None) -> TransferPoint:
    """Return the rank-one least squares of the equation error (ARX); initial states are zero.

    The coefficients of given innovations (N,) are those of C, which is one without them. What the record does not
    determine, and innovations of zero, are refused (`StructureError`, `RankError`, `DataError`).
    """
    data, unknowns, layout = criterion.data, criterion.unknowns, criterion.unknowns.layout
    if innovations is not None:
        names = [*data.inputs, " ".join(["innovation", *data.inputs, *data.outputs])]  # a name that no channel has
        us = [np.column_stack([one.u, e]) for one, e in zip(data.experiments, innovations)]
        data = Data(us, [one.y for one in data.experiments], data.dt, names, list(data.outputs))
        layout = replace(layout, nb=(*layout.nb, unknowns.nc), nk=(*layout.nk, 1), inputs=tuple(names),
                         bases=fitted_bases(data, (*layout.bases, Linear())))
    na, point = layout.na, minimise(lifted_problem(collect(data, layout), positions(layout)), count=4).point
    pairs = [(np.array(mu, dtype=float), np.ravel(np.array(b, dtype=float))) for mu, b in zip(point.mus, point.bs)]
    c = pairs.pop() if innovations is not None else (np.ones(1), np.zeros(unknowns.nc))
    pairs = [(mu, b) if free else (np.ones(1), b * mu[0]) for free, (mu, b) in zip(unknowns.free, pairs)]
    x0, a = np.zeros((unknowns.experiments, unknowns.memory)), np.array(point.w[:na])
    return TransferPoint(a, tuple(mu for mu, _ in pairs), tuple(b for _, b in pairs), float(point.w[na]), x0,
                         contained(c[0][0] * c[1], RADIUS), a)


def with_poles(criterion: TransferErrors, x: Array, a: Array) -> Descent:
    """Return what belongs to a given stable A: the rest of the unknowns after a few steps with A held."""
    unknowns, moved = criterion.unknowns, x.copy()
    moved[unknowns.slices["a"]] = a
    held = np.zeros(unknowns.shared, dtype=bool)
    held[unknowns.slices["a"]] = True
    return descend(criterion, moved, held=held, iterations=6, tolerance=1e-3)


def iterated(criterion: TransferErrors, x: Array, method: str) -> Descent | None:
    """Return the best point on the way of "Steiglitz-McBride" or of the refined instrumental variable ("instruments").

    Both linearise as Gauss-Newton does in everything but a, whose columns hold the measured output: as regressors in
    the first case, as regressors against simulated instruments in the second (Steiglitz and McBride 1965; Young 1976).
    Neither descends by rule, so the best pass counts. None without poles.
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
        found = with_poles(criterion, x, contained(x[at], 0.9999))
        settled = best is not None and abs(found.value - best.value) <= 1e-3 * best.value
        best = found if best is None or found.value < best.value else best
        if settled:
            break
        x = found.x
    return best


def _subspace(data: Data, layout: Layout) -> Array | None:
    """Return A from the subspace of the expanded inputs (past instruments); None where the record does not carry it.

    Wide expansions are left out: their block Hankel matrices cost more than all other starts together.
    """
    if not layout.na or sum(basis.size for basis in layout.bases) > WIDE:
        return None
    records = data.records
    try:
        expansion = expand(data, layout.bases)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # as in `arx_start`
            found = project(records, expansion, expansion.block_rows(records, layout.na), instruments="past")
        poles = np.linalg.eigvals(realise(found.gamma(layout.na), 1)[0])
    except (OptidError, np.linalg.LinAlgError):
        return None
    a = with_roots(poles, layout.na)
    return contained(a, RADIUS) if np.all(np.isfinite(a)) else None


def _guess(unknowns: TransferUnknowns) -> TransferPoint:
    """Return a start without any estimate: real poles, identity-like nonlinearities."""
    layout, mus = unknowns.layout, []
    for basis, free in zip(layout.bases, unknowns.free):
        points = basis.grid()
        line = np.linalg.lstsq(basis.values(points), points - points.mean(), rcond=None)[0]
        mus.append(line if free else np.ones(1))
    bs = tuple(np.full(nb, 1 / np.sqrt(nb)) for nb in layout.nb)
    a = with_roots(np.full(layout.na, 0.5), layout.na)
    return TransferPoint(a, tuple(mus), bs, 0.0, np.zeros((unknowns.experiments, unknowns.memory)))


def _perturbed(rng: np.random.Generator, a: Array) -> Array:
    """Return coefficients of A with its poles moved: in turn nearby, or anywhere in the disc in conjugate pairs."""
    roots = roots_of(contained(a, RADIUS))
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
