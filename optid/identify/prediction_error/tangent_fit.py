"""What a fit by programmes in the tangent of an iterate consists of: named variables, the programme of a step, a model.

A formulation states them (`TangentFit`); `tangent_descent` takes the steps.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.identify.prediction_error.descent import Criterion
from optid.program.judging import measure_violation
from optid.program.program import Program, Values
from optid.statistics.linearised import Linearised
from optid.statistics.unknowns import Unknowns

INSIDE = 1e-6  # relative violation up to which a point satisfies the constraints


@dataclass(frozen=True, eq=False)
class Places:
    """Named variables, and where each stands in the vector of the unknowns."""

    unknowns: Unknowns  # the order of the vector
    names: Mapping[str, str]  # {variable: part of the vector}, in its order; "x0" is the initial states

    @classmethod
    def of(cls, criterion: Criterion) -> "Places":
        """Name the parts by the keys of a criterion."""
        found, unknowns = {}, criterion.unknowns
        for part, shape in unknowns.shapes.items():
            kind = part.rstrip("0123456789")
            if np.prod(shape):
                found[part if kind == part else criterion.key(kind, int(part[len(kind) :]))] = part
        return cls(unknowns, {**found, "x0": "x0"} if unknowns.memory else found)

    def values(self, x: Array) -> dict[str, Array]:
        """Name the parts of x; initial states are (n,), or (n, experiments)."""
        unknowns, parts = self.unknowns, self.unknowns.parts(x)
        states = x[unknowns.shared :].reshape(unknowns.experiments, unknowns.memory).T
        parts["x0"] = states if unknowns.experiments > 1 else states[:, 0]
        return {name: parts[part] for name, part in self.names.items()}

    def pack(self, values: Mapping[str, Array]) -> Array:
        """Return x of named values."""
        return np.concatenate([np.ravel(values[name], order="F" if part == "x0" else "C")
                               for name, part in self.names.items()]).astype(float)

    def variables(self) -> dict[str, cp.Variable]:
        """Return new CVXPY variables."""
        return {name: cp.Variable(value.shape, name=name)
                for name, value in self.values(np.zeros(self.unknowns.size)).items()}

    def stacked(self, variables: Mapping[str, cp.Variable]) -> cp.Expression:
        """Return the variables as the vector of the unknowns."""
        return cp.hstack([variables[name] if variables[name].ndim == 1 else
                          cp.vec(variables[name], order="F" if part == "x0" else "C")
                          for name, part in self.names.items()])


@dataclass(frozen=True, eq=False)
class TangentFit(ABC):
    """A fit by programmes in the tangent of an iterate; a formulation states the programme and its model."""

    name: str  # of the formulation
    criterion: Criterion  # the errors, in the gauge of the programmes
    constraints: tuple[Any, ...]  # the user's

    @abstractmethod
    def pose(self, z0: Array, at: Linearised, damping: float) -> Program:
        """State the programme of the step from z0, with the user's constraints; ``at`` are the errors near z0."""

    @abstractmethod
    def recover(self, values: Values) -> Any:
        """Return the model of the values of the variables."""

    @cached_property
    def places(self) -> Places:
        """The named variables in the order of the unknowns."""
        return Places.of(self.criterion)

    def signed(self, x: Array) -> Array:
        """Turn the signs of mu and b to where constraints are violated least; without, f rises where the output does.

        A monotone f or a sign of the gain says which of the two equal descriptions is meant; where it asks for the
        opposite characteristic, mu or b alone is turned, since no tangent step leads through zero.
        """
        x, at = self.criterion.normalised(x), self.criterion.unknowns.slices
        errors = self.criterion.linearise(x) if self.constraints else None
        for mu, b in self.criterion.unknowns.products if self.criterion.gauge == "norm" else ():
            if mu.startswith("nu"):  # the signs of feedback functions stay
                continue
            best, chosen = np.inf, x
            first = self.criterion.gain_sign(x, b)
            signs = (first, first), (-first, -first), (-first, first), (first, -first)
            for mu_sign, b_sign in signs if mu.startswith("mu") else signs[:2]:
                turned = np.array(x)
                turned[at[mu]] *= mu_sign
                turned[at[b]] *= b_sign
                outside = 0.0 if errors is None else violation(self.pose(turned, errors, 0.0))
                if outside < (best if mu_sign == b_sign else 0.5 * best):
                    best, chosen = outside, turned
                if best <= 1e-9:
                    break
            x = chosen
        return x

    def mirrored(self, x: Array) -> Iterator[Array]:
        """Yield x with the three other pairs of signs of mu and b of every input.

        What a word says of f may be nearer to one of them, and its optimum to another: f may be convex either way.
        """
        at = self.criterion.unknowns.slices
        for mu, b in self.criterion.unknowns.products if self.criterion.gauge == "norm" else ():
            for mu_sign, b_sign in ((-1, -1), (1, -1), (-1, 1)) if mu.startswith("mu") else ():
                turned = np.array(x)
                turned[at[mu]] *= mu_sign
                turned[at[b]] *= b_sign
                yield turned

    def turns(self, x: Array, errors: Linearised) -> Array:
        """Return -1 for every input whose f falls where the output rises, if the constraints allow the opposite signs.

        1 for the others; (m,). A descent under constraints may end with other signs than it began with.
        """
        at, found = self.criterion.unknowns.slices, np.ones(self.criterion.data.m)
        for mu, b in self.criterion.unknowns.products if self.criterion.gauge == "norm" else ():
            if mu.startswith("mu") and self.criterion.gain_sign(x, b) < 0:
                turned = np.array(x)
                turned[at[mu]], turned[at[b]] = -x[at[mu]], -x[at[b]]
                found[int(b[1:])] = -1.0 if violation(self.pose(turned, errors, 0.0)) <= INSIDE else 1.0
        return found


def violation(program: Program) -> float:
    """Return the largest relative violation of the constraints at the iterate of a programme."""
    program.assign(program.view.reference)
    return measure_violation(program)[0]
