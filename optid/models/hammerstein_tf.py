"""Transfer-function Hammerstein models: y = A(q)^-1 [sum_c B_c(q) f_c(u_c) + d] + C(q)/D(q) e, one output."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases.expansions import Linear
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import StructureError
from optid.models import noise_filter, roots
from optid.models.coefficients import checked_horizon, coefficients, listed
from optid.models.equations import polynomial, written_with_noise
from optid.models.experiments import in_units_of, one_or_all
from optid.models.hammerstein_arx import HammersteinARX
from optid.models.noise_prediction import predict_record
from optid.models.nonlinearity import Nonlinearity

TITLES = {"oe": "output-error", "arx": "ARX", "armax": "ARMAX", "bj": "Box-Jenkins"}


@dataclass(frozen=True, eq=False)
class HammersteinTF:
    """A plant without noise and a noise filter: ``y = x + (C/D) e`` with ``A x = sum_c B_c f_c(u_c) + offset``.

    Four noise models are one class: output error (C = D = 1), ARX (C = 1, D = A), ARMAX (D = A) and Box-Jenkins. With
    the basis `Linear` the model is a linear one.

    Attributes:
        plant: A, B, the nonlinearities, the offset and the names; one output.
        c: (nc,) coefficients of C = 1 + c_1 q^-1 + ...
        d: (nd,) coefficients of D = 1 + d_1 q^-1 + ...; ``plant.a`` for ARX and ARMAX.

    Raises:
        StructureError: several outputs, coefficients that are not finite, or a C that is not invertible (a zero on or
            outside the unit circle): no predictor belongs to it.
    """

    plant: HammersteinARX
    c: Array = ()  # type: ignore[assignment]
    d: Array = ()  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.plant.l != 1:
            raise StructureError(f"A transfer-function model has one output; this plant has {self.plant.l}.")
        for name in ("c", "d"):
            values = coefficients(getattr(self, name), name)
            if values.ndim != 1:
                raise StructureError(f"{name} has shape {values.shape}; (n{name},) is needed.")
            object.__setattr__(self, name, values)
        largest = roots.radius(self.c)
        if largest >= 1:
            raise StructureError(
                f"C is not invertible: it has a zero of modulus {largest:.6g}. Reflect it into the unit circle "
                "(optid.models.roots.reflected): the spectrum of the noise stays what it is."
            )

    # -- what it is ----------------------------------------------------------------------------------------------

    @property
    def kind(self) -> str:
        """The word for this class in model files."""
        return "HammersteinTF"

    @cached_property
    def structure(self) -> str:
        """Which of the four it is: "oe", "arx", "armax" or "bj"."""
        if self.d.size and np.array_equal(self.d, self.plant.a):
            return "armax" if self.c.size else "arx"
        return "bj" if self.c.size or self.d.size else "oe"

    @property
    def title(self) -> str:
        """What kind of model this is, in words."""
        linear = all(isinstance(f.basis, Linear) for f in self.nonlinearities)
        return f"{'Linear' if linear else 'Hammerstein'} {TITLES[self.structure]} model"

    @property
    def m(self) -> int:
        """Number of inputs."""
        return self.plant.m

    @property
    def l(self) -> int:  # noqa: E743 - the field's letter
        """Number of outputs, one."""
        return 1

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.plant.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Name of the output."""
        return self.plant.outputs

    @property
    def input_units(self) -> tuple[str, ...]:
        """Units of the inputs, "" where unknown."""
        return self.plant.input_units

    @property
    def output_units(self) -> tuple[str, ...]:
        """Unit of the output, "" where unknown."""
        return self.plant.output_units

    @property
    def dt(self) -> float:
        """Sampling time."""
        return self.plant.dt

    @property
    def nonlinearities(self) -> tuple[Nonlinearity, ...]:
        """One per input; the constants together are ``offset``."""
        return self.plant.nonlinearities

    @property
    def f(self) -> Any:
        """The nonlinearity, see `HammersteinARX.f`."""
        return self.plant.f

    @property
    def c0(self) -> float | None:
        """Offset of f, see `HammersteinARX.c0`."""
        return self.plant.c0

    @property
    def offset_note(self) -> str:
        """Why the offset of f is not identifiable; "" when it is."""
        return self.plant.offset_note

    @property
    def a(self) -> Array:
        """(na,) coefficients of A."""
        return self.plant.a

    @property
    def b(self) -> tuple[Array, ...]:
        """One (nb,) per input."""
        return self.plant.b

    @property
    def nk(self) -> tuple[int, ...]:
        """Delays in samples, one per input."""
        return self.plant.nk

    @property
    def offset(self) -> Array:
        """(1,) constant of the plant's equation."""
        return self.plant.offset

    @property
    def gauge(self) -> str:
        """How the scale between f and B is fixed."""
        return self.plant.gauge

    @property
    def orders(self) -> dict[str, Any]:
        """The orders na, nb, nk and, as far as the noise model has them, nc and nd."""
        noise = {"armax": {"nc": self.c.size}, "bj": {"nc": self.c.size, "nd": self.d.size}}
        return self.plant.orders | noise.get(self.structure, {})

    @property
    def memory(self) -> int:
        """Samples at the start of a record that cannot be predicted.

        None for output error and Box-Jenkins, whose initial state is estimated; the largest lag for ARX and ARMAX.
        """
        return self.plant.memory if self.shares_poles else 0

    @property
    def poles(self) -> Any:
        """Poles of the plant, complex, largest first."""
        return self.plant.poles

    @property
    def is_stable(self) -> bool:
        """Whether all poles of the plant lie inside the unit circle."""
        return self.plant.is_stable

    @cached_property
    def noise_poles(self) -> Any:
        """Roots of D, complex (nd,), largest first."""
        return roots.largest_first(roots.roots_of(self.d))

    @cached_property
    def noise_zeros(self) -> Any:
        """Roots of C, complex (nc,), largest first; all inside the unit circle."""
        return roots.largest_first(roots.roots_of(self.c))

    @property
    def noise(self) -> str:
        """The noise model in words and numbers."""
        c, d = polynomial(self.c), polynomial(self.d)
        return {
            "oe": "e is added to the output: C = D = 1",
            "arx": "e is added to the equation: C = 1, D = A",
            "armax": f"C = {c}, D = A",
            "bj": f"C = {c}, D = {d}",
        }[self.structure]

    @property
    def na(self) -> int:
        """Number of poles of the plant."""
        return self.plant.na

    @property
    def nb(self) -> tuple[int, ...]:
        """Number of numerator coefficients, one per input."""
        return self.plant.nb

    def theta(self, c: int = 0) -> Array:
        """Return mu b^T of input c (P, nb), the same in every gauge."""
        return self.plant.theta(c)

    def coefficients(self) -> list[tuple[str, float]]:
        """Return (name, value) of every coefficient of A, B, the offset, C and (Box-Jenkins) D, as tables show them."""
        found = listed(self.plant)
        for name, values in (("c", self.c), ("d", () if self.shares_poles else self.d)):
            found += [(f"{name}{i}", float(value)) for i, value in enumerate(values, start=1)]
        return found

    def static_gain(self, u0: ArrayLike) -> Any:
        """Return the slope of the steady-state characteristic at u0, see `HammersteinARX.static_gain`."""
        return self.plant.static_gain(u0)

    def impulse_response(self, n: int = 100) -> Array:
        """Return the response of the plant's linear part to a unit impulse of f_c, (n, 1, m)."""
        return self.plant.impulse_response(n)

    def step_response(self, n: int = 100) -> Array:
        """Return the response of the plant's linear part to a unit step of f_c, (n, 1, m)."""
        return self.plant.step_response(n)

    def frequency_response(self, w: ArrayLike) -> Array:
        """Return A^-1 B_c at the frequencies w (radians per unit of time), complex (len(w), 1, m)."""
        return self.plant.frequency_response(w)

    def noise_impulse_response(self, n: int = 100) -> Array:
        """Return the response of C/D to a unit impulse of e, (n,)."""
        return noise_filter.impulse_response(self.c, self.d, n)

    def noise_frequency_response(self, w: ArrayLike) -> Array:
        """Return C/D at the frequencies w (radians per unit of time), complex (len(w),)."""
        shift = np.exp(-1j * np.atleast_1d(np.asarray(w, dtype=float)) * self.dt)
        above, below = (np.polyval([*reversed(p), 1.0], shift) for p in (self.c, self.d))
        return above / below

    def equation(self, digits: int = 4) -> str:
        """Write the model as difference equations: of the plant and, where it is apart, of the noise."""
        return written_with_noise(self, digits)

    def __str__(self) -> str:
        """Return the equations, the poles and the noise model."""
        text = self.equation()
        parts = {"poles": self.poles, "zeros of the noise": self.noise_zeros}
        if not self.shares_poles:
            parts["poles of the noise"] = self.noise_poles
        for name, found in parts.items():
            if found.size:
                text += f"\n{name}: {roots.in_words(found)}"
        return text

    @property
    def shares_poles(self) -> bool:
        """Whether D is A: the noise enters the equation of the plant (ARX, ARMAX)."""
        return self.structure in ("arx", "armax")

    # -- prediction and simulation -------------------------------------------------------------------------------

    def predict(self, data: Data, horizon: int = 1, x0: Any = "fit") -> Any:
        """Predict one or several steps ahead.

        Args:
            data: the record; detrended or scaled data are taken back to raw units first.
            horizon: how many samples ahead: the outputs are known up to so many samples before, the inputs always.
            x0: initial state of the plant for output-error and Box-Jenkins models: "fit" (least squares of the
                one-step prediction errors), "zero", or the state, one for each experiment. ARX and ARMAX models
                need none.

        Returns:
            (N, 1) in raw units; a tuple of such arrays for several experiments. A missing output counts as an
            innovation of zero. NaN where a missing input leaves no prediction: in the samples that it reaches (ARX,
            ARMAX), or in it (the others, whose state is estimated anew after the gap; also in stretches between gaps
            too short for that). ARX and ARMAX: NaN in the first `memory` + horizon - 1 samples, and on until so many
            outputs follow one another without a gap (ten times `memory` samples where they never do).

        Raises:
            DataError: other channels or another sampling time than the model's.
            StructureError: a horizon that is not a whole number from 1, or an x0 that cannot be read.
        """
        horizon = checked_horizon(horizon)
        raw = in_units_of(self, data)
        states = _states(x0, raw.n_experiments)
        return one_or_all([
            predict_record(self, e.u, e.y, horizon, state, f"Experiment {i}: " * (raw.n_experiments > 1))
            for i, (e, state) in enumerate(zip(raw.experiments, states), start=1)
        ])

    def innovations(self, data: Data, x0: Any = "fit") -> Any:
        """Return the one-step prediction errors (N, 1), NaN where there is none; a tuple for several experiments.

        Args:
            data: as `predict`.
            x0: as `predict`.
        """
        raw, predicted = in_units_of(self, data), self.predict(data, 1, x0)
        several = predicted if raw.n_experiments > 1 else (predicted,)
        return one_or_all([e.y - p for e, p in zip(raw.experiments, several)])

    def simulate(self, data: Any, x0: Any = "zero") -> Any:
        """Compute the noise-free outputs from the inputs alone, see `HammersteinARX.simulate`."""
        return self.plant.simulate(data, x0)

    def initial_state(self, data: Data) -> Any:
        """Estimate the state of the plant at the first sample from the simulation errors by least squares."""
        return self.plant.initial_state(data)

    def state(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Return the state of the plant after samples without noise, see `HammersteinARX.state`."""
        return self.plant.state(u, y)

    # -- changes -------------------------------------------------------------------------------------------------

    def regauge(self, gauge: str) -> "HammersteinTF":
        """Fix the scale between f and B of every input, see `HammersteinARX.regauge`; predictions do not change."""
        return replace(self, plant=self.plant.regauge(gauge))

    def with_transform(self, transform: Transform) -> "HammersteinTF":
        """Return the model in raw units; A, C and D have no units, see `HammersteinARX.with_transform`."""
        return replace(self, plant=self.plant.with_transform(transform))

    # -- leaving -------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> Path:
        """Write the model to a JSON file, from which `optid.load` restores it exactly."""
        from optid.models.files import save

        return save(self, path)

    def to_dict(self) -> dict[str, Any]:
        """Describe the model in JSON types."""
        return {"kind": self.kind, "plant": self.plant.to_dict(), "c": self.c.tolist(), "d": self.d.tolist()}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], functions: dict[str, Any] | None = None) -> "HammersteinTF":
        """Build the model that `to_dict` described; the errors are those of the parts.

        Args:
            content: what `to_dict` returned.
            functions: those of a basis of UserFunctions, by name.
        """
        plant = HammersteinARX.from_dict(content["plant"], functions)
        return cls(plant, np.array(content["c"], dtype=float), np.array(content["d"], dtype=float))

    def to_dlti(self, output: int | str = 0, input: int | str = 0) -> Any:
        """Return the linear part of the plant from one f to the output as a `scipy.signal.dlti`."""
        return self.plant.to_dlti(output, input)

    def to_control(self) -> Any:
        """Return the linear part of the plant, all inputs, as a python-control system."""
        return self.plant.to_control()

    def to_casadi(self) -> Any:
        """Return the plant, without noise, as a `casadi.Function` (x, u) -> (x_next, y)."""
        return self.plant.to_casadi()


def _states(x0: Any, count: int) -> Sequence[Any]:
    if isinstance(x0, str):
        if x0 not in ("fit", "zero"):
            raise StructureError(f"x0={x0!r}: use 'fit', 'zero' or a state for each experiment.")
        return [x0] * count
    states = list(x0) if count > 1 else [x0]
    if len(states) != count:
        raise StructureError(f"{len(states)} initial states for {count} experiments: give one each.")
    return states
