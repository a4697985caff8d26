"""Constraints of fits with several outputs: read for every output by itself, or for the one that they name."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from typing import Any

from optid.errors import StructureError
from optid.identify.process.errors import ProcessErrors
from optid.program.view import View


def for_outputs(errors: ProcessErrors, constraints: Sequence[Any]) -> Iterator[Any]:
    """Yield constraints so that each is about one output: recorded rules about the one they name, or every one.

    Others, such as functions of the user, see the quantities of all pairs: ``view["K[level,valve]"]``.

    Raises:
        StructureError: a rule that takes ``output`` and names none, or an unknown one.
    """
    names = errors.data.outputs
    for rule in constraints:
        call = getattr(rule, "call", None)
        if len(names) == 1 or call is None:
            yield rule
            continue
        known = signature(getattr(import_module(call[0]), call[1]))
        given = known.bind(*call[2], **call[3]).arguments
        if "output" in known.parameters and given.get("output") not in names:
            wrong = f"names no output {given['output']!r}" if given.get("output") else "needs output="
            raise StructureError(f"constraint {rule.name!r} {wrong}; the outputs are {', '.join(names)}")
        for o, name in enumerate(names):
            inputs = [errors.data.inputs[c] for output, c in errors.unknowns.pairs if output == o]
            idle = "output" not in given and given.get("channel") in set(errors.data.inputs) - set(inputs)
            if given.get("output", name) == name and not idle:
                yield OfOutput(rule, errors, o, rule.name if "output" in given else f"{rule.name} of {name}")


@dataclass(frozen=True, eq=False)
class OfOutput:
    """A rule about one of several outputs, under a name of its own."""

    rule: Any
    errors: ProcessErrors
    output: int
    name: str

    def __call__(self, view: View) -> dict[str, Any]:
        """Build the rule in the quantities of the output, named as if it were the only one."""
        data, pairs = self.errors.data, self.errors.unknowns.pairs
        inputs = tuple(data.inputs[c] for o, c in pairs if o == self.output)
        bases = {data.inputs[c]: basis for c, basis in enumerate(self.errors.outer_bases)}
        own = {}
        for one in inputs:
            ending = f"[{data.outputs[self.output]},{one}]"
            own |= {name.removesuffix(ending) + f"[{one}]" * (len(inputs) > 1): name for name in view.inner
                    if name.endswith(ending)}
        inner = {name: view.inner[whole] for name, whole in own.items()}
        inner["offset"] = view.inner["offset"][self.output : self.output + 1]
        part = view.part(inner, iterate=view.iterate, channels=inputs, outputs=(data.outputs[self.output],),
                         reference=Renamed(view.reference, own), bases={one: bases[one] for one in inputs})
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
