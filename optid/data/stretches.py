"""Gaps: records cut at missing inputs, after which the state is unknown, and linear interpolation."""

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optid.data.record import Data
from optid.errors import DataError, DataWarning


def runs_of(present: ArrayLike) -> NDArray[np.intp]:
    """Return first and one past the last position of every run of true marks, (R, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(present, dtype=np.int8), [0]]))).reshape(-1, 2)


def interpolate_missing(samples: ArrayLike) -> NDArray[np.float64]:
    """Interpolate missing samples (N, c) linearly by column; zeros where all are missing."""
    filled = np.array(samples, dtype=float)
    for column in filled.T:
        lost = np.isnan(column)
        if lost.any() and not lost.all():
            column[lost] = np.interp(np.flatnonzero(lost), np.flatnonzero(~lost), column[~lost])
    return np.nan_to_num(filled)


def between_gaps(data: Data, shortest: int) -> Data:
    """Cut a record at missing inputs; the stretches are its experiments.

    `shortest` is the number of samples that every output of a stretch must have; `DataError` if no stretch has them.
    """
    if not any(data.missing[name] for name in data.inputs) and all(
        np.min(np.sum(~np.isnan(e.y), axis=0)) >= shortest for e in data.experiments
    ):
        return data
    kept = []
    for i, e in enumerate(data.experiments):
        for first, last in runs_of(np.isfinite(e.u).all(axis=1)).tolist():
            # more outputs than states, or the initial state would repeat them
            if np.min(np.sum(~np.isnan(e.y[first:last]), axis=0)) >= shortest:
                kept.append(data.select(experiments=i).window(first, last))
    if not kept:
        raise DataError(f"no stretch of {shortest} samples has every input: interpolate them, or leave an input out")
    return Data.join(*kept)


def with_whole_inputs(data: Data, shortest: int) -> Data:
    """Return a record without missing inputs: as it is, or cut by `between_gaps` with a `DataWarning`."""
    gaps = [~np.isfinite(e.u) for e in data.experiments]
    lost = np.sum([gap.sum(axis=0) for gap in gaps], axis=0)
    if not lost.any():
        return data
    cut = between_gaps(data, shortest)
    total = sum(len(runs_of(~gap.any(axis=1))) for gap in gaps)
    channels = ", ".join(f"{name!r} ({count} samples)" for name, count in zip(data.inputs, lost) if count)
    dropped = total - cut.n_experiments
    short = f"; {dropped} shorter than {shortest} outputs {'is' if dropped == 1 else 'are'} left out" if dropped else ""
    warnings.warn(
        f"missing inputs: {channels}. The record is cut there: {cut.n_samples} of {data.n_samples} samples remain in "
        f"{cut.n_experiments} stretch{'es' if cut.n_experiments > 1 else ''}, each with its own initial state"
        f"{short}. Interpolated inputs would lose less where gaps are short", DataWarning, stacklevel=5)
    return cut
