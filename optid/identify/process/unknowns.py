"""The unknowns of processes as one vector: of every pair of an output and an input, of outputs, and of experiments."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from optid.models.process_dynamics import ProcessStructure
from optid.statistics.unknowns import Unknowns


@dataclass(frozen=True)
class ProcessUnknowns(Unknowns):
    """[dynamics0; mu0; dynamics1; mu1; ...; offset; drift; x0]: of every pair the numbers of its process, then mu.

    Levels and drifts have an entry per output; an initial state has the sections of all processes, then levels.
    """

    pairs: tuple[tuple[int, int], ...]  # output and input of every process, output by output
    structures: tuple[ProcessStructure, ...]
    sizes: tuple[int, ...]  # number of coefficients of every f
    experiments: int
    constant: bool = True  # whether an output has one level
    drift: bool = False  # whether the levels move along straight lines
    free: bool = False  # whether every experiment begins with its own motion
    levels: bool = False  # whether every experiment has its own levels
    innovations: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def outputs(self) -> int:
        """Number of outputs, each with one process at least."""
        return self.pairs[-1][0] + 1

    @cached_property
    def sections(self) -> list[slice]:
        """Where the sections of every process are in an initial state."""
        edges = np.cumsum([0, *(self.free * one.order for one in self.structures)]).tolist()
        return [slice(a, b) for a, b in zip(edges, edges[1:])]

    @property
    def n(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Size of an initial state."""
        return self.sections[-1].stop + self.levels * self.outputs

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Sizes of the parts."""
        found: dict[str, tuple[int, ...]] = {}
        for p, (structure, size) in enumerate(zip(self.structures, self.sizes)):
            found |= {f"dynamics{p}": (len(structure.names),), f"mu{p}": (size,)}
        return found | {"offset": (self.constant * self.outputs,), "drift": (self.drift * self.outputs,)}

    @cached_property
    def dynamic(self) -> NDArray[np.intp]:
        """Places in x of the numbers of all processes, in which the errors are nonlinear."""
        every = np.arange(self.size)
        return np.concatenate([every[self.slices[f"dynamics{p}"]] for p in range(len(self.pairs))])

    @cached_property
    def linear(self) -> NDArray[np.intp]:
        """Places in x of everything else, in which they are linear."""
        return np.setdiff1d(np.arange(self.size), self.dynamic)

    @cached_property
    def numbers(self) -> tuple[tuple[int, str], ...]:
        """Pair and name of the numbers of all processes."""
        return tuple((p, name) for p, one in enumerate(self.structures) for name in one.names)

    @cached_property
    def logarithmic(self) -> NDArray[np.bool_]:
        """Which of these numbers are logarithms."""
        return np.concatenate([one.logarithmic for one in self.structures])

    @cached_property
    def delays(self) -> dict[int, int]:
        """Where the dead time of every pair that has one is among these numbers."""
        return {p: place for place, (p, name) in enumerate(self.numbers) if name == "dead_time"}

    def of_output(self, o: int) -> tuple["ProcessUnknowns", NDArray[np.intp]]:
        """Return the unknowns of an output alone, and their places in x."""
        kept, every = [p for p, (output, _) in enumerate(self.pairs) if output == o], np.arange(self.size)
        states = [np.arange(self.n)[self.sections[p]] for p in kept]
        states += [np.arange(self.n)[self.n - self.outputs :][o : o + 1]] * self.levels
        own = np.concatenate(states).astype(np.intp)
        shared = [every[self.slices[f"{part}{p}"]] for p in kept for part in ("dynamics", "mu")]
        shared += [every[self.slices[part]][o : o + 1] for part in ("offset", "drift")]
        alone = replace(self, pairs=tuple((0, self.pairs[p][1]) for p in kept),
                        structures=tuple(self.structures[p] for p in kept), sizes=tuple(self.sizes[p] for p in kept))
        return alone, np.concatenate([*shared, *(self.shared + i * self.n + own for i in range(self.experiments))])
