"""What the compiled recursions of a state-space model read: the model, what drives it, and where unknowns stand."""

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


class Places(NamedTuple):
    """First column of every part of the unknowns among the sensitivities; -1 where a part is not unknown.

    Attributes:
        A: of A, row by row, as are the matrices below.
        C: of C.
        K: of K.
        offset: of the constant of the output.
        mu: (r,) of the coefficients of every function of the inputs.
        b: (r,) of its column of B.
        d: (r,) of its column of D.
        functions: (r + 1,) first column of its functions in `Signals.eta`.
        nu: (s,) of the coefficients of every feedback function.
        e: (s,) of its column of E.
        coordinates: (s + 1,) first column of its functions in `Signals.zeta`.
        c: (k,) of the coefficients of every latent function.
        ez: (k,) of its column of Ez.
        fz: (k,) of its column of Fz.
        cz: (k,) of its row of Cz.
        dz: (k,) of its row of Dz.
        oz: (k,) of the constant in its argument.
        members: (k + 1,) first column of its functions in `Signals.phi`.
    """

    A: int
    C: int
    K: int
    offset: int
    mu: Any
    b: Any
    d: Any
    functions: Any
    nu: Any
    e: Any
    coordinates: Any
    c: Any
    ez: Any
    fz: Any
    cz: Any
    dz: Any
    oz: Any
    members: Any

    @classmethod
    def none(cls, parts: Parts) -> "Places":
        """Return the places for a model in which the initial state alone is unknown."""
        r, s, k = (np.full(part.shape[1], -1, dtype=np.int64) for part in (parts.B, parts.E, parts.Ez))
        ends = [np.zeros(one.size + 1, dtype=np.int64) for one in (r, s, k)]
        return cls(-1, -1, -1, -1, r, r, r, ends[0], s, s, ends[1], k, k, k, k, k, k, ends[2])


class Signals(NamedTuple):
    """The run of T samples about which it is linearised.

    Attributes:
        states: (T, n).
        innovation: (T, l) measured less predicted output, zero where there is none or K is not unknown.
        returned: (T, n, l) derivative of the next state with respect to the output that comes back through the
            correction and the feedback; (0, n, l) where nothing does.
        u: (T, m) inputs in the arguments of the latent functions.
        f: (T, r) values of the functions of the inputs.
        eta: (T, P) values of their basis functions.
        g: (T, s) values of the feedback functions.
        zeta: (T, Q) values of their basis functions.
        w: (T, k) values of the latent functions.
        slopes: (T, k) their derivatives.
        phi: (T, R) values of their basis functions.
    """

    states: Array
    innovation: Array
    returned: Array
    u: Array
    f: Array
    eta: Array
    g: Array
    zeta: Array
    w: Array
    slopes: Array
    phi: Array
