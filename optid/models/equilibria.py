"""States at which a state-space model rests under constant inputs, by damped Newton steps."""

from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.models.linear import static_solution

STEPS, HALVINGS = 100, 30
RELAXATION = 300  # samples of a free run from whose end the steps start again
RESTS = 1e-12  # a state that moves by less than this share of the largest term of its equation rests


def equilibria(model: Any, f: Array, u: Array, near: Array | None = None) -> tuple[Array, Array]:
    """Return states (N, n) and outputs (N, l) at rest under inputs u (N, m) with function values f (N, r).

    The steps start from states `near` (N, n), zero by default; where no damped ones end in a state of rest, from the
    end of a free run, and then undamped.

    Raises:
        StructureError: a pole at 1, or no equilibrium found.
    """
    start = np.zeros((len(u), model.nx)) if near is None else np.array(near, dtype=float)
    curved = bool(model.feedback or model.latent)
    with np.errstate(all="ignore"):
        found = _newton(model, f, u, start)
        if found is None and curved:
            end = start
            for _ in range(RELAXATION):
                end = end + _change(model, end, f, u)[0]
            found = _newton(model, f, u, end) or _newton(model, f, u, start, damped=False)
    if found is not None:
        return found
    if not curved:
        static_solution(model.A + model.L @ model.C - np.eye(model.nx), model.B)
    raise StructureError(
        f"No equilibrium was found at u0 = {u[0].tolist()}: the feedback does not let the model rest there.")


def _newton(model: Any, f: Array, u: Array, x: Array, damped: bool = True) -> tuple[Array, Array] | None:
    """Return states and outputs at rest, None where no steps from states x (N, n) lead there."""
    own = slice(None if model.feedback or model.latent else 1)  # else the tangent is the same everywhere
    change, y, sizes = _change(model, x, f, u)
    for _ in range(STEPS):
        off = np.abs(change).max(axis=1, initial=0.0)
        if np.all(off <= RESTS * sizes):
            return x, y
        slope = model.tangent(x[own], y[own], u[own])[0] - np.eye(model.nx)
        if not (np.all(np.isfinite(slope)) and np.all(np.isfinite(change))):
            return None
        step, share = (np.linalg.pinv(slope) @ change[:, :, None])[:, :, 0], np.ones((len(x), 1))
        for _ in range(HALVINGS):
            new, y, sizes = _change(model, x - share * step, f, u)
            worse = ~(np.abs(new).max(axis=1, initial=0.0) <= np.maximum(off, RESTS * sizes))
            if not (damped and worse.any()):
                break
            share[worse] /= 2
        else:
            return None
        x, change = x - share * step, new
    return None


def _change(model: Any, x: Array, f: Array, u: Array) -> tuple[Array, Array, Array]:
    """Return how much states x (N, n) change in a sample, the outputs, and the largest term of each equation, (N,)."""
    h = model.latent_values(model.latent_signals(x, u))
    y = x @ model.C.T + f @ model.D.T + h @ model.Fz.T + model.offset_y
    moves = [x @ model.A.T, f @ model.B.T, y @ model.L.T, h @ model.Ez.T, np.tile(model.offset_x, (len(u), 1)), -x]
    moves += [np.outer(g(y[:, o]), e) for g, o, e in zip(model.feedback, model.output_of, model.E.T)]
    sizes = np.max([np.abs(move).max(axis=1, initial=0.0) for move in moves], axis=0)
    return sum(moves, np.zeros_like(x)), y, sizes
