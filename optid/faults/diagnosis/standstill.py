"""Sensors that repeat one reading to the bit: a finding that needs no statistics."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optid.data.record import Data, Experiment
from optid.faults.diagnosis.answers import Estimate
from optid.faults.screening import FlatLine, flat_lines
from optid.faults.signatures import Dictionary, candidate_of


def without_flat_lines(record: Data, number: int) -> tuple[Experiment, tuple[FlatLine, ...]]:
    """Take readings of experiment `number` (from 0) out that are identical to the bit from the second on.

    The first of them may be the last true one.
    """
    part = record.experiments[number]
    lines, y = tuple(line for line in flat_lines(record) if line.experiment == number), np.array(part.y)
    for line in lines:
        y[line.first + 1 : line.first + line.count, record.outputs.index(line.name.partition(":")[2])] = np.nan
    return replace(part, y=y) if lines else part, lines


def frozen(lines: Sequence[FlatLine], found: Dictionary, edge: int) -> tuple[Estimate, ...]:
    """Return the sensors that stand still, each at its longest run, as known to the dictionary or not.

    The first of the equal readings may be the last true one: the fault begins with the second. A run that begins nearer
    to the start of the record than `edge` may have begun before it.
    """
    longest = {line.name: line for line in sorted(lines, key=lambda line: line.count)}
    faults = []
    for name, line in longest.items():
        known = [c for c in found.candidates if c.kind == "frozen" and name in c.places]
        candidate = known[0] if known else candidate_of(found.model, name, "frozen")
        onset, censored, value = line.first + 1, line.first < edge, np.array([line.value])
        faults.append(Estimate(
            candidate.label, name, "frozen", candidate, onset, (0 if censored else onset, onset), censored, value,
            np.stack([value, value], axis=1), np.zeros((1, 1)), float("inf"),
        ))
    return tuple(sorted(faults, key=lambda fault: fault.onset))
