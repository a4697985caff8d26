"""What the dynamics of a model mean in the units of its record: time constants, damping, dead time and static gain.

A pole p of the sampled model is exp(s dt): a real one between 0 and 1 has the time constant -dt / log p, a complex pair
the natural frequency |s| and the damping -Re s / |s|. The interval of a time constant is that of its pole, mapped: it
has no upper end where that of the pole contains 1. A static gain is a quotient by A(1) = prod (1 - p), which a slow
plant leaves uncertain: its interval is that of Fieller (J. R. Statist. Soc. B 16, 1954). The other errors follow from
the derivatives of the quantities.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import OptidError, StructureError
from optid.identify.parameters import Parameter, Parameters
from optid.models.functions import has_feedback
from optid.models.model import AT_ONE
from optid.models.roots import AT_ZERO, poles_of
from optid.phrases import unit_ratio

DECAYED = 1e-6  # share of their start to which the other modes fall before the slope of an integrator is read
SAME = 1e-9  # of a sample: a smaller part is rounding
MOST = 20_000  # most samples of the response of which the slope is read

Levels = Sequence[tuple[float, float]]
"""Two levels of every input."""


def dynamics(model: Any, levels: Levels, known: Any = None, reason: str = "", level: float = 0.95) -> Parameters:
    """Return time constants by size, damping and natural frequencies, dead times, and static gains or slopes.

    The dead time of an input is nk - 1 samples, and zero for nk = 0 and nk = 1: an input held over its sampling time
    acts on the next sample (lag 1) without any dead time. A true dead time that is no multiple of the sampling time is
    longer by less than one sample; where B has the coefficient that it takes (nb = na + 1) and determines that part, it
    is included, with its error (see `optid.models.conversion.to_continuous`). Where f is nonlinear the static gain is
    the slope of the static characteristic over the middle half of the input's range, between two levels that a note
    states. A model that integrates has a slope instead: how fast the output moves for a unit of the input.

    Args:
        model: the model.
        levels: range of every input, (low, high).
        known: its `Uncertainty`, None where there is none.
        reason: why there is none.
        level: probability of the intervals.
    """
    known = None if known is None else known.at_level(level)
    return _Reading(model, levels, known).table(level, reason)


def input_levels(model: Any, record: Any = None) -> list[tuple[float, float]]:
    """Return the range of every input: that of the basis of its function, or of a record, or else 0 to 1."""
    places, found = list(getattr(model, "input_of", range(model.m))), []
    for c in range(model.m):
        basis = model.nonlinearities[places.index(c)].basis if c in places and model.nonlinearities else None
        samples = np.zeros(0) if record is None else np.concatenate([e.u[:, c] for e in record.experiments])
        samples = samples[np.isfinite(samples)]
        if basis is not None and basis.interval:
            low, high = map(float, basis.interval)
        elif samples.size and np.ptp(samples) > 0:
            low, high = float(samples.min()), float(samples.max())
        else:
            low, high = 0.0, 1.0
        found.append((low, high))
    return found


def middle(low: float, high: float) -> tuple[float, float]:
    """Return the ends of the middle half of a range, rounded to some per cent of it, so that they can be stated."""
    digits = 1 - int(np.floor(np.log10(high - low)))
    quarter = (high - low) / 4
    return round(low + quarter, digits), round(high - quarter, digits)


def integration(model: Any, known: Any = None) -> str:
    """Return the sentence about a real pole that is 1, or not told from 1 by the record; "" where there is none.

    With nonlinear feedback, or functions of latent signals, the poles of the linear part do not decide.
    """
    if has_feedback(model) or getattr(model, "latent", ()):
        return ""
    for pole in (float(pole.real) for pole in poles_of(model) if pole.imag == 0):
        if abs(pole - 1) <= AT_ONE:
            return "A pole at 1: the model integrates, its output comes to rest at no level"
        if known is not None and pole > 0:
            found = known.of(lambda model, pole=pole: nearest_real(poles_of(model), pole))
            if model.structure == "process" and found.lower <= 0:
                continue  # a time constant that is not told from zero
            if found.lower <= 1 <= found.upper:
                return (f"The record does not tell the pole {pole:.5g} (from {float(found.lower):.5g} to "
                        f"{float(found.upper):.5g}) from 1: the model may integrate, no level of rest is known")
    return ""


def nearest_real(poles: Array, pole: float) -> float:
    """Return the real pole nearest to one; NaN where it has become one of a complex pair."""
    nearest = poles[np.argmin(np.abs(poles - pole))]
    return float(nearest.real) if nearest.imag == 0 else np.nan


def slope_samples(model: Any) -> int:
    """Return after how many samples a step of a plant that integrates has become a straight line."""
    sizes = [abs(pole) for pole in poles_of(model) if abs(pole - 1) > 1e-3 and abs(pole) < 1]
    slowest = max(sizes, default=0.0)
    lags = int(getattr(model, "largest_lag", model.orders.get("nx", 0)))
    decay = 0 if slowest == 0 else int(np.log(DECAYED) / np.log(slowest))
    return min(lags + 2 + decay, MOST)


def jumps(model: Any, c: int, low: float, high: float) -> Array:
    """Return what every function of the inputs does (r,) as input c goes from one level to another."""
    if not model.nonlinearities:  # equations of the user, linear about their operating point
        return (high - low) * np.eye(model.m)[c]
    places = getattr(model, "input_of", range(model.m))
    return np.array([f(high) - f(low) if place == c else 0.0 for f, place in zip(model.nonlinearities, places)])


def mean_slopes(model: Any, levels: Levels) -> Array:
    """Return the range of every function of the inputs over that of its input (r,), negative where it falls."""
    if not model.nonlinearities:
        return np.ones(model.m)
    found = []
    for f, c in zip(model.nonlinearities, getattr(model, "input_of", range(model.m))):
        values = f(np.linspace(*levels[c], 201))
        found.append(float(np.copysign(np.ptp(values), values[-1] - values[0])) / (levels[c][1] - levels[c][0]))
    return np.array(found)


def _parameter(name: str, row: Iterable[Any], unit: str = "") -> Parameter:
    estimate, error, lower, upper = map(float, row)
    return Parameter(name, estimate, error, lower, upper, unit)


@dataclass(eq=False)
class _Reading:
    model: Any
    levels: Levels
    known: Any
    notes: list[str] = field(default_factory=list)

    def table(self, level: float, reason: str) -> Parameters:
        of_process = self.model.structure == "process"
        rows = self.of_process() if of_process else [*self.modes(), *self.dead_times(), *self.gains()]
        return Parameters(tuple(rows), level, reason, "Dynamics", tuple(dict.fromkeys(self.notes)))

    @property
    def time(self) -> str:
        """Unit of time."""
        model = self.model
        return model.time_unit or ("samples" if model.dt == 1 else "")

    def limits(self, what: str, quantity: Callable[[Any], Any]) -> Array:
        """Return the rows (k, 4) of estimate, error and ends of a quantity; NaN where there are none, with a note."""
        value = np.ravel(np.asarray(quantity(self.model), dtype=float))
        rows = np.column_stack([value, np.full((value.size, 3), np.nan)])
        if self.known is None:
            return rows
        try:
            found = self.known.of(quantity)
        except OptidError as error:
            self.notes.append(f"No standard error of the {what}: {str(error).rstrip('.')}.")
            return rows
        return np.column_stack([np.ravel(part) for part in (found.value, found.error, found.lower, found.upper)])

    # -- processes -------------------------------------------------------------------------------------------------

    def of_process(self) -> list[Parameter]:
        """Return time constants, damping, dead time and gain of a process model: its parameters."""
        units, found = self.model.coefficient_units(), []
        times = {"tau": "time constant", **{f"tau{i}": f"time constant {i}" for i in (1, 2, 3)},
                 "tau_zero": "time constant of the zero", "zeta": "damping", "dead_time": "dead time"}
        for place, (name, _) in enumerate(self.model.coefficients()):
            word, bracket, channel = name.partition("[")
            rows = self.limits(name, lambda model, place=place: model.coefficients()[place][1])
            if self.known is not None and np.isfinite(rows[0, 1]):
                wald, rows = rows, self.known.with_profile(name, rows[0])[None]
                if np.any(rows != wald):
                    self.notes.append(f"Interval of the {times[word]}{bracket}{channel} by profile likelihood; by its "
                                      f"standard error {wald[0, 2]:.4g} to {wald[0, 3]:.4g}.")
            if word in times:
                found.append(_parameter(times[word] + bracket + channel, rows[0], units[name]))
            elif word == "T":
                rows = self.limits(name, lambda model, place=place: 1 / model.coefficients()[place][1])
                found.append(_parameter(f"natural frequency{bracket}{channel}", rows[0], f"rad/{units[name] or 1}"))
        model = self.model
        for j, ((_, c), one, f) in enumerate(zip(model.pairs, model.processes, model.nonlinearities)):
            name, (low, high) = "slope" if one.structure.integrator else "static gain", middle(*self.levels[c])
            ends = np.array([low, high])
            if not f.is_linear:
                self.notes.append(f"{name.capitalize()} between {model.inputs[c]} = {low:g} and {high:g}.")
            rows = self.limits(name, lambda model, j=j, ends=ends: (
                np.diff(model.nonlinearities[j](ends)) / np.diff(ends)))
            found.append(_parameter(model.of_pair(name, j), rows[0], units[model.of_pair("K", j)]))
        return found

    # -- poles -----------------------------------------------------------------------------------------------------

    def modes(self) -> list[Parameter]:
        """Return time constants, and natural frequency and damping of complex pairs, the slowest first."""
        model = self.model
        poles = [pole for pole in poles_of(model) if pole.imag >= 0]
        delays = sum(abs(pole) <= AT_ZERO for pole in poles)
        poles = [pole for pole in poles if abs(pole) > AT_ZERO]
        if delays:
            self.notes.append(f"Poles at zero, which are samples of delay and have no time constant: {delays}.")
        if has_feedback(model) and poles:
            self.notes.append("Time constants of the linear part: those of the loop depend on the level of the output.")
        kinds = ["pair" if pole.imag else "negative" if pole.real < 0 else "integrates" if abs(pole - 1) <= AT_ONE
                 else "growth" if pole.real > 1 else "decay" for pole in poles]
        found, counts = [], dict.fromkeys(kinds, 0)
        for pole, kind in zip(poles, kinds):
            counts[kind] += 1
            number = f" {counts[kind]}" if kinds.count(kind) > 1 else ""
            found += [] if kind == "integrates" else getattr(self, f"_{kind}")(pole, number)  # its slopes say it
        return found

    def _real(self, pole: complex) -> Array:
        row = self.limits("time constants", lambda model: nearest_real(poles_of(model), pole.real))[0]
        if self.known is not None and not np.isfinite(row[1]):
            self.notes.append(f"Poles near {pole.real:.4g} nearly coincide: no standard error of the time constant.")
            row[1:] = np.nan
        return row

    def _decay(self, pole: complex, number: str) -> list[Parameter]:
        p, error, low, high = self._real(pole)
        grows, name, dt = p > 1, "time constant", self.model.dt
        if grows and low <= 1:
            return [_parameter(f"pole{number}", (p, error, low, high))]
        if grows:
            name, low, high = "time constant of growth", high, low
            self.notes.append("Time constant of growth: a pole above 1, the model is unstable.")
        ends = [np.nan if np.isnan(end) else 0.0 if end <= 0 else np.inf if end >= 1 and not grows
                else abs(dt / np.log(end)) for end in (low, high)]
        if np.isinf(ends[1]):
            self.notes.append("A time constant without upper end: the record does not tell its pole from 1, the plant "
                              "may integrate.")
        row = abs(dt / np.log(p)), error * dt / (p * np.log(p) ** 2), *ends
        return [_parameter(f"{name}{number}", row, self.time)]

    _growth = _decay

    def _negative(self, pole: complex, number: str) -> list[Parameter]:
        self.notes.append("A negative real pole alternates from sample to sample: it has no time constant.")
        return [_parameter(f"negative pole{number}", self._real(pole))]

    def _pair(self, pole: complex, number: str) -> list[Parameter]:
        dt = self.model.dt

        def quantity(model: Any) -> Array:
            poles = poles_of(model)
            nearest = poles[np.argmin(np.abs(poles - pole))]
            s = np.log(complex(nearest)) / dt if nearest.imag else np.nan
            return np.array([np.abs(s), -np.real(s) / np.abs(s)])

        rows = self.limits("damping", quantity)
        if self.known is not None and not np.isfinite(rows[:, 1]).all():
            self.notes.append(f"The pair of poles at {pole.real:.4g} is nearly real: no standard error of its damping.")
            rows[:, 1:] = np.nan
        unit = {"samples": "sample"}.get(self.time, self.time)
        return [_parameter(f"natural frequency{number}", rows[0], f"rad/{unit}" if unit else "rad"),
                _parameter(f"damping{number}", rows[1])]

    # -- inputs ----------------------------------------------------------------------------------------------------

    def dead_times(self) -> list[Parameter]:
        """Return the dead time of every input of a transfer function: nk - 1 samples."""
        model = self.model
        if model.structure == "ss":
            self.notes.append("Dead time of a state-space model is part of its states.")
        if not hasattr(model, "nk"):
            return []
        direct = [name for name, nk in zip(model.inputs, model.nk) if nk == 0]
        found, with_part = [], self._with_part_of_sample()
        if not with_part.all():
            self.notes.append("Dead time: nk - 1 samples, as given" + (
                f"; with nk = 0 {', '.join(direct)} acts on the same sample." if direct else "."))
        for c, (name, nk) in enumerate(zip(model.inputs, model.nk)):
            if with_part[c]:
                self.notes.append(f"Dead time{self._of(name)}: nk - 1 samples, as given, and the part of a sample that "
                                  "explains the last coefficient of B.")
                row = self.limits("dead time", lambda model, c=c: model.to_continuous().dead_time[[c]])[0]
                found.append(_parameter(f"dead time{self._of(name)}", row, self.time))
                continue
            more = self._insignificant(c)
            if more:
                self.notes.append(f"The first coefficients of B of {name} are not significant ({more}): the dead time "
                                  f"may be up to {self._time(max(nk + more - 1, 0))}.")
            found.append(Parameter(f"dead time{self._of(name)}", max(nk - 1, 0) * model.dt, unit=self.time))
        return found

    def _with_part_of_sample(self) -> Any:
        """Tell for every input (m,) whether its dead time exceeds nk - 1 samples by a part that B determines."""
        model = self.model
        try:
            late = model.to_continuous().dead_time / model.dt
        except StructureError:  # there is no such model
            return np.full(model.m, False)
        return late - np.maximum(np.array(model.nk) - 1, 0) > SAME

    def _insignificant(self, c: int) -> int:
        """Count the first coefficients of B whose intervals contain zero."""
        if self.known is None:
            return 0
        b = self.known.b[c]
        beyond = np.reshape((b.lower > 0) | (b.upper < 0), (len(b.value), -1)).any(axis=1)
        return int(np.argmax(beyond)) if beyond.any() else 0

    def _time(self, samples: int) -> str:
        return f"{samples * self.model.dt:.4g} {self.time}".strip()

    def gains(self) -> list[Parameter]:
        """Return the static gain from every input to every output, or the slopes of a model that integrates."""
        found = []
        integrates = integration(self.model, self.known)
        if integrates:
            self.notes.append(f"{integrates}. The slope is that of the response to a step, for a unit of the input.")
        for c, name in enumerate(self.model.inputs):
            low, high = middle(*self.levels[c])
            if not hasattr(self.model, "static_curve"):
                self.notes.append(f"Static gain at {name} = {sum(self.levels[c]) / 2:g}.")
            elif not self._is_linear(c):
                self.notes.append(f"{'Slope' if integrates else 'Static gain'} between {name} = {low:g} and {high:g}.")
            try:
                found += self._slopes(c, low, high) if integrates else self._gains(c, low, high)
            except StructureError as error:
                self.notes.append(f"No static gain from {name}: {str(error).rstrip('.')}.")
        return found

    def _is_linear(self, c: int) -> bool:
        places = getattr(self.model, "input_of", range(self.model.m))
        own = [f.is_linear for f, place in zip(self.model.nonlinearities, places) if place == c]
        return all(own) and not has_feedback(self.model) and not getattr(self.model, "latent", ())

    def _gains(self, c: int, low: float, high: float) -> list[Parameter]:
        model = self.model
        if hasattr(model, "static_curve"):
            rows = self._quotients(lambda model: np.diff(
                model.static_curve(c, np.array([low, high])), axis=0)[0] / (high - low))
        else:
            rows = self.limits("static gain", lambda model: np.reshape(
                model.static_gain(self._middle()), (model.l, model.m))[:, c])
        return [_parameter(f"static gain{self._of(model.inputs[c], name)}", row,
                           unit_ratio(unit, model.input_units[c]))
                for name, unit, row in zip(model.outputs, model.output_units, rows)]

    def _quotients(self, gains: Callable[[Any], Array]) -> Array:
        """Return the rows of static gains (l,), quotients by A(1), with the intervals of Fieller where they apply."""
        rows = self.limits("static gain", gains)
        fed = has_feedback(self.model) or getattr(self.model, "latent", ())
        if self.known is None or fed or not poles_of(self.model).size or np.isnan(rows).any():
            return rows

        def below(model: Any) -> float:
            return float(np.prod(1 - poles_of(model)).real)

        parts = self.known.of(lambda model: np.append(gains(model) * below(model), below(model)))
        sizes = np.where(parts.error > 0, parts.error, 1.0)
        both = self.known.of(lambda model: gains(model) * below(model) / sizes[:-1] + below(model) / sizes[-1])
        for o, row in enumerate(rows):
            (n, d), (sn, sd) = parts.value[[o, -1]], parts.error[[o, -1]]
            wide = rows[o, 3] - rows[o, 2]
            if not min(row[1], sn, sd) > 0 or abs(row[3] + row[2] - 2 * row[0]) > 1e-6 * wide:
                continue  # bounds by inequalities are not symmetric: theirs stay
            t, covariance = wide / (2 * row[1]), sn * sd * (both.error[o] ** 2 / 2 - 1)
            square, half, rest = d**2 - (t * sd) ** 2, n * d - t**2 * covariance, n**2 - (t * sn) ** 2
            if square <= 0 or half**2 < square * rest:
                row[2:] = -np.inf, np.inf
            else:
                root = np.sqrt(half**2 - square * rest)
                row[2:] = (half - root) / square, (half + root) / square
        return rows

    def _slopes(self, c: int, low: float, high: float) -> list[Parameter]:
        model, count = self.model, slope_samples(self.model)

        def quantity(model: Any) -> Array:
            last = model.impulse_response(count)[-1].reshape(model.l, -1)
            return last @ jumps(model, c, low, high) / (high - low) / model.dt

        unit = f"{model.input_units[c]} {self.time}".strip()
        return [_parameter(f"slope{self._of(model.inputs[c], name)}", row,
                           unit_ratio(y, f"({unit})" if " " in unit else unit))
                for name, y, row in zip(model.outputs, model.output_units, self.limits("slope", quantity))]

    def _middle(self) -> Array:
        return np.array([(low + high) / 2 for low, high in self.levels])

    def _of(self, channel: str, output: str = "") -> str:
        words = [output] if output and self.model.l > 1 else []
        words += [channel] if self.model.m > 1 else []
        return f"[{','.join(words)}]" if words else ""
