"""The simulation errors of processes in continuous time on a record, at any instants, with all derivatives.

    y(t) = sum_c G_c(s) exp(-theta_c s) eta_c(u_c)ᵀ mu_c + level + drift t + free motion

of every output. Given the dynamics everything else is linear. Times are counted in sampling times, from the first
sample of every experiment; before it the inputs had their first values. The errors have a kink in a dead time where a
delayed change of the input meets a sample: there the derivative is the one of a side, or between both that for which
the errors are stationary in the dead time. Outputs are in units of their own, and independent of each other but for
what constraints tie: each is searched by itself.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases import Basis, Linear
from optid.data.channels import Transform, model_meta
from optid.data.record import Data
from optid.identify.prediction_error.compressed_errors import CompressedErrors
from optid.identify.prediction_error.criterion import Criterion
from optid.identify.process.unknowns import ProcessUnknowns
from optid.models.nonlinearity import Nonlinearity
from optid.models.process import ProcessModel, name_of_pair
from optid.models.process_dynamics import ProcessDynamics
from optid.models.process_kernel import thin_out
from optid.program.compressed import Spread
from optid.program.units import energy_unit, outer_bases
from optid.statistics.linearised import Linearised, Method, linearise_errors

STEP = 1e-6  # of the differences by which the free motion follows the poles
AT_KINK = 1e-9  # samples between a dead time and a kink up to which it lies there
LARGEST, LARGEST_LOG = 1e7, 100.0  # numbers, and logarithms of them, beyond which nothing is simulated


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
class OutputCourse:
    """The samples of an output in an experiment that count: those with a value."""

    experiment: int
    output: int
    samples: NDArray[np.intp]
    instants: Array  # of these, in sampling times
    span: slice  # where they are among all that count


@dataclass(frozen=True, eq=False)
class ProcessErrors(Criterion):
    """The simulation errors of all outputs; `data` is the record in the units of the errors."""

    data: Data
    unknowns: ProcessUnknowns
    bases: tuple[Basis, ...]  # of the inputs, in the units of the errors
    units: Transform  # from those of the errors to those of the record; every output has a size of its own
    instants: tuple[Array, ...] = field(repr=False)  # of every experiment, in sampling times
    straight: bool = False  # whether inputs go straight from sample to sample; else they are held
    every: int = 1  # of so many samples one counts
    gauge: ClassVar[str] = "none"  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def weight(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Every output has the weight of its own units."""
        return np.eye(self.unknowns.outputs)

    @property
    def unit(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What one unit of the sum of squares is in units of the record; of several outputs there is no common one."""
        return energy_unit(self.units) if self.unknowns.outputs == 1 else 1.0

    @property
    def outer_bases(self) -> tuple[Basis, ...]:
        """The bases of the inputs in the units of the record."""
        return outer_bases(self.bases, self.units)

    def is_line(self, p: int) -> bool:
        """Whether the static curve of a pair is a straight line."""
        return isinstance(self.bases[self.unknowns.pairs[p][1]], Linear)

    def key(self, name: str, number: int) -> str:
        """Name a quantity of a pair; see `name_of_pair`."""
        return name_of_pair(name, self.unknowns.pairs[number], self.data)

    # -- outputs -----------------------------------------------------------------------------------------------------

    @cached_property
    def each(self) -> tuple["ProcessErrors", ...]:
        """The errors of every output alone."""
        if self.unknowns.outputs == 1:
            return (self,)
        u = self.units
        return tuple(replace(self, data=self.data.select(outputs=name), unknowns=self.unknowns.of_output(o)[0],
                             units=replace(u, y_scale=u.y_scale[o : o + 1], y_offset=u.y_offset[o : o + 1]))
                     for o, name in enumerate(self.data.outputs))

    def join(self, parts: list[Array]) -> Array:
        """Return x of the unknowns of every output."""
        x = np.zeros(self.unknowns.size)
        for o, part in enumerate(parts):
            x[self.unknowns.of_output(o)[1]] = part
        return x

    # -- the record --------------------------------------------------------------------------------------------------

    @cached_property
    def courses(self) -> list[OutputCourse]:
        """The outputs of all experiments."""
        found, end = [], 0
        for i, (e, t) in enumerate(zip(self.data.experiments, self.instants)):
            for o in range(self.unknowns.outputs):
                at = np.flatnonzero(np.isfinite(e.y[:, o]))[:: self.every]
                found.append(OutputCourse(i, o, at, t[at], slice(end, end + len(at))))
                end += len(at)
        return found

    @cached_property
    def y(self) -> Array:
        """The outputs that count, one course after another."""
        return np.concatenate([self.data.experiments[one.experiment].y[one.samples, one.output]
                               for one in self.courses])

    @cached_property
    def drives(self) -> list[list[InputCourse]]:
        """The functions of the inputs, [experiment][input]."""
        return [[InputCourse(*thin_out(t, one.values(e.u[:, c]), self.straight)) for c, one in enumerate(self.bases)]
                for e, t in zip(self.data.experiments, self.instants)]

    def courses_of(self, p: int) -> Iterator[tuple[OutputCourse, InputCourse]]:
        """Yield the courses of the output and of the input of a pair, experiment by experiment."""
        o, c = self.unknowns.pairs[p]
        yield from ((one, self.drives[one.experiment][c]) for one in self.courses if one.output == o)

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

    def kinks(self, p: int, theta: float) -> tuple[float, float]:
        """Return the dead times next below and above at which a delayed change of the input of a pair meets a sample.

        The larger one may be theta itself, the smaller one not.
        """
        below, above = -np.inf, np.inf
        for one, drive in self.courses_of(p):
            t, changes = one.instants, drive.changes[1:]
            at = np.searchsorted(t, changes + theta - AT_KINK)
            if len(t) and len(changes):
                below = max(below, float(np.max((t[np.maximum(at - 1, 0)] - changes)[at > 0], initial=-np.inf)))
                above = min(above, float(np.min((t[np.minimum(at, len(t) - 1)] - changes)[at < len(t)],
                                                initial=np.inf)))
        return max(below, 0.0), above

    # -- responses ---------------------------------------------------------------------------------------------------

    def processes(self, x: Array) -> list[ProcessDynamics]:
        """Return the dynamics of every pair in x, in sampling times; a dead time below zero by rounding is none."""
        found = []
        for p, one in enumerate(self.unknowns.structures):
            values = one.parameters(x[self.unknowns.slices[f"dynamics{p}"]])
            if one.delay and -AT_KINK <= values[-1] < 0:
                values[-1] = 0.0
            found.append(ProcessDynamics(one, values))
        return found

    def columns(self, x: Array, late: bool = True) -> Array:
        """Return what the outputs are linear in (rows, L) for the dynamics in x, in the order of x without these."""
        u, processes = self.unknowns, self.processes(x)
        found = np.zeros((len(self.y), u.size))
        for p, one in enumerate(processes):
            for course, drive in self.courses_of(p):
                into = found[course.span, u.slices[f"mu{p}"]]
                into[:] = one.response(course.instants, drive.changes, drive.about_rest, straight=self.straight,
                                       late=late)[:, 0]
                if not one.structure.integrator:
                    into += drive.values[0]
                if u.free:
                    states = found[course.span, u.shared + course.experiment * u.n :]
                    states[:, u.sections[p]] = one.free_response(course.instants, 0.0)
        for course in self.courses:
            last = u.shared + (course.experiment + 1) * u.n - u.outputs
            for there, first, values in ((u.constant, u.slices["offset"].start, 1.0), (u.levels, last, 1.0),
                                         (u.drift, u.slices["drift"].start, course.instants / self.length)):
                if there:
                    found[course.span, first + course.output] = values
        return found[:, u.linear]

    @cached_property
    def length(self) -> float:
        """Duration of the longest experiment, in sampling times: the unit of time of the drift."""
        return max(float(t[-1]) for t in self.instants) or 1.0

    def slopes(self, x: Array, late: bool = True) -> Array:
        """Return the derivatives (rows, k) of the outputs by the numbers of all processes."""
        u = self.unknowns
        found = np.zeros((len(self.y), u.size))
        for p, one in enumerate(self.processes(x)):
            mu = x[u.slices[f"mu{p}"]]
            for course, drive in self.courses_of(p):
                response = one.response(course.instants, drive.changes, (drive.about_rest @ mu)[:, None],
                                        straight=self.straight, late=late, sensitive=True)
                found[course.span, u.slices[f"dynamics{p}"]] = response[:, 1:, 0] * one.weights
        slopes = found[:, u.dynamic]
        if u.free:  # the free motion is smooth in the poles, and there are few
            motion = x[u.shared :]
            for j, ((_, name), place) in enumerate(zip(u.numbers, u.dynamic)):
                if name == "dead_time":  # which does not delay it
                    continue
                ends = [self.columns(x + sign * STEP * np.eye(u.size)[place], late)[:, -len(motion) :]
                        for sign in (1, -1)]
                slopes[:, j] += (ends[0] - ends[1]) @ motion / (2 * STEP)
        return slopes

    def simulate(self, x: Array) -> Array:
        """Return the outputs (rows,) of the model."""
        return self.columns(x) @ x[self.unknowns.linear]

    # -- what descents and programmes need ---------------------------------------------------------------------------

    def _between(self, x: Array, errors: Array) -> Array:
        """Return `slopes`; a dead time at a kink has a derivative between those of both sides."""
        slopes, u = self.slopes(x), self.unknowns
        for p, place in u.delays.items():
            theta = float(x[u.dynamic[place]])
            if self.kinks(p, theta)[1] > theta + AT_KINK:
                continue
            less, more = slopes[:, place], self.slopes(x, late=False)[:, place]
            down, up = less @ errors, more @ errors
            share = float(np.clip(down / (down - up), 0.0, 1.0)) if down < 0 < up else 1.0 * (up < 0)
            slopes[:, place] = (1 - share) * less + share * more
        return slopes

    def cell(self, x: Array, p: int) -> tuple[float, float]:
        """Return the dead times of a pair between which the errors are as smooth as from x; at a kink the better side.

        Both are that of x where it is the best one near it.
        """
        place = self.unknowns.delays[p]
        theta = float(x[self.unknowns.dynamic[place]])
        low, high = self.kinks(p, theta)
        if high > theta + AT_KINK:
            return low, high
        errors = self.simulate(x) - self.y
        down, up = (self.slopes(x, late)[:, place] @ errors for late in (True, False))
        if up < 0:
            return theta, self.kinks(p, theta + 10 * AT_KINK)[1]
        return (theta, theta) if down < 0 else (low, theta)

    def rows(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return a generator of the rows [x0 | shared | error] of experiment i, the outputs of a sample in turn.

        They are zero where an output is missing.
        """
        u, matrix = self.unknowns, np.zeros((len(self.y), self.unknowns.size))
        matrix[:, u.linear] = self.columns(x)
        errors = matrix[:, u.linear] @ x[u.linear] - self.y
        matrix[:, u.dynamic] = self._between(x, errors)
        shared, n = u.shared, u.n

        def of(i: int) -> Iterator[tuple[Array, int]]:
            block = np.zeros((len(self.instants[i]), u.outputs, n + shared + 1))
            here = [one for one in self.courses if one.experiment == i]
            for one in here:
                states = slice(shared + i * n, shared + (i + 1) * n)
                block[one.samples, one.output] = np.column_stack(
                    [matrix[one.span, states], matrix[one.span, :shared], errors[one.span]])
            yield block.reshape(-1, block.shape[2]), sum(len(one.samples) for one in here)

        return of

    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x."""
        u = self.unknowns
        return linearise_errors(self.rows(x), u.experiments, u.n, u.shared, method=method)

    def compressed_near(self, at: Linearised, x: Array) -> CompressedErrors:
        """Return the compressed errors near x, ``at`` the errors there."""
        return (CompressedErrors if self.unknowns.outputs == 1 else CompressedOutputs)(self, at, x)

    def value(self, x: Array) -> float:
        """Return the sum of squared errors at x."""
        return float(np.sum((self.simulate(x) - self.y) ** 2))

    def admissible(self, x: Array) -> bool:
        """Whether the numbers are those of processes: finite, no dead time negative."""
        u, numbers = self.unknowns, x[self.unknowns.dynamic]
        return bool(np.isfinite(x).all() and np.all(np.abs(numbers) <= LARGEST)
                    and np.all(np.abs(numbers[u.logarithmic]) < LARGEST_LOG)
                    and all(numbers[place] >= -AT_KINK for place in u.delays.values()))

    def model(self, values: Mapping[str, Array]) -> ProcessModel:
        """Return the model of named values in the units of the record."""
        u, dt, data = self.unknowns, self.data.dt, self.data
        processes = tuple(one.in_unit(1 / dt) for one in self.processes(self.variables.pack(values)))
        curves = tuple(Nonlinearity(self.bases[c], np.atleast_1d(values[self.key("mu", p)]))
                       for p, (_, c) in enumerate(u.pairs))
        states = np.reshape(values.get("x0", np.zeros(0)), (-1, u.experiments), order="F")
        levels = states[-u.outputs :].T if u.levels else values.get("offset", np.zeros(u.outputs))[None]
        drift = np.asarray(values.get("drift", np.zeros(u.outputs))) / (self.length * dt)
        model = ProcessModel(processes, curves, levels.mean(axis=0), drift, "first" if self.straight else "zero",
                             u.pairs, levels=levels if u.levels else None, **model_meta(data))
        return model.with_transform(self.units)


@dataclass(eq=False)
class CompressedOutputs(CompressedErrors):
    """The compressed errors of several outputs, each with a noise of its own size; see `CompressedErrors`."""

    criterion: ProcessErrors

    def one_step_fit(self, values: object) -> None:
        """Return nothing: the sum of squares is that of all outputs."""

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter under the noise of all outputs, which may be correlated."""
        found, sizes = self._sandwich(self._noise(z, moves), moves), self.criterion.units.y_scale
        return replace(found, noise=found.noise * np.outer(sizes, sizes))
