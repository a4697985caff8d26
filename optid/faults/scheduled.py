"""Signature of other matrices A(k) and B(k) of the state equation, (1.8) and (1.10).

From the onset on the plant follows other matrices, which are known functions of time. The signature is the difference
between the predictions of the healthy predictor and of one with these matrices that starts from the same state. With
the state x of the healthy predictor it obeys e+ = (A(k) - K C) e + (A(k) - A) x + (B(k) - B) f(u), so that one
recursion gives all onsets. Its magnitude is one where the plant changes as described; the recursion is that of the
whole change, and exact for other magnitudes where B alone changes.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.faults.faults import matrices_of

if TYPE_CHECKING:
    from optid.faults.signatures import Candidate
    from optid.models import HammersteinSS


def change(model: "HammersteinSS", candidate: "Candidate", states: Any, u: Any) -> tuple[Array, Array]:
    """Return the additions of a scheduled change to the state of a sample (N, n, 1), and its A(k) (N, n, n).

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
