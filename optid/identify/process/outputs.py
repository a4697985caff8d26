"""The errors of all outputs, each with the processes of its own inputs: independent but for what constraints tie."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from optid.arrays import Array
from optid.data.channels import Transform
from optid.data.record import Data
from optid.identify.prediction_error.compressed_errors import CompressedErrors
from optid.identify.prediction_error.descent import Criterion
from optid.identify.prediction_error.tangent_fit import Places
from optid.identify.process.errors import ProcessErrors, ProcessUnknowns
from optid.program.compressed import Spread
from optid.statistics.linearised import Linearised, Method
from optid.statistics.unknowns import Unknowns

OF_OUTPUTS = ("offset", "drift")  # parts of the unknowns that belong to an output rather than to a pair


@dataclass(frozen=True)
class OutputUnknowns(Unknowns):
    """The shared unknowns of all outputs one after another, then their initial states, experiment by experiment."""

    each: tuple[ProcessUnknowns, ...]
    innovations: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def experiments(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Number of experiments."""
        return self.each[0].experiments

    @property
    def n(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Size of an initial state of all outputs."""
        return sum(one.n for one in self.each)

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Sizes of the parts, numbered by pairs, or of several outputs by these."""
        found, pairs = dict[str, tuple[int, ...]](), 0
        for o, one in enumerate(self.each):
            for part, shape in one.shapes.items():
                kind = part.rstrip("0123456789")
                number = str(o) * (len(self.each) > 1) if kind == part else str(pairs + int(part[len(kind) :]))
                found[kind + number] = shape
            pairs += len(one.structures)
        return found

    @cached_property
    def states(self) -> list[slice]:
        """Where the states of every output are in an initial state."""
        edges = np.cumsum([0, *(one.n for one in self.each)]).tolist()
        return [slice(a, b) for a, b in zip(edges, edges[1:])]

    @cached_property
    def places(self) -> list[NDArray[np.intp]]:
        """Places in x of the unknowns of every output, in the order of its own."""
        found, first = [], 0
        for one, states in zip(self.each, self.states):
            inner = np.arange(states.start, states.stop) + self.shared
            found.append(np.concatenate([np.arange(first, first + one.shared), *(
                inner + i * self.n for i in range(self.experiments))]).astype(np.intp))
            first += one.shared
        return found


@dataclass(frozen=True, eq=False)
class OutputErrors(Criterion):
    """The simulation errors of all outputs, each in units of its own; one output is that alone.

    Attributes:
        data: the record.
        each: the errors of every output, of the inputs that have a process to it.
    """

    data: Data
    each: tuple[ProcessErrors, ...]
    gauge: ClassVar[str] = "none"  # pyright: ignore[reportIncompatibleVariableOverride]

    @cached_property
    def unknowns(self) -> OutputUnknowns:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The order of x."""
        return OutputUnknowns(tuple(one.unknowns for one in self.each))

    @property
    def weight(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Every output has the weight of its own units."""
        return np.eye(len(self.each))

    @property
    def unit(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What one unit of the sum of squares is in units of the record; of several outputs there is no common one."""
        return self.each[0].unit if len(self.each) == 1 else 1.0

    @cached_property
    def units(self) -> Transform:
        """From the units of the record to those of the errors; an input has the same for every output."""
        size = {name: u for one in self.each for name, u in zip(one.data.inputs, one.units.u_scale)}
        scales, origins = zip(*((one.units.y_scale[0], one.units.y_offset[0]) for one in self.each))
        inputs = self.data.inputs
        return Transform(tuple(size.get(name, 1.0) for name in inputs), (0.0,) * len(inputs), scales, origins)

    @cached_property
    def energy(self) -> float:
        """Sum of squares of the outputs about their means, without the levels of experiments."""
        return sum(one.energy for one in self.each)

    @cached_property
    def energy_of_record(self) -> float:
        """The same with the levels."""
        return sum(one.energy_of_record for one in self.each)

    # -- names -------------------------------------------------------------------------------------------------------

    @cached_property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Output and input of every process."""
        return tuple((o, self.data.inputs.index(name)) for o, one in enumerate(self.each) for name in one.data.inputs)

    def key(self, name: str, number: int) -> str:
        """Name a quantity of a pair, or of an output: ``K[output,input]``; of one output as `ProcessErrors.key`."""
        if len(self.each) == 1:
            return self.each[0].key(name, number)
        if name in OF_OUTPUTS:
            return f"{name}[{self.data.outputs[number]}]"
        o, c = self.pairs[number]
        return f"{name}[{self.data.outputs[o]},{self.data.inputs[c]}]"

    def outer(self, o: int, name: str) -> str:
        """Return the name here of what output o alone calls by a name."""
        if len(self.each) == 1:
            return name
        word, _, channel = name.partition("[")
        if word in OF_OUTPUTS:
            return self.key(word, o)
        return f"{word}[{self.data.outputs[o]},{channel.rstrip(']') or self.each[o].data.inputs[0]}]"

    def of_output(self, o: int, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the variables of output o by the names that it has for them."""
        names = Places.of(self.each[o]).names
        found = {name: values[self.outer(o, name)] for name in names if name != "x0"}
        return {**found, "x0": values["x0"][self.unknowns.states[o]]} if "x0" in names else found

    # -- what programmes need ----------------------------------------------------------------------------------------

    def split(self, x: Array) -> list[Array]:
        """Return the unknowns of every output."""
        return [x[places] for places in self.unknowns.places]

    def join(self, parts: list[Array]) -> Array:
        """Return x of the unknowns of every output."""
        x = np.zeros(self.unknowns.size)
        for places, part in zip(self.unknowns.places, parts):
            x[places] = part
        return x

    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x: the factors of the outputs side by side."""
        found = [one.linearise(part, method) for one, part in zip(self.each, self.split(x))]
        if len(found) == 1:
            return found[0]
        beside: Any = block_diag
        states = tuple((beside(*(s[0] for s in several)), beside(*(s[1] for s in several)),
                        np.concatenate([s[2] for s in several])) for several in zip(*(one.states for one in found)))
        return Linearised(beside(*(one.root for one in found)), np.concatenate([one.pull for one in found]),
                          states, sum(one.remainder for one in found), sum(one.rows for one in found),
                          max(one.condition for one in found),
                          "qr" if all(one.method == "qr" for one in found) else "gram")

    def rows(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return a generator of the rows of experiment i, the outputs of a sample one after the other."""
        readers, u = [one.rows(part) for one, part in zip(self.each, self.split(x))], self.unknowns
        if len(readers) == 1:
            return readers[0]

        def of(i: int) -> Iterator[tuple[Array, int]]:
            blocks = [next(read(i)) for read in readers]
            found, first = np.zeros((len(blocks[0][0]), len(blocks), u.n + u.shared + 1)), u.n
            for o, ((block, _), one, states) in enumerate(zip(blocks, u.each, u.states)):
                found[:, o, states] = block[:, : one.n]
                found[:, o, first : first + one.shared] = block[:, one.n : -1]
                found[:, o, -1] = block[:, -1]
                first += one.shared
            yield found.reshape(-1, found.shape[2]), sum(count for _, count in blocks)

        return of

    def value(self, x: Array) -> float:
        """Return the sum of squared errors at x."""
        return sum(one.value(part) for one, part in zip(self.each, self.split(x)))

    def admissible(self, x: Array) -> bool:
        """Whether the numbers of all outputs are those of processes."""
        return all(one.admissible(part) for one, part in zip(self.each, self.split(x)))

    def compress(self, at: Linearised, reference: Array) -> CompressedErrors:
        """Return the compressed errors near a point."""
        return (CompressedErrors if len(self.each) == 1 else CompressedOutputs)(self, at, reference)


@dataclass(eq=False)
class CompressedOutputs(CompressedErrors):
    """The compressed errors of several outputs, each with a noise of its own size; see `CompressedErrors`."""

    criterion: OutputErrors

    def one_step_fit(self, values: object) -> None:
        """Return nothing: the sum of squares is that of all outputs."""

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter under the noise of all outputs, which may be correlated."""
        found, sizes = self._sandwich(self._noise(z, moves), moves), self.criterion.units.y_scale
        return replace(found, noise=found.noise * np.outer(sizes, sizes))
