"""The programme for B, D, E, offset and x0 of a state-space model whose (A, C) are known.

Two forms of one least-squares problem (`optid.identify.subspace.observer`):

* factored: every channel is rank one, ``Theta_i = mu_i [B_i; D_i]ᵀ``; solved and certified by the machinery of
  rank-one blocks. Named variables: ``x0``, ``offset``, ``mu``, ``b`` (= [B_i; D_i]) and, for an output that is fed
  back, ``mu feedback``, ``b feedback``.
* lumped: ``Theta_i`` as it comes, convex; the factors are split off afterwards in the metric of the least squares.
  Named variables: ``x0``, ``offset``, ``Theta``, ``Theta feedback``. Linear channels always take this form.

With several inputs the per-channel names carry the input, as in ``mu[valve]``. Expressions for constraints in either
form: ``Theta`` (P, n + l), the lumped ``Bu`` (n, p), ``Du`` (l, p) and ``Ez`` (n, q); where every channel is linear
``B`` (n, m) and ``D`` (l, m) too. ``reference`` of the view holds A and C.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.bases import Linear
from optid.certificate.lifting import certify_rank_one
from optid.data.channels import Transform
from optid.identify.subspace.observer import ObserverProblem
from optid.program.expressions import flat
from optid.program.program import Program, Values
from optid.program.units import energy_unit, outer_bases
from optid.program.view import View
from optid.structures.bilinear import starts
from optid.structures.least_squares import LeastSquaresStructure, RankOneStructure
from optid.structures.rank_one import reduce
from optid.structures.whitening import leading_pair

RELAXED = 150
"""Multipliers up to which the proof of this step, which says nothing of (A, C), is worth a semidefinite programme."""


@dataclass(frozen=True, eq=False)
class Factors:
    """What the programme answers.

    Attributes:
        mus: coefficients of the nonlinearity of every input.
        bs: (n + l,) or (n,) entries [B_i; D_i] of every input.
        nus: coefficients of every feedback family in its orthonormal coordinates.
        es: (n,) of every feedback family.
        x0: (experiments, n).
        offset: (l,).
    """

    mus: list[np.ndarray]
    bs: list[np.ndarray]
    nus: list[np.ndarray]
    es: list[np.ndarray]
    x0: np.ndarray
    offset: np.ndarray


@dataclass(frozen=True, eq=False)
class Realisation:
    """The names of the programme.

    Attributes:
        step: the compressed least squares.
        factored: whether channels are rank one in the programme itself.
        units: from those of the step to those of the record; None where they are the same.
    """

    step: ObserverProblem
    factored: bool
    units: Transform | None = None

    def key(self, name: str, i: int) -> str:
        """Name of a quantity of block i: ``mu[valve]``, ``mu feedback[level]``."""
        x = self.step.form.expansion
        if i < x.m:
            return name if x.m == 1 else f"{name}[{x.input_names[i]}]"
        family = x.feedback[i - x.m]
        return name if x.l == 1 else f"{name}[{x.output_names[family.output]}]"

    def names(self, i: int) -> tuple[str, str, str]:
        """Names of the two factors and of the matrix of block i."""
        if i < self.step.form.expansion.m:
            return self.key("mu", i), self.key("b", i), self.key("Theta", i)
        return self.key("mu feedback", i), self.key("b feedback", i), self.key("Theta feedback", i)

    def factors(self, values: Values) -> Factors:
        """Read a point; a matrix is split in the Kronecker metric of the least squares."""
        step = self.step
        x, form = step.form.expansion, step.form
        pairs, core = [], None
        for i, shape in enumerate(form.blocks):
            first, second, whole = self.names(i)
            if first in values:
                pairs.append((np.asarray(values[first]), np.asarray(values[second])))
                continue
            theta = np.reshape(values[whole], shape)
            core = core or reduce(step.problem)
            if i in core.kept:
                place = core.kept.index(i)
                metric = core.whitening.factors_mu[place], core.whitening.factors_b[place]
                pairs.append(leading_pair(theta, *metric))
            else:
                pairs.append((np.ones(1), theta[0]) if shape[0] == 1 else (theta[:, 0], np.ones(1)))
        pairs = [_oriented(mu, b, linear=i < x.m and isinstance(x.inputs[i], Linear))
                 for i, (mu, b) in enumerate(pairs)]
        return Factors(
            [mu for mu, _ in pairs[: x.m]], [b for _, b in pairs[: x.m]], [mu for mu, _ in pairs[x.m :]],
            [b for _, b in pairs[x.m :]], np.reshape(values["x0"], (form.n, form.experiments), order="F").T,
            np.asarray(values["offset"]) if form.offset else np.zeros(form.l))


def _oriented(mu: np.ndarray, b: np.ndarray, *, linear: bool) -> tuple[np.ndarray, np.ndarray]:
    """A linear channel has mu = 1; every other a b of unit length, its largest entry positive."""
    if linear:
        return np.ones(1), b * mu[0]
    length = float(np.linalg.norm(b))
    if length == 0.0:
        return np.zeros_like(mu), np.full(len(b), 1 / np.sqrt(len(b)))
    length *= float(np.sign(b[int(np.argmax(np.abs(b)))]))
    return mu * length, b / length


def realisation_programme(
    step: ObserverProblem, name: str, constraints: Sequence[Any] = (), *, factored: bool = True,
    units: Transform | None = None
) -> tuple[Realisation, Program]:
    """Pose the step.

    Args:
        step: the compressed least squares.
        name: name of the formulation.
        constraints: builders, about the coefficients.
        factored: keep every channel rank one; where all are linear there is nothing to keep.
        units: from those of the step to those of the record, in which the constraints speak.

    Returns:
        The names, and the programme, whose ``recover`` gives `Factors`.
    """
    form = step.form
    several = any(min(shape) > 1 for shape in form.blocks)
    realisation = Realisation(step, factored and several, units)
    linear: dict[str, cp.Variable] = {"x0": cp.Variable(
        form.n if form.experiments == 1 else (form.n, form.experiments), name="x0")}
    if form.offset:
        linear["offset"] = cp.Variable(form.l, name="offset")
    pose = _factored if realisation.factored else _lumped
    program = pose(realisation, name, linear)
    relative = np.any(form.weights != 1)  # to the sizes of the outputs, which have the same unit as the residuals
    unit = 1.0 if units is None or relative else energy_unit(units)
    return realisation, replace(program.subject_to(*constraints), recover=realisation.factors, unit=unit)


def _factored(realisation: Realisation, name: str, linear: Mapping[str, cp.Variable]) -> Program:
    step = realisation.step
    variables, thetas, gauges, names = dict(linear), [], [], []
    point = _start(step)
    start = _linear_start(step, point.w)
    for i, (p, b) in enumerate(step.form.blocks):
        first, second, _ = realisation.names(i)
        variables[first], variables[second] = cp.Variable(p, name=first), cp.Variable(b, name=second)
        thetas.append(cp.outer(variables[first], variables[second]))
        gauges.append(cp.sum_squares(variables[second]) == 1)
        names.append((first, second))
        empty = not np.any(point.bs[i])
        start[first] = np.zeros(p) if empty else point.mus[i]
        start[second] = np.full(b, 1 / np.sqrt(b)) if empty else point.bs[i]
    return _least_squares_programme(
        step, name, variables, _residual(step, linear, thetas), constraints={"gauge": tuple(gauges)}, start=start,
        recover=realisation.factors, view=_view(realisation, {**variables}, thetas),
        structure=RankOneStructure(step.problem, tuple(linear), tuple(names), "norm"),
        certify=partial(certify_rank_one, max_size=RELAXED))


def _lumped(realisation: Realisation, name: str, linear: Mapping[str, cp.Variable]) -> Program:
    step = realisation.step
    variables, thetas = dict(linear), []
    start = least_squares_values(realisation)
    for i, shape in enumerate(step.form.blocks):
        whole = realisation.names(i)[2]
        variables[whole] = cp.Variable(shape, name=whole)
        thetas.append(variables[whole])
    return _least_squares_programme(
        step, name, variables, _residual(step, linear, thetas), start=start, recover=realisation.factors,
        view=_view(realisation, {**variables}, thetas),
        structure=LeastSquaresStructure(step.problem, tuple(variables)))


def _least_squares_programme(step: ObserverProblem, name: str, variables: dict[str, cp.Variable],
                             residual: cp.Expression, *, constraints: dict[str, Any] | None = None, **parts: Any
                             ) -> Program:
    r = cp.Variable(residual.size, name="residual")
    objective = cp.Minimize(cp.sum_squares(r) + step.problem.remainder)
    constraints = {"residual": (r == residual,), **(constraints or {})}
    return Program(name, objective, constraints, {**variables, "residual": r}, structural=frozenset(constraints),
                   derived={"residual": residual}, scale=step.problem.scale, compressed=step, unit=step.unit, **parts)


def least_squares_values(realisation: Realisation) -> dict[str, np.ndarray]:
    """Return the unrestricted minimiser by the names of the lumped form."""
    step = realisation.step
    z = step.least_squares()
    found = _linear_start(step, z[: step.problem.linear])
    for i, shape in enumerate(step.form.blocks):
        found[realisation.names(i)[2]] = z[step.form.block(i)].reshape(shape, order="F")
    return found


def _start(step: ObserverProblem) -> Any:
    step.least_squares()  # refuses what the record does not determine, by name
    core = reduce(step.problem)
    return core.point(*starts(core, count=1)[0])


def _linear_start(step: ObserverProblem, w: np.ndarray) -> dict[str, np.ndarray]:
    form = step.form
    states = form.n * form.experiments
    x0 = w[:states] if form.experiments == 1 else w[:states].reshape(form.n, form.experiments, order="F")
    return {"x0": np.array(x0)} | ({"offset": np.array(w[states:])} if form.offset else {})


def _residual(step: ObserverProblem, linear: Mapping[str, cp.Variable], thetas: Sequence[cp.Expression]
              ) -> cp.Expression:
    parts = [flat(part) for part in (*linear.values(), *thetas)]
    return step.problem.root @ cp.hstack(parts) - step.problem.target


def _view(realisation: Realisation, expressions: dict[str, Any], thetas: Sequence[cp.Expression]) -> View:
    """Return what constraints may speak about; Theta_i is (P, n + l) or, without feedthrough, (P, n)."""
    step = realisation.step
    form = step.form
    x, n, l = form.expansion, form.n, form.l  # noqa: E741
    for i, theta in enumerate(thetas):
        expressions[realisation.names(i)[2]] = theta
    inner = [theta[:, :n].T for theta in thetas]
    direct = [theta[:, n:].T if b > n else np.zeros((l, p)) for theta, (p, b) in zip(thetas, form.blocks)]
    expressions["Bu"], expressions["Du"] = cp.hstack(inner[: x.m]), cp.hstack(direct[: x.m])
    if x.q:
        expressions["Ez"] = cp.hstack(inner[x.m :])
    if all(isinstance(basis, Linear) for basis in x.inputs):
        expressions["B"], expressions["D"] = expressions["Bu"], expressions["Du"]
    bases = x.inputs if realisation.units is None else outer_bases(x.inputs, realisation.units)
    return View(expressions, channels=x.input_names, outputs=x.output_names,
                bases=dict(zip(x.input_names, bases)),
                gauge="norm" if realisation.factored else "", reference={"A": form.a, "C": form.c},
                units=realisation.units)
