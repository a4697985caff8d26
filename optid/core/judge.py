"""Our own measurements at a point that a solver returned: what it says of the point is a claim, these numbers decide.

The multipliers of a solver count where they make the point stationary; where they do not, or are missing, those count
that come nearest to it: non-negative least squares over the active rows. The gauge of a product has the multiplier that
follows from the objective not depending on the scale between its factors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from optid.arrays import Array, largest
from optid.core.constraint import Constraint, join_by_name, symmetric_part
from optid.core.leaves import LeafSpace, positions, variable_size
from optid.core.problem import Problem
from optid.core.terms import GroupNorms, Length, NuclearNorms, Values, flat
from optid.program.solution import Residuals
from optid.structures.multipliers import fit_multipliers

ACTIVE = 1e-6  # slack, relative to the size of the constraint's terms, below which it counts as active
UNCONFIRMED = 1e-7  # stationarity above which multipliers fitted to the point are tried as well
NOTHING = 1e-7  # share of the objective below which a part that has almost vanished counts as zero
INSIDE = 1e-6  # distance from a bound of an unknown, relative to its size, within which it holds
LARGEST = 4_000_000  # entries of the slopes of active rows up to which multipliers are fitted to a point
ANGLES = 24  # directions in a plane of null vectors of a matrix constraint


@dataclass(frozen=True, eq=False)
class Judgement:
    """A point as we measured it.

    Attributes:
        objective: its value, in units of the problem.
        residuals: violation, stationarity, complementarity.
        duals: the multipliers that these rest on, flat by name of the constraint; of rows divided by their sizes.
        fitted: whether they are ours.
        gauge: multipliers of the gauges of the products.
    """

    objective: float
    residuals: Residuals
    duals: dict[str, Array]
    fitted: bool
    gauge: Array


@dataclass(frozen=True, eq=False)
class RowsAtPoint:
    """A constraint at a point.

    Attributes:
        constraint: it.
        residual: g (m,).
        slope: (m, unknowns), sparse where it has many entries.
        size: of what the rows add up.
        size_in_words: the same in the units in which the user wrote it.
    """

    constraint: Constraint
    residual: Array
    slope: Any
    size: float
    size_in_words: float

    @property
    def excess(self) -> float:
        """How far it is violated, relative to its size."""
        return _excess(self.constraint, self.residual) / self.size

    def gradients(self) -> tuple[Any, Array]:
        """Return the slopes of what is active, and the multipliers that one unit of each stands for."""
        g, m = self.residual, len(self.constraint)
        if self.constraint.cone == "psd":
            values, vectors = np.linalg.eigh(-symmetric_part(g))
            null = vectors[:, values < ACTIVE * self.size]
            parts = [flat(np.outer(null @ turn, null @ turn)) for turn in _directions(null.shape[1])]
            weights = np.array(parts).reshape(-1, m)
            return weights @ self.slope, weights
        active = np.flatnonzero((g > -ACTIVE * self.size) | self.constraint.is_equality)
        return self.slope[active], np.eye(m)[active]


def judge(problem: Problem, x: Values, duals: Mapping[str, Array]) -> Judgement:
    """Measure a point of a problem, with flat multipliers by constraint, of which some may be missing or wrong.

    A point with numbers that are not finite is infinitely far from everything.
    """
    if not all(np.all(np.isfinite(x[name])) for name in problem.start):
        return Judgement(np.nan, Residuals(np.inf, "", np.inf, np.inf), {}, False, np.zeros(len(problem.gauged)))
    rows, lagrangian, amounts = rows_at(problem, x), LagrangianAtPoint.of(problem, x), []
    for product in problem.gauged:
        level, parts = product.level(x)
        amounts.append((abs(level) / (1.0 + sum(float(np.sum(np.abs(flat(x[name])))) for name in parts)), "gauge"))
    for name in problem.symmetric:
        amount = float(np.max(np.abs(x[name] - x[name].T), initial=0.0)) / (1.0 + float(np.max(np.abs(x[name]))))
        amounts.append((amount, f"symmetry of {name}"))
    for name, (low, high) in problem.bounds.items():
        width = max([float(np.max(lagrangian.sizes[problem.slices[name]], initial=0.0)), *(
            float(np.max(np.abs(end[np.isfinite(end)]), initial=0.0)) for end in (low, high))])
        amounts.append((float(np.max(np.maximum(low - x[name], x[name] - high), initial=0.0)) / width, name))
    violation, worst = largest([*amounts, *((row.excess, row.constraint.name) for row in rows)])
    if not np.isfinite(violation):
        rest = Residuals(np.inf, worst, np.inf, np.inf)
        return Judgement(lagrangian.value, rest, {}, False, np.zeros(len(problem.gauged)))
    given, fitted = _projected(rows, duals), False
    if not problem.is_measured:
        best = np.nan, np.nan
    elif given is not None:
        best = lagrangian.measure(rows, given)
    else:
        best = (np.inf, np.inf) if _size(problem, rows) <= LARGEST else (np.nan, np.nan)
    unsure = rows and not np.isnan(best[0]) and not best[0] <= UNCONFIRMED
    if unsure and (own := _fitted(rows, lagrangian)) is not None:
        again = lagrangian.measure(rows, own)
        if not again[0] >= best[0]:
            given, best, fitted = own, again, True
    named = {} if given is None else join_by_name([row.constraint for row in rows], given)
    return Judgement(lagrangian.value, Residuals(violation, worst, *best), named, fitted,
                     lagrangian.gauge_multipliers(rows, given or ()))


def rows_at(problem: Problem, x: Values) -> list[RowsAtPoint]:
    """Return the constraints of a problem at a point."""
    held = problem.constraints(x)
    if not held:
        return []
    y, slope, found = problem.leaf_values(x), problem.slope(x), []
    for one in held:
        g = one.residual(problem.space, y)
        rows = one.slope(problem.space, y)
        found.append(RowsAtPoint(one, g, rows @ slope, *sizes_of_terms(one, rows, g, problem.space, y)))
    return found


def largest_excess(problem: Problem, x: Values, unknowns: frozenset[str] = frozenset()) -> float:
    """Return how far the constraints of a problem are violated at a point, relative to their sizes.

    All of them, or those that speak about the named unknowns alone.
    """
    y = problem.leaf_values(x)

    def amount(one: Constraint) -> float:
        g = one.residual(problem.space, y)
        return _excess(one, g) / sizes_of_terms(one, one.slope(problem.space, y), g, problem.space, y)[0]

    worst, _ = largest((amount(one), one.name) for one in problem.constraints(x)
                       if not unknowns or one.leaves(problem.space) <= unknowns)
    return worst if np.isfinite(worst) else float("inf")


def _excess(one: Constraint, g: Array) -> float:
    """Return the largest violation of a row, in its own units, or of a matrix; infinite where it is not finite."""
    return float(np.max(one.violations(g), initial=0.0)) if np.all(np.isfinite(g)) else float("inf")


def sizes_of_terms(one: Constraint, rows: Any, g: Array, space: LeafSpace, y: Values) -> tuple[float, float]:
    """Return the size of what the rows of a constraint (m, leaves) add up, in units of the rows and in the user's.

    Every leaf counts with its largest entry, but not below its usual size: where it vanishes only rounding is left.
    """
    if one.cone == "other" and (one.expression is None or not np.all(np.isfinite(g)) or _has_gap(rows)):
        size = max((float(np.max(np.abs(arg.value), initial=0.0)) for arg in one.limit.member.args), default=0.0)
        return (size or 1.0) / float(np.min(one.sizes)), size or 1.0
    total = np.abs(one.right if one.cone != "other" else rows @ space.vector(y) - g)
    for name, place in space.places.items():
        largest = max(float(np.max(np.abs(y[name]), initial=0.0)), space.usual_sizes.get(name, 0.0))
        total = total + largest * np.asarray(abs(rows[:, place]).sum(axis=1)).ravel()
    return float(np.max(total, initial=0.0)) or 1.0, float(np.max(total * one.sizes, initial=0.0)) or 1.0


def _has_gap(rows: Any) -> bool:
    """Whether a slope is not known everywhere."""
    return not np.all(np.isfinite(rows.data if sp.issparse(rows) else rows))


@dataclass(frozen=True, eq=False)
class LagrangianAtPoint:
    """Objective, its gradient by the unknowns and the magnitudes it is a sum of, to which constraints are added."""

    problem: Problem
    x: Values
    value: float
    gradient: Array
    magnitudes: Array

    @classmethod
    def of(cls, problem: Problem, x: Values) -> "LagrangianAtPoint":
        """Return that of the objective alone."""
        return cls(problem, x, *problem.pull(x))

    @cached_property
    def gauges(self) -> list[tuple[Array, Array]]:
        """The slope of every gauge, and the direction in which the scale of its product changes."""
        return gauges(self.problem, self.x)

    @property
    def yardstick(self) -> float:
        """The objective, or that of the zero model where it is larger."""
        return max(abs(self.value), self.problem.scale)

    @cached_property
    def sizes(self) -> Array:
        """The size of the unknown (unknowns,) that every component belongs to."""
        usual = self.problem.space.usual_sizes
        return np.concatenate([np.full(np.size(self.x[name]), variable_size(self.x[name], usual.get(name)))
                               for name in self.problem.slices])

    def measure(self, rows: Sequence[RowsAtPoint], duals: Sequence[Array]) -> tuple[float, float]:
        """Return stationarity and complementarity with multipliers of the rows."""
        problem, total, terms, products = self.problem, self.gradient.copy(), self.magnitudes.copy(), 0.0
        for row, dual in zip(rows, duals):
            total += dual @ row.slope
            terms += np.abs(dual) @ np.abs(row.slope)
            if row.constraint.cone == "psd":  # in this cone only the sum of the products vanishes
                products += abs(float(dual @ row.residual))
            elif not row.constraint.is_equality:
                products += float(np.sum(np.abs(dual * row.residual)))
        for weight, (gauge, _) in zip(self.gauge_multipliers(rows, duals), self.gauges):
            total += weight * gauge
            terms += abs(weight) * np.abs(gauge)
        if problem.symmetric:
            total = self._symmetric(total)
        if any(isinstance(term, Length) for term in problem.terms):
            total = total + self._eased(total)
        rates = []
        for name, place in problem.slices.items():
            part, effort = self._free_part(name, total[place], terms[place])
            rates.append((float(np.max(np.abs(part) / self.floor(effort, place), initial=0.0)), name))
        # relative to a hundredth of the zero model's objective where the objective vanishes
        return largest(rates)[0], products / max(abs(self.value), 1e-2 * problem.scale, np.finfo(float).tiny)

    def floor(self, magnitudes: Array, place: slice = slice(None)) -> Array:
        """Return what components of the gradient are relative to, from the magnitudes of their terms."""
        floor = magnitudes + self.yardstick / self.sizes[place]  # terms, and the objective per size of the unknown
        return np.where(floor > 0, floor, 1.0)

    def gauge_multipliers(self, rows: Sequence[RowsAtPoint], duals: Sequence[Array]) -> Array:
        """Return those with which nothing changes along the scale of a product, on which the objective rests."""
        total = self.gradient + sum((dual @ row.slope for row, dual in zip(rows, duals)), np.zeros(self.problem.size))
        rates = [(float(total @ along), float(gauge @ along)) for gauge, along in self.gauges]
        return np.array([-pull / rate if rate else 0.0 for pull, rate in rates])

    def _eased(self, total: Array) -> Array:
        """Return what other subgradients of short lengths of unknowns take off a gradient (unknowns,)."""
        found = np.zeros(self.problem.size)
        for term in self.problem.terms:
            if isinstance(term, Length) and set(term.z) <= self.problem.slices.keys():
                slope = np.zeros((len(term.target), self.problem.size))
                slope[:, positions(self.problem.slices, term.z)] = term.root
                found += term.ease(self.x, self._symmetric(slope), self._symmetric(total), NOTHING * self.yardstick)
        return found

    def _symmetric(self, slope: Array) -> Array:
        """Return slopes (..., unknowns) by symmetric unknowns in which both of two equal entries have the mean."""
        found = np.array(slope)
        for name in self.problem.symmetric:
            place, shape = self.problem.slices[name], np.shape(self.x[name])
            turned = np.arange(np.size(self.x[name])).reshape(shape).ravel(order="F")
            found[..., place] = (slope[..., place] + slope[..., place][..., turned]) / 2
        return found

    def _free_part(self, name: str, part: Array, terms: Array) -> tuple[Array, Array]:
        """Return the gradient by an unknown with the nearest subgradient of terms with kinks, and its magnitudes."""
        shape = np.shape(self.x[name])
        if name in self.problem.bounds:
            low, high = self.problem.bounds[name]
            value, margin = flat(self.x[name]), INSIDE * self.sizes[self.problem.slices[name]]
            down, up = value <= flat(low) + margin, value >= flat(high) - margin
            part = np.where(down & (part > 0) | up & (part < 0), 0.0, part)
        for term in self.problem.terms:
            if isinstance(term, NuclearNorms | GroupNorms) and name in term.weights:
                rest = NOTHING * self.yardstick
                nearest = flat(term.nearest(name, self.x[name], part.reshape(shape, order="F"), rest))
                part, terms = part + nearest, terms + np.abs(nearest)
        return part, terms


def gauges(problem: Problem, x: Values) -> list[tuple[Array, Array]]:
    """Return the slope of every gauge by the unknowns, and the direction in which the scale of its product changes."""
    found = []
    for product in problem.gauged:
        slope, along = np.zeros(problem.size), np.zeros(problem.size)
        for name, part in product.level(x)[1].items():
            slope[problem.slices[name]] = part
        along[problem.slices[product.mu]] = flat(x[product.mu])
        along[problem.slices[product.b]] = -flat(x[product.b])
        found.append((slope, along))
    return found


def _projected(rows: Sequence[RowsAtPoint], duals: Mapping[str, Array]) -> list[Array] | None:
    """Return the multipliers of a solver on the dual cones; None where one is missing or not finite."""
    found = []
    for row in rows:
        part = np.ravel(np.asarray(duals.get(row.constraint.name, ()), dtype=float))[row.constraint.span]
        if part.size != len(row.constraint) or not np.all(np.isfinite(part)):
            return None
        found.append(in_dual_cone(row.constraint, part))
    return found


def in_dual_cone(constraint: Constraint, dual: Array) -> Array:
    """Return flat multipliers of a constraint, projected on its dual cone."""
    if constraint.cone == "psd":
        values, vectors = np.linalg.eigh(symmetric_part(dual))
        return flat((vectors * np.maximum(values, 0.0)) @ vectors.T)
    return dual if constraint.is_equality else np.maximum(dual, 0.0)


def _fitted(rows: Sequence[RowsAtPoint], lagrangian: LagrangianAtPoint) -> list[Array] | None:
    """Return the multipliers that leave least of the gradient; None where the iterations do not suffice."""
    problem = lagrangian.problem
    if _size(problem, rows) > LARGEST or not np.all(np.isfinite(lagrangian.gradient)):
        return None
    slopes, equal, parts = active_slopes(lagrangian, rows)
    try:
        weights, _ = fit_multipliers(slopes * lagrangian.sizes, -lagrangian.gradient * lagrangian.sizes, equal)
    except (RuntimeError, ValueError):  # the iterations did not suffice, or products left the range of numbers
        return None
    counts = np.cumsum([len(problem.gauged), *map(len, parts)])
    return [weights[a:b] @ stands for a, b, stands in zip(counts, counts[1:], parts)]


def active_slopes(lagrangian: LagrangianAtPoint, rows: Sequence[RowsAtPoint]) -> tuple[Array, Array, list[Array]]:
    """Return the slopes (k, unknowns) of the gauges and of what is active, and which of them are equalities.

    Third, by constraint, the multipliers that one unit of each stands for.
    """
    parts = [row.gradients() for row in rows]
    held = [gauge[None] for gauge, _ in lagrangian.gauges]
    slopes = np.vstack([np.zeros((0, lagrangian.problem.size)), *held, *(slope for slope, _ in parts)])
    equal = np.concatenate([np.ones(len(held), dtype=bool), *(
        np.full(len(slope), row.constraint.is_equality) for row, (slope, _) in zip(rows, parts))])
    return slopes, equal, [stands for _, stands in parts]


def _size(problem: Problem, rows: Sequence[RowsAtPoint]) -> int:
    """Return the number of entries of the slopes of all constraints."""
    return sum(len(row.constraint) for row in rows) * problem.size


def _directions(count: int) -> Array:
    """Return unit vectors of a null space: a fine fan in a plane, axes and diagonals in more dimensions."""
    if count <= 1:
        return np.eye(count)
    if count == 2:
        angle = np.pi * np.arange(ANGLES) / ANGLES
        return np.column_stack([np.cos(angle), np.sin(angle)])
    axes = np.eye(count)
    diagonals = [(axes[i] + sign * axes[j]) / np.sqrt(2) for i in range(count) for j in range(i) for sign in (1, -1)]
    return np.vstack([axes, *diagonals])
