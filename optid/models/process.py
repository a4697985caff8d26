"""Process models: gain, time constants and dead time in continuous time, behind static curves; run over records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from optid.arrays import Array, finite
from optid.data.channels import Transform
from optid.errors import DataError, StructureError
from optid.models.continuous import ContinuousModel
from optid.models.experiments import Record, check_inputs, scaled_least_squares
from optid.models.model import Model
from optid.models.nonlinearity import Nonlinearity
from optid.models.process_dynamics import ProcessDynamics, ProcessStructure, thin_out

HOLDS = ("zero", "first")


def _of_samples(name: str) -> Any:
    """Return a method that exports the model in state equations of the same samples."""
    def export(self: "ProcessModel", *arguments: Any, **options: Any) -> Any:
        return getattr(self.to_continuous().to_discrete(self.dt), name)(*arguments, **options)

    export.__doc__ = f"Export as `Model.{name}` does the model with the same samples; errors as of `to_continuous`."
    return export


@dataclass(frozen=True, eq=False, repr=False)
class ProcessModel(Model):
    """y(t) = sum_c G_c(s) exp(-theta_c s) f_c(u_c(t)) + level + drift t, in raw units.

    A run begins at rest under the first inputs; a process with an integrator stands still there. An initial state is
    the deviation from rest of the sections of all inputs, the motion of which is not delayed.

    Attributes:
        processes: dynamics of every input, of static gain one; times in the unit of dt.
        level: (1,) output at rest where every f is zero; with integrators, output at the start.
        drift: slope of the level over time.
        hold: what an input does between its samples, "zero" (stays) or "first" (straight lines).
        nonlinearities, dt, time_unit, inputs, outputs, input_units, output_units, gauge, levels: see `Model`.
    """

    processes: tuple[ProcessDynamics, ...]
    nonlinearities: tuple[Nonlinearity, ...]
    level: Array
    drift: float = 0.0
    hold: str = "zero"
    dt: float = 1.0
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    gauge: str = "none"
    time_unit: str = ""
    levels: Array | None = None
    GAUGES: ClassVar[tuple[str, ...]] = ("none",)
    SIMULATORS: ClassVar[tuple[str, ...]] = ("free", "predict")
    structure: ClassVar[str] = "process"  # pyright: ignore[reportIncompatibleVariableOverride]
    memory: ClassVar[int] = 0  # pyright: ignore[reportIncompatibleVariableOverride]
    offset_note: ClassVar[str] = "the constant of f is part of the level"

    def __post_init__(self) -> None:
        if len(self.processes) != len(self.nonlinearities) or not self.processes:
            raise StructureError(f"{len(self.processes)} processes for {len(self.nonlinearities)} static curves")
        if self.hold not in HOLDS:
            raise StructureError(f"hold={self.hold!r} must be one of {', '.join(map(repr, HOLDS))}")
        level = np.atleast_1d(finite(self.level, "level"))
        given = {"nonlinearities": self.nonlinearities, "processes": tuple(one.sort() for one in self.processes),
                 "level": level, "drift": float(self.drift)}
        self._fix(given, len(self.processes), 1)

    @property
    def c0(self) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """No offset of f: it is part of the level."""
        return None

    @property
    def title(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What kind of model this is."""
        family = "Process model" if all(f.is_linear for f in self.nonlinearities) else "Hammerstein process model"
        return f"{family} in continuous time"

    @property
    def orders(self) -> dict[str, Any]:
        """Types of the processes, for tables."""
        return {"process" + ("" if self.m == 1 else f" {name}"): one.structure.word
                for name, one in zip(self.inputs, self.processes)}

    @property
    def poles(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Poles of the model sampled every dt, exp(s dt), largest first."""
        found = np.exp(np.concatenate([one.poles for one in self.processes]) * self.dt)
        return found[np.argsort(-np.abs(found), kind="stable")]

    @property
    def dead_times(self) -> Array:
        """Dead time (m,) of every input, in the unit of dt."""
        return np.array([one.dead_time for one in self.processes])

    def _of(self, name: str, c: int) -> str:
        return name if self.m == 1 else f"{name}[{self.inputs[c]}]"

    def coefficients(self) -> list[tuple[str, float]]:
        """Return gain, time constants and dead time of every input, the level, and the drift where there is one."""
        found = []
        for c, (one, f) in enumerate(zip(self.processes, self.nonlinearities)):
            if f.is_linear:
                found.append((self._of("K", c), float(f.mu[0])))
            found += [(self._of(name, c), float(value)) for name, value in zip(one.structure.names, one.p)]
        return found + [("level", float(self.level[0]))] + [("drift", self.drift)] * (self.drift != 0)

    def coefficient_units(self) -> dict[str, str]:
        """Return the units of the coefficients by name, "" where unknown."""
        time = self.time_unit or ("samples" if self.dt == 1 else "")
        y = self.output_units[0]
        found = {"level": y, "drift": f"{y or 1}/{time}" if time else y}
        for c, one in enumerate(self.processes):
            below = " ".join(part for part in (self.input_units[c], time * one.structure.integrator) if part)
            found[self._of("K", c)] = f"{y or 1}/{f'({below})' if ' ' in below else below}" if below else y
            found |= {self._of(name, c): time * bool(timed)
                      for name, timed in zip(one.structure.names, one.structure.temporal)}
        return found

    def equation(self) -> str:
        """Return the equation as text."""
        terms = []
        for one, f, name in zip(self.processes, self.nonlinearities, self.inputs):
            gain = f"{f.mu[0]:.4g} {name}" if f.is_linear else f"f{'' if self.m == 1 else f'_{name}'}({name})"
            terms.append(f"{one.equation()} {gain}")
        rest = [(self.level[0], ""), *([(self.drift, " t")] if self.drift else [])]
        beside = "".join(f" {'-' if size < 0 else '+'} {abs(size):.4g}{of}" for size, of in rest)
        return f"{self.outputs[0]} = {' + '.join(terms)}{beside}"

    # -- responses -----------------------------------------------------------------------------------------------------

    def impulse_response(self, n: int = 100) -> Array:
        """Return the response of the linear part to a unit held for one sampling time, (n, 1, m)."""
        t, pulse = np.arange(float(n)), np.array([[0.0], [1.0], [0.0]])
        return np.stack([one.in_unit(self.dt).response(t, np.array([-1.0, 0.0, 1.0]), pulse)[:, :, 0]
                         for one in self.processes], axis=2)

    def frequency_response(self, w: ArrayLike) -> Any:
        """Return that of the linear part at w (radians per unit of time), with dead time, complex (len(w), 1, m)."""
        s = 1j * np.atleast_1d(np.asarray(w, dtype=float))
        return np.stack([one.transfer(s) for one in self.processes], axis=1)[:, None]

    def static_curve(self, c: int, u: Array) -> Array:
        """Return the static characteristic (k, 1) of an input at (k,) values, without the level."""
        self._refuse_integrator()
        return self.nonlinearities[c](np.asarray(u, dtype=float))[:, None]

    def _static_gain(self, u0: Array) -> Array:
        self._refuse_integrator()
        return np.array([[float(f.slope(point)) for f, point in zip(self.nonlinearities, u0)]])

    def _refuse_integrator(self) -> None:
        if any(one.structure.integrator for one in self.processes):
            raise StructureError("The model has a pole at 1 (an integrator): it has no static gain.")

    # -- running over records ------------------------------------------------------------------------------------------

    @property
    def n_sections(self) -> int:
        """Number of sections of all inputs."""
        return sum(one.structure.order for one in self.processes)

    @property
    def _state_shape(self) -> tuple[int]:
        return (self.n_sections + (self.levels is not None),)

    @cached_property
    def _scaled(self) -> tuple[ProcessDynamics, ...]:
        return tuple(one.in_unit(self.dt) for one in self.processes)

    def respond(self, u: Array, instants: Array | None = None, read_at: Array | None = None) -> Array:
        """Return the output (N,) to inputs (J, m) from rest, at any instants.

        Args:
            u: inputs, none missing.
            instants: (J,) times of the inputs, increasing; multiples of dt by default.
            read_at: (N,) times of the outputs, not decreasing; those of the inputs by default.
        """
        t = np.arange(float(len(u))) if instants is None else np.asarray(instants, dtype=float) / self.dt
        at = t if read_at is None else np.asarray(read_at, dtype=float) / self.dt
        found = self.level[0] + self.drift * self.dt * (at - t[0])
        for c, (one, f) in enumerate(zip(self._scaled, self.nonlinearities)):
            changes, values = thin_out(t, f(u[:, c])[:, None], self.hold == "first")
            found = found + one.response(at, changes, values - values[0], straight=self.hold == "first")[:, 0, 0]
            found = found if one.structure.integrator else found + values[0, 0]
        return found

    def _motion(self, count: int) -> Array:
        """Return the free motion (N, n) of every entry of a state."""
        t = np.arange(float(count))
        found = np.hstack([one.free_response(t, 0.0) for one in self._scaled])
        return found if self.levels is None else np.column_stack([found, np.ones(count)])

    def _run(self, simulator: str, records: Sequence[Record], x0: Any) -> list[Array]:
        found = []
        for (u, _, label), state in zip(records, self._states(simulator, records, x0)):
            check_inputs(self, u, label)
            found.append((self.respond(u) + self._motion(len(u)) @ state)[:, None])
        return found

    def _predicted(self, u: Array, y: Array, horizon: int, state: Array, label: str) -> Array:
        return self._run("free", [(u, y, label)], state)[0]  # without a noise model nothing else is known

    def _fitted(self, simulator: str, u: Array, y: Any, label: str) -> Array:
        check_inputs(self, u, label)
        rest, here = y[:, 0] - self.respond(u), np.isfinite(y[:, 0])
        if not here.any():
            raise DataError(f"{label}Output {self.outputs[0]!r} has no sample: no initial state can be estimated.")
        return scaled_least_squares(self._motion(len(u))[here], rest[here])

    # -- other tools ---------------------------------------------------------------------------------------------------

    def to_continuous(self) -> ContinuousModel:
        """Return the same as state equations in continuous time with dead times; of several levels the mean.

        Raises:
            StructureError: inputs that go straight between samples, a drift, an integrator.
        """
        for there, what in (
                (self.hold == "first", "Inputs that go straight between samples (hold='first')"),
                (self.drift != 0, "A drift, which is no answer to the inputs,"),
                (any(one.structure.integrator for one in self.processes),
                 "An integrator that stands still under the first inputs of every run, whichever they are,")):
            if there:
                raise StructureError(f"{what} cannot be stated in equations of a state and held inputs. Use "
                                     "model.simulate, or the parameters (model.coefficients())")
        A, b, c, d = zip(*(one.equations for one in self.processes))
        names = {name: getattr(self, name) for name in ("inputs", "outputs", "input_units", "output_units")}
        inner: Any = block_diag(*A)
        driven: Any = block_diag(*b)
        return ContinuousModel(inner, driven.T, np.concatenate(c)[None], np.array([d]), self.nonlinearities,
                               tuple(range(self.m)), self.dead_times, np.zeros(self.n_sections), self.level,
                               self.time_unit, **names)

    @property
    def zeros(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Zeros of the model with the same samples, as of `Model.zeros`; errors as of `to_continuous`."""
        return self.to_continuous().to_discrete(self.dt).zeros

    to_dlti, to_casadi, to_c, to_st, to_fmu = map(_of_samples, ("to_dlti", "to_casadi", "to_c", "to_st", "to_fmu"))

    def to_control(self, pade: int | None = None) -> Any:
        """Return the continuous transfer as a python-control system; a dead time requires `pade`."""
        return self.to_continuous().to_control(pade)

    # -- gauge, units, files -------------------------------------------------------------------------------------------

    def _regauged(self, gauge: str, signs: bool) -> Self:
        return self

    def _in_raw_units(self, transform: Transform) -> Self:
        size, level = transform.y_scale[0], transform.y_offset[0] + transform.y_scale[0] * self.level
        curves = []
        for one, f, scale, origin in zip(self.processes, self.nonlinearities, transform.u_scale, transform.u_offset):
            curve, constant = f.mapped(scale, origin)
            curves.append(curve.scaled(size))
            level = level + size * constant * (not one.structure.integrator)
        levels = None if self.levels is None else transform.y_offset[0] + size * self.levels
        return replace(self, nonlinearities=tuple(curves), level=level, drift=size * self.drift, levels=levels)

    def to_dict(self) -> dict[str, Any]:
        """Describe the model in JSON types."""
        return {**super().to_dict(), "processes": [one.to_dict() for one in self.processes]}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], functions: dict[str, Any] | None = None) -> Self:
        """Build what `to_dict` described."""
        processes = tuple(ProcessDynamics.from_dict(one) for one in content["processes"])
        return super().from_dict({**content, "processes": processes}, functions)


def process_model(process: str, *, K: float = 1.0, level: float = 0.0, dt: float = 1.0, **parameters: Any  # noqa: N803
                  ) -> ProcessModel:
    """Return a linear process model with one input from its parameters.

    Args:
        process: procest's name of its type, such as "P1D".
        K: gain, or with an integrator the slope of the output for a unit of the input.
        level: output at rest for an input of zero.
        dt: sampling time.
        parameters: `tau` (`tau1`, ...), `T`, `zeta`, `tau_zero`, `dead_time`, and further fields of `ProcessModel`.

    Raises:
        StructureError: an unknown type, a parameter that is missing or impossible.
    """
    from optid.bases import Linear

    structure = ProcessStructure.read(process)
    missing = [name for name in structure.names if name not in parameters]
    if missing:
        raise StructureError(f"{structure.word} needs {', '.join(structure.names)}; {', '.join(missing)} is missing")
    dynamics = ProcessDynamics(structure, np.array([parameters.pop(name) for name in structure.names], dtype=float))
    return ProcessModel((dynamics,), (Nonlinearity(Linear(), np.array([K])),), np.array([level]), dt=dt, **parameters)
