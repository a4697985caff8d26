"""From sampled models to continuous ones and to other sampling times, for inputs that are held between samples."""

from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.models import roots
from optid.models.continuous import ContinuousModel
from optid.models.export import state_space
from optid.models.held_inputs import held_equations, held_step
from optid.models.pole_table import PoleTable

AT_REST = 1e-9  # share of the largest coefficient of B below which what is left of it is zero
SCAN = 64  # parts of a sampling time in which a fractional dead time is looked for


def to_continuous(model: Any) -> ContinuousModel:
    """Return the continuous model whose samples, with inputs held between them, are those of this one, without noise.

    The equations are the matrix logarithm of a step. The delay nk of a transfer function becomes a dead time of nk - 1
    samples; where B of an input has one coefficient more than a dead time of whole samples allows (nb = na + 1 with
    nk >= 1, one output), the dead time is longer by the part of a sample that explains all coefficients. With one pole
    there is one at most; with several there may be two, or none. Of a model with `levels` it is the mean.

    Raises:
        StructureError: there is no such model, or no unique one: a pole at 0 (a delay), a negative real pole, poles at
            half the sampling rate, nonlinear feedback or functions of latent signals, equations of the user.
    """
    if model.structure == "physical":
        raise StructureError("A physical model has the equations of its user, who knows them in continuous time: "
                             "there is nothing to convert.")
    for functions, what in (("feedback", "Nonlinear feedback"), ("latent", "A function of latent signals")):
        if getattr(model, functions, ()):
            raise StructureError(f"{what} acts on samples of the model's own signals, which are not held between "
                                 "them: the matrix logarithm, which converts linear equations, does not exist.")
    shared = {name: getattr(model, name) for name in (
        "nonlinearities", "time_unit", "inputs", "outputs", "input_units", "output_units")}
    if model.structure == "ss":
        return _of_state_space(model, shared)
    return _of_transfer_function(model, shared)


def _of_state_space(model: Any, shared: dict[str, Any]) -> ContinuousModel:
    Phi, Gamma = model.A + model.L @ model.C, model.B + model.L @ model.D
    _refuse_delays(Phi, "Give the order without them: identify a transfer function with nk, or fewer states.")
    offset = model.offset_x + model.L @ model.offset_y
    A, driven = held_equations(Phi, np.column_stack([Gamma, offset]), model.dt)
    return ContinuousModel(A, driven[:, :-1], model.C, model.D, input_of=model.input_of, offset_x=driven[:, -1],
                           offset_y=model.offset_y, dead_time=np.zeros(len(model.nonlinearities)), **shared)


def _of_transfer_function(model: Any, shared: dict[str, Any]) -> ContinuousModel:
    whole = np.array([max(delay - 1, 0) for delay in model.nk])
    undelayed, excess = replace(model, nk=tuple(np.minimum(model.nk, 1)), levels=None), np.zeros(model.m)
    if model.l == 1 and model.na:
        undelayed, excess = _divided(undelayed)
    longest = max(lag + b - 1 for lag, b in zip(undelayed.nk, undelayed.nb))
    if longest > model.na:
        raise StructureError(
            f"B reaches {longest - model.na} samples further back than A (na = {model.na}): a pole at 0, which is a "
            "delay and has no logarithm. Move the delay into nk, or choose nb <= na with nk >= 1 (na + 1 with nk = 0).")
    Phi, Gamma, C, D = state_space(undelayed)
    _refuse_delays(Phi, "The last coefficients of A are zero: lower na.")
    constant = -(undelayed.matrices @ model.offset).reshape(-1)
    A, driven = held_equations(Phi, np.column_stack([Gamma, constant]), model.dt)
    B, parts = driven[:, :-1].copy(), np.zeros(model.m)
    for c in np.flatnonzero(excess):
        parts[c] = _fractional_delay(A, B[:, [c]], C, float(excess[c]), model.dt, model.inputs[c])
        B[:, [c]] = held_step(A, B[:, [c]], parts[c])[0] @ B[:, [c]]
    return ContinuousModel(A, B, C, D, input_of=tuple(range(model.m)), offset_x=driven[:, -1], offset_y=model.offset,
                           dead_time=whole * model.dt + parts, **shared)


def _divided(model: Any) -> tuple[Any, Array]:
    """Divide B of every input that is one lag too long by A; return the model with the remainders, and the quotients.

    The quotients (m,) multiply the function of the sample before: B = quotient q^-1 A + remainder.
    """
    numerators, quotients = [], np.zeros(model.m)
    for c, (lag, b) in enumerate(zip(model.nk, model.b)):
        if lag == 1 and len(b) == model.na + 1 and abs(model.a[-1]) > roots.AT_ZERO**model.na:
            quotients[c] = b[-1] / model.a[-1]
            b = (b - quotients[c] * np.concatenate([[1.0], model.a]))[:-1]
        numerators.append(b)
    return replace(model, b=tuple(numerators)), quotients


def _fractional_delay(A: Array, B: Array, C: Array, excess: float, dt: float, channel: str) -> float:
    """Return the part of a sample by which an input acts later, from how the sample before acts beside the state.

    With the undelayed state x, driven up to the sample, the output is read at a part d before it. That takes back
    C exp(-A d) times what the last input did in d; in the states of the output that is an excess of
    -C int_0^d exp(A s) B ds.
    """
    grid = np.linspace(0, dt, SCAN + 1)

    def mismatch(part: Any) -> Any:
        return excess + (C @ held_step(A, B, part)[1])[..., 0, 0]

    values = mismatch(grid)
    size = abs(excess) + float(np.abs(values - excess).max())
    values[np.abs(values) <= AT_REST * size] = 0.0
    changes, exact = np.flatnonzero(values[:-1] * values[1:] < 0), np.flatnonzero(values == 0)
    if len(changes) + len(exact) != 1:
        raise StructureError(
            f"B of input {channel!r} has one coefficient more than a dead time of whole samples allows, and "
            f"{'more than one' if len(changes) + len(exact) else 'no'} dead time within a sampling time explains it: "
            "the remainder is a pole at 0, which is a delay and has no logarithm. Choose nb <= na, or another nk.")
    if len(exact):
        return float(grid[exact[0]])
    from scipy.optimize import brentq

    solve: Any = brentq
    return solve(mismatch, grid[changes[0]], grid[changes[0] + 1], xtol=1e-15 * dt, rtol=1e-14)


def _refuse_delays(Phi: Array, remedy: str) -> None:
    """Refuse poles at 0."""
    count = int(np.sum(np.abs(np.linalg.eigvals(Phi)) <= roots.AT_ZERO)) if len(Phi) else 0
    if count:
        raise StructureError(f"{count} pole{'s' * (count > 1)} at 0: a delay of a sample, which has no logarithm. "
                             f"{remedy}")


def to_discrete(model: Any, dt: float) -> Any:
    """Return the model at another sampling time, a `HammersteinSS`, by way of `to_continuous`, with its errors."""
    return to_continuous(model).to_discrete(dt)


def zeros(model: Any) -> Any:
    """Invariant zeros from all functions of the inputs to all outputs, complex, largest first.

    With one input and one output these are the roots of B. Systems with other numbers of inputs than outputs mostly
    have none.
    """
    if model.structure not in ("ss", "physical") and model.l == model.m == 1:
        return roots.largest_first(np.roots(model.b[0]).astype(complex))
    return roots.invariant_zeros(*state_space(model))


def pole_table(model: Any) -> PoleTable:
    """Time constant, natural frequency and damping of every mode, the slowest first.

    Linear feedback of outputs is part of the modes; nonlinear feedback, which moves them with its level, is not.
    """
    return PoleTable.of_sampled(roots.poles_of(model), model.dt, model.time_unit)
