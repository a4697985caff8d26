"""Continuous models: state equations in units of time behind static functions and dead times, and their samples."""

from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from math import comb, factorial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_integer, finite
from optid.data.channels import Ports, sampling_time
from optid.errors import DataError, StructureError
from optid.models import roots
from optid.models.experiments import check_inputs, named_channels, operating_point, samples_of, state_like
from optid.models.export import control_names, control_package
from optid.models.held_inputs import held_step, run_held, split_delays
from optid.models.nonlinearity import Nonlinearity
from optid.models.pole_table import PoleTable

MATRICES = {"A": "nn", "B": "nr", "C": "ln", "D": "lr", "offset_x": "n", "offset_y": "l", "dead_time": "r"}


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousModel(Ports):
    """State equations in continuous time behind static functions and dead times, without noise, in raw units.

        x'(t) = A x + B w(t) + offset_x
        y(t) = C x + D w(t) + offset_y,    w_j(t) = f_j(u(t - dead_time_j))

    Attributes:
        A: (n, n), per unit of time.
        B: (n, r), one column per function, per unit of time.
        C: (l, n).
        D: (l, r).
        nonlinearities: the r functions f of the inputs, without offsets.
        input_of: the input that each acts on, r indices.
        dead_time: (r,) in units of time, not negative.
        offset_x: (n,) constant of the state equation, per unit of time.
        offset_y: (l,) constant of the output equation.
        time_unit: unit of time, "" where unknown.
        inputs, outputs, input_units, output_units: names and units of the m inputs and l outputs, as of `Model`.

    Raises:
        StructureError: shapes that do not agree, values that are not finite, a negative dead time.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    nonlinearities: tuple[Nonlinearity, ...]
    input_of: tuple[int, ...]
    dead_time: Array
    offset_x: Array
    offset_y: Array
    time_unit: str = ""
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    SAMPLED: ClassVar[Any] = None  # the class of the sampled model, which enters itself

    def __post_init__(self) -> None:
        fixed: dict[str, Any] = {name: finite(getattr(self, name), name) for name in MATRICES}
        fixed |= {name: tuple(getattr(self, name)) for name in ("nonlinearities", "input_of")}
        sizes = {"n": len(fixed["A"]), "r": len(fixed["nonlinearities"]), "l": fixed["offset_y"].size}
        for name, letters in MATRICES.items():
            shape = tuple(sizes[letter] for letter in letters)
            if fixed[name].shape != shape:
                raise StructureError(f"{name} has shape {fixed[name].shape}; {sizes['n']} states, {sizes['r']} "
                                     f"functions and {sizes['l']} outputs need {shape}.")
        m = len(self.inputs) or 1 + max(fixed["input_of"], default=-1)
        if len(fixed["input_of"]) != sizes["r"] or any(not 0 <= c < m for c in fixed["input_of"]):
            raise StructureError(f"input_of = {fixed['input_of']}: one input from 0 to {m - 1} for each of the "
                                 f"{sizes['r']} functions.")
        for j, f in enumerate(fixed["nonlinearities"]):
            if f.offset:
                raise StructureError(f"nonlinearities[{j}] has an offset: the constants belong to offset_x, offset_y.")
        if np.any(fixed["dead_time"] < 0):
            j = int(np.argmax(fixed["dead_time"] < 0))
            raise StructureError(f"dead_time[{j}] = {fixed['dead_time'][j]:g}: it must not be negative.")
        for name, value in {**fixed, **named_channels(self, m, sizes["l"])}.items():
            object.__setattr__(self, name, value)

    # -- what it says ----------------------------------------------------------------------------------------------

    @cached_property
    def poles(self) -> Any:
        """Eigenvalues of A, complex (n,), the slowest first."""
        found: Any = np.linalg.eigvals(self.A).astype(complex)
        return found[np.lexsort((found.imag, np.abs(found)))]

    @cached_property
    def zeros(self) -> Any:
        """Invariant zeros from all functions of the inputs to all outputs, complex; the dead times are left out."""
        return roots.invariant_zeros(self.A, self.B, self.C, self.D)

    @property
    def f(self) -> Nonlinearity | tuple[Nonlinearity, ...]:
        """The nonlinearity of the input; a tuple when there are several."""
        return self.nonlinearities[0] if len(self.nonlinearities) == 1 else self.nonlinearities

    @property
    def pole_table(self) -> PoleTable:
        """Time constant, natural frequency and damping of every mode."""
        return PoleTable.of_continuous(self.poles, self.time_unit)

    def static_gain(self, u0: ArrayLike) -> Any:
        """Return the slope of the outputs at rest by the inputs at u0 (m,); a number, or (l, m) for several channels.

        An integrator, which does not come to rest, and u0 of another size are refused (`StructureError`).
        """
        points = operating_point(self, u0)
        slopes = np.zeros((len(self.nonlinearities), self.m))
        for j, (f, c) in enumerate(zip(self.nonlinearities, self.input_of)):
            slopes[j, c] = f.slope(points[c])
        gain = (self.D - self.C @ self._at_rest(self.B)) @ slopes
        return float(gain[0, 0]) if gain.size == 1 else gain

    def _at_rest(self, right: Array) -> Array:
        """Solve A x = right."""
        if any(np.isinf(mode.time_constant) and mode.natural_frequency == 0 for mode in self.pole_table):
            raise StructureError("The model has a pole at 0 (an integrator): it comes to rest at no level.")
        return np.linalg.solve(self.A, right)

    def frequency_response(self, w: ArrayLike) -> Any:
        """Return the response (len(w), l, r) of the linear part and its dead times at w (radians per unit of time)."""
        s = 1j * np.atleast_1d(np.asarray(w, dtype=float))[:, None, None]
        response = self.C @ np.linalg.solve(s * np.eye(len(self.A)) - self.A, self.B.astype(complex)) + self.D
        return response * np.exp(-s * self.dead_time)

    def __repr__(self) -> str:
        return f"ContinuousModel({len(self.A)} states, {', '.join(self.inputs)} to {', '.join(self.outputs)})"

    def __str__(self) -> str:
        """Return the sizes, the dead times and the table of poles."""
        late = [f"{self.inputs[c]} {self._time(delay)}" for c, delay in zip(self.input_of, self.dead_time) if delay]
        return "\n".join([
            f"x'(t) = A x + B f(u(t - dead_time)) + offset_x, y(t) = C x + D f(u(t - dead_time)) + offset_y; "
            f"{len(self.A)} states", f"dead time: {', '.join(late) or 'none'}",
            *([str(self.pole_table)] if len(self.A) else [])])

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    def _time(self, value: float) -> str:
        return f"{value:.6g} {self.time_unit}".rstrip()

    # -- what it does ----------------------------------------------------------------------------------------------

    def simulate(self, u: ArrayLike, dt: float | None = None, *, times: ArrayLike | None = None, x0: Any = "zero"
                 ) -> Array:
        """Compute the outputs at the instants of the inputs, exactly: every input is held until its next sample.

        Args:
            u: inputs (N,) or (N, m) in raw units.
            dt: sampling time of regular inputs.
            times: (N,) ascending instants of others, in units of time.
            x0: "zero" (nothing before the record: states and functions are zero), "rest" (at rest under the first
                inputs), or the state (n,), with the first inputs held before as long as the dead times reach.

        Returns:
            (N, l) in raw units, or (N,) for u given as (N,) and one output.

        Raises:
            DataError: a missing input, other channels, instants that do not ascend, outputs that leave the range of
                numbers.
            StructureError: not one of dt and times, an x0 that cannot be read, no state of rest.
        """
        samples = samples_of(u, "u", self.m)
        check_inputs(self, samples, "")
        if (dt is None) == (times is None):
            raise StructureError("Give either dt= for regular samples or times= for others.")
        w = np.column_stack([f(samples[:, c]) for f, c in zip(self.nonlinearities, self.input_of)]
                            ) if self.nonlinearities else np.zeros((len(samples), 0))
        unit, t = (sampling_time(dt), np.arange(float(len(w)))) if times is None else (1.0, _instants(times, len(w)))
        start, before = self._start(x0, w[0])
        system = unit * self.A, unit * self._driven, self.C, np.column_stack([self.D, np.zeros(self.l)])
        with np.errstate(all="ignore"):
            y = self.offset_y + run_held(system, np.append(self.dead_time / unit, 0.0), t - t[0],
                                         np.column_stack([w, np.ones(len(w))]), before, start)
        if not np.isfinite(y).all():
            k, o = np.argwhere(~np.isfinite(y))[0]
            raise DataError(f"The simulation of output {self.outputs[o]!r} leaves the range of numbers at sample {k}: "
                            "the model is unstable.")
        return y[:, 0] if np.ndim(u) == 1 and self.l == 1 else y

    @property
    def _driven(self) -> Array:
        """[B offset_x]."""
        return np.column_stack([self.B, self.offset_x])

    def _start(self, x0: Any, first: Array) -> tuple[Array, Array]:
        """Return the state at the first sample and the values of the functions before it."""
        if isinstance(x0, str):
            if x0 == "zero":
                return np.zeros(len(self.A)), np.zeros(first.size)
            if x0 != "rest":
                raise StructureError(f"x0={x0!r}: use 'zero', 'rest' or an array ({len(self.A)},).")
            return -self._at_rest(self.B @ first + self.offset_x), first
        return state_like(x0, (len(self.A),)), first

    # -- sampled, and for other tools ------------------------------------------------------------------------------

    def to_discrete(self, dt: float) -> Any:
        """Return the `HammersteinSS` that equals this model at the samples k dt of held inputs.

        Its states are those of this model, then for every function with a dead time its last values, the oldest first:
        poles at 0. A mode above half the sampling rate is aliased: its frequency cannot be read from the samples.
        """
        dt = sampling_time(dt)
        whole, rest = split_delays(self.dead_time, dt)
        lengths = whole + (rest > 0)
        n, r, total = len(self.A), len(lengths), len(self.A) + int(lengths.sum())
        A, B, offset = np.zeros((total, total)), np.zeros((total, r)), np.zeros(total)
        C, D = np.zeros((self.l, total)), np.zeros((self.l, r))
        A[:n, :n], constant = held_step(self.A, self._driven, dt)
        C[:, :n], offset[:n] = self.C, constant[:, -1]
        end = n
        for j, count in enumerate(lengths):
            start, end = end, end + count
            values = np.eye(count + 1, total + 1, k=start)  # those that wait, the oldest first, then the new one
            values[-1] = np.eye(1, total + 1, k=total)
            later, new = held_step(self.A, self.B[:, [j]], dt - rest[j])
            old = later @ held_step(self.A, self.B[:, [j]], rest[j])[1]
            acting = np.vstack([old @ values[:1] + new @ values[[int(rest[j] > 0)]], self.D[:, [j]] @ values[:1]])
            A[:n] += acting[:n, :total]
            C += acting[n:, :total]
            A[start:end] = values[1:, :total]
            B[:n, j], D[:, j], B[start:end, j] = acting[:n, total], acting[n:, total], values[1:, total]
        names = {name: getattr(self, name) for name in ("inputs", "outputs", "input_units", "output_units")}
        return self.SAMPLED(A, B, C, D, self.nonlinearities, self.input_of, offset_x=offset, offset_y=self.offset_y,
                            dt=dt, time_unit=self.time_unit, **names)

    def to_control(self, pade: int | None = None) -> Any:
        """Return the linear part as a python-control system, with the names of `Model.to_control`.

        python-control has no continuous dead time: one requires `pade`; see `with_pade`.

        Raises:
            StructureError: a dead time without `pade`, or an impossible order.
            OptidError: python-control is not installed.
        """
        model = self._without_dead_time(pade)
        return control_package().ss(model.A, model.B, model.C, model.D, 0, **control_names(self))

    def to_lti(self, pade: int | None = None) -> Any:
        """Return the linear part, from every f to every output, as a `scipy.signal.lti`; dead times as `to_control`."""
        from scipy.signal import lti

        model = self._without_dead_time(pade)
        return lti(model.A, model.B, model.C, model.D)

    def _without_dead_time(self, pade: int | None) -> "ContinuousModel":
        if pade is not None:
            return self.with_pade(pade)
        for j, delay in enumerate(self.dead_time):
            if delay:
                raise StructureError(
                    f"Input {self.inputs[self.input_of[j]]!r} has a dead time of {self._time(delay)}, which no finite "
                    "number of states holds in continuous time: pass pade=n for an approximation of order n, or "
                    "export the sampled model, to_discrete(dt), whose dead time is exact.")
        return self

    def with_pade(self, order: int) -> "ContinuousModel":
        """Return the model with every dead time replaced by its Pade approximation of an order, 1 to 10.

        The phase is that of the dead time up to a frequency of about order / dead time.
        """
        late = [j for j, delay in enumerate(self.dead_time) if delay]
        n, r, count = len(self.A), len(self.dead_time), check_integer(order, "pade", 1, 10)
        A, D = np.zeros((n + count * len(late),) * 2), np.eye(r)
        B, C = np.zeros((len(A), r)), np.zeros((r, len(A)))
        for i, j in enumerate(late):
            part = slice(n + i * count, n + (i + 1) * count)
            weights = [factorial(2 * count - k) * comb(count, k) for k in range(count + 1)]  # of (dead time s)^k
            den = np.array(weights, dtype=float)[::-1] / weights[-1]
            num = den * (-1.0) ** np.arange(count, -1, -1)
            A[part, part] = np.eye(count, k=-1)
            A[part, part][0] = -den[1:]
            A[part, part] /= self.dead_time[j]
            B[part.start, j] = 1 / self.dead_time[j]
            C[j, part], D[j, j] = num[1:] - num[0] * den[1:], num[0]
        A[:n], B[:n] = np.hstack([self.A, np.zeros((n, len(A) - n))]) + self.B @ C, self.B @ D
        C = np.hstack([self.C, np.zeros((self.l, len(A) - n))]) + self.D @ C
        constant = np.concatenate([self.offset_x, np.zeros(len(A) - n)])
        return replace(self, A=A, B=B, C=C, D=self.D @ D, dead_time=np.zeros(r), offset_x=constant)


def _instants(times: ArrayLike, count: int) -> Array:
    """Read ascending instants (N,); refuse others (`DataError`)."""
    read = np.asarray(times, dtype=float)
    if read.shape != (count,):
        raise DataError(f"times has shape {read.shape}; it must be ({count},), one instant for each sample of u.")
    bad = ~np.isfinite(read)
    if bad.any():
        raise DataError(f"times: instant {int(np.argmax(bad))} is {read[np.argmax(bad)]}; it must be a number.")
    if np.any(np.diff(read) <= 0):
        k = int(np.argmax(np.diff(read) <= 0)) + 1
        raise DataError(f"times: instant {k} is {read[k]:g} after {read[k - 1]:g}; the instants must ascend.")
    return read
