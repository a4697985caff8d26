"""A request of a page: a record as it is prepared, a formulation with its arguments, constraints drawn by hand."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.registry import CONSTRAINTS, FORMULATIONS, entry_point, named_constraint

BAND = "step_band"
"""The constraint that is linearised at a model with past outputs."""

PASSES = 3
"""Fits under a band, each linearised at the model of the previous fit."""


@dataclass(frozen=True)
class ChosenConstraint:
    """A named constraint: the word of its function, its arguments, and the name under which its price is shown."""

    word: str
    arguments: Mapping[str, Any]
    name: str

    def rule(self, **more: Any) -> Any:
        """Build it."""
        try:
            return entry_point(CONSTRAINTS, self.word).load()(**self.arguments, **more).with_name(self.name)
        except TypeError as error:
            raise StructureError(f"constraint {self.word!r}: {error}") from None


@dataclass(frozen=True)
class Request:
    """One state of the page."""

    inputs: tuple[str, ...]  # names of the inputs
    outputs: tuple[str, ...]  # names of the outputs
    window: tuple[int, int]  # first sample and the one after the last
    formulation: str  # its name
    arguments: Mapping[str, Any]  # of the formulation
    constraints: tuple[ChosenConstraint, ...] = ()  # set by hand
    draft: bool = False  # whether it is part of a drag: one pass for bands of the step response is then enough
    detrended: bool = False  # whether a drift of the outputs is removed; constraints stay in the units of the record
    dt: float | None = None  # sampling time onto which the record is brought; its own if None

    @classmethod
    def parse(cls, state: Any, draft: bool = False) -> "Request":
        """Read a state as the page sends it, a `draft` during a drag; anything else is a `DataError`."""
        try:
            constraints = tuple(ChosenConstraint(str(c["word"]), dict(c["arguments"]), str(c["name"]))
                                for c in state["constraints"])
            first, last = map(int, state["window"])
            for key in [*state["arguments"], *(key for c in constraints for key in c.arguments)]:
                if not key.isidentifier():
                    raise ValueError(f"{key!r} is not the name of an argument")
            arguments = {str(key): value for key, value in state["arguments"].items() if value not in (None, "", [])}
            dt = None if state.get("dt") is None else float(state["dt"])
            found = cls(tuple(map(str, state["inputs"])), tuple(map(str, state["outputs"])), (first, last),
                        str(state["formulation"]), arguments, constraints, draft, bool(state.get("detrended")), dt)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DataError(f"the page sent a state that cannot be read ({type(error).__name__}: {error})") from None
        entry_point(FORMULATIONS, found.formulation)
        return found

    @property
    def key(self) -> str:
        """A text that is equal for states with the same fit."""
        constraints = [(c.word, dict(c.arguments), c.name) for c in self.constraints]
        return json.dumps([self.preparation, self.formulation, dict(self.arguments), constraints,
                           self.draft and BAND in [c.word for c in self.constraints]], sort_keys=True)

    @property
    def preparation(self) -> tuple[Any, ...]:
        """Channels, window and changes of the samples, equal for requests with the same record."""
        return self.inputs, self.outputs, self.window, self.detrended, self.dt

    def record(self, data: Data) -> Data:
        """Return the channels and the window of a record, detrended and resampled as chosen."""
        if not self.inputs or not self.outputs:
            raise DataError("choose at least one input and one output")
        chosen = data.select(inputs=list(self.inputs), outputs=list(self.outputs))
        chosen = chosen if self.whole(data) else chosen.window(*self.window)
        chosen = chosen.detrend(order=1).raw() if self.detrended else chosen
        return chosen if self.dt is None else chosen.resample(self.dt)

    def whole(self, data: Data) -> bool:
        """Whether the window is the whole record: with several experiments, the whole shortest one."""
        return self.window == (0, shortest(data))

    def fit(self, data: Data, begun: Callable[["Request"], Any] | None = None) -> Any:
        """Fit the record; with a band on the step response by repeated fits, each linearised at the previous model.

        `begun` returns the first fit, that of the same request without bands, if it may be known.
        """
        from optid.identify.fitting import fit

        record, rules = self.record(data), [c.rule() for c in self.constraints if c.word != BAND]
        bands = [c for c in self.constraints if c.word == BAND]
        if not (bands and self.arguments.get("na", 0)):
            rules += [c.rule() for c in bands]
            return fit(record, self.formulation, constraints=rules, **self.arguments)
        free = replace(self, constraints=tuple(c for c in self.constraints if c.word != BAND))
        found = free.fit(data) if begun is None else begun(free)
        for _ in range(1 if self.draft else PASSES):
            around = [c.rule(around=found.model) for c in bands]
            found = fit(record, self.formulation, constraints=[*rules, *around], **self.arguments)
        return found


def shortest(data: Data) -> int:
    """Return the number of samples of the shortest experiment."""
    return min(e.n_samples for e in data.experiments)


def suggest_state(data: Data, suggestion: Mapping[str, Any]) -> dict[str, Any]:
    """Return the initial state of a page: that of a built-in example, or small orders for any record.

    The suggestion is arguments of a fit, with constraints as words.
    """
    orders = {"na": 2, "nb": 2, "nk": 0, "basis": "triangular:8"}
    arguments = {key: suggestion.get(key, value) for key, value in orders.items()}
    constraints = []
    for text in suggestion.get("constraints", ()):
        rule = named_constraint(text)
        constraints.append({"word": text.partition(":")[0], "name": rule.name, "arguments": bound(rule.call)})
    return {"inputs": list(data.inputs), "outputs": list(data.outputs), "window": [0, shortest(data)],
            "formulation": suggestion.get("formulation_name", "hammerstein_arx.exact"), "arguments": arguments,
            "constraints": constraints}


def bound(call: tuple[str, str, tuple[Any, ...], Mapping[str, Any]]) -> dict[str, Any]:
    """Return the arguments of a recorded call by name."""
    import inspect
    from importlib import import_module

    module, function, args, kwargs = call
    return dict(inspect.signature(getattr(import_module(module), function)).bind(*args, **kwargs).arguments)
