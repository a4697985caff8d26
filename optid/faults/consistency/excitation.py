"""Whether the input of a record moves what is suspected: without that there is no verdict on a loss."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from optid.faults.search.scanning import Scan

LEAST = 4.0
"""Deflection that a complete loss must have beside a constant offset, for its record to say anything."""


def untestable(found: "Scan") -> dict[str, str]:
    """Return the candidates that a record can say nothing about, and why.

    A loss shows as a lack of movement. Where the input stands still, a loss is an offset of the actuator, and where the
    function of it is zero, it is nothing. So the whole record is asked how large a complete loss would be beside a
    constant offset of the same actuator.

    Args:
        found: the search of the record.
    """
    result = {}
    for c, candidate in enumerate(found.dictionary.candidates):
        if candidate.columns and found.u is not None:
            as_stuck, white = replace(candidate, kind="stuck"), found.whitened
            into_state, into_output = found.dictionary.additions(as_stuck, len(white.r), 0, found.u)
            trace = white.seen(white.predictor.respond(into_state, into_output, white.present))
            flat = trace.reshape(-1, trace.shape[2])
            beside = flat[:, 1:]
            rest = flat[:, 0] - beside @ np.linalg.lstsq(beside, flat[:, 0], rcond=1e-9)[0]
            deflection = round(float(np.linalg.norm(rest)), 6)
            if deflection < LEAST:
                value = float(np.linalg.eigvalsh(flat.T @ flat)[0])
                result[candidate.label] = (
                    f"no excitation: a complete loss would have a deflection of {deflection:.2g} beside a constant "
                    f"offset, {LEAST:g} is needed (smallest Gram eigenvalue {max(value, 0.0):.2g})"
                )
        elif candidate.kind not in ("frozen", "noise", "loss") and np.isnan(found.statistic[c]).all():
            result[candidate.label] = "nothing of it is seen in this record"
    return result
