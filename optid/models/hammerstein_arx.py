"""The Hammerstein-ARX model: A(q) y = sum_c B_c(q) f_c(u_c) + d + e, one or several inputs and outputs."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.data.channels import Transform, numbered_names
from optid.data.record import Data
from optid.errors import StructureError
from optid.models import responses, roots, simulation
from optid.models.coefficients import check_shapes, checked_horizon, coefficients, listed
from optid.models.experiments import in_units_of, one_or_all, records_of, samples_of
from optid.models.gauges import in_raw_units, regauged
from optid.models.nonlinearity import Nonlinearity

if TYPE_CHECKING:
    from optid.models.layout import Layout

__all__ = ["HammersteinARX", "Nonlinearity"]

TINY_SUM = 1e-6
"""Share of |b| below which sum b counts as zero: the offset of f then has no effect that could be measured."""


@dataclass(frozen=True, eq=False)
class HammersteinARX:
    """y(k) + sum_i A_i y(k-i) = sum_c sum_j b_c[j] f_c(u_c(k - nk_c - j)) + offset + e(k), in raw units.

    With the basis `Linear` this is a linear ARX model.

    Attributes:
        a: (na,) for one output, (na, l, l) for several.
        b: one array per input, (nb_c,) for one output, (nb_c, l) for several.
        nonlinearities: one per input, their offsets None: the constants together are `offset`. See `f`.
        nk: delay in samples, one per input.
        offset: (l,) constant of the equation.
        dt: sampling time.
        inputs: names of the m inputs.
        outputs: names of the l outputs.
        input_units: one per input, "" where unknown.
        output_units: one per output, "" where unknown.
        gauge: how the scale between f and B is fixed: "norm", "gain", "b0" or "none"; see `regauge`.

    Raises:
        StructureError: shapes that do not agree, coefficients that are not finite, an unknown gauge.
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
    gauge: str = field(default="none", kw_only=True)

    def __post_init__(self) -> None:
        fixed = {
            "a": coefficients(self.a, "a"),
            "b": tuple(coefficients(b, f"b[{c}]") for c, b in enumerate(self.b)),
            "nonlinearities": tuple(self.nonlinearities),
            "nk": tuple(int(delay) for delay in self.nk),
            "offset": np.atleast_1d(coefficients(self.offset, "offset")),
            "dt": float(self.dt),
            "inputs": tuple(self.inputs) or numbered_names("u", len(self.b)),
        }
        fixed["outputs"] = tuple(self.outputs) or numbered_names("y", fixed["offset"].size)
        fixed["input_units"] = tuple(self.input_units) or ("",) * len(fixed["inputs"])
        fixed["output_units"] = tuple(self.output_units) or ("",) * len(fixed["outputs"])
        for name, value in fixed.items():
            object.__setattr__(self, name, value)
        check_shapes(self)

    # -- sizes ---------------------------------------------------------------------------------------------------

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.b)

    @property
    def l(self) -> int:  # noqa: E743 - the field's letter
        """Number of outputs."""
        return self.offset.size

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
        """The orders na, nb and nk; nb and nk have one entry per input."""
        return {"na": self.na, "nb": self.nb, "nk": self.nk}

    @property
    def memory(self) -> int:
        """Largest lag n: the first n samples of a record cannot be predicted, and the state is (n, l)."""
        return max(self.na, *(delay + nb - 1 for delay, nb in zip(self.nk, self.nb)))

    @property
    def layout(self) -> "Layout":
        """Columns of the regression this model solves."""
        from optid.models.layout import Layout

        bases = tuple(f.basis for f in self.nonlinearities)
        return Layout(self.na, self.nb, self.nk, bases, self.outputs, self.inputs)

    # -- what it says --------------------------------------------------------------------------------------------

    @property
    def kind(self) -> str:
        """The word for this class in model files."""
        return "HammersteinARX"

    @property
    def title(self) -> str:
        """What kind of model this is, in words."""
        return f"{'Linear' if all(map(_is_linear, self.nonlinearities)) else 'Hammerstein'} ARX model"

    def coefficients(self) -> list[tuple[str, float]]:
        """Return (name, value) of every coefficient of A, B and the offset, as tables show them."""
        return listed(self)

    @property
    def f(self) -> Nonlinearity | tuple[Nonlinearity, ...]:
        """The nonlinearity, with its offset where `c0` knows it; a tuple when there are several inputs."""
        if self.m > 1:
            return self.nonlinearities
        return replace(self.nonlinearities[0], offset=self.c0)

    @property
    def c0(self) -> float | None:
        """Offset of f, d / sum b; None where the data cannot tell it from the constant: see `offset_note`."""
        return None if self.offset_note else self._ratio[0]

    @property
    def offset_note(self) -> str:
        """Why the offset of f is not identifiable; "" when it is."""
        if self.m > 1:
            return "With several inputs one constant cannot be shared out among the nonlinearities."
        if _is_linear(self.nonlinearities[0]):
            return "A linear channel has no offset of its own."
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
            companion[: self.l] = -np.hstack(list(simulation.matrices_of(self)))
        return roots.largest_first(np.linalg.eigvals(companion).astype(complex))

    @property
    def is_stable(self) -> bool:
        """Whether all poles lie inside the unit circle."""
        return bool(np.all(np.abs(self.poles) < 1))

    def static_gain(self, u0: ArrayLike) -> Any:
        """Return the slope of the steady-state characteristic at u0, A(1)^-1 sum_j b_j f'(u0).

        Args:
            u0: operating point, a number or (m,).

        Returns:
            A number for one input and output, otherwise (l, m).

        Raises:
            StructureError: u0 of the wrong size, or an integrator (a pole at 1), which has no static gain.
        """
        return responses.static_gain(self, u0)

    def impulse_response(self, n: int = 100) -> Array:
        """Return the response of the linear part to a unit impulse of f_c, (n, l, m), in the gauge of the model."""
        return responses.impulse_response(self, n)

    def step_response(self, n: int = 100) -> Array:
        """Return the response of the linear part to a unit step of f_c, (n, l, m), in the gauge of the model."""
        return np.cumsum(responses.impulse_response(self, n), axis=0)

    def frequency_response(self, w: ArrayLike) -> Array:
        """Return A^-1 B_c at the frequencies w (radians per unit of time, up to pi / dt), complex (len(w), l, m)."""
        return responses.frequency_response(self, w)

    def equation(self, digits: int = 4) -> str:
        """Write the model as one difference equation per output.

        f is `f`: where its offset is identifiable the constant is inside f, otherwise it stands at the end.
        """
        from optid.models.equations import written

        return written(self, digits)

    def __str__(self) -> str:
        """Return the equations and the poles."""
        return self.equation() + (f"\npoles: {roots.in_words(self.poles)}" if len(self.poles) else "")

    # -- prediction and simulation -------------------------------------------------------------------------------

    def predict(self, data: Data, horizon: int = 1) -> Any:
        """Predict one or several steps ahead.

        Args:
            data: the record; detrended or scaled data are taken back to raw units first.
            horizon: how many samples ahead: the outputs are known up to so many samples before, the inputs always.

        Returns:
            (N, l) in raw units, NaN in the first `memory` + horizon - 1 samples and where a sample needed is missing; a
            tuple of such arrays for several experiments.

        Raises:
            DataError: other channels or another sampling time than the model's.
            StructureError: a horizon that is not a whole number from 1.
        """
        horizon = checked_horizon(horizon)
        data = in_units_of(self, data)
        return one_or_all([simulation.predict_record(self, e.u, e.y, horizon) for e in data.experiments])

    def simulate(self, data: Any, x0: Any = "zero") -> Any:
        """Compute the outputs from the inputs alone.

        Args:
            data: Data, or inputs (N,) or (N, m), or a list of such arrays, in raw units.
            x0: "zero" (nothing before the record), "fit" (least squares on the outputs present; needs Data), or the
                state (n, l) as `state` gives it, one for each experiment.

        Returns:
            (N, l) in raw units, or (N,) for u given as (N,) and one output; a tuple of such arrays for several
            experiments.

        Raises:
            DataError: a missing input, other channels or sampling time, or an output that leaves the range of numbers.
            StructureError: an x0 that cannot be read.

        Warns:
            DataWarning: the model is unstable.
        """
        records, flat = records_of(self, data)
        states = self._states(data, records, x0)
        simulation.warn_unstable(self)
        outputs = [simulation.simulate_record(self, u, x, label) for (u, _, label), x in zip(records, states)]
        return one_or_all([y[:, 0] for y in outputs] if flat and self.l == 1 else outputs)

    def initial_state(self, data: Data) -> Any:
        """Estimate the state (n, l) at the first sample by least squares; a tuple for several experiments.

        Raises:
            DataError: as `simulate`.
        """
        records, _ = records_of(self, data)
        return one_or_all(self._states(data, records, "fit"))

    def state(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Return the state (n, l) that follows the samples u (N, m) and y (N, l), N >= n.

        Row i is what these samples add to the right-hand side of the equation i samples ahead.

        Raises:
            DataError: too few samples, or one of the last n missing.
        """
        return simulation.following_state(self, samples_of(u, "u", self.m), samples_of(y, "y", self.l))

    def _states(self, data: Any, records: Sequence[Any], x0: Any) -> list[Array]:
        if isinstance(x0, str):
            if x0 == "zero":
                return [np.zeros((self.memory, self.l))] * len(records)
            if x0 != "fit":
                raise StructureError(f"x0={x0!r}: use 'zero', 'fit' or an array ({self.memory}, {self.l}).")
            if not isinstance(data, Data):
                raise StructureError("x0='fit' needs the outputs: pass Data, or x0='zero' or a state.")
            return [simulation.fitted_state(self, u, y, label) for u, y, label in records]
        states = list(x0) if len(records) > 1 else [x0]
        if len(states) != len(records):
            raise StructureError(f"{len(states)} initial states for {len(records)} experiments: give one each.")
        return [simulation.state_like(self, state) for state in states]

    # -- changes -------------------------------------------------------------------------------------------------

    def regauge(self, gauge: str) -> "HammersteinARX":
        """Fix the scale between f and B of every input; predictions do not change.

        Args:
            gauge: "norm" (norm of b one, first non-zero coefficient positive), "gain" (sum b = 1 + sum a: unit static
                gain of the linear part; one output), "b0" (first coefficient of b one), "none" (as it is; linear
                channels get f(u) = u).

        Raises:
            StructureError: unknown gauge, or one that this model cannot take.
        """
        return regauged(self, gauge)

    def with_transform(self, transform: Transform) -> "HammersteinARX":
        """Return the model in raw units, given that this one was identified on data changed by `transform`.

        Every basis but UserFunctions follows a change of units exactly, so the predictions are the same.

        Raises:
            StructureError: a basis of UserFunctions, or other numbers of channels.
        """
        return in_raw_units(self, transform)

    # -- leaving -------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> Path:
        """Write the model to a JSON file, from which `optid.load` restores it exactly."""
        from optid.models.files import save

        return save(self, path)

    def to_dict(self) -> dict[str, Any]:
        """Describe the model in JSON types."""
        return {
            "kind": self.kind,
            "a": self.a.tolist(),
            "b": [b.tolist() for b in self.b],
            "nonlinearities": [f.to_dict() for f in self.nonlinearities],
            "nk": list(self.nk),
            "offset": self.offset.tolist(),
            "dt": self.dt,
            "inputs": list(self.inputs),
            "outputs": list(self.outputs),
            "input_units": list(self.input_units),
            "output_units": list(self.output_units),
            "gauge": self.gauge,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any], functions: dict[str, Any] | None = None) -> "HammersteinARX":
        """Build the model that `to_dict` described; the errors are those of the parts.

        Args:
            content: what `to_dict` returned.
            functions: those of a basis of UserFunctions, by name.
        """
        outputs = len(content["outputs"])
        a = np.array(content["a"], dtype=float)
        return cls(
            a=a if a.size or outputs == 1 else a.reshape(0, outputs, outputs),
            b=tuple(np.array(b, dtype=float) for b in content["b"]),
            nonlinearities=tuple(Nonlinearity.from_dict(f, functions) for f in content["nonlinearities"]),
            offset=np.array(content["offset"], dtype=float),
            dt=content["dt"],
            gauge=content["gauge"],
            **{
                name: tuple(content[name]) for name in ("nk", "inputs", "outputs", "input_units", "output_units")
            },
        )

    def to_dlti(self, output: int | str = 0, input: int | str = 0) -> Any:
        """Return the linear part from one f to one output as a `scipy.signal.dlti`."""
        from optid.models.export import to_dlti

        return to_dlti(self, output, input)

    def to_control(self) -> Any:
        """Return the linear part, all inputs and outputs, as a python-control system."""
        from optid.models.export import to_control

        return to_control(self)

    def to_casadi(self) -> Any:
        """Return (x, u) -> (x_next, y) as a `casadi.Function`; see `optid.export.to_casadi`."""
        from optid.models.export import to_casadi

        return to_casadi(self)


def _is_linear(nonlinearity: Nonlinearity) -> bool:
    from optid.bases.expansions import Linear

    return isinstance(nonlinearity.basis, Linear)
