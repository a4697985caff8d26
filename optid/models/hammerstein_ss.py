"""The Hammerstein state-space model with nonlinear output feedback, in innovation form."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases.expansions import Linear
from optid.data.channels import Transform, numbered_names
from optid.data.record import Data
from optid.data.stretches import between_gaps
from optid.errors import DataError, StructureError
from optid.models import roots, state_forms, state_responses
from optid.models import state_simulation as simulation
from optid.models.coefficients import checked_horizon, coefficients
from optid.models.experiments import one_or_all, records_of
from optid.models.feedback_tables import tabulated
from optid.models.noise_covariances import NoiseCovariances
from optid.models.nonlinearity import Nonlinearity


@dataclass(frozen=True, eq=False)
class HammersteinSS:
    """x(k+1) = A x + B f(u) + E g(y) + L y + offset_x + K e, y(k) = C x + D f(u) + offset_y + e, in raw units.

    With the basis `Linear` and no feedback this is a linear state-space model. The feedback never reaches the output
    of the same sample: there is no algebraic loop.

    Attributes:
        A: (n, n).
        B: (n, r), one column per nonlinearity of the inputs.
        C: (l, n).
        D: (l, r); zero by default, like E, L, K and the offsets.
        nonlinearities: r of them; by default the identity of every input.
        input_of: the input that each acts on, r indices; by default one per input in order.
        E: (n, s), one column per nonlinearity of the outputs.
        feedback: s of them.
        output_of: the output that each acts on, s indices; by default one per output in order.
        L: (n, l) linear output injection.
        K: (n, l) gain of the innovations; zero for an output-error model.
        offset_x: (n,) constant of the state equation.
        offset_y: (l,) constant of the output equation.
        noise: covariances of the noises, or None.
        dt: sampling time.
        inputs: names of the m inputs.
        outputs: names of the l outputs.
        input_units: one per input, "" where unknown.
        output_units: one per output, "" where unknown.
        gauge: how the scale between f and B is fixed: "norm", "gain" or "none"; see `regauge`.

    Raises:
        StructureError: shapes that do not agree, coefficients that are not finite, an unknown gauge, a direct
            feedthrough of g.
    """

    A: Array
    B: Array
    C: Array
    D: Any = None
    nonlinearities: tuple[Nonlinearity, ...] = ()
    input_of: tuple[int, ...] = ()
    E: Any = None
    feedback: tuple[Nonlinearity, ...] = ()
    output_of: tuple[int, ...] = ()
    L: Any = None
    K: Any = None
    offset_x: Any = None
    offset_y: Any = None
    noise: NoiseCovariances | None = None
    dt: float = 1.0
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    gauge: str = field(default="none", kw_only=True)

    def __post_init__(self) -> None:
        fixed: dict[str, Any] = {
            name: coefficients(np.atleast_2d(getattr(self, name)), name) for name in ("A", "B", "C")
        }
        (n, r), outputs = fixed["B"].shape, len(fixed["C"])
        functions = tuple(self.nonlinearities) or tuple(Nonlinearity(Linear(), np.ones(1)) for _ in range(r))
        feedback = tuple(self.feedback)
        zeros = {"D": (outputs, r), "E": (n, len(feedback)), "L": (n, outputs), "K": (n, outputs), "offset_x": (n,)}
        for name, shape in (zeros | {"offset_y": (outputs,)}).items():
            given = getattr(self, name)
            fixed[name] = coefficients(np.zeros(shape) if given is None else given, name)
        fixed["input_of"] = tuple(int(c) for c in self.input_of) or tuple(range(len(functions)))
        fixed["output_of"] = tuple(int(o) for o in self.output_of) or tuple(range(len(feedback)))
        fixed["inputs"] = tuple(self.inputs) or numbered_names("u", 1 + max(fixed["input_of"], default=-1))
        fixed["outputs"] = tuple(self.outputs) or numbered_names("y", outputs)
        fixed["input_units"] = tuple(self.input_units) or ("",) * len(fixed["inputs"])
        fixed["output_units"] = tuple(self.output_units) or ("",) * len(fixed["outputs"])
        fixed["nonlinearities"], fixed["feedback"], fixed["dt"] = functions, feedback, float(self.dt)
        for name, value in fixed.items():
            object.__setattr__(self, name, value)
        state_forms.check_shapes(self)

    # -- sizes ---------------------------------------------------------------------------------------------------

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def l(self) -> int:  # noqa: E743 - the field's letter
        """Number of outputs."""
        return len(self.C)

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def kind(self) -> str:
        """The word for this class in model files."""
        return "HammersteinSS"

    @property
    def title(self) -> str:
        """What kind of model this is, in words."""
        linear = all(isinstance(f.basis, Linear) for f in self.nonlinearities)
        return f"{'Linear' if linear else 'Hammerstein'} state-space model" + (
            " with nonlinear feedback" if self.feedback else ""
        )

    @property
    def orders(self) -> dict[str, Any]:
        """The number of states nx."""
        return {"nx": self.nx}

    @property
    def memory(self) -> int:
        """Samples at the start of a record that cannot be predicted: none, the initial state is estimated."""
        return 0

    @cached_property
    def parts(self) -> simulation.Parts:
        """Matrices and tables as the compiled recursions read them."""
        matrices = [np.array(part, order="C") for part in (self.A, self.C, self.E, self.L, self.K)]
        return simulation.Parts._make(
            [*matrices, np.array(self.output_of, dtype=np.int64), tabulated(self.feedback)]
        )

    # -- what it says --------------------------------------------------------------------------------------------

    @property
    def f(self) -> Nonlinearity | tuple[Nonlinearity, ...]:
        """The nonlinearity of the input; a tuple when there are several."""
        return self.nonlinearities[0] if len(self.nonlinearities) == 1 else self.nonlinearities

    @property
    def offset_note(self) -> str:
        """Why the offsets of f and g are not identifiable."""
        return "The constants of f and g are part of the constants of the state and output equations."

    @cached_property
    def poles(self) -> Any:
        """Eigenvalues of A, complex (n,), largest first: the poles with the feedback g and L taken as given signals."""
        return roots.largest_first(np.linalg.eigvals(self.A).astype(complex))

    @property
    def is_stable(self) -> bool:
        """Whether all poles lie inside the unit circle."""
        return bool(np.all(np.abs(self.poles) < 1))

    def equilibrium(self, u0: ArrayLike) -> tuple[Array, Array]:
        """Return a state (n,) and outputs (l,) at which the model rests under constant inputs u0 (m,).

        With feedback there may be several; the one that Newton's method finds from x = 0 is returned.

        Raises:
            StructureError: u0 of the wrong size, a pole at 1, or no equilibrium found.
        """
        return state_responses.equilibrium(self, u0)

    def static_gain(self, u0: ArrayLike) -> Any:
        """Return the slope of the steady-state characteristic at u0, feedback included.

        Args:
            u0: operating point, a number or (m,).

        Returns:
            A number for one input and output, otherwise (l, m).

        Raises:
            StructureError: as `equilibrium`.
        """
        return state_responses.static_gain(self, u0)

    def impulse_response(self, n: int = 100) -> Array:
        """Return the response of (A, B, C, D) to a unit impulse of every f, (n, l, r), in the gauge of the model."""
        return state_responses.markov(self, self.B, n)

    def step_response(self, n: int = 100) -> Array:
        """Return the response of (A, B, C, D) to a unit step of every f, (n, l, r), in the gauge of the model."""
        return np.cumsum(self.impulse_response(n), axis=0)

    def frequency_response(self, w: ArrayLike) -> Array:
        """Return C (zI - A)^-1 B + D at the frequencies w (radians per unit of time), complex (len(w), l, r)."""
        return state_responses.frequency_response(self, w)

    def coefficients(self) -> list[tuple[str, float]]:
        """Return (name, value) of the entries of all matrices, as tables show them; zero matrices are left out."""
        from optid.models.state_text import listed

        return listed(self)

    def equation(self, digits: int = 4) -> str:
        """Write the model as equations: one per state up to four states, in matrices with the poles beyond."""
        from optid.models.state_text import written

        return written(self, digits)

    def __str__(self) -> str:
        """Return the equations and the poles."""
        return self.equation() + (f"\npoles: {roots.in_words(self.poles)}" if len(self.poles) else "")

    def expanded(self, u: Array) -> Array:
        """Return the values of the r nonlinearities at the inputs u (N, m), (N, r)."""
        columns = [f(u[:, c]) for f, c in zip(self.nonlinearities, self.input_of)]
        return np.column_stack(columns) if columns else np.zeros((len(u), 0))

    # -- the three simulators --------------------------------------------------------------------------------------

    def predict(self, data: Data, horizon: int = 1, x0: Any = "fit") -> Any:
        """Predict with the innovation form (P1): every output up to `horizon` samples before is known.

        A missing output corrects nothing, and its feedback sees the prediction instead. After a missing input the
        state is not known: the stretches in between are predicted each from an initial state of its own, and short
        ones not at all.

        Args:
            data: the record; detrended or scaled data are taken back to raw units first.
            horizon: how many samples ahead; the inputs are known always.
            x0: "fit" (least squares of the one-step errors), "zero", or the state (n,), one for each experiment.

        Returns:
            (N, l) in raw units, NaN in the first horizon - 1 samples and where inputs leave no prediction; a tuple of
            such arrays for several experiments.

        Raises:
            DataError: no stretch with every input, other channels or sampling time, predictions that leave the range
                of numbers.
            StructureError: a horizon that is not a whole number from 1, or an x0 that cannot be read.
        """
        horizon = checked_horizon(horizon)
        if isinstance(data, Data) and any(np.isnan(e.u).any() for e in data.experiments):
            return self._predicted_between_gaps(data, horizon, x0)
        jobs, states, _ = self._jobs("predict", data, x0)
        return one_or_all([simulation.ahead(job, x, horizon) for job, x in zip(jobs, states)])

    def _predicted_between_gaps(self, data: Data, horizon: int, x0: Any) -> Any:
        if not isinstance(x0, str):
            raise StructureError("inputs are missing, and no state is known after such a gap: use x0='fit' or 'zero'")
        raw = data.raw()
        cut, places = between_gaps(raw, 2 * self.nx + 1)
        stretches = self.predict(cut, horizon, x0)
        found = [np.full(e.y.shape, np.nan) for e in raw.experiments]
        for (experiment, part), predicted in zip(places, stretches if isinstance(stretches, tuple) else (stretches,)):
            found[experiment][part] = predicted
        return one_or_all(found)

    def simulate_measured_feedback(self, data: Data, x0: Any = "zero") -> Any:
        """Simulate with the measured outputs in the feedback (P2), without correcting the state.

        Where an output is missing the model's own output is fed back. Without feedback this is `simulate`.

        Args:
            data: the record; detrended or scaled data are taken back to raw units first.
            x0: "zero", "fit" (least squares on the outputs present), or the state (n,), one for each experiment.

        Returns:
            (N, l) in raw units; a tuple of such arrays for several experiments.

        Raises:
            DataError: as `simulate`.
            StructureError: an x0 that cannot be read, or inputs without outputs.

        Warns:
            DataWarning: the model is unstable.
        """
        jobs, states, _ = self._jobs("measured_feedback", data, x0)
        simulation.warn_unstable(self)
        return one_or_all([simulation.run(job, x) for job, x in zip(jobs, states)])

    def simulate(self, data: Any, x0: Any = "zero") -> Any:
        """Simulate freely (P3): the model's own outputs are fed back.

        Args:
            data: Data, or inputs (N,) or (N, m), or a list of such arrays, in raw units.
            x0: "zero", "fit" (least squares on the outputs present, from the value of P2; needs Data), or the state
                (n,), one for each experiment.

        Returns:
            (N, l) in raw units, or (N,) for u given as (N,) and one output; a tuple of such arrays for several
            experiments.

        Raises:
            DataError: a missing input, other channels or sampling time, or an output that leaves 100 times the range
                of the data (of numbers, where no outputs are given), with the sample at which it does.
            StructureError: an x0 that cannot be read.

        Warns:
            DataWarning: the model is unstable.
        """
        jobs, states, flat = self._jobs("free", data, x0)
        simulation.warn_unstable(self)
        outputs = [simulation.run(job, x) for job, x in zip(jobs, states)]
        return one_or_all([y[:, 0] for y in outputs] if flat and self.l == 1 else outputs)

    def initial_state(self, data: Data, simulator: str = "free") -> Any:
        """Estimate the state (n,) at the first sample by least squares; a tuple for several experiments.

        Args:
            data: the record.
            simulator: whose errors are made small: "predict", "measured_feedback" or "free".

        Raises:
            DataError: as `simulate`.
            StructureError: an unknown simulator.
        """
        if simulator not in simulation.SIMULATORS:
            raise StructureError(f"simulator={simulator!r}: use one of {', '.join(simulation.SIMULATORS)}.")
        return one_or_all(self._jobs(simulator, data, "fit")[1])

    def _jobs(self, simulator: str, data: Any, x0: Any) -> tuple[list[simulation.Run], list[Array], bool]:
        """Return the run of every experiment, its initial state, and whether u was one-dimensional."""
        records, flat = records_of(self, data)
        limits = None if simulator == "predict" else simulation.allowed_range([y for _, y, _ in records])
        if simulator != "free" and any(y is None for _, y, _ in records):
            raise StructureError("This simulator needs the outputs: pass Data, or call simulate.")
        jobs = [simulation.prepared(self, simulator, u, y, limits, label) for u, y, label in records]
        return jobs, self._states(jobs, records, x0), flat

    def _states(self, jobs: list[simulation.Run], records: Sequence[Any], x0: Any) -> list[Array]:
        if isinstance(x0, str):
            if x0 == "zero":
                return [np.zeros(self.nx)] * len(jobs)
            if x0 != "fit":
                raise StructureError(f"x0={x0!r}: use 'zero', 'fit' or an array ({self.nx},).")
            if any(y is None for _, y, _ in records):
                raise StructureError("x0='fit' needs the outputs: pass Data, or x0='zero' or a state.")
            return [self._fitted(job, y) for job, (_, y, _) in zip(jobs, records)]
        states = list(x0) if len(jobs) > 1 else [x0]
        if len(states) != len(jobs):
            raise StructureError(f"{len(states)} initial states for {len(jobs)} experiments: give one each.")
        return [simulation.state_like(self, state) for state in states]

    def _fitted(self, job: simulation.Run, y: Array) -> Array:
        """Fit the initial state of one run; a free run with feedback starts from the value of P2, or from rest."""
        unbounded = simulation.prepared(self, "free", job.u, None, None, job.label)
        if not self.feedback:
            bounds = unbounded.low, unbounded.high
            return simulation.fitted_state(job._replace(low=bounds[0], high=bounds[1]), y)
        if job.known is not None:
            return simulation.fitted_state(job, y)
        try:
            start = simulation.fitted_state(unbounded._replace(known=y), y)
            return simulation.fitted_state(job, y, start)
        except DataError:
            return simulation.fitted_state(job, y)

    # -- changes -------------------------------------------------------------------------------------------------

    def transformed(self, T: ArrayLike) -> "HammersteinSS":
        """Return the model in the states T x; predictions do not change.

        Args:
            T: (n, n), invertible.

        Raises:
            StructureError: T of another shape, or singular.
        """
        return state_forms.transformed(self, T)

    def balanced(self) -> "HammersteinSS":
        """Return the model in balanced states: both Gramians of (A, [B E], C) are diagonal and equal.

        Raises:
            StructureError: an unstable model, or one that is not minimal.
        """
        return state_forms.balanced(self)

    def injected(self, gain: ArrayLike) -> "HammersteinSS":
        """Move gain times the output out of A into L: A - gain C, L + gain, K - gain.

        P1 and P3 do not change; P2 does, since it feeds back the measured output. With gain = -L the injection is
        absorbed into A.

        Args:
            gain: (n, l).

        Raises:
            StructureError: a gain of another shape.
        """
        return state_forms.injected(self, gain)

    def regauge(self, gauge: str) -> "HammersteinSS":
        """Fix the scale between f and B, and g and E; predictions do not change.

        Args:
            gauge: "norm" (every column [B; D] of norm one, its first Markov parameter that is not zero positive; E
                alike), "gain" (unit static gain of the linear part from every f; one output; E as with "norm"), "none"
                (as it is; linear channels get f(u) = u).

        Raises:
            StructureError: unknown gauge, or one that this model cannot take.
        """
        return state_forms.regauged(self, gauge)

    def with_transform(self, transform: Transform) -> "HammersteinSS":
        """Return the model in raw units, given that this one was identified on data changed by `transform`.

        Every basis but UserFunctions follows a change of units exactly, so the predictions are the same.

        Raises:
            StructureError: a basis of UserFunctions, or other numbers of channels.
        """
        return state_forms.in_raw_units(self, transform)

    # -- leaving -------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Describe the model in JSON types."""
        return state_forms.to_dict(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], functions: dict[str, Any] | None = None) -> "HammersteinSS":
        """Build the model that `to_dict` described; ``functions`` are those of a basis of UserFunctions, by name."""
        return cls(**state_forms.read(content, functions))

    def save(self, path: str | Path) -> Path:
        """Write the model to a JSON file, from which `optid.load` restores it exactly."""
        from optid.models.files import save

        return save(self, path)

    def to_dlti(self) -> Any:
        """Return (A, B, C, D), from every f to every output, as a `scipy.signal.dlti`."""
        from scipy.signal import dlti

        return dlti(self.A, self.B, self.C, self.D, dt=self.dt)

    def to_control(self) -> Any:
        """Return (A, B, C, D), from every f to every output, as a python-control system."""
        from optid.models.export import control_package

        return control_package().ss(self.A, self.B, self.C, self.D, self.dt)

    def to_casadi(self) -> Any:
        """Return (x, u) -> (x_next, y) as a `casadi.Function`, the free run without noise."""
        from optid.models.export import state_space_to_casadi

        return state_space_to_casadi(self)
