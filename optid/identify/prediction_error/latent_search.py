"""The search for functions of latent signals, one after another: directions of z by the gain of one Gauss-Newton step.

With Ez and Fz at zero the errors are linear in both, for every direction of z. The rank-one parts of the best steps
start short descents, of which the best continue. Splines begin with few cells, which are halved; long records begin
with a part of their samples.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from optid.arrays import LARGEST_INTEGER, Array, check_integer, one_of, short_repr
from optid.bases import Basis, BSpline, Linear, Polynomial, parse
from optid.data.record import Data
from optid.errors import DataError, DataWarning, RankError, StructureError
from optid.identify.arguments import outputs_present
from optid.identify.prediction_error.descent import COMPARED, Descent, descend
from optid.identify.prediction_error.latent_directions import MARGIN, directions
from optid.identify.prediction_error.state_errors import StateErrors
from optid.identify.prediction_error.state_search import start_from_model
from optid.models import HammersteinSS
from optid.statistics.state_unknowns import Latent, StatePoint, beyond_affine

RANKED = 3_000  # samples on which directions are ranked and tried
FEWEST = 100  # samples of an experiment that is cut
STAGES = (8_000, 20_000)  # samples of the descents before the one on the whole record
CELLS = 12  # largest number of cells of a spline in the search
SAME = 0.999  # ratio of the gains of two directions above which they count as the same
SHORT = 12
HEATS = ((10, SHORT), (5, 30), (2, 60))  # numbers of descents, and their steps
LEFT = 0.1  # share of the errors by one more function, from which the search is repeated
# relative fall over a few steps below which descents stop: in the search, on the whole of a long or short record
PACE = {"search": 1e-2, "long": 3e-3, "short": 0.0}
SIZES = (1.0, 0.3, 0.05)  # shares of the Gauss-Newton step from which a descent may start
SHARES = (0.9, 0.7, 0.5, 0.3, 0.1, 0.0)  # sizes of a function where a longer record would leave its range
Extend = Callable[..., Any]  # see `optid.identify.prediction_error.state_fit.fit_states`


def latent_channels(channels: int, latent_basis: Any, latent: str, direct: bool, seed: int, iterations: int,
                    tries: int) -> Extend:
    """Return what adds the latent signals of `formulations.latent_signals.lfr`; arguments and errors as there."""
    check_integer(channels, "channels")
    check_integer(seed, "seed", 0, LARGEST_INTEGER)
    one_of("latent", latent, ("states+inputs", "states"))
    inner = _on_latent(latent_basis)
    one = Latent(inner, beyond_affine(inner), direct=direct, moved=latent != "states")
    return partial(add_channels, channels=(one,) * channels, seed=seed, iterations=iterations,
                   tries=check_integer(tries, "tries", 0))


def output_functions(basis: Any, outputs: int, moved: bool, iterations: int) -> Extend:
    """Return what puts a function in a basis in the place of every output, moved by inputs at once or not."""
    inner = _on_latent(basis)
    functions = tuple(Latent(inner, np.eye(inner.size), feeds=False, output=o, moved=moved) for o in range(outputs))
    return partial(add_output_functions, functions=functions, iterations=iterations)


def _on_latent(given: Basis | str) -> Basis:
    """Return the basis of a latent function, on [-1, 1]."""
    basis = parse(given) if isinstance(given, str) else given
    if not isinstance(basis, Basis):
        raise StructureError(f"the basis of a latent signal is {short_repr(given)}: give one such as Polynomial(3) or "
                             "its name, 'polynomial:3'")
    outside = "extrapolate" if isinstance(basis, Polynomial) else "linear"
    return replace(cast(Any, basis), interval=(-1.0, 1.0), outside=outside)


def add_channels(errors: StateErrors, best: Descent, known: Sequence[HammersteinSS], channels: tuple[Latent, ...], *,
                 seed: int = 0, iterations: int = 60, tries: int = 2) -> tuple[StateErrors, Descent, dict[str, Any]]:
    """Add functions of latent signals to a model; return the criterion with them, its optimum, and figures.

    Args:
        errors: the criterion of the model without them.
        best: its optimum.
        known: models with the functions, from which to descend as well.
        channels: the functions, each on the interval [-1, 1] of its argument.
        seed: of the random directions.
        iterations: of a descent at most.
        tries: searches for every function, after the first with the other functions present. Where one more function
            would gain much, all of them are searched again from other directions, ``2 tries - 1`` times at most. With 0
            the known models alone are starts.

    Raises:
        RankError: no direction of z leads to a model whose run stays finite.
        StructureError: a known model has other functions.
    """
    rng, refusal = np.random.default_rng(seed), RankError("no start has a finite run that stays in its range")
    searches = _continued(_widened(errors, channels), known, iterations)
    for _ in range(2 * tries - 1):
        try:
            searches.append(_search(errors, best, channels, rng, iterations, tries))
        except RankError as error:
            refusal = error
            continue
        if _expected(searches[-1][0], searches[-1][1].x, channels[0], rng) <= LEFT:
            break
    if not searches:
        raise refusal
    part, end, figures = min(searches, key=lambda one: one[1].value)
    if iterations:
        figures |= _idle(errors, best.x, part, end)
    return part, end, figures


def _continued(errors: StateErrors, known: Sequence[HammersteinSS], iterations: int
               ) -> list[tuple[StateErrors, Descent, dict[str, Any]]]:
    """Descend from known models with all functions, where their runs stay finite."""
    pace, found = PACE["long" if errors.data.n_samples > STAGES[0] else "short"], []
    for i, model in enumerate(known, start=1):
        if (x := start_from_model(errors, model)) is not None:
            found.append((errors, descend(errors, x, iterations=iterations, progress=pace, start=f"start {i}"), {}))
    return [one for one in found if np.isfinite(one[1].value)]


def _search(errors: StateErrors, best: Descent, channels: tuple[Latent, ...], rng: np.random.Generator,
            iterations: int, tries: int) -> tuple[StateErrors, Descent, dict[str, Any]]:
    """Search once; arguments and errors as `add_channels`."""
    figures: dict[str, Any] = {}
    part = replace(errors, data=first_samples(errors.data, RANKED // errors.unknowns.l))
    x, steps = best.x, best.steps
    for number, latent in enumerate(channels, start=1):
        try:
            wider, end, expected = _added(part, x, _coarse(latent), rng, iterations)
        except RankError as error:
            raise RankError(f"latent signal {number}: {error}") from error
        figures[f"expected gain of latent signal {number}"] = expected
        x, more = _confirmed(wider, end.x, part, x, errors.data)
        part, steps = wider, steps + end.steps + more
    end = descend(part, x, iterations=0)
    for number in [*range(len(channels))] * (tries - 1):
        part, end, more = _exchanged(part, end, number, rng, iterations)
        x, steps = end.x, steps + more
    total = errors.data.n_samples
    for size in sorted({min(size, total) for size in (*STAGES, total)}):
        part = replace(part, data=first_samples(errors.data, size))
        while part.unknowns.latent[0].size < channels[0].size:
            end = descend(part, _finite(part, x), iterations=iterations, tolerance=COMPARED, progress=PACE["search"])
            part, x = _renewed(part, end.x, 2)
            steps += end.steps
        pace = PACE["search" if size < total else "long" if size > STAGES[0] else "short"]
        end = descend(part, _finite(part, x), iterations=iterations, progress=pace, start=best.start)
        x, steps = end.x, steps + end.steps
    return part, replace(end, steps=steps), figures


def _confirmed(wider: StateErrors, x: Array, errors: StateErrors, before: Array, data: Data) -> tuple[Array, int]:
    """Return a point with one more function, of the few samples it was searched on, that is no worse on many more.

    Where it is worse than the point before, the function begins there at zero, with its argument. Also return the
    steps taken.
    """
    many = first_samples(data, STAGES[0])
    more, fewer = replace(wider, data=many), replace(errors, data=many)
    reference = descend(fewer, before, iterations=SHORT, tolerance=COMPARED, progress=PACE["search"])
    steps = reference.steps
    with suppress(RankError):
        found = descend(more, _finite(more, x), iterations=SHORT, tolerance=COMPARED, progress=PACE["search"])
        steps += found.steps
        if found.value < reference.value:
            return found.x, steps
    start, point = fewer.unknowns.unpack(reference.x), more.unknowns.unpack(x)
    row = np.concatenate([point.Cz[-1], point.Dz[-1], point.offset_z[-1:]])
    n, outputs = fewer.unknowns.n, fewer.unknowns.l
    zero = more.unknowns.pack(_with(start, row[None], point.cs[-1:], np.zeros((n, 1)), np.zeros((outputs, 1))))
    zero = more.normalise(zero)
    found = descend(more, zero, iterations=SHORT, tolerance=COMPARED, progress=PACE["search"])
    return (found.x if found.value <= reference.value else zero), steps + found.steps


def _expected(errors: StateErrors, x: Array, latent: Latent, rng: np.random.Generator) -> float:
    """Return the gain expected of one more function beyond twice that for white errors."""
    part = replace(errors, data=first_samples(errors.data, RANKED // errors.unknowns.l))
    more = _coarse(latent)
    by_chance = (errors.unknowns.n + errors.unknowns.l) * more.size / outputs_present(part.data)
    return max((gain for gain, *_ in _ranked(part, x, more, rng)), default=0.0) - 2 * by_chance


def _added(part: StateErrors, x: Array, latent: Latent, rng: np.random.Generator, iterations: int
           ) -> tuple[StateErrors, Descent, float]:
    """Add the function of a latent signal; also return the expected gain of its best direction."""
    x = whiten_states(part, x)
    ranked = sorted(_ranked(part, x, latent, rng), key=lambda one: -one[0])
    ranked = [one for one, before in zip(ranked, [None, *ranked]) if before is None or one[0] < SAME * before[0]]
    ends = [one for _, *chosen in ranked[: HEATS[0][0]] if (one := _short(part, x, latent, *chosen)) is not None]
    if not ends:
        raise RankError("no direction gives a finite run: use fewer latent signals, another basis, or latent='states'.")
    part, steps = _widened(part, (latent,)), sum(one.steps for one in ends)
    ends.sort(key=lambda one: one.value)
    starts = []
    for one in ends[: HEATS[1][0]]:
        filled = _renewed(part, one.x)[1]  # long first steps may have moved z far
        starts.append(filled if np.isfinite(part.value(filled)) else one.x)
    for count, more in (*HEATS[1:], (1, iterations)):
        ends = [descend(part, x, iterations=more, tolerance=COMPARED, progress=PACE["search"]) for x in starts[:count]]
        ends.sort(key=lambda one: one.value)
        starts, steps = [one.x for one in ends], steps + sum(one.steps for one in ends)
    return part, replace(ends[0], steps=steps), ranked[0][0]


def _exchanged(part: StateErrors, end: Descent, number: int, rng: np.random.Generator, iterations: int
               ) -> tuple[StateErrors, Descent, int]:
    """Search again for one function with the others present; return the better model, and the steps taken."""
    point, latent = part.unknowns.unpack(end.x), part.unknowns.latent
    kept = np.delete(np.arange(len(latent)), number)
    rest = replace(part, unknowns=replace(part.unknowns, latent=tuple(latent[i] for i in kept)))
    left = replace(point, cs=tuple(point.cs[i] for i in kept), Ez=point.Ez[:, kept], Fz=point.Fz[:, kept],
                   Cz=point.Cz[kept], Dz=point.Dz[kept], offset_z=point.offset_z[kept])
    without = descend(rest, rest.unknowns.pack(left), iterations=SHORT, tolerance=COMPARED)
    if not np.isfinite(without.value):
        return part, end, without.steps
    try:
        new, found, _ = _added(rest, without.x, latent[number], rng, iterations)
    except RankError:
        return part, end, without.steps
    steps = without.steps + found.steps
    return (new, found, steps) if found.value < end.value else (part, end, steps)


def _coarse(latent: Latent) -> Latent:
    """Return a function on fewer cells, which can be halved until they are those of a spline."""
    basis = latent.basis
    while isinstance(basis, BSpline) and basis.p > CELLS and basis.p % 2 == 0:
        basis = replace(basis, p=basis.p // 2)
    return replace(latent, basis=basis, vectors=beyond_affine(basis))


def _renewed(errors: StateErrors, x: Array, cells: int = 1) -> tuple[StateErrors, Array]:
    """Divide the cells of every function, and rescale z to its interval where it has left it or shrunk.

    The affine parts of the functions move to the matrices and offsets. A division alone changes nothing.
    """
    unknowns, finer, cs, affine = errors.unknowns, [], [], []
    point, known = unknowns.unpack(x), np.linspace(-1, 1, 1001)
    rows = np.hstack([point.Cz, point.Dz, point.offset_z[:, None]])
    inputs = np.vstack([e.u for e in errors.data.experiments])
    signals = np.hstack([np.vstack(errors.run_states(point)), inputs, np.ones((len(inputs), 1))])
    for one, row, c in zip(unknowns.latent, rows, point.cs):
        basis: Any = one.basis
        basis = basis if cells == 1 else replace(basis, p=cells * basis.p)
        finer.append(replace(one, basis=basis, vectors=beyond_affine(basis)))
        z, low, high = known, np.min(signals @ row), np.max(signals @ row)
        if max(-low, high) > 1 or high - low < 1:
            factor, middle = 2 / (MARGIN * (high - low)), (low + high) / 2
            z = middle + known / factor
            row[-1] -= middle
            row *= factor
        columns = np.column_stack([basis.values(known) @ finer[-1].vectors, known, np.ones(known.size)])
        found = np.linalg.lstsq(columns, one.basis.values(z) @ one.vectors @ c)[0]
        cs.append(found[:-2])
        affine.append(found[-2] * row + found[-1] * np.eye(row.size)[-1])
    n, point = unknowns.n, replace(point, Cz=rows[:, : unknowns.n], Dz=rows[:, unknowns.n : -1], offset_z=rows[:, -1])
    linear = np.array([isinstance(basis, Linear) for basis in unknowns.expansion.inputs])
    to_state, to_output = point.Ez @ affine, point.Fz @ affine
    A, C = point.A + to_state[:, :n], point.C + to_output[:, :n]
    shift = np.linalg.lstsq(np.eye(n) - A, to_state[:, -1])[0]
    point = replace(point, A=A, C=C, b=point.b + linear * to_state[:, n:-1], x0=point.x0 - shift, cs=tuple(cs),
                    d=point.d + linear * unknowns.feedthrough * to_output[:, n:-1],
                    offset=point.offset + C @ shift + to_output[:, -1], offset_z=point.offset_z + point.Cz @ shift)
    errors = replace(errors, unknowns=replace(unknowns, latent=tuple(finer)))
    return errors, errors.normalise(errors.unknowns.pack(point))


def add_output_functions(errors: StateErrors, best: Descent, known: Sequence[HammersteinSS],
                         functions: tuple[Latent, ...], iterations: int = 60
                         ) -> tuple[StateErrors, Descent, dict[str, Any]]:
    """Make every output a function of the former output z_o: y_o = h_o(z_o) + constant.

    Arguments and errors as `add_channels`; ``functions`` has one for every output.
    """
    linear, point, n = errors, errors.unknowns.unpack(best.x), errors.unknowns.n
    signals = np.hstack([np.vstack(errors.run_states(point)), np.vstack([e.u for e in errors.data.experiments])])
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
    ends = [descend(errors, errors.unknowns.pack(start), iterations=iterations, start=best.start)]
    ends += [end for _, end, _ in _continued(errors, known, iterations)]
    found = min(ends, key=lambda end: end.value)
    return errors, replace(found, steps=best.steps + found.steps), _idle(linear, best.x, errors, found)


def _idle(before: StateErrors, x: Array, after: StateErrors, found: Descent) -> dict[str, Any]:
    """Return a figure, with a warning, where functions reduce the errors insignificantly (BIC)."""
    rows, more = outputs_present(after.data), after.unknowns.size - before.unknowns.size
    without, left = before.value(x), found.value
    if not np.isfinite(without) or rows * np.log(max(without, 1e-300) / max(left, 1e-300)) > more * np.log(rows):
        return {}
    effect = (f"they lower the squared errors by {max(100 * (1 - left / max(without, 1e-300)), 0.0):.2g} %, "
              f"insignificant for {more} parameters (BIC): leave them out")
    warnings.warn(f"The functions of latent signals have no significant effect: {effect}.", DataWarning, stacklevel=2)
    return {"effect of latent signals": effect}


def whiten_states(errors: StateErrors, x: Array) -> Array:
    """Return the same model in states of unit covariance over the record."""
    point = errors.unknowns.unpack(x)
    runs = errors.run_states(point)
    covariance = np.atleast_2d(np.cov(np.vstack(runs).T))
    values, vectors = np.linalg.eigh(covariance + 1e-9 * np.trace(covariance) * np.eye(len(covariance)))
    turn = (vectors / np.sqrt(values)).T
    back = np.linalg.inv(turn)
    moved = replace(point, A=turn @ point.A @ back, C=point.C @ back, K=turn @ point.K, b=turn @ point.b,
                    e=turn @ point.e, Ez=turn @ point.Ez, Cz=point.Cz @ back, x0=point.x0 @ turn.T)
    return errors.normalise(errors.unknowns.pack(moved))


def first_samples(data: Data, size: int) -> Data:
    """Return a long record cut to so many samples, the first of every experiment in proportion to its length."""
    share = size / data.n_samples
    if share >= 1:
        return data
    lengths = [min(max(round(share * e.n_samples), FEWEST), e.n_samples) for e in data.experiments]
    return Data.join(*(data.select(experiments=i).window(0, n) for i, n in enumerate(lengths)))


def _finite(errors: StateErrors, start: Array) -> Array:
    """Return a start whose run stays in its range, with a smaller last function if necessary."""
    at, last = errors.unknowns.slices, len(errors.unknowns.latent) - 1
    for share in (1.0, *SHARES):
        x = np.array(start)
        x[at[f"g{last}"]] *= share
        if np.isfinite(errors.value(x)):
            return x
    raise RankError("a model with a finite run on the first samples leaves the range of the record on the rest: use "
                    "fewer latent signals, or another basis.")


def _widened(errors: StateErrors, latent: tuple[Latent, ...]) -> StateErrors:
    return replace(errors, unknowns=replace(errors.unknowns, latent=(*errors.unknowns.latent, *latent)))


def _with(point: StatePoint, rows: Array, cs: tuple[Array, ...], Ez: Array, Fz: Array) -> StatePoint:
    """The point with further latent functions; ``rows`` (k, n + m + 1) are those of their arguments."""
    n = len(point.A)
    return replace(point, cs=(*point.cs, *cs), Ez=np.hstack([point.Ez, Ez]), Fz=np.hstack([point.Fz, Fz]),
                   Cz=np.vstack([point.Cz, rows[:, :n]]), Dz=np.vstack([point.Dz, rows[:, n:-1]]),
                   offset_z=np.concatenate([point.offset_z, rows[:, -1]]))


def _ranked(errors: StateErrors, x: Array, latent: Latent, rng: np.random.Generator
            ) -> Iterator[tuple[float, Array, Array]]:
    """Yield (relative gain of a Gauss-Newton step, row of z, matrix [Ez; Fz] (n + l, r) of the step)."""
    point, n = errors.unknowns.unpack(x), errors.unknowns.n
    r, outputs = latent.size, errors.unknowns.l
    for row in directions(errors, point, latent, rng):
        single = [replace(latent, vectors=latent.vectors[:, [j]], row=row) for j in range(r)]
        trial = _widened(errors, tuple(single))
        start = _with(point, np.tile(row, (r, 1)), (np.ones(1),) * r, np.zeros((n, r)), np.zeros((outputs, r)))
        at = trial.linearise(trial.unknowns.pack(start), "gram")
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
    """Descend briefly from the rank-one part of a Gauss-Newton step; None where no share of it stays finite."""
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
