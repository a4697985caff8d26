"""Constraints of fits with several outputs: read for every output by itself, or for the one that they name."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from typing import Any

from optid.errors import StructureError
from optid.identify.process.outputs import OF_OUTPUTS, OutputErrors
from optid.program.view import View


def for_outputs(errors: OutputErrors, constraints: Sequence[Any]) -> Iterator[Any]:
    """Yield constraints so that each is about one output: recorded rules about the one they name, or every one.

    Others, such as functions of the user, see the quantities of all pairs: ``view["K[level,valve]"]``.

    Raises:
        StructureError: a rule that takes ``output`` and names none, or an unknown one.
    """
    for rule in constraints:
        call = getattr(rule, "call", None)
        if len(errors.each) == 1 or call is None:
            yield rule
            continue
        names, known = errors.data.outputs, signature(getattr(import_module(call[0]), call[1]))
        given = known.bind(*call[2], **call[3]).arguments
        if "output" in known.parameters and given.get("output") not in names:
            wrong = f"names no output {given['output']!r}" if given.get("output") else "needs output="
            raise StructureError(f"constraint {rule.name!r} {wrong}; the outputs are {', '.join(names)}")
        for o, one in enumerate(errors.each):
            if given.get("output", names[o]) == names[o] and not (
                    "output" not in given and given.get("channel") in set(errors.data.inputs) - set(one.data.inputs)):
                yield OfOutput(rule, errors, o, rule.name if "output" in given else f"{rule.name} of {names[o]}")


@dataclass(frozen=True, eq=False)
class OfOutput:
    """A rule about one of several outputs, under a name of its own."""

    rule: Any
    errors: OutputErrors
    output: int
    name: str

    def __call__(self, view: View) -> dict[str, Any]:
        """Build the rule in the quantities of the output."""
        one, outer = self.errors.each[self.output], self.errors.outer
        words = {name.partition("[")[0] for name in view.inner} - {"x0"}
        channels = ("",) if len(one.data.inputs) == 1 else [f"[{name}]" for name in one.data.inputs]
        names = [*OF_OUTPUTS, *(word + channel for word in words - set(OF_OUTPUTS) for channel in channels)]
        there = {name: outer(self.output, name) for name in names}
        own = {name: whole for name, whole in there.items() if whole in view.inner}
        part = view.part({name: view.inner[whole] for name, whole in own.items()}, iterate=view.iterate,
                         channels=one.data.inputs, outputs=one.data.outputs, reference=Renamed(view.reference, own),
                         bases=dict(zip(one.data.inputs, one.outer_bases)))
        return {self.name: self.rule.build(part)}


class Renamed(Mapping[str, Any]):
    """Values under other names."""

    def __init__(self, values: Mapping[str, Any], names: Mapping[str, str]) -> None:
        self._values, self._names = values, {name: there for name, there in names.items() if there in values.keys()}

    def __getitem__(self, name: str) -> Any:
        return self._values[self._names[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)
