"""Other matrices A(k) and B(k) of the state equation as a candidate, (1.8) and (1.10).

From the onset on the plant follows other matrices, whose course is known. Two predictors are compared, the healthy one
and one with these matrices that starts from the same state at the onset: the difference of their predictions is the
signature. With the state x of the healthy predictor it obeys e+ = (A(k) - K C) e + (A(k) - A) x + (B(k) - B) f(u), so
that all onsets come from one recursion. Its magnitude is one where the plant changes as described; the recursion is
that of the whole change, and exact for other magnitudes where B alone changes.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.faults import Fault, matrices_of

if TYPE_CHECKING:
    from optid.faults.signatures import Candidate, Dictionary
    from optid.models import HammersteinSS


def with_schedules(found: "Dictionary", schedules: Mapping[str, Fault]) -> "Dictionary":
    """Return the dictionary with known changes of A and B as further candidates, "process:<name> schedule".

    Sample k of their matrices is sample k of the window; the onset of a schedule is not read: all are searched.

    Raises:
        StructureError: another kind of fault, a name that is there already.
    """
    from optid.faults.signatures import Candidate

    n, l, more = found.model.nx, found.model.l, []  # noqa: E741
    for name, fault in schedules.items():
        if fault.kind != "schedule":
            raise StructureError(f"{name}: a fault of kind {fault.kind!r}; Fault.schedule(A=, B=) is needed.")
        new = Candidate(f"process:{name}", "schedule", np.zeros((n, 1)), np.zeros((l, 1)), schedule=fault)
        new = replace(new, members=(new.own_label,), places=(new.name,))
        if new.label in (*found.labels, *(c.label for c in more)):
            raise StructureError(f"{new.label} is in the dictionary already.")
        more.append(new)
    return found.with_candidates(more)


def change(model: "HammersteinSS", candidate: "Candidate", states: Array, u: Array) -> tuple[Array, Array]:
    """Return what a scheduled change adds to the state of a sample (N, n, 1), and its A(k) (N, n, n).

    Args:
        model: the healthy model.
        candidate: with its schedule.
        states: (N, n) of the healthy predictor.
        u: (N, m) inputs.

    Raises:
        StructureError: matrices of another shape, or not finite.
    """
    fault, count = candidate.schedule, len(u)
    assert fault is not None
    A, B = (matrices_of(candidate.label, word, given, range(count), healthy, count)
            for word, given, healthy in (("A", fault.A, model.A), ("B", fault.B, model.B)))
    step = np.einsum("kij,kj->ki", A - model.A, states) + np.einsum("kij,kj->ki", B - model.B, model.expanded(u))
    added = np.zeros((count, model.nx, 1))
    added[1:, :, 0] = step[:-1]
    return added, A
