"""A record as the errors of processes need it: its instants, its units, and what it cannot tell refused by name."""

from typing import Any

import numpy as np

from optid.arrays import one_of
from optid.bases import Linear, fitted_bases
from optid.data.channels import Transform
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import DataError, StructureError
from optid.identify.arguments import check_offset, outputs_in_memory
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.unknowns import ProcessUnknowns
from optid.models.equations import HOLDS
from optid.models.process_dynamics import read_structures
from optid.program.units import in_units, inner_bases, own_units

INITIAL = ("rest", "free")
SHORTEST = 8  # samples of a stretch between missing inputs that is used


def process_errors(data: Data, process: Any, basis: Any, hold: str = "zero", offset: Any = True, drift: Any = False,
                   initial: str = "rest") -> ProcessErrors:
    """Check the arguments of a fit, and return its errors on the record in units of their own.

    Arguments and errors as of `formulations.process.process`.
    """
    one_of("hold", hold, HOLDS)
    one_of("initial", initial, INITIAL)
    if not isinstance(drift, bool | np.bool_):
        raise StructureError(f"drift must be True or False; got {drift!r}")
    data = outputs_in_memory(data, "simulation errors")
    rows = read_structures(process, data.inputs, data.outputs)
    free = initial == "free"
    if any(np.isnan(e.u).any() for e in data.experiments):
        data, free = with_whole_inputs(data, SHORTEST), True  # no stretch but the first may begin at rest
    instants = tuple(np.arange(float(e.n_samples)) if e.stamps is None else e.stamps / data.dt
                     for e in data.experiments)
    refuse_still_inputs(data)
    bases, constants = fitted_bases(data, basis), check_offset(offset, data)
    lines = [isinstance(one, Linear) for one in bases]
    if hold == "first" and not all(lines):
        raise StructureError("hold='first' is exact for straight static curves only: use hold='zero' with a basis")
    own = [own_units(data.select(outputs=name), lines, bool(constants)) for name in data.outputs]
    units = Transform(own[0].u_scale, (0.0,) * data.m, tuple(one.y_scale[0] for one in own),
                      tuple(one.y_offset[0] for one in own))
    inner = tuple(inner_bases(bases, units))
    there = [(o, c, one) for o, row in enumerate(rows) for c, one in enumerate(row) if one is not None]
    unknowns = ProcessUnknowns(
        tuple((o, c) for o, c, _ in there), tuple(one for *_, one in there), tuple(inner[c].size for _, c, _ in there),
        data.n_experiments, constants is True, bool(drift), free, constants == "each")
    return ProcessErrors(in_units(data, units), unknowns, inner, units, instants, hold == "first")


def refuse_still_inputs(data: Data) -> None:
    """Refuse an input that never moves: a step before the record begins cannot be seen in it (`DataError`)."""
    for c, name in enumerate(data.inputs):
        values = np.concatenate([e.u[:, c] for e in data.experiments])
        if np.ptp(values) > 0 and any(np.ptp(e.u[:, c]) > 0 for e in data.experiments):
            continue
        courses = [y[np.isfinite(y)] for y in np.vstack([e.y for e in data.experiments]).T]
        seen = "; ".join(f"{output!r} alone, from {y[0]:.4g} to {y[-1]:.4g}"
                         for output, y in zip(data.outputs, courses))
        raise DataError(f"input {name!r} never moves within an experiment (it stays at {values[0]:g}), so that gain "
                        "and dead time are not determined, nor is a step before the record began. Determined is the "
                        f"course of {seen}: begin the record before the step, or leave the input out")
