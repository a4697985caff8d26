"""What the compiled recursions of a state-space model read: the model, what drives it, and what unknowns change."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.models.feedback_tables import Tables


class Parts(NamedTuple):
    """A model: x+ = A x + B f(u) + E g(y) + L y + Ez h(z) + K e, y = C x + D f(u) + Fz h(z) + e, z = Cz x + ....

    Attributes:
        A: (n, n).
        B: (n, r).
        C: (l, n).
        D: (l, r).
        E: (n, s).
        L: (n, l).
        K: (n, l).
        Ez: (n, k) what the latent functions add to the next state.
        Fz: (l, k) what they add to the output.
        Cz: (k, n) the states in their arguments.
        output_of: (s,) output that every feedback function acts on.
        tables: of the s feedback functions, then of the k latent ones.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    L: Array
    K: Array
    Ez: Array
    Fz: Array
    Cz: Array
    output_of: np.ndarray
    tables: Tables


class Stretch(NamedTuple):
    """What drives T samples of a run.

    Attributes:
        drive: (T, n) what the inputs and the constant add to the next state.
        direct: (T, l) what they add to the output.
        feedback: (T, s) g of the measured outputs, NaN where the model's output is to be fed back.
        y: (T, l) measured outputs, NaN where there is none.
        z: (T, k) what the inputs and the constant add to the arguments of the latent functions.
        low: (l,) lower end of the range that the outputs must not leave.
        high: (l,) upper end.
    """

    drive: Array
    direct: Array
    feedback: Array
    y: Array
    z: Array
    low: Array
    high: Array

    def part(self, samples: slice) -> "Stretch":
        """Return the stretch cut to some samples."""
        return Stretch._make([*(signal[samples] for signal in self[:5]), *self[5:]])


class Direct(NamedTuple):
    """What every unknown changes directly, entry by entry: ``target[row, column] += gain * values[signal]``.

    Attributes:
        row: (e,) latent function, output or state that changes.
        column: (e,) column of the unknown among the sensitivities.
        signal: (e,) column of `Signals.values`.
        gain: (e,).
        ends: (4,) the entries of latent functions, those of outputs and those of the next state lie between them.
    """

    row: np.ndarray
    column: np.ndarray
    signal: np.ndarray
    gain: Array
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
    """The run of T samples about which it is linearised.

    Attributes:
        returned: (T, n, l) derivative of the next state with respect to the output that comes back through the
            correction and the feedback; (0, n, l) where nothing does.
        slopes: (T, k) derivatives of the latent functions.
        values: (T, s) what the entries of `Direct` multiply.
    """

    returned: Array
    slopes: Array
    values: Array
