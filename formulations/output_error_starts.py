"""Starts of an output-error fit: equation error, Steiglitz-McBride, refined instruments, subspace, perturbed poles.

All of them give coefficients of a stable A; poles outside the unit circle are reflected into it. The numerators and
nonlinearities that belong to a given A follow by a few steps in which A is held.
"""

import warnings

import numpy as np

from formulations.equation_error import compress
from formulations.output_error import OutputError
from formulations.prediction_error import Descent, descend
from optid.data.record import Data
from optid.errors import DataWarning, OptidError
from optid.identify.subspace.projection import project, realise
from optid.models.roots import contained, roots_of
from optid.statistics.expansion import expand
from optid.statistics.sensitivities import PlantPoint, Unknowns, instruments
from optid.structures.bilinear import minimise

Array = np.ndarray

PASSES = 8
"""Passes of Steiglitz-McBride and of the instruments; they settle in fewer or not at all."""

WIDE = 6
"""Functions, over all inputs, up to which the subspace start is worth its cost."""

RADIUS = 0.98
"""Poles of a start lie inside this radius, so that its simulation forgets within the record."""


def equation_error(data: Data, unknowns: Unknowns) -> Array | None:
    """Return the rank-one least squares of the equation error (ARX) as a start; None where the rows do not suffice."""
    layout = unknowns.layout
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # rows lost here are not lost to the simulation error
            problem = compress(data, na=layout.na, nb=layout.nb, nk=layout.nk, basis=layout.bases, own=False)
        point = minimise(problem.problem, count=4).point
    except OptidError:
        return None
    values = problem.linear_part(point.w)
    mus, bs = [], []
    for free, mu, b in zip(unknowns.free, point.mus, point.bs):
        mus.append(np.asarray(mu if free else np.ones(1), dtype=float))
        bs.append(np.ravel(np.asarray(b if free else b * mu[0], dtype=float)))
    x0 = np.zeros((unknowns.experiments, unknowns.memory))
    a, offset = values.get("a", np.zeros(0)), float(values["offset"][0])
    return unknowns.pack(PlantPoint(a, tuple(mus), tuple(bs), offset, x0))


def subspace(data: Data, unknowns: Unknowns) -> Array | None:
    """Return A from the subspace of the expanded inputs (past instruments); None where the record does not carry it.

    Wide expansions are left out: their block Hankel matrices cost more than all other starts together.
    """
    layout = unknowns.layout
    if not layout.na or sum(basis.size for basis in layout.bases) > WIDE:
        return None
    records = [np.hstack([e.u, e.y]) for e in data.experiments]
    try:
        expansion = expand(records, layout.bases, (), layout.inputs, layout.outputs)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # as in `equation_error`
            found = project(records, expansion, expansion.block_rows(records, layout.na), instruments="past")
        poles = np.linalg.eigvals(realise(found.gamma(layout.na), 1)[0])
    except (OptidError, np.linalg.LinAlgError):
        return None
    a = np.asarray(np.real(np.poly(poles))[1:], dtype=float)
    return contained(a, RADIUS) if a.size == layout.na and np.all(np.isfinite(a)) else None


def blank(unknowns: Unknowns) -> Array:
    """Return a start without any estimate: real poles, identity-like nonlinearities."""
    layout = unknowns.layout
    mus = []
    for basis, free in zip(layout.bases, unknowns.free):
        points = basis.grid()
        line = np.linalg.lstsq(basis.values(points), points - points.mean(), rcond=None)[0]
        mus.append(line if free else np.ones(1))
    bs = tuple(np.full(nb, 1 / np.sqrt(nb)) for nb in layout.nb)
    x0 = np.zeros((unknowns.experiments, unknowns.memory))
    a = np.asarray(np.atleast_1d(np.poly(np.full(layout.na, 0.5)))[1:], dtype=float)
    return unknowns.pack(PlantPoint(a, tuple(mus), bs, 0.0, x0))


def with_poles(criterion: OutputError, x: Array, a: Array, start: str) -> Descent:
    """Return what belongs to a given stable A: the rest of the unknowns after a few steps with A held."""
    unknowns, moved = criterion.unknowns, x.copy()
    moved[unknowns.slices["a"]] = a
    held = np.zeros(unknowns.shared, dtype=bool)
    held[unknowns.slices["a"]] = True
    return descend(criterion, moved, held=held, iterations=6, tolerance=1e-3, start=start)


def iterated(criterion: OutputError, x: Array, method: str) -> Descent | None:
    """Return the best point on the way of Steiglitz-McBride ("sm") or of the refined instrumental variable ("iv").

    Both linearise as Gauss-Newton does in everything but a, whose columns hold the measured output: as regressors in
    the first case, as regressors against simulated instruments in the second (Steiglitz and McBride 1965; Young 1976).
    Neither descends by rule, so the best pass counts.

    Args:
        criterion: the errors.
        x: an admissible start.
        method: "sm" or "iv".
    """
    unknowns = criterion.unknowns
    p, na = unknowns.shared, unknowns.layout.na
    at, best = unknowns.slices["a"], None
    for _ in range(PASSES if na else 0):
        gram = instruments(criterion.data, unknowns, unknowns.unpack(x), functions=criterion.functions)
        regressors = np.arange(p)
        regressors[at] = p + np.arange(na)
        tested = regressors if method == "sm" else np.arange(p)
        normal, right = gram[np.ix_(tested, regressors)], -gram[tested, -1]
        rows = criterion.gauge_rows(x)
        size = np.sqrt(np.maximum(np.diag(gram)[regressors], 1e-300))
        system = np.vstack([normal / np.outer(size, size), rows])
        step = np.linalg.lstsq(system, np.concatenate([right / size, np.zeros(len(rows))]), rcond=1e-12)[0] / size
        x = x.copy()
        x[:p] += step
        if not np.all(np.isfinite(x)):
            break
        found = with_poles(criterion, x, contained(x[at], 0.9999), method)
        settled = best is not None and abs(found.value - best.value) <= 1e-3 * best.value
        best = found if best is None or found.value < best.value else best
        if settled:
            break
        x = found.x
    return best


def perturbed(rng: np.random.Generator, a: Array) -> Array:
    """Return coefficients of A with its poles moved: in turn nearby, or anywhere in the disc in conjugate pairs."""
    roots = roots_of(contained(a, RADIUS))
    if rng.random() < 0.5:
        upper = roots[np.imag(roots) >= 0]
        radius = 1 - np.clip((1 - np.abs(upper)) * np.exp(rng.normal(0, 1.0, upper.size)), 1 - RADIUS, 1.0)
        angle = np.abs(np.angle(upper) + rng.normal(0, 0.1, upper.size))
        moved = radius * np.exp(1j * np.where(np.imag(upper) > 0, angle, np.angle(upper)))
        return np.real(np.poly(np.concatenate([moved, np.conj(moved[np.imag(upper) > 0])])))[1:]
    pairs = len(a) // 2
    moved = RADIUS * np.sqrt(rng.random(pairs)) * np.exp(1j * np.pi * rng.random(pairs) ** 2)
    real = RADIUS * np.sqrt(rng.random(len(a) - 2 * pairs))
    return np.real(np.poly(np.concatenate([moved, np.conj(moved), real])))[1:]
