"""What the compiled recursions of a state-space model read: the model, what drives it, and what unknowns change."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.models.feedback_tables import Tables


class Parts(NamedTuple):
    """A model: x+ = A x + B f(u) + E g(y) + L y + Ez h(z) + K e, y = C x + D f(u) + Fz h(z) + e, z = Cz x + ...."""

    A: Array  # (n, n)
    B: Array  # (n, r)
    C: Array  # (l, n)
    D: Array  # (l, r)
    E: Array  # (n, s)
    L: Array  # (n, l)
    K: Array  # (n, l)
    Ez: Array  # (n, k) what the latent functions add to the next state
    Fz: Array  # (l, k) what they add to the output
    Cz: Array  # (k, n) the states in their arguments
    output_of: np.ndarray  # (s,) output that every feedback function acts on
    tables: Tables  # of the s feedback functions, then of the k latent ones


class Stretch(NamedTuple):
    """What drives T samples of a run."""

    drive: Array  # (T, n) what the inputs and the constant add to the next state
    direct: Array  # (T, l) what they add to the output
    feedback: Array  # (T, s) g of the measured outputs, NaN where the model's output is to be fed back
    y: Array  # (T, l) measured outputs, NaN where there is none
    z: Array  # (T, k) what the inputs and the constant add to the arguments of the latent functions
    low: Array  # (l,) lower end of the range that the outputs must not leave
    high: Array  # (l,) upper end

    def part(self, samples: slice) -> "Stretch":
        """Return the stretch cut to some samples."""
        return Stretch._make([*(signal[samples] for signal in self[:5]), *self[5:]])


class Direct(NamedTuple):
    """What every unknown changes directly, entry by entry: ``target[row, column] += gain * values[signal]``."""

    row: np.ndarray  # (e,) latent function, output or state that changes
    column: np.ndarray  # (e,) column of the unknown among the sensitivities
    signal: np.ndarray  # (e,) column of `Signals.values`
    gain: Array  # (e,)
    # (4,) the entries of latent functions, those of outputs and those of the next state lie between them
    ends: np.ndarray

    @classmethod
    def of(cls, latent: Sequence[Any] = (), outputs: Sequence[Any] = (), states: Sequence[Any] = ()) -> "Direct":
        """Join tables (row, column, signal, gain), whose shapes broadcast; an unknown of column -1 is none."""
        tables = []
        for group in (latent, outputs, states):
            entries = [np.array(np.broadcast_arrays(*one), dtype=float).reshape(4, -1) for one in group]
            table = np.concatenate([np.zeros((4, 0)), *entries], axis=1)
            tables.append(table[:, table[1] >= 0])
        *places, gain = np.concatenate(tables, axis=1)
        ends = np.cumsum([0, *(table.shape[1] for table in tables)])
        row, column, signal, ends = (place.astype(np.uintp) for place in (*places, ends))  # quicker than signed ones
        return cls(row, column, signal, gain, ends)


class Signals(NamedTuple):
    """The run of T samples about which it is linearised."""

    # (T, n, l) derivative of the next state with respect to the output that comes back through the correction and the
    # feedback; (0, n, l) where nothing does
    returned: Array
    slopes: Array  # (T, k) derivatives of the latent functions
    values: Array  # (T, s) what the entries of `Direct` multiply
