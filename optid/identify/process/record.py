"""A record as the errors of processes need it: its instants, its units, and what it cannot tell refused by name."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.arrays import Array, check_integer, one_of
from optid.bases import Linear, fitted_bases
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import DataError, StructureError
from optid.identify.arguments import check_offset, one_output
from optid.identify.process.errors import ProcessErrors, ProcessUnknowns
from optid.models.process import HOLDS
from optid.models.process_dynamics import ProcessStructure, read_structures
from optid.program.units import in_units, inner_bases, own_units

INITIAL = ("rest", "free")
SHORTEST = 8  # samples of a stretch between missing inputs that is used


@dataclass(frozen=True)
class Terms:
    """What there is beside the processes; see `formulations.process.process`."""

    hold: str = "zero"
    offset: Any = True
    drift: Any = False
    initial: str = "rest"

    def __post_init__(self) -> None:
        one_of("hold", self.hold, HOLDS)
        one_of("initial", self.initial, INITIAL)
        if not isinstance(self.drift, bool | np.bool_):
            raise StructureError(f"drift must be True or False; got {self.drift!r}")


def process_type(poles: int, zero: bool, delay: bool, integrator: bool) -> ProcessStructure:
    """Return a type with real poles (`StructureError`: there is none)."""
    return ProcessStructure(check_integer(poles, "poles", 0), False, bool(zero), bool(delay), bool(integrator))


def process_errors(data: Data, process: Any, basis: Any, terms: Terms, times: Any = None) -> ProcessErrors:
    """Check the arguments of a fit, and return its errors on the record in units of their own.

    Arguments and errors as of `formulations.process.process`.
    """
    data = one_output(data, "simulation errors")
    constants, free = check_offset(terms.offset, data), terms.initial == "free"
    structures = read_structures(process, data.inputs)
    instants = read_times(data, times)
    if any(np.isnan(e.u).any() for e in data.experiments):
        if times is not None:
            raise DataError("inputs are missing in a record with its own times: fill them with the value that was "
                            "held, or leave those samples out of the record and of the times")
        data, free = with_whole_inputs(data, SHORTEST), True  # no stretch but the first may begin at rest
        instants = read_times(data, None)
    refuse_still_inputs(data)
    bases = fitted_bases(data, basis)
    linear = [isinstance(one, Linear) for one in bases]
    if terms.hold == "first" and not all(linear):
        raise StructureError("hold='first' is exact for straight static curves only: use hold='zero' with a basis")
    units = replace(own_units(data, linear, bool(constants)), u_offset=(0.0,) * data.m)
    bases = tuple(inner_bases(bases, units))
    unknowns = ProcessUnknowns(structures, tuple(one.size for one in bases), data.n_experiments, constants is True,
                               bool(terms.drift), free, constants == "each")
    return ProcessErrors(in_units(data, units), unknowns, bases, units, instants, terms.hold == "first")


def read_times(data: Data, times: Any) -> tuple[Array, ...]:
    """Return the instants of every experiment in sampling times, from its first sample on.

    Raises:
        DataError: other numbers than the samples, times that are not finite or do not increase, by sample.
    """
    if times is None:
        return tuple(np.arange(float(e.n_samples)) for e in data.experiments)
    arrays = times if isinstance(times, list | tuple) and np.ndim(times[0]) else [times]
    if len(arrays) != data.n_experiments:
        raise DataError(f"times has {len(arrays)} arrays for {data.n_experiments} experiments")
    found = []
    for i, (given, e) in enumerate(zip(arrays, data.experiments), start=1):
        where = f"experiment {i}: " * (data.n_experiments > 1)
        t = np.asarray(given)
        if t.dtype.kind == "M":
            t = (t - t[0]) / np.timedelta64(1, "ns") * 1e-9
        t = np.asarray(t, dtype=float)
        if t.shape != (e.n_samples,):
            raise DataError(f"{where}times has shape {t.shape}; it must be ({e.n_samples},), one for each sample")
        if not np.isfinite(t).all():
            raise DataError(f"{where}the time of sample {int(np.argmin(np.isfinite(t)))} is not finite")
        steps = np.diff(t)
        if np.any(steps <= 0):
            k = int(np.argmax(steps <= 0)) + 1
            word = "runs backwards" if steps[k - 1] < 0 else "stands still"
            raise DataError(f"{where}the time {word} at sample {k} ({t[k - 1]:g}, then {t[k]:g}; "
                            f"{int(np.sum(steps <= 0))} such samples in all). Sort the record by time and remove "
                            "repeated times, or read it by its sampling time")
        found.append((t - t[0]) / data.dt)
    return tuple(found)


def refuse_still_inputs(data: Data) -> None:
    """Refuse an input that never moves: a step before the record begins cannot be seen in it (`DataError`)."""
    for c, name in enumerate(data.inputs):
        values = np.concatenate([e.u[:, c] for e in data.experiments])
        if np.ptp(values) > 0 and any(np.ptp(e.u[:, c]) > 0 for e in data.experiments):
            continue
        y = np.concatenate([e.y[:, 0] for e in data.experiments])
        y = y[np.isfinite(y)]
        raise DataError(f"input {name!r} never moves within an experiment (it stays at {values[0]:g}), so that gain "
                        "and dead time are not determined, nor is a step before the record began. Determined is the "
                        f"course of {data.outputs[0]!r} alone, from {y[0]:.4g} to {y[-1]:.4g}: begin the record before "
                        "the step, or leave the input out")
