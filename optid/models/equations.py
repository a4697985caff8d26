"""Equations of a plant as its user writes them: once, in CVXPY atoms, with named states and parameters."""

import runpy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from optid.arrays import one_of
from optid.errors import LookupFailed, StructureError, nearest

Bounds = tuple[float | None, float | None]

RESERVED = ("x0", "residual")
TIMES, HOLDS = ("continuous", "discrete"), ("zero", "first")


@dataclass(frozen=True, eq=False)
class Equations:
    """State and output equations with named states and parameters.

    Attributes:
        right: a function of v, in which ``v["name"]`` is a state, an input or a parameter, that returns a dictionary:
            for every state its derivative (its next value in discrete time), for every output of the record its
            value. It is called with numbers at one instant and with whole courses, so it works entry by entry
            (``cp.multiply``, not ``@``).
        states: {name: value from which the search starts}.
        parameters: {name: value from which the search starts}.
        bounds: {state or parameter: (low, high)}, None where open. Bounds of states keep roots and logarithms defined.
        time: "continuous" or "discrete".
        hold: what an input does between its samples, "zero" (stays) or "first" (straight lines).
        step: step of the trapezoidal rule in units of time, the sampling time divided by an integer; None for the
            sampling time itself.

    Raises:
        StructureError: names that are not there or occur twice, starts outside their bounds, unknown words.
    """

    right: Callable[[Mapping[str, Any]], Mapping[str, Any]]
    states: Mapping[str, float]
    parameters: Mapping[str, float]
    bounds: Mapping[str, Bounds] = field(default_factory=dict)
    time: str = "continuous"
    hold: str = "zero"
    step: float | None = None

    def __post_init__(self) -> None:
        if not callable(self.right):
            raise StructureError(f"the equations are a {type(self.right).__name__}, not a function of v")
        if not self.states or not self.parameters:
            raise StructureError("equations need at least one state and one parameter, each with a start: "
                                 'states={"h": 1.0}, parameters={"k": 0.5}')
        values = {**self.states, **self.parameters}
        if twice := sorted({*self.states} & {*self.parameters}):
            raise StructureError(f"{twice[0]!r} is both a state and a parameter: give one of them another name")
        for name, value in values.items():
            if name in RESERVED:
                raise StructureError(f"{name!r} is a name of the formulation: take another one")
            if np.ndim(value) or not np.isfinite(value):
                raise StructureError(f"the start of {name!r} is {value!r}: it must be a finite number")
        for name, given in self.bounds.items():
            if name not in values:
                raise StructureError(f"bounds of {name!r}, which is neither a state nor a parameter. "
                                     f"{nearest(name, values)}")
            low, high = self.interval(name)
            if not low <= values[name] <= high or not low < high:
                raise StructureError(f"{name!r} starts at {values[name]:g}, outside its bounds {tuple(given)}")
        one_of("time", self.time, TIMES)
        one_of("hold", self.hold, HOLDS)

    def interval(self, name: str) -> tuple[float, float]:
        """Return the bounds of a state or parameter as numbers, infinite where open."""
        low, high = self.bounds.get(name, (None, None))
        return -np.inf if low is None else float(low), np.inf if high is None else float(high)

    def substeps(self, dt: float) -> int:
        """Return the steps of integration in a sampling time; refuse one that does not divide it (`StructureError`)."""
        if self.step is None:
            return 1
        count = dt / self.step if self.step > 0 else 0.0
        if self.time == "discrete" or count < 0.5 or abs(count - round(count)) > 1e-6 * count:
            raise StructureError(f"step={self.step!r}: the sampling time {dt:g} divided by an integer, in continuous "
                                 "time")
        return round(count)

    def evaluate(self, v: Mapping[str, Any], outputs: tuple[str, ...]) -> dict[str, Any]:
        """Return the values of states and outputs; refuse unknown or missing names (`StructureError`)."""
        found = self.right(_Named(v))
        if not isinstance(found, Mapping):
            raise StructureError(f"the equations return a {type(found).__name__}; return a dictionary of "
                                 f"{', '.join([*self.states, *outputs])}")
        wanted = (*self.states, *outputs)
        for name in (name for name in wanted if name not in found):
            raise StructureError(f"the equations return nothing for {name!r}; they return {', '.join(found)}")
        for name in (name for name in found if name not in wanted):
            raise StructureError(f"the equations return {name!r}, which is neither a state nor an output of the "
                                 f"record. {nearest(name, wanted)}")
        return {name: found[name] for name in wanted}


class _Named(dict[str, Any]):
    def __missing__(self, name: str) -> Any:
        raise StructureError(f"the equations ask for {name!r}, which is no state, parameter or input. "
                             f"{nearest(name, self)}")


def equations(given: Any) -> Equations:
    """Return equations, or those that a word names: "file.py:name" or "package.module:name".

    Raises:
        LookupFailed: there is no such file, module or name.
        StructureError: what stands there are no `Equations`.
    """
    found = given
    if isinstance(given, str):
        place, _, name = given.rpartition(":")
        try:
            content = runpy.run_path(place) if place.endswith(".py") else vars(import_module(place or name))
        except (FileNotFoundError, ImportError, ValueError) as error:
            raise LookupFailed(f"no equations at {given!r} ({error}): write them as plant.py:name") from error
        if name not in content:
            raise LookupFailed(f"{Path(place).name} has no {name!r}. {nearest(name, content)}")
        found = content[name]
    if not isinstance(found, Equations):
        raise StructureError(f"equations={given!r} is a {type(found).__name__}, not optid.Equations")
    return found
