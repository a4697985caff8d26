"""Transfer-function models: coefficients, noise, responses, gauge, units, and runs over records.

The state x (n, l) is what the past adds to the right-hand side of the next n equations: the observer form of the plant.
It shifts by one every sample and receives B_i f(u) - A_i y, so a free response is 1/A driven by the rows of x.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, finite
from optid.data.channels import Transform
from optid.errors import DataError, StructureError
from optid.models import recursions, roots, text, transfer_states
from optid.models.experiments import Record, check_inputs
from optid.models.gauges import GAUGES, gauge_factor, plant_sign
from optid.models.layout import Layout
from optid.models.linear import static_solution
from optid.models.model import Model
from optid.models.nonlinearity import Nonlinearity
from optid.models.recursions import autoregression, predict_regression

# share of |b| below which sum b counts as zero: the offset of f then has no effect that could be measured
TINY_SUM = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class HammersteinTF(Model):
    """``y = x + (C/D) e`` with ``A x = sum_c B_c f_c(u_c) + offset``, in raw units.

    The plant is ``x(k) + sum_i A_i x(k-i) = sum_c sum_j b_c[j] f_c(u_c(k - nk_c - j)) + offset``. By default D is A and
    C is 1: an ARX model, with one or several outputs. With C it is ARMAX, with its own D Box-Jenkins, with D = 1
    and no C output error. With the basis `Linear` the model is a linear one.

    Attributes:
        a: (na,) for one output, (na, l, l) for several.
        b: one array per input, (nb_c,) for one output, (nb_c, l) for several.
        nonlinearities: one per input, their offsets None: the constants together are `offset`. See `f`.
        nk: delay in samples, one per input.
        offset: (l,) constant of the equation.
        dt, time_unit, inputs, outputs, input_units, output_units: see `Model`.
        c: (nc,) coefficients of C = 1 + c_1 q^-1 + ...; one output.
        d: (nd,) coefficients of D = 1 + d_1 q^-1 + ...; one output. None where D is A.
        gauge: how the scale between f and B is fixed: "norm", "gain", "b0" or "none"; see `regauge`.
        levels: (E, l) constants of the experiments of its record, whose mean `offset` is; see `Model`.

    Raises:
        StructureError: shapes that do not agree, coefficients that are not finite, an unknown gauge, a C or D for
            several outputs, or a C that is not invertible (a zero on or outside the unit circle): no predictor belongs
            to it.
    """

    a: Array
    b: tuple[Array, ...]
    nonlinearities: tuple[Nonlinearity, ...]
    nk: tuple[int, ...]
    offset: Array
    dt: float = 1.0
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    c: Any = field(default=(), kw_only=True)
    d: Any = field(default=None, kw_only=True)
    gauge: str = field(default="none", kw_only=True)
    time_unit: str = field(default="", kw_only=True)
    levels: Any = field(default=None, kw_only=True)
    GAUGES = GAUGES
    SIMULATORS = ("predict", "free")
    equation, coefficients, noise = text.equations, text.coefficients, property(text.noise)
    state, following = transfer_states.state, transfer_states.following
    _fitted = transfer_states.fit_state  # pyright: ignore[reportAssignmentType]

    def __post_init__(self) -> None:
        a, offset = finite(self.a, "a"), np.atleast_1d(finite(self.offset, "offset"))
        fields = {"a": a.reshape(0, offset.size, offset.size) if offset.size > 1 and not a.size else a,
                  "b": tuple(finite(b, f"b[{c}]") for c, b in enumerate(self.b)),
                  "nonlinearities": self.nonlinearities,
                  "nk": tuple(int(delay) for delay in self.nk),
                  "offset": offset,
                  "c": finite(self.c, "c"),
                  "d": None if self.d is None else finite(self.d, "d")}
        if fields["d"] is not None and fields["d"].size and np.array_equal(fields["d"], a):
            fields["d"] = None
        self._fix(fields, len(self.b), offset.size)
        self._check()
        _ = self.layout

    def _check(self) -> None:
        l, m = self.offset.size, len(self.b)  # noqa: E741 - the field's letter
        if self.offset.ndim != 1:
            raise StructureError(f"offset has shape {self.offset.shape}; it must be (l,).")
        if len(self.nonlinearities) != m:
            raise StructureError(f"nonlinearities has {len(self.nonlinearities)} entries for {m} inputs.")
        if self.a.ndim != (1 if l == 1 else 3) or self.a.shape[1:] not in ((), (l, l)):
            raise StructureError(f"a has shape {self.a.shape}; it must be {'(na,)' if l == 1 else f'(na, {l}, {l})'}.")
        for c, b in enumerate(self.b):
            if b.ndim != (1 if l == 1 else 2) or not b.size or b.shape[1:] not in ((), (l,)):
                raise StructureError(f"b[{c}] has shape {b.shape}; it must be {'(nb,)' if l == 1 else f'(nb, {l})'}.")
        if any(f.offset is not None for f in self.nonlinearities):
            raise StructureError("A nonlinearity of a model has offset None: the constant belongs in offset=.")
        for name, values in (("c", self.c), ("d", self.d)):
            if values is not None and values.ndim != 1:
                raise StructureError(f"{name} has shape {values.shape}; it must be (n{name},).")
        if self.l > 1 and self.structure != "arx":
            raise StructureError(f"A model with c or d has one output; this one has {self.l}: it can only be ARX.")
        largest = roots.radius(self.c)
        if largest >= 1:
            raise StructureError(
                f"C is not invertible: it has a zero of modulus {largest:.6g}. Reflect it into the unit circle "
                "(optid.models.roots.contain_roots): the spectrum of the noise stays what it is.")

    # -- sizes and noise -----------------------------------------------------------------------------------------

    @property
    def na(self) -> int:
        """Number of past outputs."""
        return len(self.a)

    @property
    def nb(self) -> tuple[int, ...]:
        """Number of numerator coefficients, one per input."""
        return tuple(len(b) for b in self.b)

    @property
    def orders(self) -> dict[str, Any]:
        """The orders na, nb and nk (nb and nk with one entry per input) and, where the noise has them, nc and nd."""
        noise = {"nc": self.c.size} if self.structure in ("armax", "bj") else {}
        if self.structure == "bj":
            noise["nd"] = self.noise_denominator.size
        return {"na": self.na, "nb": self.nb, "nk": self.nk} | noise

    @property
    def largest_lag(self) -> int:
        """Largest lag n: the state of the plant is (n, l)."""
        return self.layout.first_row

    @property
    def memory(self) -> int:
        """Samples that cannot be predicted: the largest lag for ARX and ARMAX; else the initial state is estimated."""
        return self.largest_lag if self.d is None else 0

    @cached_property
    def layout(self) -> Layout:
        """Columns of the regression this model solves; it refuses orders that do not agree."""
        bases = tuple(f.basis for f in self.nonlinearities)
        return Layout(self.na, self.nb, self.nk, bases, self.outputs, self.inputs)

    @property
    def matrices(self) -> Array:
        """A_1 .. A_na, (na, l, l) whatever the number of outputs."""
        return self.a.reshape(self.na, self.l, self.l)

    @cached_property
    def numerators(self) -> Array:
        """B of every input by lag, the delay included, (largest lag + 1, l, m)."""
        found = np.zeros((self.largest_lag + 1, self.l, self.m))
        for c, (delay, b) in enumerate(zip(self.nk, self.b)):
            found[delay : delay + len(b), :, c] = b.reshape(-1, self.l)
        found.flags.writeable = False
        return found

    @property
    def structure(self) -> str:
        """Which of the four it is: "oe", "arx", "armax" or "bj"."""
        if self.d is None:
            return "armax" if self.c.size else "arx"
        return "bj" if self.c.size or self.d.size else "oe"

    @property
    def noise_denominator(self) -> Array:
        """Coefficients of D after the leading one: `d`, or `a` where D is A."""
        return self.a if self.d is None else self.d

    # -- plant ---------------------------------------------------------------------------------------------------

    @property
    def c0(self) -> float | None:
        """Offset of f, d / sum b; None where the data cannot tell it from the constant: see `offset_note`."""
        return None if self.offset_note else self._ratio[0]

    @property
    def offset_note(self) -> str:
        """Why the offset of f is not identifiable; "" when it is."""
        if self.m > 1:
            return "With several inputs one constant cannot be shared out among the nonlinearities."
        if self.nonlinearities[0].is_linear:
            return "A linear channel has no offset."
        total = self.b[0].sum(axis=0)
        if np.linalg.norm(total) <= TINY_SUM * np.abs(self.b[0]).sum():
            return "The coefficients of B sum to zero: a constant in f has no effect."
        if self._ratio[1] > 1e-9:
            return "The constants of the outputs are not in the proportion of the sums of B."
        return ""

    @cached_property
    def _ratio(self) -> tuple[float, float]:
        total = np.atleast_1d(self.b[0].sum(axis=0))
        ratio = float(total @ self.offset / (total @ total))
        return ratio, float(np.linalg.norm(self.offset - ratio * total) / max(np.linalg.norm(self.offset), 1e-300))

    def theta(self, c: int = 0) -> Array:
        """Return mu b^T of input c, the same in every gauge: (P, nb), or (P, nb l) with the outputs outermost."""
        return np.outer(self.nonlinearities[c].mu, self.b[c].ravel(order="F"))

    @cached_property
    def poles(self) -> Any:
        """Roots of det A(z), complex (na l,), largest first."""
        n = self.na * self.l
        companion = np.eye(n, k=-self.l)
        if n:
            companion[: self.l] = -np.hstack(list(self.matrices))
        return roots.largest_first(np.linalg.eigvals(companion).astype(complex))

    @property
    def gain_signs(self) -> Array:
        """Return 1 for every input with whose function the output rises, -1 where it falls; see `plant_signs`."""
        return np.array([plant_sign(self.a, b) for b in self.b])

    def with_signs(self, signs: ArrayLike) -> Self:
        """Multiply f and B of every input by its sign (m,), 1 or -1; predictions do not change."""
        pairs = list(zip(np.asarray(signs, dtype=float), self.b, self.nonlinearities))
        return replace(self, b=tuple(sign * b for sign, b, _ in pairs),
                       nonlinearities=tuple(f.times(sign) for sign, _, f in pairs))

    def _static_gain(self, points: Array) -> Array:
        return self._at_rest(self.numerators.sum(axis=0) * [f.slope(u) for f, u in zip(self.nonlinearities, points)])

    def static_curve(self, c: int, points: Array) -> Array:
        """Return the outputs (N, l) at rest with input c held at points (N,) and the functions of the others at zero.

        An integrator is refused (`StructureError`).
        """
        level = self._at_rest(np.column_stack([self.offset, self.numerators[:, :, c].sum(axis=0)]))
        return level[:, 0] + np.outer(self.nonlinearities[c](points), level[:, 1])

    def _at_rest(self, right: Array) -> Array:
        """Solve the equations at rest for constant right-hand sides (l, r)."""
        return static_solution(np.eye(self.l) + self.matrices.sum(axis=0), right)

    def impulse_response(self, n: int = 100) -> Array:
        """Return the response of A^-1 B_c to a unit impulse of f_c, (n, l, m), in the gauge of the model."""
        return self._response(self.numerators, n)

    def _response(self, drive: Array, n: int) -> Array:
        """Return the response (n, l, r) of A^-1 to what enters its equations at first (k, l, r)."""
        right = np.zeros((n, *drive.shape[1:]))
        right[: len(drive)] = drive[:n]
        return np.stack([autoregression(self.matrices, right[:, :, c]) for c in range(drive.shape[2])], axis=2)

    def frequency_response(self, w: ArrayLike) -> Array:
        """Return A^-1 B_c at the frequencies w (radians per unit of time, up to pi / dt), complex (len(w), l, m)."""
        shift = np.exp(-1j * np.atleast_1d(np.asarray(w, dtype=float)) * self.dt)  # q^-1
        powers = shift[:, None] ** np.arange(self.largest_lag + 1)
        denominator = np.eye(self.l) + np.tensordot(powers[:, 1 : self.na + 1], self.matrices, 1)
        return np.asarray(np.linalg.solve(denominator, np.tensordot(powers, self.numerators, 1)))

    # -- gauge and units -----------------------------------------------------------------------------------------

    def _regauged(self, gauge: str, signs: bool) -> Self:
        if gauge == "none":
            scales = [f.unit_slope for f in self.nonlinearities]
        else:
            scales = [gauge_factor(gauge, self.a, b, name) for b, name in zip(self.b, self.inputs)]
        if gauge == "norm" and not signs:
            scales = [abs(scale) for scale in scales]
        return replace(self, b=tuple(b / s for b, s in zip(self.b, scales)), gauge=gauge,
                       nonlinearities=tuple(f.times(s) for f, s in zip(self.nonlinearities, scales)))

    def _in_raw_units(self, transform: Transform) -> Self:
        gain, shift = np.array(transform.y_scale), np.array(transform.y_offset)
        a = self.a if self.l == 1 else self.a * (gain[:, None] / gain)
        b = tuple(row * gain for row in self.b)
        offset = gain * self.offset + shift + a.reshape(self.matrices.shape).sum(axis=0) @ shift
        functions = []
        for f, rows, scale, origin in zip(self.nonlinearities, b, transform.u_scale, transform.u_offset):
            moved, constant = f.in_units(scale, origin)
            functions.append(moved)
            offset = offset + constant * rows.sum(axis=0)
        levels = None if self.levels is None else offset + gain * (self.levels - self.offset)
        return replace(self, a=a, b=b, nonlinearities=tuple(functions), offset=offset, levels=levels)

    def at_level(self, constant: ArrayLike) -> Self:
        """Return the model with one constant (l,) of the equation, such as `offset` or a row of `levels`."""
        return replace(self, offset=constant, levels=None)

    def with_output_levels(self, shifts: Array) -> Self:
        """Return the model of a record whose outputs are higher by shifts (E, l) of zero mean, one an experiment."""
        return replace(self, levels=self.levels + shifts @ (np.eye(self.l) + self.matrices.sum(axis=0)).T)

    # -- running over records ------------------------------------------------------------------------------------

    @property
    def _state_shape(self) -> tuple[int, int]:
        return self.largest_lag + (self.levels is not None), self.l

    def predict_record(self, u: Array, y: Any, horizon: int = 1, x0: Array | None = None, label: str = "") -> Array:
        """Predict one record in raw units; see `predict`. The arguments are those of `Model.predict_record`."""
        if self.structure not in ("arx", "armax"):
            return super().predict_record(u, y, horizon, x0, label)
        drive = self.forcing(u)
        if self.levels is not None:
            drive = drive + (self._fitted_level(drive, y) if x0 is None else x0[-1])
        return self._stateless(drive, y, horizon)

    def _stateless(self, drive: Array, y: Array, horizon: int) -> Array:
        """Predict y (N, l) of an ARX or ARMAX model with a given right-hand side (N, l) of its equation."""
        if self.structure == "arx":
            return predict_regression(self.matrices, drive, y, horizon, self.memory)
        return self._noise_predicted(y, drive, horizon, self.memory)

    def _fitted_level(self, drive: Array, y: Array) -> Array:
        """Estimate what the constants (l,) of ARX or ARMAX differ from `offset` by least squares of one-step errors."""
        predicted = self._stateless(drive, y, 1)
        effect, rest = self._stateless(drive + 1.0, y, 1) - predicted, y - predicted
        unknown = np.isnan(rest) | np.isnan(effect)
        effect, rest = np.where(unknown, 0.0, effect), np.where(unknown, 0.0, rest)
        energy = np.sum(effect**2, axis=0)
        return np.sum(effect * rest, axis=0) / np.where(energy > 0, energy, 1.0)

    def _predicted(self, u: Array, y: Array, horizon: int, state: Array, label: str) -> Array:
        x = self._simulated(u, state, label)
        return x + self._noise_predicted(y - x, None, horizon, 0)

    def _noise_predicted(self, s: Array, drive: Array | None, horizon: int, start: int) -> Array:
        """Predict s = drive + (C/D) e, (N, 1)."""
        c, d = self.c, self.noise_denominator
        found = recursions.innovations(s[:, 0], None if drive is None else drive[:, 0], c, d, start)
        return recursions.predict(found, c, d, horizon)[:, None]

    def forcing(self, u: Array) -> Array:
        """Return the right-hand side sum_c B_c(q) f_c(u_c) + offset, (N, l), with nothing before the record."""
        right, f = np.tile(self.offset, (len(u), 1)), [f(one) for f, one in zip(self.nonlinearities, u.T)]
        for lag, c in np.argwhere(self.numerators[: len(u)].any(axis=1)):
            right[lag:] += f[c][: len(u) - lag, None] * self.numerators[lag, :, c]
        return right

    def _run(self, simulator: str, records: Sequence[Record], x0: Any) -> list[Array]:
        states = self._states(simulator, records, x0)
        self._warn_unstable()
        return [self._simulated(u, state, label) for (u, _, label), state in zip(records, states)]

    def _simulated(self, u: Array, state: Array, label: str = "") -> Array:
        """Compute the plant's outputs (N, l) from the inputs (N, m) and the state, whose last row may be a level.

        Raises:
            DataError: a missing input, or an output that leaves the range of numbers; named by channel and sample.
        """
        check_inputs(self, u, label)
        n, right = self.largest_lag, self.forcing(u)
        right[:n] += state[: min(n, len(right))]
        right += state[n:].sum(axis=0)
        y = autoregression(self.matrices, right)
        lost = ~np.isfinite(y).all(axis=1)
        if lost.any():
            k = int(np.argmax(lost))
            name = self.outputs[int(np.argmin(np.isfinite(y[k])))]
            raise DataError(
                f"{label}The simulated output {name!r} leaves the range of numbers at sample {k}: the largest pole has "
                f"radius {self.radius:.6g}. Identify the model with a stability constraint, or simulate fewer samples.")
        return y

    # -- text and content of files -------------------------------------------------------------------------------

    def __str__(self) -> str:
        """Return the equations, the poles and the noise model."""
        lines = super().__str__()
        for name, values in (("zeros", self.c), ("poles", self.d)):
            if values is not None and values.size:
                lines += f"\n{name} of the noise: {roots.in_words(roots.largest_first(roots.roots_of(values)))}"
        return lines

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], functions: dict[str, Any] | None = None) -> Self:
        """Build the model that `to_dict` described, also one whose file holds the plant apart or no noise model."""
        if content["kind"] == "HammersteinARX":
            content = {**content, "c": (), "d": None}
        elif "plant" in content:
            content = {**content["plant"], "c": content["c"], "d": content["d"]}
        return super().from_dict(content, functions)
