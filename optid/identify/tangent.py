"""The least-squares problem of a fit, linearised at its solution in the tangent space of its constraints.

The tangent space is that of the gauge and the user's equalities, in coordinates where the information is the identity.
The covariance of gauge-free quantities, such as ``mu bᵀ`` or a prediction, does not depend on the gauge.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.core.constraint import Constraint, symmetric_part
from optid.core.judge import gauges
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.errors import RankError, StructureError
from optid.identify.intervals import LocalEstimate
from optid.program.expressions import differences
from optid.program.solution import Status
from optid.structures.whitening import symmetric_root

FAR = 1e-3  # smallest eigenvalue of a matrix that must be definite, relative to its largest, that is far from active
NO_EFFECT = 1e-10
"""Size of an effect on the predictions, relative to the largest, below which a direction counts as undetermined."""
STEP = 1e-5  # step of the central differences, relative to the size of the parameter
BENT, HALVINGS = 2.0, 20  # rise of the objective, over the linear one, to which a move is halved; halvings at most
LEADING, MINOR = 4, 0.1  # directions that are followed, at most; effect of the others, relative to the largest
MEANINGS = {
    "gaussian": "confidence intervals of least squares, Student's quantile",
    "projected": "confidence intervals under inequalities: hull of projected posterior and basic bootstrap",
    "penalised": "intervals of the posterior whose prior is the penalty: they cover on average over f, not pointwise"}

Quantity = Callable[[Any], ArrayLike]
"""A function of the model: a number or an array of fixed shape."""


@dataclass(frozen=True, eq=False)
class Tangent:
    """A fit as a local linear regression, the source of intervals without refits."""

    # from the values of the variables, by name, to the model in the units, gauge and signs of the fit
    rebuild: Callable[[dict[str, Array]], Any]
    shapes: dict[str, tuple[int, ...]]  # of the variables of the programme by name, in the order of x
    x: Array  # (n_x,) solution, every variable flattened column by column
    directions: Array  # (n_x, n) dx/dv, v the whitened tangent coordinates
    local: LocalEstimate = field(repr=False)  # the estimate in these coordinates
    noise: Array  # (l, l) covariance of the equation error e, in raw units
    kind: str  # of the intervals, one of `MEANINGS`
    words: tuple[str, ...] = ()  # what the errors are that white ones of one level are not
    # objective at values of the variables, where it is not quadratic in what the linear model is linear in
    objective: Callable[[dict[str, Array]], float] | None = field(default=None, repr=False)

    @property
    def meaning(self) -> str:
        """Description of the intervals."""
        return "; ".join([MEANINGS[self.kind], *(f"errors {word}" for word in self.words)])

    def __getstate__(self) -> dict[str, Any]:
        _ = self.neighbours  # `rebuild`, which holds the programme, is not needed afterwards
        return {**vars(self), "rebuild": None, "objective": None}

    def limits(self, quantity: Quantity, level: float) -> tuple[Array, Array, Array]:
        """Return (standard error, lower end, upper end) of a quantity, flat and relative to its estimate."""
        return self.local.limits(self.slopes(quantity), level)

    def slopes(self, quantity: Quantity) -> Array:
        """Derivatives (q, n) of a quantity in the whitened tangent coordinates, by differences of `neighbours`."""
        columns = []
        for above, below, gap in self.neighbours:
            high, low = (np.ravel(np.asarray(quantity(model), dtype=float)) for model in (above, below))
            if high.shape != low.shape:
                raise StructureError("the quantity changes its shape with the model, so it has no derivative")
            columns.append((high - low) / gap)
        return np.column_stack(columns) @ self.directions

    def error_within_reach(self, quantity: Quantity) -> Array | None:
        """Return standard errors (q,) by moves that raise the objective about as the linear model says.

        Where parameters all but cancel, the linear model takes them far beyond where it holds. Along the directions
        that change the quantity most they go one standard deviation, or as far as the objective lets them. None where
        the objective is not known, or lets them go nowhere.
        """
        if self.objective is None or self.rebuild is None:
            return None
        u, s, vt = np.linalg.svd(self.slopes(quantity) @ self.local.scatter, full_matrices=False)
        leading = int(min(LEADING, np.sum(s > MINOR * s[0])))
        error = np.linalg.norm(u[:, leading:] * s[leading:], axis=1)
        before = self.objective(_unpacked(self.shapes, self.x))
        here = np.ravel(np.asarray(quantity(self.rebuild(_unpacked(self.shapes, self.x))), dtype=float))
        for turn in vt[:leading]:
            move = self.local.scatter @ turn
            ends = [self._moved(quantity, here, sign * self.directions @ move, before + BENT * float(move @ move))
                    for sign in (1.0, -1.0)]
            if any(end is None for end in ends):
                return None
            # without squares, which leave the range of numbers where an unstable model moves a quantity far
            error = np.hypot(error, np.hypot(*np.sqrt(0.5) * np.array(ends, dtype=float)))
        return error

    def _moved(self, quantity: Quantity, here: Array, step: Array, most: float) -> Array | None:
        """Return the change of a quantity by a step, halved until the objective is at most so large; None if never."""
        assert self.objective is not None
        for k in range(HALVINGS):
            values = _unpacked(self.shapes, self.x + step / 2**k)
            with suppress(StructureError), np.errstate(all="ignore"):
                if self.objective(values) <= most:
                    there = np.ravel(np.asarray(quantity(self.rebuild(values)), dtype=float))
                    if np.all(np.isfinite(there)):
                        return there - here
        return None

    @cached_property
    def neighbours(self) -> list[tuple[Any, Any, float]]:
        """Models a small step above and below in every unknown of the programme, and the distance between them.

        At the edge of the models, such as a zero of C on the unit circle, the model of the fit takes the place of the
        one beyond; an unknown that cannot move to either side is a `StructureError`.
        """
        sizes, found = np.abs(self.x), []
        scale = np.concatenate([np.full(part.size, max(float(np.max(part)), 1e-300))
                                for part in _unpacked(self.shapes, sizes).values()])
        for j, step in enumerate(STEP * np.maximum(sizes, 1e-2 * scale)):
            ends = []
            for x in self.x + np.outer([step, -step, 0.0], np.eye(self.x.size)[j]):
                with suppress(StructureError):
                    ends.append((self.rebuild(_unpacked(self.shapes, x)), float(x[j])))
                if len(ends) == 2:
                    break
            else:
                raise StructureError("the fit lies at the edge of the possible models, where no standard errors hold; "
                                     "choose other orders, or a constraint such as stable:0.999")
            (above, high), (below, low) = ends
            found.append((above, below, high - low))
        return found


def linearise(fit: Any, rebuild: Callable[[dict[str, Array]], Any], draws: int, seed: int) -> Tangent:
    """Linearise a fit whose programme carries its compressed least-squares problem; arguments as in `uncertainty`.

    The noise estimate comes from the minimum without the inequalities, so that active ones do not bias it.

    Raises:
        StructureError: a fit that is no least squares (robust loss, nuclear norm), or an active constraint that has no
            linearisation.
        RankError: a parameter without effect on the predictions, such as the numerator of an input whose f is zero.
    """
    _refuse(fit)
    problem: Problem = fit.problem
    compressed, found = problem.compressed, fit.solution.values
    shapes = {name: np.shape(value) for name, value in problem.start.items() if name not in problem.courses}
    x = np.concatenate([np.ravel(found[name], order="F") for name in shapes])
    point = {name: found[name] for name in problem.start}
    equalities, inequalities, slack = constraint_rows(problem, point, tuple(shapes))

    lift, lifted = differences(lambda x: compressed.lift(_unpacked(shapes, x)), x)
    squares = compressed.problem
    free, triangle, basis = whiten_directions(squares.root @ lift, equalities, shapes)
    directions = free @ np.linalg.inv(triangle)
    pull = basis.T @ (squares.root @ lifted - squares.target)
    centre = -pull if len(slack) else np.zeros_like(pull)

    spread = compressed.spread(lifted + lift @ (directions @ centre), lift @ directions)
    # drawn in the rows of the problem, where no choice of a basis of the tangent space changes the draws
    scatter = symmetric_root(spread.covariance) @ basis.T
    local = LocalEstimate(centre, scatter, spread.dof, inequalities @ directions, slack, draws, seed)
    kind = "penalised" if spread.penalised else "projected" if local.held else "gaussian"
    transform = getattr(fit.data, "transform", None)
    scale = np.ones(len(spread.noise)) if transform is None else np.array(transform.y_scale)
    criterion = getattr(compressed, "criterion", None)
    objective = None if criterion is None else lambda values: (
        criterion.value(z) if criterion.admissible(z := compressed.lift(values)) else np.inf)
    return Tangent(rebuild, shapes, x, directions, local, problem.unit * spread.noise * np.outer(scale, scale),
                   kind, spread.words, objective)


def _unpacked(shapes: dict[str, tuple[int, ...]], x: Array) -> dict[str, Array]:
    """Split a flat vector into named arrays, each filled column by column."""
    edges = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])[:-1]
    return {name: part.reshape(shape, order="F") for (name, shape), part in zip(shapes.items(), np.split(x, edges))}


def _refuse(fit: Any) -> None:
    if not fit.solution.has_point:
        raise StructureError("the fit has no point, so that there are no intervals")
    if fit.solution.status is Status.LIMIT:
        raise StructureError(f"they hold at an optimum, and the solver stopped before one: {fit.solution.reason}")
    if fit.problem.compressed is None:
        advice = "; use optid.bootstrap" if fit.model is not None and fit.model.structure == "arx" else ""
        raise StructureError("they follow from compressed least squares, which "
                             f"{fit.formulation!r} does not keep{advice}")
    loss = str(fit.arguments.get("loss", "squares"))
    if loss != "squares":
        raise StructureError(f"loss {loss!r} is not least squares, so that its standard errors do not follow from the "
                             "statistics; use optid.bootstrap")
    if fit.problem.weights.get("weight", 0.0) > 0:
        raise StructureError("the nuclear norm shrinks Theta by an amount that no interval accounts for; refit with "
                             "'hammerstein_arx.exact', or use optid.bootstrap for the scatter about the shrunk value")


def whiten_directions(effect: Array, equalities: Array, shapes: dict[str, tuple[int, ...]]) -> tuple[Array, Array,
                                                                                                     Array]:
    """Return (free directions, R, Q) with effect @ free = Q R; unknowns without effect are a `RankError` by name."""
    sizes = np.linalg.norm(effect, axis=0)
    for name, part in _unpacked(shapes, sizes).items():
        if np.any(part <= NO_EFFECT * np.max(sizes)):
            raise RankError(f"{name!r} has an entry without any effect on the predictions: its error is unbounded. "
                            "Leave the channel out, or fix the entry by a constraint")
    scale = 1.0 / sizes
    rows = equalities * scale
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    _, values, vectors = np.linalg.svd(rows / np.where(lengths > 0, lengths, 1.0))
    rank = int(np.count_nonzero(values > 1e-9 * max(float(values[0]) if values.size else 0.0, 1e-300)))
    free = scale[:, None] * vectors[rank:].T
    basis, triangle = np.linalg.qr(effect @ free)
    diagonal = np.abs(np.diag(triangle))
    if diagonal.size and np.min(diagonal) <= NO_EFFECT * np.max(diagonal):
        still = vectors[rank:].T @ np.linalg.svd(triangle)[2][-1]
        parts = {name: float(np.linalg.norm(part)) for name, part in _unpacked(shapes, still).items()}
        most = [name for name, part in parts.items() if part > 0.1 * max(parts.values())]
        raise RankError(f"a combination of the parameters ({', '.join(most)}) has no effect on the predictions: its "
                        "error is unbounded. Use fewer basis functions or lags, or fix it by a constraint")
    return free, triangle, basis


def constraint_rows(problem: Problem, x: Values, names: tuple[str, ...]) -> tuple[Array, Array, Array]:
    """Return the gradients of the equalities, and the gradients and slacks of the inequalities (>= 0), at a point.

    The gradients are those by the named unknowns. Constraints about courses are left out, which the others imply.
    """
    columns = np.concatenate([np.arange(problem.size)[problem.slices[name]] for name in names])
    y, slope = problem.leaf_values(x), problem.slope(x)[:, columns]
    nothing = np.zeros((0, columns.size))
    equal, above, slack = [nothing], [nothing], [np.zeros(0)]
    equal += [gauge[None, columns] for gauge, _ in gauges(problem, x)]
    for one in problem.constraints(x):
        if one.leaves(problem.space) & problem.courses:
            continue
        g = one.residual(problem.space, y)
        if one.cone == "psd" or one.expression is None and one.cone == "other":
            _refuse_active(one, g)
            continue
        rows = one.slope(problem.space, y) @ slope
        if not np.all(np.isfinite(rows)):
            raise StructureError(f"constraint {one.name!r} has no gradient at the solution: use optid.bootstrap "
                                 "instead")
        if one.is_equality:
            equal.append(rows)
        else:
            above.append(-rows)
            slack.append(np.maximum(-g, 0.0))
    return np.vstack(equal), np.vstack(above), np.concatenate(slack)


def _refuse_active(one: Constraint, g: Array) -> None:
    """Refuse a matrix inequality that is not far from active, and any other cone."""
    if one.cone == "psd":
        values = np.linalg.eigvalsh(-symmetric_part(g))
        if values[0] > FAR * np.max(np.abs(values)):
            return
    raise StructureError(f"constraint {one.name!r} is an active {type(one.limit.member).__name__}, which has no "
                         "linearisation: use optid.bootstrap for intervals")
