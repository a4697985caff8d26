"""The simulation errors of processes in continuous time on a record, at any instants, with all derivatives.

    y(t) = sum_c G_c(s) exp(-theta_c s) eta_c(u_c)ᵀ mu_c + level + drift t + free motion

Given the dynamics everything else is linear. Times are counted in sampling times, from the first sample of every
experiment; before it the inputs had their first values. The errors have a kink in a dead time where a delayed change of
the input meets a sample: there the derivative is the one of a side, or between both that for which the errors are
stationary in the dead time.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optid.arrays import Array
from optid.bases import Basis
from optid.data.channels import Transform
from optid.data.record import Data
from optid.identify.prediction_error.descent import Criterion
from optid.models.process_dynamics import ProcessDynamics, ProcessStructure, thin_out
from optid.program.units import energy_unit, outer_bases
from optid.statistics.linearised import Linearised, Method, linearised
from optid.statistics.unknowns import Unknowns

STEP = 1e-6  # of the differences by which the free motion follows the poles
AT_KINK = 1e-9  # samples between a dead time and a kink up to which it lies there


@dataclass(frozen=True)
class ProcessUnknowns(Unknowns):
    """[dynamics0; mu0; dynamics1; mu1; ...; offset; drift; x0]: of every input the numbers of its process, then mu."""

    structures: tuple[ProcessStructure, ...]
    sizes: tuple[int, ...]  # number of coefficients of every f
    experiments: int
    constant: bool = True  # whether there is one level of the output
    drift: bool = False  # whether the level moves along a straight line
    free: bool = False  # whether every experiment begins with its own motion
    levels: bool = False  # whether every experiment has its own level
    innovations: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def n(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Size of an initial state: of all sections, and of a level."""
        return self.free * sum(one.order for one in self.structures) + self.levels

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Sizes of the parts."""
        found: dict[str, tuple[int, ...]] = {}
        for c, (structure, size) in enumerate(zip(self.structures, self.sizes)):
            found |= {f"dynamics{c}": (len(structure.names),), f"mu{c}": (size,)}
        return found | {"offset": (int(self.constant),), "drift": (int(self.drift),)}

    @cached_property
    def linear(self) -> NDArray[np.intp]:
        """Places in x of everything else, in which they are linear."""
        return np.setdiff1d(np.arange(self.size), self.dynamic)

    @cached_property
    def dynamic(self) -> NDArray[np.intp]:
        """Places in x of the numbers of all processes, in which the errors are nonlinear."""
        every = np.arange(self.size)
        return np.concatenate([every[self.slices[f"dynamics{c}"]] for c in range(len(self.structures))])


@dataclass(frozen=True, eq=False)
class InputCourse:
    """An input of an experiment: the values (J, M) of its functions from the times (J,) on at which they change."""

    changes: Array
    values: Array

    @property
    def about_rest(self) -> Array:
        """The values about the first ones, with which the process is at rest."""
        return self.values - self.values[0]


@dataclass(frozen=True, eq=False)
class ProcessErrors(Criterion):
    """The simulation errors of one output; `data` is the record in the units of the errors."""

    data: Data
    unknowns: ProcessUnknowns
    bases: tuple[Basis, ...]  # of the inputs, in the units of the errors
    units: Transform  # from those of the record to those of the errors
    instants: tuple[Array, ...] = field(repr=False)  # of every experiment, in sampling times
    straight: bool = False  # whether inputs go straight from sample to sample; else they are held
    every: int = 1  # of so many samples one counts
    weight: ClassVar[Array] = np.eye(1)  # pyright: ignore[reportIncompatibleVariableOverride]
    gauge: ClassVar[str] = "none"  # pyright: ignore[reportIncompatibleVariableOverride]
    integrates: ClassVar[bool] = False

    @property
    def unit(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What one unit of the sum of squares is in units of the record."""
        return energy_unit(self.units)

    @property
    def outer_bases(self) -> tuple[Basis, ...]:
        """The bases of the inputs in the units of the record."""
        return outer_bases(self.bases, self.units)

    def key(self, name: str, number: int) -> str:
        """Name a quantity of an input: plain with one input, ``name[input]`` with several."""
        return name if self.data.m == 1 else f"{name}[{self.data.inputs[number]}]"

    # -- the record --------------------------------------------------------------------------------------------------

    @cached_property
    def places(self) -> list[NDArray[np.intp]]:
        """Samples of every experiment that count: those with an output."""
        return [np.flatnonzero(np.isfinite(e.y[:, 0]))[:: self.every] for e in self.data.experiments]

    @cached_property
    def read_at(self) -> list[Array]:
        """Instants of the samples that count, per experiment."""
        return [t[at] for t, at in zip(self.instants, self.places)]

    @cached_property
    def y(self) -> Array:
        """The outputs that count, of all experiments one after another."""
        return np.concatenate([e.y[at, 0] for e, at in zip(self.data.experiments, self.places)])

    @cached_property
    def spans(self) -> list[slice]:
        """Where the samples of every experiment are in `y`."""
        edges = np.cumsum([0, *(len(at) for at in self.places)]).tolist()
        return [slice(a, b) for a, b in zip(edges, edges[1:])]

    @cached_property
    def drives(self) -> list[list[InputCourse]]:
        """The functions of the inputs, [experiment][input]."""
        return [[InputCourse(*thin_out(t, one.values(e.u[:, c]), self.straight)) for c, one in enumerate(self.bases)]
                for e, t in zip(self.data.experiments, self.instants)]

    def first_part(self, most: int, changes: int) -> "ProcessErrors":
        """Return the errors of about so many samples of every experiment, of its beginning if inputs change more."""
        sizes = [min([len(t), *(int(np.searchsorted(t, drive.changes[changes])) for drive in drives
                                if len(drive.changes) > changes and not self.straight)])
                 for t, drives in zip(self.instants, self.drives)]
        if max(sizes) <= most and sizes == [len(t) for t in self.instants]:
            return self
        cut = [replace(e, u=e.u[:n], y=e.y[:n], stamps=None) for e, n in zip(self.data.experiments, sizes)]
        if not all(np.isfinite(e.y).any() for e in cut):
            return self
        data = Data.of_experiments(cut, self.data.dt, self.data.inputs, self.data.outputs)
        return replace(self, data=data, instants=tuple(t[:n] for t, n in zip(self.instants, sizes)),
                       every=self.every * max(1, max(sizes) // most))

    def kinks(self, c: int, theta: float) -> tuple[float, float]:
        """Return the dead times next below and above at which a delayed change of input c meets a sample.

        The larger one may be theta itself, the smaller one not.
        """
        below, above = -np.inf, np.inf
        for t, drives in zip(self.read_at, self.drives):
            changes = drives[c].changes[1:]
            at = np.searchsorted(t, changes + theta - AT_KINK)
            if len(t) and len(changes):
                below = max(below, float(np.max((t[np.maximum(at - 1, 0)] - changes)[at > 0], initial=-np.inf)))
                above = min(above, float(np.min((t[np.minimum(at, len(t) - 1)] - changes)[at < len(t)],
                                                initial=np.inf)))
        return max(below, 0.0), above

    # -- responses ---------------------------------------------------------------------------------------------------

    def processes(self, x: Array) -> list[ProcessDynamics]:
        """Return the dynamics of every input in x, in sampling times; a dead time below zero by rounding is none."""
        found = []
        for c, one in enumerate(self.unknowns.structures):
            p = one.parameters(x[self.unknowns.slices[f"dynamics{c}"]])
            if one.delay and -AT_KINK <= p[-1] < 0:
                p[-1] = 0.0
            found.append(ProcessDynamics(one, p))
        return found

    def columns(self, x: Array, late: bool = True) -> Array:
        """Return what the output is linear in (rows, L) for the dynamics in x, in the order of x without these."""
        dynamics, u = self.processes(x), self.unknowns
        found = np.zeros((len(self.y), u.size - len(u.dynamic)))
        position = 0
        for c, one in enumerate(dynamics):
            part = slice(position, position + u.sizes[c])
            for t, drives, span in zip(self.read_at, self.drives, self.spans):
                drive = drives[c]
                found[span, part] = one.response(t, drive.changes, drive.about_rest, straight=self.straight,
                                                 late=late)[:, 0]
                if not one.structure.integrator:
                    found[span, part] += drive.values[0]
            position = part.stop
        if u.constant:
            found[:, position] = 1.0
            position += 1
        if u.drift:
            found[:, position] = np.concatenate(self.read_at) / self.length
            position += 1
        for i, (t, span) in enumerate(zip(self.read_at, self.spans)):
            first = position + i * u.n
            if u.free:
                modes = np.hstack([one.free_response(t, 0.0) for one in dynamics])
                found[span, first : first + modes.shape[1]] = modes
            if u.levels:
                found[span, first + u.n - 1] = 1.0
        return found

    @cached_property
    def length(self) -> float:
        """Duration of the longest experiment, in sampling times: the unit of time of the drift."""
        return max(float(t[-1]) for t in self.instants) or 1.0

    def slopes(self, x: Array, late: bool = True) -> Array:
        """Return the derivatives (rows, k) of the output by the numbers of all processes."""
        u, found = self.unknowns, []
        for c, one in enumerate(self.processes(x)):
            mu, parts = x[u.slices[f"mu{c}"]], []
            for t, drives in zip(self.read_at, self.drives):
                drive = drives[c]
                response = one.response(t, drive.changes, (drive.about_rest @ mu)[:, None], straight=self.straight,
                                        late=late, sensitive=True)
                parts.append(response[:, 1:, 0] * one.weights)
            found.append(np.vstack(parts))
        slopes = np.hstack(found)
        if u.free:  # the free motion is smooth in the poles, and there are few
            linear = x[u.linear]
            first = len(linear) - u.n * u.experiments
            names = [name for one in u.structures for name in one.names]
            for j, place in enumerate(u.dynamic):
                if names[j] == "dead_time":  # which does not delay it
                    continue
                ends = [self.columns(x + sign * STEP * np.eye(u.size)[place], late)[:, first:] for sign in (1, -1)]
                slopes[:, j] += (ends[0] - ends[1]) @ linear[first:] / (2 * STEP)
        return slopes

    def simulate(self, x: Array) -> Array:
        """Return the outputs (rows,) of the model."""
        return self.columns(x) @ x[self.unknowns.linear]

    # -- what descents and programmes need ---------------------------------------------------------------------------

    def _matrix(self, x: Array) -> tuple[Array, Array]:
        """Return the derivatives (rows, size) of the output in the order of x, and the errors."""
        u, linear = self.unknowns, self.columns(x)
        errors = linear @ x[u.linear] - self.y
        matrix = np.zeros((len(errors), u.size))
        matrix[:, u.linear] = linear
        matrix[:, u.dynamic] = self._between(x, errors)
        return matrix, errors

    def _between(self, x: Array, errors: Array) -> Array:
        """Return `slopes`; a dead time at a kink has a derivative between those of both sides."""
        slopes = self.slopes(x)
        for c, structure in enumerate(self.unknowns.structures):
            theta, place = x[self.unknowns.slices[f"dynamics{c}"]][-1] if structure.delay else 0.0, self.place(c)
            if not structure.delay or self.kinks(c, theta)[1] > theta + AT_KINK:
                continue
            less, more = slopes[:, place], self.slopes(x, late=False)[:, place]
            down, up = less @ errors, more @ errors
            share = float(np.clip(down / (down - up), 0.0, 1.0)) if down < 0 < up else 1.0 * (up < 0)
            slopes[:, place] = (1 - share) * less + share * more
        return slopes

    def cell(self, x: Array, c: int) -> tuple[float, float]:
        """Return the dead times of input c between which the errors are as smooth as from x; at a kink the better side.

        Both are that of x where it is the best one near it.
        """
        theta = float(x[self.unknowns.slices[f"dynamics{c}"]][-1])
        low, high = self.kinks(c, theta)
        if high > theta + AT_KINK:
            return low, high
        errors, place = self.simulate(x) - self.y, self.place(c)
        down, up = (self.slopes(x, late)[:, place] @ errors for late in (True, False))
        if up < 0:
            return theta, self.kinks(c, theta + 10 * AT_KINK)[1]
        return (theta, theta) if down < 0 else (low, theta)

    def place(self, c: int) -> int:
        """Return the place of the dead time of input c among the numbers of all processes."""
        return sum(len(one.names) for one in self.unknowns.structures[: c + 1]) - 1

    def rows(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return a generator of the rows [x0 | shared | error] of experiment i, zero where an output is missing."""
        matrix, errors = self._matrix(x)
        shared, n = self.unknowns.shared, self.unknowns.n

        def of(i: int) -> Iterator[tuple[Array, int]]:
            span, at = self.spans[i], self.places[i]
            block = np.zeros((len(self.instants[i]), n + shared + 1))
            states = slice(shared + i * n, shared + (i + 1) * n)
            block[at] = np.column_stack([matrix[span, states], matrix[span, :shared], errors[span]])
            yield block, len(at)

        return of

    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x."""
        u = self.unknowns
        return linearised(self.rows(x), u.experiments, u.n, u.shared, method=method)

    def value(self, x: Array) -> float:
        """Return the sum of squared errors at x."""
        return float(np.sum((self.simulate(x) - self.y) ** 2))

    def admissible(self, x: Array) -> bool:
        """Whether the numbers are those of a process: finite, no dead time negative."""
        if not np.all(np.isfinite(x)) or np.max(np.abs(x[self.unknowns.dynamic]), initial=0.0) > 1e7:
            return False
        return all(not one.delay or x[self.unknowns.slices[f"dynamics{c}"]][-1] >= -AT_KINK
                   for c, one in enumerate(self.unknowns.structures)) and all(
            np.max(np.abs(x[self.unknowns.slices[f"dynamics{c}"]][one.logarithmic]), initial=0.0) < 100
            for c, one in enumerate(self.unknowns.structures))

    def gauge_rows(self, x: Array) -> Array:
        """Return no directions."""
        return np.zeros((0, self.unknowns.shared))

    def with_linear(self, x: Array, linear: ArrayLike) -> Array:
        """Return the dynamics of x with other linear unknowns."""
        found = np.array(x, dtype=float)
        found[self.unknowns.linear] = linear
        return found
