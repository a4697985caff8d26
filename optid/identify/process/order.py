"""The type of a process by the Bayesian information criterion, with the runner-up.

A second-order factor stands for two poles, real or complex; where the chosen one has real poles, the type is named and
fitted with these.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.errors import RankError, StructureError
from optid.identify.process.descent import ProcessPoint, search_cells
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.outputs import OutputErrors
from optid.identify.process.starts import best_descents, usual_box
from optid.models.process_dynamics import ProcessStructure

CANDIDATES = ("P1", "P1D", "P2U", "P2DU", "P2DZU", "P3DU", "P0DI", "P1DI")
EVIDENCE = 2.0  # difference of the criterion up to which two types are not distinguishable (Kass and Raftery 1995)
FLOOR = 1e-20  # share of the energy of the output below which errors are rounding


@dataclass(frozen=True, eq=False)
class RankedType:
    """A type that was tried, with its criterion and the point where it is best."""

    structure: ProcessStructure
    criterion: float
    point: ProcessPoint

    @property
    def named(self) -> ProcessStructure:
        """The type, with real poles where the second-order factor has these."""
        names = self.structure.names
        if not self.structure.pair or self.point.x[names.index("zeta")] < 0:
            return self.structure
        return replace(self.structure, real=self.structure.real + 2, pair=False)


def try_type(errors: ProcessErrors, structure: ProcessStructure) -> RankedType:
    """Return a type for all inputs with its Bayesian information criterion."""
    tried = replace(errors, unknowns=replace(errors.unknowns, structures=(structure,) * errors.data.m))
    box = usual_box(tried)
    best = search_cells(tried, best_descents(tried, box)[0], box)
    count = len(errors.y)
    value = max(best.value, FLOOR * errors.energy)
    return RankedType(structure, count * np.log(value / count) + tried.unknowns.size * np.log(count), best)


def choose_types(errors: OutputErrors) -> tuple[OutputErrors, dict[str, Any]]:
    """Return the errors with the types that the criterion chooses for every output, and what it says of runners-up.

    `RankError` as of `choose_type`.
    """
    each, words = zip(*(choose_type(one) for one in errors.each))
    said = words[0] if len(words) == 1 else "; ".join(
        f"{output}: {word}" for output, word in zip(errors.data.outputs, words))
    return replace(errors, each=each), {"process type": said}


def choose_type(errors: ProcessErrors) -> tuple[ProcessErrors, str]:
    """Return the errors of an output with the type that the criterion chooses, and what it says of the runner-up.

    Raises:
        RankError: too few samples for the smallest type and its runner-up.
    """
    found, reasons = list[RankedType](), list[str]()
    for word in CANDIDATES:
        structure = ProcessStructure.read(word)
        if len(errors.y) < 2 * (len(structure.names) * errors.data.m + errors.unknowns.size):
            continue
        try:
            found.append(try_type(errors, structure))
        except (StructureError, np.linalg.LinAlgError) as error:
            reasons.append(f"{word}: {error}")
    if len(found) < 2:
        raise RankError(f"{len(errors.y)} output samples are too few to compare process types"
                        f"{'; '.join(['', *reasons])}: name one (process='P1D')")
    found.sort(key=lambda one: one.criterion)
    best, second = found[:2]
    behind = second.criterion - best.criterion
    word = (f"not distinguishable from {second.named.word}" if behind < EVIDENCE else f"runner-up {second.named.word}")
    chosen = replace(errors, unknowns=replace(errors.unknowns, structures=(best.named,) * errors.data.m))
    return chosen, f"{best.named.word} by BIC, {word}, {behind:.1f} behind"
