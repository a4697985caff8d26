"""The type of a process by the Bayesian information criterion, with the runner-up.

A second-order factor stands for two poles, real or complex; where the chosen one has real poles, the type is named and
fitted with these.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optid.errors import RankError, StructureError
from optid.identify.process.descent import search_cells
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.starts import best_descents, usual_box
from optid.models.process_dynamics import ProcessStructure

CANDIDATES = ("P1", "P1D", "P2U", "P2DU", "P2DZU", "P3DU", "P0DI", "P1DI")
GENERAL = ProcessStructure.read("P2DU")  # the type beside which bases are compared
EVIDENCE = 2.0  # difference of the criterion up to which two types are not distinguishable (Kass and Raftery 1995)
FLOOR = 1e-20  # share of the energy of the output below which errors are rounding


def try_type(errors: ProcessErrors, structure: ProcessStructure) -> tuple[float, ProcessStructure]:
    """Return the Bayesian information criterion of a type for all inputs, and the type with real poles if it has any.

    Where there are several inputs the poles of the first one decide.
    """
    u = errors.unknowns
    tried = replace(errors, unknowns=replace(u, structures=(structure,) * len(u.pairs)))
    box, count = usual_box(tried), len(errors.y)
    best = search_cells(best_descents(tried, box)[0], box)
    criterion = count * np.log(max(best.value, FLOOR * errors.energy) / count) + len(best.x) * np.log(count)
    if structure.pair and best.numbers[structure.names.index("zeta")] >= 0:
        structure = replace(structure, real=structure.real + 2, pair=False)
    return criterion, structure


def best_basis(several: Sequence[ProcessErrors]) -> int:
    """Return which of the errors with different bases has the least criterion beside two poles with dead time.

    A basis comes before a type: dynamics would be bent to explain what a coarse static curve leaves.
    """
    def criterion(errors: ProcessErrors) -> float:
        if len(errors.y) < 2 * (errors.unknowns.size + len(GENERAL.names) * len(errors.unknowns.pairs)):
            return np.inf
        return sum(try_type(one, GENERAL)[0] for one in errors.each)

    return int(np.argmin([criterion(one) for one in several])) if len(several) > 1 else 0


def choose_types(errors: ProcessErrors) -> tuple[ProcessErrors, str]:
    """Return the errors with the types that the criterion chooses for every output, and what it says of runners-up.

    `RankError` as of `choose_type`.
    """
    found = [choose_type(one) for one in errors.each]
    structures = tuple(found[o][0] for o, _ in errors.unknowns.pairs)
    said = [f"{f'{output}: ' * (len(found) > 1)}{word}" for output, (_, word) in zip(errors.data.outputs, found)]
    return replace(errors, unknowns=replace(errors.unknowns, structures=structures)), "; ".join(said)


def choose_type(errors: ProcessErrors) -> tuple[ProcessStructure, str]:
    """Return the type that the criterion chooses for an output, and what it says of the runner-up.

    Raises:
        RankError: too few samples for the smallest type and its runner-up.
    """
    found, reasons = list[tuple[float, ProcessStructure]](), list[str]()
    for structure in map(ProcessStructure.read, CANDIDATES):
        if len(errors.y) < 2 * (len(structure.names) * errors.data.m + errors.unknowns.size):
            continue
        try:
            found.append(try_type(errors, structure))
        except (StructureError, np.linalg.LinAlgError) as error:
            reasons.append(f"{structure.word}: {error}")
    if len(found) < 2:
        raise RankError(f"{len(errors.y)} output samples are too few to compare process types"
                        f"{'; '.join(['', *reasons])}: name one (process='P1D')")
    (least, best), (other, second) = sorted(found, key=lambda one: one[0])[:2]
    runner_up = f"{'not distinguishable from' if other - least < EVIDENCE else 'runner-up'} {second.word}"
    return best, f"{best.word} by BIC, {runner_up}, {other - least:.1f} behind"
