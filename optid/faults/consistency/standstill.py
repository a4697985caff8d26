"""Sensors that repeat one reading to the bit: a finding that needs no statistics."""

from typing import NamedTuple

import numpy as np

from optid.data.record import Data
from optid.faults.diagnosis.answers import Estimate
from optid.faults.diagnosis.records import Flattened
from optid.faults.signatures import Candidate, Dictionary


class Frozen(NamedTuple):
    """What stands still.

    Attributes:
        faults: one for each sensor, at its longest run.
        count: readings of the longest run of all.
    """

    faults: tuple[Estimate, ...]
    count: int


def frozen(still: Flattened, record: Data, found: Dictionary, edge: int) -> Frozen:
    """Return the sensors that stand still.

    The first of the equal readings may be the last true one: the fault begins with the second.

    Args:
        still: what was found.
        record: the record.
        found: the dictionary; a sensor that it does not know as frozen is named as well.
        edge: a run that begins nearer to the start of the record may have begun before it.
    """
    longest = {}
    for line in still.lines:
        if line.name not in longest or line.count > longest[line.name].count:
            longest[line.name] = line
    faults = []
    for name, line in longest.items():
        o = record.outputs.index(name.partition(":")[2])
        known = [c for c in found.candidates if c.kind == "frozen" and name in c.places]
        candidate = known[0] if known else Candidate(
            name, "frozen", np.zeros((found.model.nx, 1)), np.eye(found.model.l)[:, [o]],
            members=(f"{name} frozen",), places=(name,),
        )
        onset = line.first + 1
        censored = line.first < edge
        value = np.array([line.value])
        faults.append(Estimate(
            candidate.label, name, "frozen", candidate, onset, (0 if censored else onset, onset), censored, value,
            np.stack([value, value], axis=1), np.zeros((1, 1)), float("inf"),
        ))
    count = max((line.count for line in longest.values()), default=0)
    return Frozen(tuple(sorted(faults, key=lambda fault: fault.onset)), count)
