"""Process models: gain, time constants and dead time in continuous time, behind static curves; run over records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from optid.arrays import Array, finite, one_of, one_or_all
from optid.data.channels import Ports, Transform
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.models.continuous import ContinuousModel
from optid.models.equations import HOLDS
from optid.models.experiments import Record, check_inputs, in_units_of, scaled_least_squares
from optid.models.functions import static_functions
from optid.models.model import Model
from optid.models.nonlinearity import Nonlinearity
from optid.models.process_dynamics import ProcessDynamics, ProcessStructure
from optid.models.process_kernel import thin_out
from optid.models.text import signed_terms


def name_of_pair(name: str, pair: tuple[int, int], ports: Ports) -> str:
    """Name a quantity of a pair: plain with one input, ``name[input]`` with several, ``name[output,input]``."""
    output, channel = ports.outputs[pair[0]], ports.inputs[pair[1]]
    if ports.l > 1:
        return f"{name}[{output},{channel}]"
    return name if ports.m == 1 else f"{name}[{channel}]"


def _of_samples(name: str) -> Any:
    """Return a method that exports the model in state equations of the same samples."""
    def export(self: "ProcessModel", *arguments: Any, **options: Any) -> Any:
        return getattr(self.to_continuous().to_discrete(self.dt), name)(*arguments, **options)

    export.__doc__ = f"Export as `Model.{name}` does the model with the same samples; errors as of `to_continuous`."
    return export


@dataclass(frozen=True, eq=False, repr=False)
class ProcessModel(Model):
    """y(t) = sum_c G_c(s) exp(-theta_c s) f_c(u_c(t)) + level + drift t, of every output, in raw units.

    A run begins at rest under the first inputs; a process with an integrator stands still there. An initial state is
    the deviation from rest of the sections of all processes, the motion of which is not delayed.

    Attributes:
        processes: dynamics of every pair, of static gain one; times in the unit of dt.
        nonlinearities: static curve of every pair.
        level: (l,) outputs at rest where every f is zero; with integrators, outputs at the start.
        drift: (l,) slopes of the levels over time.
        hold: what an input does between its samples, "zero" (stays) or "first" (straight lines).
        pairs: (output, input) of every process, output by output; of one output all inputs when not given.
        dt, time_unit, inputs, outputs, input_units, output_units, gauge, levels: see `Model`.
    """

    processes: tuple[ProcessDynamics, ...]
    nonlinearities: tuple[Nonlinearity, ...]
    level: Array
    drift: Any = 0.0
    hold: str = "zero"
    pairs: tuple[tuple[int, int], ...] = ()
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
    c0: ClassVar[None] = None  # pyright: ignore[reportIncompatibleVariableOverride]
    offset_note: ClassVar[str] = "the constant of f is part of the level"

    def __post_init__(self) -> None:
        if len(self.processes) != len(self.nonlinearities) or not self.processes:
            raise StructureError(f"{len(self.processes)} processes for {len(self.nonlinearities)} static curves")
        one_of("hold", self.hold, HOLDS)
        level = np.atleast_1d(finite(self.level, "level"))
        drift = np.broadcast_to(finite(self.drift, "drift"), level.shape)
        pairs = tuple((int(o), int(c)) for o, c in self.pairs) or tuple((0, c) for c in range(len(self.processes)))
        m = len(self.inputs) or 1 + max(c for _, c in pairs)
        if len(pairs) != len(self.processes) or list(pairs) != sorted(set(pairs)) or not all(
                0 <= o < level.size and 0 <= c < m for o, c in pairs):
            raise StructureError(f"pairs={pairs}: (output, input) of each of {len(self.processes)} processes, in "
                                 f"order, of {level.size} outputs and {m} inputs")
        given = {"nonlinearities": self.nonlinearities, "processes": tuple(one.sort() for one in self.processes),
                 "level": level, "drift": drift, "pairs": pairs}
        self._fix(given, m, level.size)

    @property
    def input_of(self) -> tuple[int, ...]:
        """The input that every function acts on."""
        return tuple(c for _, c in self.pairs)

    @property
    def title(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What kind of model this is."""
        family = "Process model" if all(f.is_linear for f in self.nonlinearities) else "Hammerstein process model"
        return f"{family} in continuous time"

    @property
    def orders(self) -> dict[str, Any]:
        """Types of the processes, for tables."""
        if self.l > 1:
            return {f"process {self.outputs[o]},{self.inputs[c]}": one.structure.word
                    for (o, c), one in zip(self.pairs, self.processes)}
        return {"process" + ("" if self.m == 1 else f" {self.inputs[c]}"): one.structure.word
                for (_, c), one in zip(self.pairs, self.processes)}

    @property
    def poles(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Poles of the model sampled every dt, exp(s dt), largest first."""
        found = np.exp(np.concatenate([one.poles for one in self.processes]) * self.dt)
        return found[np.argsort(-np.abs(found), kind="stable")]

    @property
    def dead_times(self) -> Array:
        """Dead time (r,) of every pair, in the unit of dt."""
        return np.array([one.dead_time for one in self.processes])

    def of_pair(self, name: str, number: int) -> str:
        """Name a quantity of a pair; see `name_of_pair`."""
        return name_of_pair(name, self.pairs[number], self)

    def _of_output(self, name: str, o: int) -> str:
        return name if self.l == 1 else f"{name}[{self.outputs[o]}]"

    def coefficients(self) -> list[tuple[str, float]]:
        """Return gain, time constants and dead time of every pair, the levels, and drifts where there are some."""
        found = []
        for number, (one, f) in enumerate(zip(self.processes, self.nonlinearities)):
            if f.is_linear:
                found.append((self.of_pair("K", number), float(f.mu[0])))
            found += [(self.of_pair(name, number), float(value)) for name, value in zip(one.structure.names, one.p)]
        for name, values in (("level", self.level), ("drift", self.drift * np.any(self.drift))):
            found += [(self._of_output(name, o), float(value)) for o, value in enumerate(np.atleast_1d(values))
                      if name == "level" or np.any(self.drift)]
        return found

    def coefficient_units(self) -> dict[str, str]:
        """Return the units of the coefficients by name, "" where unknown."""
        time, found = self.time_unit or ("samples" if self.dt == 1 else ""), {}
        for o, y in enumerate(self.output_units):
            found |= {self._of_output("level", o): y, self._of_output("drift", o): f"{y or 1}/{time}" if time else y}
        for number, ((o, c), one) in enumerate(zip(self.pairs, self.processes)):
            y = self.output_units[o]
            below = " ".join(part for part in (self.input_units[c], time * one.structure.integrator) if part)
            found[self.of_pair("K", number)] = f"{y or 1}/{f'({below})' if ' ' in below else below}" if below else y
            found |= {self.of_pair(name, number): time * bool(timed)
                      for name, timed in zip(one.structure.names, one.structure.temporal)}
        return found

    def equation(self) -> str:
        """Return the equations as text, one per output."""
        words, lines = [function.word for function in static_functions(self)], []
        for o, output in enumerate(self.outputs):
            terms = []
            for (to, c), one, f, word in zip(self.pairs, self.processes, self.nonlinearities, words):
                if to == o:
                    name = self.inputs[c]
                    terms.append(f"{one.equation()} {f'{f.mu[0]:.4g} {name}' if f.is_linear else f'{word}({name})'}")
            beside = signed_terms([(self.level[o], ""), (self.drift[o], "t")])
            lines.append(f"{output} = {' + '.join(terms)}{beside}")
        return "\n".join(lines)

    # -- responses -----------------------------------------------------------------------------------------------------

    def _by_output(self, each: Sequence[Any]) -> Any:
        """Return what belongs to pairs, (N,) each, as (N, l, r): zero for the other outputs."""
        found = np.zeros((len(each[0]), self.l, len(each)), dtype=each[0].dtype)
        for j, ((o, _), one) in enumerate(zip(self.pairs, each)):
            found[:, o, j] = one
        return found

    def impulse_response(self, n: int = 100) -> Array:
        """Return the response of the linear part to a unit held for one sampling time, (n, l, r)."""
        t, pulse = np.arange(float(n)), np.array([[0.0], [1.0], [0.0]])
        return self._by_output([one.response(t, np.array([-1.0, 0.0, 1.0]), pulse)[:, 0, 0] for one in self._scaled])

    def frequency_response(self, w: ArrayLike) -> Any:
        """Return that of the linear part at w (radians per unit of time), with dead time, complex (len(w), l, r)."""
        s = 1j * np.atleast_1d(np.asarray(w, dtype=float))
        return self._by_output([one.transfer(s) for one in self.processes])

    def static_curve(self, c: int, u: Array) -> Array:
        """Return the static characteristic (k, l) of an input at (k,) values, without the levels."""
        self._refuse_integrator()
        found = np.zeros((len(u), self.l))
        for (o, place), f in zip(self.pairs, self.nonlinearities):
            if place == c:
                found[:, o] = f(np.asarray(u, dtype=float))
        return found

    def _static_gain(self, u0: Array) -> Array:
        self._refuse_integrator()
        found = np.zeros((self.l, self.m))
        for (o, c), f in zip(self.pairs, self.nonlinearities):
            found[o, c] = float(f.slope(u0[c]))
        return found

    def _refuse_integrator(self) -> None:
        if any(one.structure.integrator for one in self.processes):
            raise StructureError("The model has a pole at 1 (an integrator): it has no static gain.")

    # -- running over records ------------------------------------------------------------------------------------------

    @property
    def n_sections(self) -> int:
        """Number of sections of all processes."""
        return sum(one.structure.order for one in self.processes)

    @property
    def _state_shape(self) -> tuple[int]:
        return (self.n_sections + self.l * (self.levels is not None),)

    @cached_property
    def _scaled(self) -> tuple[ProcessDynamics, ...]:
        return tuple(one.in_unit(self.dt) for one in self.processes)

    def respond(self, u: Array, instants: Array | None = None) -> Array:
        """Return the outputs (N, l) to inputs (N, m) from rest, at any instants; (N,) of a model with one output.

        Args:
            u: inputs, none missing.
            instants: (N,) their times, increasing; multiples of dt by default.
        """
        t = np.arange(float(len(u))) if instants is None else np.asarray(instants, dtype=float) / self.dt
        found, straight = self.level + self.drift * self.dt * (t - t[0])[:, None], self.hold == "first"
        for (o, c), one, f in zip(self.pairs, self._scaled, self.nonlinearities):
            changes, values = thin_out(t, f(u[:, c])[:, None], straight)
            found[:, o] += one.response(t, changes, values - values[0], straight=straight)[:, 0, 0]
            found[:, o] += 0.0 if one.structure.integrator else values[0, 0]
        return found[:, 0] if self.l == 1 else found

    def _courses(self, u: Array, label: str, stamps: Array | None = None) -> tuple[Array, Array]:
        """Return the outputs (N, l) to inputs from rest, and the free motion (N, l, n) of every entry of a state.

        The entries are the sections pair by pair, then levels.
        """
        check_inputs(self, u, label)
        t = np.arange(float(len(u))) if stamps is None else stamps / self.dt
        each = [one.free_response(t, 0.0) for one in self._scaled]
        outputs = np.repeat([o for o, _ in self.pairs], [one.shape[1] for one in each])
        motion = np.hstack(each)[:, None, :] * np.equal.outer(np.arange(self.l), outputs)
        if self.levels is not None:
            motion = np.concatenate([motion, np.broadcast_to(np.eye(self.l), (len(u), self.l, self.l))], axis=2)
        return self.respond(u, stamps).reshape(len(u), self.l), motion

    def simulate(self, data: Any, x0: Any = "zero") -> Any:
        """Compute the outputs from the inputs alone, at the times of the record; arguments as of `Model.simulate`."""
        return self._at_times(data, x0) if isinstance(data, Data) else super().simulate(data, x0)

    def predict(self, data: Data, horizon: int = 1, x0: Any = "fit") -> Any:
        """Predict as `Model.predict`: without a noise model nothing but the initial state is learnt from outputs."""
        return super().predict(data, horizon, x0) if data.is_regular else self._at_times(data, x0)

    def _at_times(self, data: Data, x0: Any) -> Any:
        parts = in_units_of(self, data).experiments
        records = [(e.u, e.y, f"Experiment {i}: " * (len(parts) > 1)) for i, e in enumerate(parts, start=1)]
        return one_or_all(self._run("free", records, x0, [e.stamps for e in parts]))

    def _run(self, simulator: str, records: Sequence[Record], x0: Any, stamps: Sequence[Any] = ()) -> list[Array]:
        fit = isinstance(x0, str) and x0 == "fit" and all(y is not None for _, y, _ in records)
        states = [None] * len(records) if fit else self._states(simulator, records, x0)
        found = []
        for (u, y, label), state, times in zip(records, states, stamps or [None] * len(records)):
            own, motion = self._courses(u, label, times)
            if state is None:
                state = self._least(motion, y - own, label)  # pyright: ignore[reportOptionalOperand]
            found.append(own + motion @ state)
        return found

    def _fitted(self, simulator: str, u: Array, y: Any, label: str) -> Array:
        own, motion = self._courses(u, label)
        return self._least(motion, y - own, label)

    def _least(self, motion: Array, rest: Array, label: str) -> Array:
        """Return the state whose motion (N, l, n) explains most of a rest (N, l)."""
        here = np.isfinite(rest)
        for o, name in enumerate(self.outputs):
            if not here[:, o].any():
                raise DataError(f"{label}Output {name!r} has no sample: no initial state can be estimated.")
        return scaled_least_squares(motion[here], rest[here])

    # -- other tools ---------------------------------------------------------------------------------------------------

    def to_continuous(self) -> ContinuousModel:
        """Return the same as state equations in continuous time with dead times; of several levels the mean.

        Raises:
            StructureError: inputs that go straight between samples, a drift, an integrator.
        """
        for there, what in (
                (self.hold == "first", "Inputs that go straight between samples (hold='first')"),
                (bool(np.any(self.drift)), "A drift, which is no answer to the inputs,"),
                (any(one.structure.integrator for one in self.processes),
                 "An integrator that stands still under the first inputs of every run, whichever they are,")):
            if there:
                raise StructureError(f"{what} cannot be stated in equations of a state and held inputs. Use "
                                     "model.simulate, or the parameters (model.coefficients())")
        A, b, c, d = zip(*(one.equations for one in self.processes))
        names = {name: getattr(self, name) for name in ("inputs", "outputs", "input_units", "output_units")}
        inner: Any = block_diag(*A)
        driven: Any = block_diag(*b)
        read, direct = np.zeros((self.l, self.n_sections)), np.zeros((self.l, len(d)))
        edges = np.cumsum([0, *map(len, A)])
        for j, (o, _) in enumerate(self.pairs):
            read[o, edges[j] : edges[j + 1]], direct[o, j] = c[j], d[j]
        return ContinuousModel(inner, driven.T, read, direct, self.nonlinearities, self.input_of, self.dead_times,
                               np.zeros(self.n_sections), self.level, self.time_unit, **names)

    @property
    def zeros(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Zeros of the model with the same samples, as of `Model.zeros`; errors as of `to_continuous`."""
        return self.to_continuous().to_discrete(self.dt).zeros

    to_dlti, to_casadi, to_c, to_st, to_fmu = map(_of_samples, ("to_dlti", "to_casadi", "to_c", "to_st", "to_fmu"))

    def to_control(self, pade: int | None = None) -> Any:
        """Return the continuous transfer as a python-control system; a dead time requires `pade`."""
        return self.to_continuous().to_control(pade)

    # -- gauge, units, files -------------------------------------------------------------------------------------------

    def _in_raw_units(self, transform: Transform) -> Self:
        sizes, curves = np.array(transform.y_scale), []
        shift = np.array(transform.y_offset)
        for (o, c), one, f in zip(self.pairs, self.processes, self.nonlinearities):
            curve, constant = f.in_units(transform.u_scale[c], transform.u_offset[c])
            curves.append(curve.times(sizes[o]))
            shift[o] += sizes[o] * constant * (not one.structure.integrator)
        levels = None if self.levels is None else shift + sizes * self.levels
        return replace(self, nonlinearities=tuple(curves), level=shift + sizes * self.level, drift=sizes * self.drift,
                       levels=levels)

    def to_dict(self) -> dict[str, Any]:
        """Describe the model in JSON types."""
        return {**super().to_dict(), "processes": [one.to_dict() for one in self.processes]}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], functions: dict[str, Any] | None = None) -> Self:
        """Build what `to_dict` described."""
        processes = tuple(ProcessDynamics.from_dict(one) for one in content["processes"])
        return super().from_dict({"pairs": (), **content, "processes": processes}, functions)


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
