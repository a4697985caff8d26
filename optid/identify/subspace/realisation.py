"""The least-squares step for (B, D, E, offset, x0) with A and C known.

The equations are those of the observer form (`optid.identify.subspace.regressors`). Every complete run of samples has
its own initial state; those of all but the first run of an experiment are eliminated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.bases import Linear
from optid.data.channels import model_meta
from optid.data.record import Data
from optid.data.stretches import runs_of
from optid.errors import RankError
from optid.identify.subspace.plan import Plan
from optid.identify.subspace.regressors import ObserverForm
from optid.models import HammersteinSS, Nonlinearity
from optid.program.units import energy_unit, outer_bases
from optid.statistics.expansion import Expansion
from optid.statistics.factors import add_to_root
from optid.structures.bilinear import starts
from optid.structures.lifted_regression import leading_pairs
from optid.structures.rank_one import RankOne

HEIGHTS = frozenset({"mu", "Theta", "offset", "x0", "B", "Bu", "D", "Du", "Ez", "mu feedback", "Theta feedback"})
"""Named quantities in the unit of the outputs; A, C and the norm of b have none."""


class StepMatrices(NamedTuple):
    """What the step estimates: x+ = A x + Bu eta(u) + Ez zeta(y), y = C x + Du eta(u) + d, from x0."""

    bu: Array  # (n, p)
    du: Array  # (l, p)
    ez: Array  # (n, q)
    d: Array  # (l,)
    x0: Array  # (experiments, n)


@dataclass(frozen=True, eq=False)
class Realisation:
    """The compressed step, in named unknowns: one pair of factors per channel, or one matrix."""

    form: ObserverForm  # the layout
    problem: RankOne  # ``||R z - s||^2 + remainder`` with one rank-one block per channel; weighted units
    rows: int  # equations used
    plan: Plan  # whose record it is
    factored: bool = False  # whether channels are rank one in the programme itself

    def least_squares(self) -> Array:
        """Return the unrestricted minimiser z; an unknown that the record does not determine is a `RankError`."""
        root, norms = self.problem.root, np.linalg.norm(self.problem.root, axis=0)
        lost = np.abs(np.diag(root)) <= 1e-10 * np.where(norms > 0, norms, 1.0)
        if lost.any():
            raise RankError(f"The record does not determine {self.form.names()[int(np.argmax(lost))]}: the regressors "
                            "before it explain its effect. Use a longer or richer record, fewer functions, a lower "
                            "order, or leave the channel out.")
        return np.asarray(np.linalg.solve(root, self.problem.target), dtype=float)

    def ratios(self) -> dict[str, float]:
        """Return the second over the first singular value of every channel's unrestricted matrix."""
        found = {}
        several = any(min(shape) > 1 for shape in self.form.blocks)
        thetas = self.form.thetas(self.least_squares()) if several else []
        for i, (name, theta) in enumerate(zip(self.form.channels, thetas)):
            if min(theta.shape) > 1:
                values = np.linalg.svd(theta, compute_uv=False)
                name = name if i >= self.form.expansion.m else f"channel {name}"
                found[f"second over first singular value, {name}"] = float(values[1] / values[0])
        return found

    def matrices(self, z: Array) -> StepMatrices:
        """Split z into matrices."""
        form, x, states = self.form, self.form.expansion, self.form.experiments * self.form.n
        thetas = form.thetas(z)
        effects = np.hstack([theta[:, : form.n].T for theta in thetas])
        direct = [theta[:, form.n :].T if direct else np.zeros((form.l, len(theta)))
                  for theta, direct in zip(thetas, form.feedthrough)]
        offset = z[states : form.linear] if form.offset else np.zeros(form.l)
        return StepMatrices(effects[:, : x.p], np.hstack(direct), effects[:, x.p :], offset,
                            z[:states].reshape(-1, form.n))

    @property
    def names(self) -> list[tuple[str, str, str]]:
        """Names of the two factors and of the matrix of every channel, such as ``mu[valve]``."""
        x = self.form.expansion
        tails = [f"[{name}]" * (x.m > 1) for name in x.input_names]
        tails += [" feedback" + f"[{x.output_names[family.output]}]" * (x.l > 1) for family in x.feedback]
        return [(f"mu{tail}", f"b{tail}", f"Theta{tail}") for tail in tails]

    def start(self) -> dict[str, Array]:
        """Return the unrestricted minimiser, or starts of the factors; errors as `least_squares`."""
        form, z, point = self.form, self.least_squares(), None
        if self.factored:
            point = self.problem.core.point(*starts(self.problem.core, count=1)[0])
        linear = z[: form.linear] if point is None else point.w
        states = form.n * form.experiments
        x0 = linear[:states] if form.experiments == 1 else linear[:states].reshape(form.n, form.experiments, order="F")
        found = {"x0": np.array(x0)} | ({"offset": np.array(linear[states:])} if form.offset else {})
        for i, ((mu, b, theta), value) in enumerate(zip(self.names, form.thetas(z))):
            found |= {theta: value} if point is None else {mu: point.mus[i], b: point.bs[i]}
        return found

    @property
    def linear(self) -> tuple[str, ...]:
        """Names of the unknowns outside products, in their order in z."""
        return ("x0", "offset") if self.form.offset else ("x0",)

    def facts(self) -> dict[str, Any]:
        """Return what constraints may ask besides named expressions: keyword arguments of a `View`."""
        x, units = self.form.expansion, self.plan.units
        return {"channels": x.input_names, "outputs": x.output_names, "units": units, "heights": HEIGHTS,
                "bases": dict(zip(x.input_names, outer_bases(x.inputs, units))),
                "gauge": "norm" if self.factored else "", "reference": {"A": self.form.a, "C": self.form.c}}

    def common(self) -> dict[str, Any]:
        """Return the constraints about coefficients, scale and unit of the `optid.core.problem.Problem`."""
        relative = np.any(self.form.weights != 1)  # to the sizes of outputs in the unit of the residuals
        return {"builders": self.plan.about("coefficients"), "scale": self.problem.scale,
                "unit": 1.0 if relative else energy_unit(self.plan.units)}

    def expressions(self, thetas: Sequence[Any]) -> dict[str, Any]:
        """Return ``Bu`` (n, p), ``Du`` (l, p) and ``Ez`` (n, q) of expressions of the matrices of all channels.

        These are (P, n + l) or, without feedthrough, (P, n); where every channel is linear ``B`` and ``D`` come too.
        """
        form, n, m = self.form, self.form.n, self.form.expansion.m
        inner = [theta[:, :n].T for theta in thetas]
        direct = [theta[:, n:].T if direct else np.zeros((form.l, theta.shape[0]))
                  for theta, direct in zip(thetas, form.feedthrough)]
        found = {"Bu": cp.hstack(inner[:m]), "Du": cp.hstack(direct)}
        if form.expansion.q:
            found["Ez"] = cp.hstack(inner[m:])
        if all(isinstance(basis, Linear) for basis in form.expansion.inputs):
            found |= {"B": found["Bu"], "D": found["Du"]}
        return found

    def model(self, values: Mapping[str, Array]) -> HammersteinSS:
        """Return the model of a point; a matrix is split in the Kronecker metric of the least squares."""
        form, x, data = self.form, self.form.expansion, self.plan.data
        if self.names[0][0] in values:
            pairs = [(np.asarray(values[mu]), np.asarray(values[b])) for mu, b, _ in self.names]
        else:
            thetas = [np.reshape(values[theta], shape) for (_, _, theta), shape in zip(self.names, form.blocks)]
            pairs = leading_pairs(self.problem.core, thetas)
        pairs = [_oriented(mu, b, linear=i < x.m and isinstance(x.inputs[i], Linear))
                 for i, (mu, b) in enumerate(pairs)]
        n, l, m = form.n, form.l, x.m  # noqa: E741
        mus, bs = [mu for mu, _ in pairs], [b for _, b in pairs]
        direct = [b[n:] if len(b) > n else np.zeros(l) for b in bs[:m]]
        matrices = {"A": form.a, "B": np.column_stack([b[:n] for b in bs[:m]]), "C": form.c,
                    "D": np.column_stack(direct),
                    "offset_y": np.asarray(values["offset"]) if form.offset else np.zeros(l)}
        found = state_model(x, data, matrices, mus[:m], mus[m:], np.column_stack([np.zeros((n, 0)), *bs[m:]]))
        if not any(basis.size > 1 for basis in x.inputs):
            return found
        signs = np.where([isinstance(basis, Linear) for basis in x.inputs], 1.0, found.gain_signs)
        return replace(found.with_signs(signs), gauge="norm")


def observer_problem(records: Sequence[Array], form: ObserverForm, plan: Plan, targets: Sequence[Array] | None = None
                     ) -> Realisation:
    """Compress the step of a plan.

    The records are raw channels (N, m + l), or (N, m + 2 l) with simulated outputs, one array per experiment.
    ``targets`` are the measured outputs (N, l) where some in the records are estimated. Fewer equations than unknowns
    are a `RankError`.
    """
    x, extra, own = form.expansion, form.extra, slice(form.experiments * form.n, None)
    total = form.size + extra
    root, rows, energy = np.zeros((total + 1, total + 1)), 0, 0.0
    for e, record in enumerate(records):
        y = record[:, x.m : x.m + x.l] if targets is None else targets[e]
        for i, (start, stop) in enumerate(runs_of(~np.isnan(record[:, form.needed]).any(axis=1))):
            part, used, squares = form.compress(record[start:stop], y[start:stop])
            rows += used
            energy += squares
            if i == 0:
                wide = np.zeros((len(part), total + 1))
                wide[:, e * form.n : (e + 1) * form.n] = part[:, : form.n]
                wide[:, own] = part[:, form.n :]
                root = add_to_root(root, wide)
            else:  # the initial state of a later run is eliminated
                root[own, own] = add_to_root(root[own, own], part[form.n :, form.n :])
    if rows < total:
        raise RankError(f"{rows} equations for {total} unknowns of the step for B, D and x0: use a longer record, "
                        "fewer basis functions or a lower order.")
    size = form.size
    if extra:  # the equations projected on the instruments
        root = add_to_root(np.zeros((size + 1, size + 1)), root[:size, np.r_[: size - extra, size : total + 1]])
    problem = RankOne(root[:size, :size], root[:size, size], float(root[size, size] ** 2), form.blocks, form.linear,
                      energy)
    return Realisation(form, problem, rows, plan)


def _oriented(mu: Array, b: Array, *, linear: bool) -> tuple[Array, Array]:
    """Return mu and b with mu = 1 for a linear channel, otherwise b of unit length, its largest entry positive."""
    if linear:
        return np.ones(1), b * mu[0]
    length = float(np.linalg.norm(b))
    if length == 0.0:
        return np.zeros_like(mu), np.full(len(b), 1 / np.sqrt(len(b)))
    length *= float(np.sign(b[int(np.argmax(np.abs(b)))]))
    return mu * length, b / length


def state_model(expansion: Expansion, data: Data, matrices: Mapping[str, Array], mus: Sequence[Array],
                nus: Sequence[Array], e: Array) -> HammersteinSS:
    """Build the model with the meta data of a record; the linear part of the feedback becomes L and a constant.

    The matrices are A (n, n), B (n, m), C (l, n) and D (l, m) of `HammersteinSS`, and its K (n, l) and offset_y (l,)
    where they are not zero; mus are the coefficients of the nonlinearity of every input, nus those of every feedback
    family in its orthonormal coordinates, with one column of e (n, s) each.
    """
    families = expansion.feedback
    parts = [np.outer(column, nu) for column, nu in zip(e.T, nus)]
    injection, constant = expansion.injection(np.hstack([np.zeros((len(e), 0)), *parts]))
    return HammersteinSS(
        **matrices, E=e if families else None, L=injection,
        nonlinearities=tuple(Nonlinearity(basis, mu) for basis, mu in zip(expansion.inputs, mus)),
        feedback=tuple(Nonlinearity(family.basis, family.vectors @ nu) for family, nu in zip(families, nus)),
        output_of=tuple(family.output for family in families), offset_x=constant, **model_meta(data))
