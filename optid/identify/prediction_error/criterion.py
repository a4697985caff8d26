"""A sum of squared errors in a vector of unknowns, and the convex problem of a step of a fit that lowers it.

The problem of the fit has one term, `optid.core.terms.Errors`, with its criterion.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.core.judge import largest_excess
from optid.core.leaves import Product
from optid.core.problem import Problem
from optid.core.terms import Errors, Squares, Values, flat
from optid.data.channels import Transform
from optid.data.record import Data
from optid.statistics.linearised import Linearised, Method
from optid.statistics.unknowns import Unknowns

INSIDE = 1e-6  # relative violation up to which a point satisfies the constraints


@dataclass(frozen=True, eq=False)
class Places:
    """Named variables, and where each stands in the vector of the unknowns of errors."""

    criterion: "Criterion"  # the errors

    @cached_property
    def names(self) -> dict[str, str]:
        """{variable: part of the vector}, in its order, named by the keys of the criterion; "x0": initial states."""
        found, unknowns = {}, self.criterion.unknowns
        for part, shape in unknowns.shapes.items():
            kind = part.rstrip("0123456789")
            if np.prod(shape):
                found[part if kind == part else self.criterion.key(kind, int(part[len(kind) :]))] = part
        return {**found, "x0": "x0"} if unknowns.memory else found

    def values(self, x: Array) -> dict[str, Array]:
        """Name the parts of x; initial states are (n,), or (n, experiments)."""
        unknowns, parts = self.criterion.unknowns, self.criterion.unknowns.parts(x)
        states = x[unknowns.shared :].reshape(unknowns.experiments, unknowns.memory).T
        parts["x0"] = states if unknowns.experiments > 1 else states[:, 0]
        return {name: parts[part] for name, part in self.names.items()}

    def pack(self, values: Mapping[str, Array]) -> Array:
        """Return x of named values."""
        return np.concatenate([np.ravel(values[name], order="F" if part == "x0" else "C")
                               for name, part in self.names.items()]).astype(float)

    def value(self, values: Values) -> float:
        """Return the sum of squared errors at named values."""
        return self.criterion.value(self.pack(values))

    def squares(self, values: Values) -> Squares:
        """Return the sum of squared errors near named values, the errors to first order."""
        z0 = self.pack(values)
        at = self.criterion.linearise(z0)
        root, errors = at.whole
        return Squares(root[:, self.columns], root @ z0 - errors, at.remainder, tuple(self.names))

    def stack(self, variables: Mapping[str, cp.Expression]) -> cp.Expression:
        """Return the variables as the vector of the unknowns."""
        return cp.hstack([variables[name] if variables[name].ndim == 1 else
                          cp.vec(variables[name], order="F" if part == "x0" else "C")
                          for name, part in self.names.items()])

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """Where in the vector the entries of the variables are, one after another, each column by column."""
        places = self.values(np.arange(self.criterion.unknowns.size, dtype=float))
        return np.concatenate([flat(one) for one in places.values()]).astype(np.intp)


class Criterion(ABC):
    """A sum of squared errors in a vector x of unknowns, of which the last ones are initial states."""

    data: Data  # the record
    unknowns: Unknowns  # the order of x
    gauge: str  # how the scale between mu and b is fixed
    weight: Array  # (l, l) weight of the errors
    units: Transform  # from those of the models of points to those of the record
    unit: float = 1.0  # what one unit of the sum of squares is in units of the record
    # whether the errors are nonlinear in the initial states, so that steps of these are damped, too
    bends: bool = False

    @cached_property
    def variables(self) -> Places:
        """The named variables, and where each stands in x."""
        return Places(self)

    def facts(self) -> dict[str, Any]:
        """Return what constraints may ask besides named expressions: keyword arguments of a `View`."""
        return {}

    def common(self) -> dict[str, Any]:
        """Return what every `optid.core.problem.Problem` of the errors has: scale, unit, and energy of the record."""
        return {"scale": self.energy, "unit": self.unit, "energy": self.unit * self.energy_of_record}

    def factors(self, gauge: str = "") -> tuple[Product, ...]:
        """Return ``Theta = mu bᵀ`` of every input whose function is unknown; where no gauge is named there is none."""
        unknowns: Any = self.unknowns
        return tuple(Product(self.key("mu", c), self.key("b", c), gauge)
                     for c, free in enumerate(unknowns.free) if free)

    def linear_thetas(self, variables: Mapping[str, Any]) -> dict[str, cp.Expression]:
        """Return ``Theta``, one row, of every input that acts linearly."""
        unknowns: Any = self.unknowns
        return {self.key("Theta", c): cp.reshape(variables[self.key("b", c)], (1, -1), order="F")
                for c, free in enumerate(unknowns.free) if not free}

    @property
    def errors(self) -> str:
        """What they are called."""
        return "prediction errors" if self.unknowns.innovations else "simulation errors"

    @property
    def dynamics(self) -> str:
        """Name of the part of x that has the poles: the matrix A, or the coefficients a of a polynomial."""
        return "A" if "A" in self.unknowns.slices else "a"

    @cached_property
    def labels(self) -> list[str]:
        """What the names of the courses of every experiment end in: "[1]", ..., nothing where there is only one."""
        count = self.data.n_experiments
        return [f"[{i}]" if count > 1 else "" for i in range(1, count + 1)]

    # (E, l) what `remove_levels` subtracted from the outputs, where every experiment has constants of its own
    shifts: Array | None = None

    @cached_property
    def energy(self) -> float:
        """Weighted sum of squares of the outputs about their means, without the levels that were subtracted."""
        return self._energy([e.y for e in self.data.experiments])

    @cached_property
    def energy_of_record(self) -> float:
        """The same of the outputs with their levels."""
        outputs, shifts = [e.y for e in self.data.experiments], self.shifts
        return self._energy(outputs if shifts is None else [y + shift for y, shift in zip(outputs, shifts)])

    def _energy(self, outputs: Sequence[Array]) -> float:
        y = np.vstack(outputs)
        y = np.nan_to_num(y - np.nanmean(y, axis=0))
        return float(np.sum((y @ self.weight) * y))

    def compressed_near(self, at: Linearised, x: Array) -> Any:
        """Return the compressed errors near x (`optid.program.compressed`), ``at`` the errors there."""
        raise NotImplementedError(f"no steps are taken with {type(self).__name__}")

    @abstractmethod
    def key(self, name: str, number: int) -> str:
        """Name a quantity of a channel, such as "mu" of input 0."""

    @abstractmethod
    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x, compressed by a method of `optid.statistics.linearised`; infinite as in `value`."""

    @abstractmethod
    def rows(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return a generator of the weighted rows [x0 | shared | error] near x of experiment i, zero without an error.

        They are (T l, q + 1), the outputs of a sample one after the other, each block with the number of its errors.
        """

    @abstractmethod
    def value(self, x: Array) -> float:
        """Return the sum of squared errors at x, without sensitivities; infinite where a run leaves its range."""

    @abstractmethod
    def admissible(self, x: Array) -> bool:
        """Whether the errors exist at x: its filters are stable."""

    def confine(self, x: Array) -> Array:
        """Return the nearest admissible point where that is one of parts that no constraint is about, else x."""
        return x

    def scale(self, x: Array, b: str) -> float:
        """Return what a part b of x is divided by, and its mu multiplied with, to reach the gauge: its norm."""
        return float(np.linalg.norm(x[self.unknowns.slices[b]]))

    def gain_sign(self, x: Array, b: str) -> float:
        """Return the sign that part b of x, and its mu, are given: here that of its largest entry."""
        part = x[self.unknowns.slices[b]]
        return -1.0 if part[np.argmax(np.abs(part))] < 0 else 1.0

    def normalise(self, x: Array) -> Array:
        """Return the same model in the gauge."""
        x, at = np.array(x), self.unknowns.slices
        for mu, b in self.unknowns.products:
            if factor := self.scale(x, b):
                x[at[mu]], x[at[b]] = x[at[mu]] * factor, x[at[b]] / factor
            else:  # a channel without effect: any direction will do
                x[at[mu]], x[at[b]] = 0.0, 1 / np.sqrt(x[at[b]].size)
        return x


def criterion_of(problem: Problem) -> Criterion:
    """Return the errors of a fit, in the gauge of its problem."""
    (term,) = problem.terms
    assert isinstance(term, Errors)
    return term.criterion


def step_problem(problem: Problem, x: Array, at: Linearised, damping: float) -> Problem:
    """Return the problem of the step from x, ``at`` the errors near x."""
    criterion = criterion_of(problem)
    compressed, places = criterion.compressed_near(at, x), criterion.variables
    root, target, remainder = compressed.problem
    if damping:
        sizes = np.sqrt(damping) * np.linalg.norm(at.whole[0], axis=0)
        root, target = np.vstack([root, np.diag(sizes)]), np.append(target, sizes * x)
    squares = Squares(root[:, places.columns], target, remainder, tuple(places.names))
    return problem.tangent(places.values(x), squares, compressed)


def excess(problem: Problem, x: Array, unknowns: frozenset[str] = frozenset()) -> float:
    """Return the largest relative violation of the constraints, or of those about some unknowns alone."""
    return largest_excess(problem, criterion_of(problem).variables.values(x), unknowns)
