"""What every model shares: channels, units, gauge, stability, responses, running over records, text and files."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from html import escape
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, as_list, check_integer, finite, one_of, one_or_all
from optid.data.channels import Ports, Transform, interval_text
from optid.data.record import Data
from optid.data.stretches import runs_of
from optid.errors import DataError, DataWarning, StructureError
from optid.models import conversion, export, files, fmu, generated_code, roots
from optid.models.experiments import Record, named_channels, operating_point, records_of, state_like
from optid.models.linear import frequency_response, impulse_response
from optid.models.nonlinearity import Nonlinearity
from optid.models.roots import AT_ONE

TITLES = {"oe": "output-error", "arx": "ARX", "armax": "ARMAX", "bj": "Box-Jenkins", "ss": "state-space"}
ROUNDING = 1e-12  # of a pole on the unit circle


class Model(Ports):
    """A linear part between static functions, with named channels; the fields are those of its dataclasses.

    Attributes:
        nonlinearities: functions of the inputs.
        dt: sampling time.
        time_unit: unit of dt: "s" where the record had a clock or dt was given, "" where it is unknown.
        inputs: names of the m inputs; u or u1, u2, ... by default.
        outputs: names of the l outputs; y or y1, y2, ... by default.
        input_units: one per input, "" where unknown.
        output_units: one per output, "" where unknown.
        gauge: how the scale between f and B is fixed; see `regauge`.
        orders: the numbers of the structure by their names, na, nb, nk, nx.
        poles: complex, largest first.
        memory: samples at the start of a record that cannot be predicted.
        c0: offset of f where the data tell it from the constants of the equations, else None.
        offset_note: why c0 is None; "" where it is known.
        structure: the kind of linear part and noise: "arx", "armax", "oe", "bj" or "ss".
        levels: (E, l) constants of the experiments of its record where each has one of its own, else None. The constant
            of the model is then their mean, and that of another record unknown: a state that does not change.
    """

    nonlinearities: tuple[Nonlinearity, ...]
    dt: float
    time_unit: str
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    gauge: str
    orders: Any
    poles: Any
    memory: int
    structure: Any
    levels: Any = None
    __dataclass_fields__: ClassVar[dict[str, Any]]
    GAUGES: ClassVar[tuple[str, ...]]
    SIMULATORS: ClassVar[tuple[str, ...]]
    c0: Any
    offset_note: Any
    equation: Callable[..., str]
    static_curve: Callable[[int, Array], Array]
    _static_gain: Callable[[Array], Array]
    _state_shape: Any
    _run: Callable[[str, Sequence[Record], Any], list[Array]]
    _fitted: Callable[[str, Array, Any, str], Array]
    _in_raw_units: Callable[[Transform], Self]

    def _fix(self, fields: Mapping[str, Any], m: int, l: int) -> None:  # noqa: E741 - the field's letter
        """Set the fields of a new model, with default names and units for m inputs and l outputs, and check them."""
        fixed = {**fields, "nonlinearities": tuple(fields["nonlinearities"]), "dt": float(self.dt),
                 **named_channels(self, m, l)}
        if self.levels is not None:
            fixed["levels"] = finite(self.levels, "levels")
            if fixed["levels"].ndim != 2 or not len(fixed["levels"]) or fixed["levels"].shape[1] != l:
                raise StructureError(f"levels has shape {fixed['levels'].shape}; it must be (experiments, {l}).")
        for name, value in fixed.items():
            object.__setattr__(self, name, value)
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise StructureError(f"dt = {self.dt!r}: it must be a positive number.")
        if not isinstance(self.time_unit, str):
            raise StructureError(f"time_unit = {self.time_unit!r}: it must be text, such as 's'.")
        one_of("gauge", self.gauge, self.GAUGES)

    @property
    def kind(self) -> str:
        """The word for this class in model files."""
        return type(self).__name__

    @property
    def title(self) -> str:
        """What kind of model this is, in words."""
        family = "Linear" if all(f.is_linear for f in self.nonlinearities) else "Hammerstein"
        more = [word for word, functions in (("nonlinear feedback", "feedback"), ("latent functions", "latent"))
                if getattr(self, functions, ())]
        return f"{family} {TITLES[self.structure]} model{' with ' * bool(more)}{' and '.join(more)}"

    @property
    def interval(self) -> str:
        """The sampling time with its unit, as text."""
        return interval_text(self.dt, self.time_unit)

    @property
    def sampling(self) -> str:
        """The sampling time in words, for reports and exported code."""
        return f"sampling time: {self.interval}{'' if self.time_unit else ' (unit unknown)'}"

    @property
    def radius(self) -> float:
        """Modulus of the largest pole; zero without poles."""
        return float(np.max(np.abs(self.poles), initial=0.0))

    @property
    def is_stable(self) -> bool:
        """Whether all poles lie inside the unit circle, by more than rounding."""
        return self.radius < 1 - ROUNDING

    @property
    def integrates(self) -> bool:
        """Whether the model has a pole at 1 and is stable otherwise: its outputs ramp while the inputs are held."""
        return self.integrates_within(AT_ONE)

    def integrates_within(self, distance: float) -> bool:
        """Whether a real pole lies so near to 1 and all others lie inside the unit circle, one an output at most."""
        near = (np.abs(self.poles - 1) <= distance) & (np.abs(self.poles.imag) <= ROUNDING)
        return 0 < int(near.sum()) <= self.l and bool(np.all(np.abs(self.poles[~near]) < 1 - ROUNDING))

    def impulse_response(self, n: int = 100) -> Array:
        """Return the response of the linear part to a unit impulse of every f, (n, l, r), in the gauge of the model."""
        return impulse_response(*export.state_space(self), n)

    def frequency_response(self, w: ArrayLike) -> Array:
        """Return that of the linear part at the frequencies w (radians per unit of time), complex (len(w), l, r)."""
        return frequency_response(*export.state_space(self), w, self.dt)

    def step_response(self, n: int = 100) -> Array:
        """Return the response of the linear part to a unit step of every f, (n, l, r), in the gauge of the model."""
        return np.cumsum(self.impulse_response(n), axis=0)

    @property
    def f(self) -> Nonlinearity | tuple[Nonlinearity, ...]:
        """The nonlinearity of the input, with its offset where `c0` knows it; a tuple when there are several."""
        functions = self.nonlinearities
        return replace(functions[0], offset=self.c0) if len(functions) == 1 else functions

    def static_gain(self, u0: ArrayLike) -> Any:
        """Return the slope of the steady-state characteristic at u0, a number or (m,), feedback included.

        It is a number for one input and output, otherwise (l, m).

        Raises:
            StructureError: u0 of the wrong size, an integrator (a pole at 1), or no equilibrium found.
        """
        gain = self._static_gain(operating_point(self, u0))
        return float(gain[0, 0]) if gain.size == 1 else gain

    def __repr__(self) -> str:
        orders = ", ".join(f"{name}={value}" for name, value in self.orders.items())
        return f"{type(self).__name__}({self.title} of {', '.join(self.outputs)}; {orders}, dt={self.interval})"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    def __str__(self) -> str:
        """Return the equations, the poles and the sampling time."""
        ramps = " (integrates)" * self.integrates
        poles = f"\npoles: {roots.in_words(self.poles)}{ramps}" if len(self.poles) else ""
        return f"{self.equation()}{self._levels_in_words()}{poles}\n{self.sampling}"

    def _levels_in_words(self) -> str:
        if self.levels is None:
            return ""
        parts = [f"{low:.4g} to {high:.4g}" + f" ({name})" * (self.l > 1)
                 for name, low, high in zip(self.outputs, self.levels.min(axis=0), self.levels.max(axis=0))]
        return f"\nconstants of the {len(self.levels)} experiments: {', '.join(parts)}; above is their mean"

    # -- running over records ------------------------------------------------------------------------------------

    def predict(self, data: Data, horizon: int = 1, x0: Any = "fit") -> Any:
        """Predict one or several steps ahead: every output up to `horizon` samples before is known, and all inputs.

        An ARX model predicts where every sample it needs is present. In the others a missing output counts as an
        innovation of zero: it corrects nothing, and feedback sees the prediction instead. A missing input leaves no
        prediction: with ARMAX where it reaches, with the others in the sample, after which the state is estimated anew;
        stretches too short for that are not predicted.

        Args:
            data: the record; detrended or scaled data are taken back to raw units first.
            horizon: how many samples ahead.
            x0: state at the first sample: "fit" (least squares of the one-step prediction errors), "zero", or the
                state, one for each experiment. ARX and ARMAX models need none.

        Returns:
            (N, l) in raw units, NaN where there is no prediction and in the first `memory` + horizon - 1 samples; a
            tuple of such arrays for several experiments. ARMAX: NaN on until so many outputs follow one another without
            a gap (ten times `memory` samples where they never do).

        Raises:
            DataError: no stretch with every input, other channels or sampling time than the model's, predictions that
                leave the range of numbers.
            StructureError: a horizon that is not a positive integer, or an x0 that cannot be read.
        """
        horizon, (records, _) = check_integer(horizon, "horizon"), records_of(self, data)
        fit = isinstance(x0, str) and x0 == "fit"
        states = [None] * len(records) if fit else self._states("predict", records, x0)
        predicted = [self.predict_record(u, y, horizon, state, label) for (u, y, label), state in zip(records, states)]
        gaps = any(np.isnan(u).any() for u, _, _ in records)
        if gaps and self.structure not in ("arx", "armax") and all(np.isnan(p).all() for p in predicted):
            raise DataError(f"no stretch of {2 * self._state_shape[0] + 1} samples has every input: interpolate them, "
                            "or leave an input out")
        return one_or_all(predicted)

    def predict_record(self, u: Array, y: Any, horizon: int = 1, x0: Array | None = None, label: str = "") -> Array:
        """Predict (N, l) one record in raw units as `predict` does, from arrays u (N, m) and y (N, l), NaN = missing.

        x0 None is the state of the smallest one-step prediction errors; `label` names the experiment in a message.
        """
        known, prediction = np.isfinite(u).all(axis=1), np.full(y.shape, np.nan)
        for first, last in runs_of(known):
            inputs, outputs, state = u[first:last], y[first:last], x0 if first == 0 else None
            if state is None:
                if not known.all() and np.isfinite(outputs).sum(axis=0).min() <= 2 * self._state_shape[0]:
                    continue  # the estimated state would repeat the outputs
                state = self._fitted("predict", inputs, outputs, label)
            prediction[first:last] = self._predicted(inputs, outputs, horizon, state, label)
        return prediction

    def _predicted(self, u: Array, y: Array, horizon: int, state: Array, label: str) -> Array:
        return self._run("free", [(u, y, label)], state)[0]  # without a noise model nothing else is known

    def simulate(self, data: Any, x0: Any = "zero") -> Any:
        """Compute the outputs from the inputs alone; nonlinear feedback sees the model's own outputs (P3).

        Args:
            data: Data, or inputs (N,) or (N, m), or a list of such arrays, in raw units.
            x0: "zero" (nothing before the record), "fit" (least squares on the outputs present; needs Data), or the
                state, one for each experiment; see `initial_state`. Of a model with `levels` the last row of a state is
                the deviation of the constant from the mean: "zero" runs at the mean, "fit" estimates it.

        Returns:
            (N, l) in raw units, or (N,) for u given as (N,) and one output; a tuple of such arrays for several
            experiments.

        Raises:
            DataError: a missing input, other channels or sampling time, or an output that leaves the range of numbers
                (with nonlinear feedback and Data: 100 times the range of the data), with the sample at which it does.
            StructureError: an x0 that cannot be read.

        Warns:
            DataWarning: the model is unstable, and no integrator.
        """
        records, flat = records_of(self, data)
        outputs = self._run("free", records, x0)
        return one_or_all([y[:, 0] for y in outputs] if flat and self.l == 1 else outputs)

    def innovations(self, data: Data, x0: Any = "fit") -> Any:
        """Return the errors (N, l) of `predict` one step ahead, NaN where it has none; a tuple for several records."""
        predicted = self.predict(data, 1, x0)
        return one_or_all([e.y - p for e, p in zip(data.raw().experiments, as_list(predicted))])

    @property
    def n_states(self) -> int:
        """How many numbers the state has."""
        return int(np.prod(self._state_shape))

    def initial_state(self, data: Data, simulator: str = "free") -> Any:
        """Estimate the state at the first sample by least squares; a tuple for several experiments.

        The simulator whose errors are minimised is "free", "predict" or, with nonlinear feedback, "measured_feedback".

        Raises:
            DataError: as `simulate`.
            StructureError: an unknown simulator.
        """
        return one_or_all(self._states(simulator, records_of(self, data)[0], "fit"))

    def _states(self, simulator: str, records: Sequence[Record], x0: Any) -> list[Array]:
        """Return the state of every record at its first sample.

        Raises:
            StructureError: an unknown simulator, one that needs the outputs, or an x0 that cannot be read.
        """
        one_of("simulator", simulator, self.SIMULATORS)
        if simulator != "free" and any(y is None for _, y, _ in records):
            raise StructureError("This simulator needs the outputs: pass Data, or call simulate.")
        if isinstance(x0, str):
            if x0 == "zero":
                return [np.zeros(self._state_shape)] * len(records)
            if x0 != "fit":
                raise StructureError(f"x0={x0!r}: use 'zero', 'fit' or an array {self._state_shape}.")
            if any(y is None for _, y, _ in records):
                raise StructureError("x0='fit' needs the outputs: pass Data, or x0='zero' or a state.")
            return [self._fitted(simulator, *record) for record in records]
        states = list(x0) if len(records) > 1 else [x0]
        if len(states) != len(records):
            raise StructureError(f"{len(states)} initial states for {len(records)} experiments: give one each.")
        return [state_like(state, self._state_shape) for state in states]

    def _warn_unstable(self) -> None:
        if not (self.is_stable or self.integrates):
            warnings.warn(
                f"The model is unstable: its largest pole has radius {self.radius:.6g}. Its simulation grows and tells "
                "little about the fit; use one-step prediction, or identify with a stability constraint.",
                DataWarning,
                stacklevel=4)

    # -- gauge and units -----------------------------------------------------------------------------------------

    def regauge(self, gauge: str, signs: bool = True) -> Self:
        """Fix the scale between f and B of every function, and of nonlinear feedback; predictions do not change.

        Args:
            gauge: "norm" (norm of B one, of [B; D] in a state-space model; f rises where the output rises, see
                `optid.models.gauges.plant_signs`), "gain" (unit static gain of the linear part; one output), "b0"
                (first coefficient of B one; transfer functions only), "none" (as it is; linear channels get f(u) = u).
            signs: with False the gauge "norm" leaves the signs as they are.

        Raises:
            StructureError: unknown gauge, or one that this model cannot take.
        """
        one_of("gauge", gauge, self.GAUGES)
        if gauge == "gain" and self.l > 1:
            raise StructureError("gauge 'gain' is defined for one output; use 'norm'.")
        return self._regauged(gauge, signs)

    def _regauged(self, gauge: str, signs: bool) -> Self:
        return self

    def with_transform(self, transform: Transform) -> Self:
        """Return the model in raw units, given that this one was identified on data changed by `transform`.

        Every basis but UserFunctions follows a change of units exactly, so the predictions are the same.

        Raises:
            StructureError: a basis of UserFunctions, or other numbers of channels.
        """
        if transform.is_identity:
            return self
        if len(transform.u_scale) != self.m or len(transform.y_scale) != self.l:
            raise StructureError(
                f"The transform has {len(transform.u_scale)} inputs and {len(transform.y_scale)} outputs, "
                f"the model {self.m} and {self.l}.")
        # units do not turn signs: what a constraint decided about them stays
        return self._in_raw_units(transform).regauge(self.gauge, signs=False)

    # -- other tools and files -----------------------------------------------------------------------------------

    to_continuous, to_discrete = conversion.to_continuous, conversion.to_discrete
    zeros, pole_table = property(conversion.zeros), property(conversion.pole_table)
    to_dlti, to_control, to_casadi = export.to_dlti, export.to_control, export.to_casadi
    to_c, to_st, to_fmu = generated_code.to_c, generated_code.to_st, fmu.to_fmu

    def to_dict(self) -> dict[str, Any]:
        """Describe the model in JSON types."""
        return {"kind": self.kind} | {one.name: _in_json(getattr(self, one.name)) for one in fields(self)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], functions: dict[str, Any] | None = None) -> Self:
        """Build what `to_dict` described, with the functions of UserFunctions by name; errors as of the parts."""
        content = {"time_unit": "", "levels": None, **content}  # an older file has none
        given = {one.name: content[one.name] for one in fields(cls)}
        for name in given.keys() & {"nonlinearities", "feedback", "latent"}:
            given[name] = tuple(Nonlinearity.from_dict(f, functions) for f in given[name])
        return cls(**given)

    def save(self, path: str | Path, record: Mapping[str, Any] | None = None) -> Path:
        """Write the model to a JSON file, from which `optid.load` restores it to the last bit.

        Args:
            path: the file.
            record: files of the record that it was identified from, and how they are read (`files.record_of`).
        """
        return files.write(self.to_dict() | ({"record": dict(record)} if record else {}), path, files.FORMAT,
                           files.VERSION)


def _in_json(value: Any) -> Any:
    """Arrays as lists, parts as their own descriptions."""
    if isinstance(value, tuple):
        return [_in_json(one) for one in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.to_dict() if hasattr(value, "to_dict") else value
