"""A record from the sample before a fault on, with the state that the healthy plant had there."""

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.data.stretches import interpolated
from optid.errors import DataError, DataWarning
from optid.faults.whitening import Predictor

if TYPE_CHECKING:
    from optid.models import HammersteinSS

LONGEST = 20_000
"""Samples after the fault that are used at most."""


class Window(NamedTuple):
    """A record from the sample before the fault on.

    Attributes:
        u: (N, m) inputs.
        y: (N, l) readings.
        present: (N, l) whether a reading is there.
        x0: (n,) predicted state at the first sample.
        e0: (l,) innovation there; zero where not held.
        held: whether the first sample is before the fault: its innovation belongs to the healthy plant.
        free_start: whether nothing is known of x0.
    """

    u: Array
    y: Array
    present: Array
    x0: Array
    e0: Array
    held: bool
    free_start: bool


def cut(model: "HammersteinSS", steady: Predictor, u: Array, y: Array, onset: int, known_start: bool) -> Window:
    """Cut a record at the onset of a fault.

    Args:
        model: the healthy model.
        steady: its predictor.
        u: (N, m) inputs of the whole record.
        y: (N, l) readings.
        onset: first sample that the fault changes.
        known_start: whether the plant was healthy before, so that its state is predicted from what it did.

    Raises:
        DataError: a missing input from the sample before the fault on.

    Warns:
        DataWarning: a record that is longer than what is used.
    """
    if len(y) - onset > LONGEST:
        warnings.warn(
            f"Of {len(y) - onset} samples after the fault the last {LONGEST} are used.", DataWarning, stacklevel=4
        )
        onset, known_start = len(y) - LONGEST, False
    present = ~np.isnan(y)
    before = min(onset, 4 * steady.settling)
    start = max(onset - 1, 0)
    missing = np.isnan(u[start:]).any(axis=1)
    if missing.any():
        k = start + int(np.argmax(missing))
        raise DataError(f"Sample {k} lacks an input: a refit needs every input from the fault on.")
    nothing = np.zeros(model.nx), np.zeros(model.l)
    if not known_start or onset == 0 or np.isnan(u[onset - before : onset]).any():
        return Window(u[onset:], y[onset:], present[onset:], *nothing, False, True)
    part = slice(onset - before, onset)
    f = model.expanded(u[part])
    drive, direct = f @ model.B.T + model.offset_x + fed(model, y[part]), f @ model.D.T + model.offset_y
    states, innovations = observed(model, steady.K, (drive, direct), y[part], nothing[0])
    impulse = np.zeros((before, model.nx, model.nx))
    impulse[0] = np.eye(model.nx)
    held = replace(steady, L=np.zeros_like(steady.L))
    seen = held.respond(impulse, np.zeros((before, model.l, model.nx)), present[part])
    white = held.whitened(seen, present[part]).reshape(-1, model.nx)
    r = held.whitened(innovations, present[part]).ravel()
    if 3 * before < steady.settling or np.linalg.matrix_rank(white) < model.nx:  # 1e-2 of an error is left
        return Window(u[onset:], y[onset:], present[onset:], *nothing, False, True)
    x0: Any = np.linalg.lstsq(white, r, rcond=None)[0]
    states, innovations = observed(model, steady.K, (drive, direct), y[part], x0)
    return Window(u[start:], y[start:], present[start:], states[-1], innovations[-1], True, False)


def observed(
    model: "HammersteinSS", K: Array, known: tuple[Array, Array], y: Array, x0: Array, e0: Array | None = None
) -> tuple[Array, Array]:
    """Return the predicted states (N, n) and the innovations (N, l), zero where a reading is missing.

    Args:
        model: A and C.
        K: (n, l) gain.
        known: what is known of the step (N, n) and of the output (N, l).
        y: (N, l) readings.
        x0: (n,) state at the first sample.
        e0: (l,) innovation there, where it is given.
    """
    from optid.faults.repair import observing

    states, innovations = np.empty((len(y), model.nx)), np.empty((len(y), model.l))
    drive, direct = (np.ascontiguousarray(part) for part in known)
    matrices: Any = [np.ascontiguousarray(part) for part in (model.A, model.C, K)]
    observing.observe(
        matrices[0], matrices[1], matrices[2], drive, direct, np.nan_to_num(y), ~np.isnan(y), np.array(x0, dtype=float),
        np.zeros(model.l) if e0 is None else e0, e0 is not None, states, innovations,
    )
    return states, innovations


def fed(model: "HammersteinSS", y: Array) -> Array:
    """What measured outputs drive the state with: E g(y) + L y, (N, n); missing readings are interpolated."""
    if not model.feedback and not model.L.any():
        return np.zeros((len(y), model.nx))
    filled = interpolated(y)
    fed = filled @ model.L.T
    for j, (g, o) in enumerate(zip(model.feedback, model.output_of)):
        fed += np.outer(g(filled[:, o]), model.E[:, j])
    return fed
