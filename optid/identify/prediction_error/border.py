"""Poles that meet on the border of a region, where a programme in the tangent of an iterate does not see its way on.

A pair of poles on the border that comes near the real axis turns ever steeper for its matrix inequality: steps end
although the errors fall further along the border, to a double pole that no such inequality contains. The errors as a
function of two poles, everything else fitted again, tell whether there is a better point.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
from scipy.linalg import schur

from optid.arrays import Array
from optid.errors import DataError
from optid.identify.prediction_error.criterion import Criterion
from optid.identify.prediction_error.descent import beside_poles
from optid.models.roots import roots_of
from optid.statistics.linearised import linearise_errors

# shares of the imaginary part of a pair that are tried
SHARES = (0.03, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0, 1.001, 1.01, 1.05, 1.25, 2.0)
SHIFTS = (-0.01, -1e-3, 1e-3, 0.01)  # of the mean of two poles, or of one of them, that are tried inside
APART = (1e-3, 0.01, 0.05, 0.2)  # half the distances that two real poles, or a pair nearly so, are tried at
LEAST = 5e-5  # imaginary part of a pair, at least: a double pole is hardly better
NEARLY = 0.05  # imaginary part below which a pair may become two real poles
ON = 0.01  # distance to the border of poles that lie on it, or on the way there
REACH = 0.3  # by which the mean of two poles is moved at most, to where both are inside
INWARD = 1e-7  # by which they are then moved back from the border
SHORT = 5000  # samples up to which moves are also tried where no pole is near a border: two may hide a valley
COUPLED = 0.01  # entry beside the diagonal of two poles, at least, without which they cannot become a double one
ROUNDING = 1e-7  # by which moved poles may lie outside
OUTSIDE = 1e-6  # the same of those that a programme placed
MOVES = 20  # one after the other
SLOW = 6  # time constants in the longest experiment of a pole that acts over much of it
STEPS, PARTS = 20, 6  # of the fit of everything else; halvings of each
FITTED = 1e-8  # share that a further step may promise where two poles meet
SETTLED = 1e-9  # share of the errors that a step gains that is the last


def about_poles(constraints: Sequence[Any]) -> Callable[[Array], float] | None:
    """Return by how much poles obey all constraints on them; None where there is none, or one that cannot tell."""
    rules = [rule for rule in constraints if "poles" in getattr(rule, "about", ())]
    depths = [depth for rule in rules if (depth := getattr(rule, "depth", None)) is not None]
    if not rules or len(depths) < len(rules):
        return None
    return lambda poles: min(depth(poles) for depth in depths)


def along_border(criterion: Criterion, depth: Callable[[Array], float], x: Array, share: float, alone: bool = True
                 ) -> Array:
    """Move two poles at a time along the border while that lowers the errors by a share; return the last point.

    Args:
        criterion: the errors, of a transfer function or a state-space model.
        depth: of `about_poles`.
        x: where to start; it is returned where it is allowed and no move is better.
        share: of the sum of squared errors.
        alone: whether everything but the poles is free, and fitted again; else it stays as it is.
    """
    def fit_rest(x: Array) -> tuple[Array, float]:
        if alone:
            return _fitted(criterion, x)
        return x, criterion.value(x) if criterion.admissible(x) else np.inf

    def is_allowed(two: Array) -> bool:
        return depth(two) >= -ROUNDING

    for _ in range(MOVES):
        poles = poles_of(criterion, x)
        inside = depth(poles) >= -OUTSIDE
        if inside and criterion.data.n_samples > SHORT and not _on_border(poles, is_allowed):
            break
        best, least = None, np.inf
        if inside:
            if alone:  # as far as it goes: valleys may be curved
                end = beside_poles(criterion, x, tolerance=FITTED, progress=SETTLED)
                point, least = end.x, end.value
            else:
                point, least = fit_rest(x)
            best = point if is_allowed(poles) and least < criterion.value(x) * (1 - share) else None
            least *= 1 - share if is_allowed(poles) else 1 + share  # a rounding outside, the border is as good
        for two, others in _couples(poles):
            for mean, square in _moves(two, is_allowed) if depth(others) >= -OUTSIDE else ():
                point, value = fit_rest(_moved(criterion, x, two, others, mean, square))
                if value < least:
                    best, least = point, value
        if best is None:
            break
        x = best
    return x


def poles_of(criterion: Criterion, x: Array) -> Any:
    """Return the poles at x."""
    part = criterion.unknowns.parts(x)[criterion.dynamics]
    return np.linalg.eigvals(part) if part.ndim == 2 else roots_of(part)


def creeps(criterion: Criterion, x: Array) -> bool:
    """Whether the slowest pole acts longer than an experiment."""
    if criterion.dynamics not in criterion.unknowns.slices:
        return False
    slowest = float(np.abs(poles_of(criterion, x)).max())
    return slowest > 1 - 1 / max(e.n_samples for e in criterion.data.experiments)


def _on_border(poles: Array, allowed: Callable[[Array], bool]) -> bool:
    turns = np.exp(2j * np.pi * np.arange(8) / 8)
    return any(not allowed(np.array([pole + ON * turn, np.conj(pole + ON * turn)])) for pole in poles for turn in turns)


def _couples(poles: Array) -> Iterator[tuple[Array, Array]]:
    """Yield every two neighbouring real poles, and every pair, with the other poles."""
    real = sorted((i for i in range(len(poles)) if abs(poles[i].imag) <= 1e-12), key=lambda i: poles[i].real)
    pairs = [(i, int(np.argmin(np.abs(poles - np.conj(poles[i]))))) for i in range(len(poles)) if poles[i].imag > 1e-12]
    for couple in (*zip(real[:-1], real[1:]), *pairs):
        yield poles[list(couple)], np.delete(poles, couple)


def _moves(two: Array, allowed: Callable[[Array], bool]) -> Iterator[tuple[float, float]]:
    """Yield means m and squares s of two poles m +- sqrt(s) that lie on the border, and of some near them inside."""
    mean, apart = float(np.mean(two).real), float(abs(two[0].imag))
    now = float(np.real((two[0] - two[1]) ** 2)) / 4
    for shift, square in product(SHIFTS, (now, 0.9 * now, 1.1 * now)):
        root = np.sqrt(complex(square))
        if allowed(np.array([mean + shift + root, mean + shift - root])):
            yield mean + shift, square
    for stays, moves in ((two[0], two[1]), (two[1], two[0])) if not apart else ():
        for shift in SHIFTS:
            if allowed(np.array([stays, moves + shift])):
                yield float((stays + moves + shift).real) / 2, float((stays - moves - shift).real) ** 2 / 4
    squares = [-max(share * apart, LEAST) ** 2 for share in SHARES] if apart else [-gap**2 for gap in (LEAST, *APART)]
    squares += [gap**2 for gap in APART] if apart < NEARLY else []
    for square in squares:
        if (end := _on(mean, square, allowed)) is not None:
            yield end, square


def _on(mean: float, square: float, allowed: Callable[[Array], bool]) -> float | None:
    """Return the mean next to a given one at which two poles m +- sqrt(s) lie on the border; None far from it."""
    root = np.sqrt(complex(square))

    def fits(at: float) -> bool:
        return allowed(np.array([at + root, at - root]))

    ends = []
    for direction in (1.0, -1.0):
        inside = next((mean - direction * step for step in (0.0, 0.01, 0.05, REACH)
                       if fits(mean - direction * step)), None)
        if inside is not None:
            low, high = 0.0, 2 * REACH
            while high - low > 0.1 * INWARD:
                middle = (low + high) / 2
                low, high = (middle, high) if fits(inside + direction * middle) else (low, middle)
            ends.append(inside + direction * (low - INWARD))
    return min(ends, key=lambda end: abs(end - mean)) if ends else None


def _moved(criterion: Criterion, x: Array, two: Array, others: Array, mean: float, square: float) -> Array:
    """Return x with two poles at m +- sqrt(s)."""
    x, at = np.array(x), criterion.unknowns.slices
    if "A" not in at:
        root = np.sqrt(complex(square))
        x[at["a"]] = np.real(np.poly(np.concatenate([[mean + root, mean - root], others])))[1:]
        return x
    a = criterion.unknowns.parts(x)["A"]
    near = 1e-6 + np.abs(two[:, None] - others[None, :]).min(initial=1.0) / 2
    form, turn = schur(a, output="real", sort=lambda re, im=0.0: bool(np.abs(complex(re, im) - two).min() < near))[:2]
    # what else the two states do stays as it is: one entry beside the diagonal takes what the poles need
    half = (form[0, 0] - form[1, 1]) / 2
    kept, moved = ((0, 1), (1, 0)) if abs(form[0, 1]) >= abs(form[1, 0]) else ((1, 0), (0, 1))
    form[kept] = float(np.sign(form[kept]) or 1.0) * max(abs(form[kept]), COUPLED)
    form[moved] = (square - half**2) / form[kept]
    form[0, 0], form[1, 1] = mean + half, mean - half
    x[at["A"]] = (turn @ form @ turn.T).ravel()
    return x


def meet(criterion: Criterion, x: Array) -> bool:
    """Whether a model has two poles that all but meet, and everything else is fitted to them.

    Where no move along the border lowers the errors either, it is the best one near them.
    """
    poles = poles_of(criterion, x)
    if len(poles) != 2 or abs(poles[0] - poles[1]) > 2 * ON:
        return False
    value = criterion.value(x)
    return _step(criterion, x, hold_c=False)[1] <= FITTED * value


def with_double_pole(criterion: Criterion, depth: Callable[[Array], float], x: Array) -> Array | None:
    """Return x with the first pair near the real axis made an all but double pole on the border; None without one."""
    for two, others in _couples(poles_of(criterion, x)):
        if LEAST < abs(two[0].imag) < NEARLY:
            mean = _on(float(np.mean(two).real), -(LEAST**2), lambda one: depth(one) >= -ROUNDING)
            return None if mean is None else _moved(criterion, x, two, others, mean, -(LEAST**2))
    return None


def with_slow_poles(criterion: Criterion, x: Array) -> list[Array]:
    """Return x with two neighbouring poles made slow, and everything else fitted: one of two real ones, or a pair.

    With a slow pole the static gain, which words about f refer to, may oppose the first response. A pair that rings
    through the record amplifies what f leaves, and keeps its frequency.
    """
    slow = float(np.exp(-SLOW / max(e.n_samples for e in criterion.data.experiments)))
    for two, others in _couples(poles_of(criterion, x)):
        fast = float(np.mean(two).real) if two[0].imag else float(two[0].real)
        moves = [((fast + slow) / 2, ((slow - fast) / 2) ** 2)] if fast < slow else []
        if two[0].imag and abs(two[0]) < slow:
            rings = two[0] * slow / abs(two[0])
            moves.append((float(rings.real), -float(rings.imag) ** 2))
        if moves:
            return [_fitted(criterion, _moved(criterion, x, two, others, *move))[0] for move in moves]
    return []


def _step(criterion: Criterion, x: Array, hold_c: bool) -> tuple[Array, float]:
    """Return the step of Gauss and Newton that holds the poles, and what it promises to gain."""
    at, unknowns, parts = criterion.unknowns.slices, criterion.unknowns, (criterion.dynamics, *("C",) * hold_c)
    held = np.concatenate([np.arange(x.size)[at[part]] for part in parts if part in at])
    rest, step = np.setdiff1d(np.arange(x.size), held), np.zeros(x.size)
    # without weight on what changes no output, which may be needed here
    matrix, errors = linearise_errors(criterion.rows(x), unknowns.experiments, unknowns.memory, unknowns.shared,
                                      method="qr").whole
    sizes = np.maximum(np.linalg.norm(matrix[:, rest], axis=0), 1e-300)
    step[rest] = -np.linalg.lstsq(matrix[:, rest] / sizes, errors, rcond=1e-12)[0] / sizes
    left = matrix @ step + errors
    return step, float(errors @ errors - left @ left)


def _fitted(criterion: Criterion, x: Array) -> tuple[Array, float]:
    """Fit everything but the poles again, by Gauss and Newton; return the point and its sum of squares.

    At first C is held too: the rest of a linear model is then linear least squares.
    """
    if not criterion.admissible(x):
        return x, np.inf
    value = criterion.value(x)
    for count in range(STEPS):
        try:
            step = _step(criterion, x, hold_c=not count)[0]
        except (DataError, FloatingPointError):
            return x, value
        found, there = np.inf, x
        for part in 0.5 ** np.arange(PARTS):
            there = criterion.confine(x + part * step)
            found = criterion.value(there) if criterion.admissible(there) else np.inf
            if found < value:
                break
        last = not found < value * (1 - SETTLED)
        x, value = (there, found) if found < value else (x, value)
        if last and count:
            break
    return x, value
