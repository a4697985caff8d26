"""Forms of a state-space model that predict the same: states, scales, units; and its description in JSON types."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases.expansions import Linear
from optid.data.channels import Transform
from optid.errors import StructureError, nearest
from optid.models.noise_covariances import NoiseCovariances
from optid.models.nonlinearity import Nonlinearity
from optid.models.state_responses import markov

if TYPE_CHECKING:
    from optid.models.hammerstein_ss import HammersteinSS

GAUGES = ("norm", "gain", "none")
MATRICES = ("A", "B", "C", "D", "E", "L", "K", "offset_x", "offset_y")


def check_shapes(model: "HammersteinSS") -> None:
    """Refuse parts of a model that do not agree.

    Raises:
        StructureError: names the part and the shape that is needed.
    """
    n, outputs, r, s = model.nx, model.l, len(model.nonlinearities), len(model.feedback)
    if model.E.shape == (n + outputs, s) and s and outputs:
        raise StructureError(
            f"E has {n + outputs} rows for {n} states: its last {outputs} would carry g(y) to the output y of the same "
            "sample, an algebraic loop. Delay the feedback by one sample: keep the first rows only."
        )
    wanted = {
        "A": (n, n), "B": (n, r), "C": (outputs, n), "D": (outputs, r), "E": (n, s), "L": (n, outputs),
        "K": (n, outputs), "offset_x": (n,), "offset_y": (outputs,),
    }
    for name, shape in wanted.items():
        found = getattr(model, name).shape
        if found != shape:
            raise StructureError(
                f"{name} has shape {found}; {n} states, {r} functions of the inputs, {s} of the outputs and {outputs} "
                f"outputs need {shape}."
            )
    _check_channels(model, "nonlinearities", "input_of", model.m)
    _check_channels(model, "feedback", "output_of", outputs)
    for kind, count in (("inputs", model.m), ("outputs", outputs)):
        names, units = getattr(model, kind), getattr(model, kind[:-1] + "_units")
        if len(names) != count or len(units) != count:
            raise StructureError(f"{len(names)} names and {len(units)} units for {count} {kind}.")
    if model.noise is not None and model.noise.S.shape != (n, outputs):
        raise StructureError(f"The noise covariances are those of {model.noise.S.shape}; {(n, outputs)} is needed.")
    if not (np.isfinite(model.dt) and model.dt > 0):
        raise StructureError(f"dt = {model.dt!r}: a positive number.")
    if model.gauge not in GAUGES:
        raise StructureError(f"Unknown gauge {model.gauge!r}: use one of {', '.join(GAUGES)}.")


def _check_channels(model: "HammersteinSS", functions: str, where: str, count: int) -> None:
    found, channels = getattr(model, functions), getattr(model, where)
    if len(found) != len(channels) or any(not 0 <= c < count for c in channels):
        raise StructureError(
            f"{where} = {channels}: one channel from 0 to {count - 1} for each of the {len(found)} {functions}."
        )
    for j, f in enumerate(found):
        if f.offset:
            raise StructureError(f"{functions}[{j}] has an offset: the constants belong to offset_x and offset_y.")


def transformed(model: "HammersteinSS", T: ArrayLike) -> "HammersteinSS":
    """Change the states to T x; the documentation is at `HammersteinSS.transformed`."""
    turn, n = np.atleast_2d(np.asarray(T, dtype=float)), model.nx
    turn = turn.reshape(0, 0) if n == 0 and turn.size == 0 else turn
    if turn.shape != (n, n) or not np.all(np.isfinite(turn)):
        raise StructureError(f"T has shape {turn.shape}; a finite matrix ({n}, {n}) is needed.")
    if n and np.linalg.cond(turn) > 1e14:
        raise StructureError("T is singular: a change of states can be undone.")
    back = np.linalg.inv(turn)
    noise = None if model.noise is None else model.noise.mapped(turn, np.eye(model.l))
    moved = {name: turn @ getattr(model, name) for name in ("B", "E", "L", "K", "offset_x")}
    return replace(model, A=turn @ model.A @ back, C=model.C @ back, noise=noise, gauge="none", **moved)


def balanced(model: "HammersteinSS") -> "HammersteinSS":
    """Balance the Gramians; the documentation is at `HammersteinSS.balanced`."""
    return model if model.nx == 0 else transformed(model, balancing(model.A, np.hstack([model.B, model.E]), model.C))


def balancing(A: Array, B: Array, C: Array) -> Array:
    """Return the change of states T (n, n) that makes both Gramians of (A, B, C) diagonal and equal.

    Raises:
        StructureError: A is unstable, or the triple is not minimal.
    """
    from scipy.linalg import solve_discrete_lyapunov

    largest = float(np.abs(np.linalg.eigvals(A)).max())
    if largest >= 1:
        raise StructureError(f"The model is unstable (largest pole {largest:.6g}): it has no Gramians.")
    reach = _factor(solve_discrete_lyapunov(A, B @ B.T))
    see = _factor(solve_discrete_lyapunov(A.T, C.T @ C))
    left, values, right = np.linalg.svd(see.T @ reach)
    if values[-1] <= 1e-13 * values[0]:
        raise StructureError(
            f"The model is not minimal: its Hankel singular values fall from {values[0]:.3g} to {values[-1]:.3g}. "
            "Identify it with fewer states."
        )
    return (left / np.sqrt(values)).T @ see.T


def _factor(gramian: Array) -> Array:
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def injected(model: "HammersteinSS", gain: ArrayLike) -> "HammersteinSS":
    """Move an output injection between A and L; the documentation is at `HammersteinSS.injected`."""
    moved = np.asarray(gain, dtype=float)
    if moved.shape != model.L.shape:
        raise StructureError(f"The gain has shape {moved.shape}; {model.L.shape} is needed.")
    return replace(
        model, A=model.A - moved @ model.C, B=model.B - moved @ model.D, L=model.L + moved, K=model.K - moved,
        offset_x=model.offset_x - moved @ model.offset_y, noise=None, gauge="none",
    )


def regauged(model: "HammersteinSS", gauge: str, signs: bool = True) -> "HammersteinSS":
    """Move the scales; the documentation is at `HammersteinSS.regauge`. Without ``signs`` they stay as they are."""
    if gauge not in GAUGES:
        raise StructureError(f"Unknown gauge {gauge!r}. {nearest(gauge, GAUGES)}")
    if gauge == "gain" and model.l > 1:
        raise StructureError("gauge 'gain' is defined for one output; use 'norm'.")
    first = _signs(markov(model, model.B, model.nx + 1)) if signs else np.ones(model.B.shape[1])
    scales = np.linalg.norm(np.vstack([model.B, model.D]), axis=0) * first
    if gauge == "gain":
        scales = _gains(model)
    elif gauge == "none":
        scales = np.array([_unit_slope(f) for f in model.nonlinearities])
    back = np.ones(model.E.shape[1])
    if gauge != "none":
        back = np.linalg.norm(model.E, axis=0)
        if signs:
            back = back * _signs(markov(model, model.E, model.nx + 1, direct=False))
    scales, back = np.where(scales == 0, 1.0, scales), np.where(back == 0, 1.0, back)
    return replace(
        model, B=model.B / scales, D=model.D / scales, E=model.E / back, gauge=gauge,
        nonlinearities=tuple(replace(f, mu=s * f.mu) for f, s in zip(model.nonlinearities, scales)),
        feedback=tuple(replace(g, mu=s * g.mu) for g, s in zip(model.feedback, back)),
    )


def _unit_slope(f: Nonlinearity) -> float:
    """The factor of B that gives a linear channel the slope one; one for every other."""
    return 1 / float(f.mu[0]) if isinstance(f.basis, Linear) and f.mu[0] != 0 else 1.0


def _gains(model: "HammersteinSS") -> Array:
    left = np.eye(model.nx) - model.A
    if model.nx and np.linalg.cond(left) > 1e12:
        raise StructureError("gauge 'gain' cannot be reached: the model has a pole at 1; use 'norm'.")
    gains = (model.C @ np.linalg.solve(left, model.B) + model.D)[0]
    sizes = np.abs(model.C) @ np.abs(np.linalg.solve(left, model.B)) + np.abs(model.D)
    for gain, size, c in zip(gains, sizes[0], model.input_of):
        if not abs(gain) > 1e-9 * size:
            raise StructureError(
                f"gauge 'gain' cannot be reached: the static gain of input {model.inputs[c]!r} is zero; use 'norm'."
            )
    return gains


def _signs(response: Array) -> Array:
    """Sign of the first Markov parameter (T, l, r) of every column that is not negligible."""
    signs = np.ones(response.shape[2])
    for j in range(signs.size):
        entries = response[:, :, j].ravel()
        large = np.flatnonzero(np.abs(entries) > 1e-6 * np.abs(entries).max(initial=0.0))
        signs[j] = np.sign(entries[large[0]]) if large.size else 1.0
    return signs


def in_raw_units(model: "HammersteinSS", transform: Transform) -> "HammersteinSS":
    """Undo a change of units; the documentation is at `HammersteinSS.with_transform`."""
    if transform.is_identity:
        return model
    gain, shift = np.array(transform.y_scale), np.array(transform.y_offset)
    if len(transform.u_scale) != model.m or gain.size != model.l:
        raise StructureError(
            f"The transform has {len(transform.u_scale)} inputs and {gain.size} outputs, "
            f"the model {model.m} and {model.l}."
        )
    functions, constants = _mapped(model.nonlinearities, model.input_of, transform.u_scale, transform.u_offset)
    feedback, fed = _mapped(model.feedback, model.output_of, transform.y_scale, transform.y_offset)
    # the states take the unit that all outputs share: C, and with it what a norm of B means, stays as it is then
    state = gain[0] if np.all(gain == gain[0]) else 1.0
    injection = state * model.L / gain
    raw = replace(
        model, B=state * model.B, C=gain[:, None] * model.C / state, D=gain[:, None] * model.D, E=state * model.E,
        L=injection, K=state * model.K / gain,
        offset_x=state * (model.offset_x + model.B @ constants + model.E @ fed) - injection @ shift,
        offset_y=gain * (model.offset_y + model.D @ constants) + shift, nonlinearities=functions, feedback=feedback,
        noise=None if model.noise is None else model.noise.mapped(state * np.eye(model.nx), np.diag(gain)),
    )
    # units do not turn signs: what a constraint decided about them stays
    return regauged(raw, model.gauge, signs=False)


def _mapped(
    functions: tuple[Nonlinearity, ...], where: tuple[int, ...], scales: tuple[float, ...], offsets: tuple[float, ...]
) -> tuple[tuple[Nonlinearity, ...], Array]:
    moved, constants = [], []
    for f, c in zip(functions, where):
        basis, matrix, constant = f.basis.mapped(scales[c], offsets[c])
        moved.append(Nonlinearity(basis, matrix @ f.mu))
        constants.append(float(constant @ f.mu))
    return tuple(moved), np.array(constants)


def to_dict(model: "HammersteinSS") -> dict[str, Any]:
    """Describe the model in JSON types."""
    return {
        "kind": model.kind,
        **{name: getattr(model, name).tolist() for name in MATRICES},
        "nonlinearities": [f.to_dict() for f in model.nonlinearities],
        "input_of": list(model.input_of),
        "feedback": [g.to_dict() for g in model.feedback],
        "output_of": list(model.output_of),
        "noise": None if model.noise is None else model.noise.to_dict(),
        "dt": model.dt,
        **{name: list(getattr(model, name)) for name in ("inputs", "outputs", "input_units", "output_units")},
        "gauge": model.gauge,
    }


def read(content: Mapping[str, Any], functions: dict[str, Any] | None) -> dict[str, Any]:
    """Return the arguments of the model that `to_dict` described."""
    sizes = {"n": len(content["A"]), "l": len(content["outputs"]), "r": len(content["nonlinearities"])}
    sizes["s"] = len(content["feedback"])
    shapes = {"A": "nn", "B": "nr", "C": "ln", "D": "lr", "E": "ns", "L": "nl", "K": "nl", "offset_x": "n"}
    arrays = {
        name: np.array(content[name], dtype=float).reshape([sizes[letter] for letter in shapes.get(name, "l")])
        for name in MATRICES
    }
    return {
        **arrays,
        "nonlinearities": tuple(Nonlinearity.from_dict(f, functions) for f in content["nonlinearities"]),
        "feedback": tuple(Nonlinearity.from_dict(g, functions) for g in content["feedback"]),
        "noise": None if content["noise"] is None else NoiseCovariances.from_dict(content["noise"]),
        "dt": content["dt"],
        "gauge": content["gauge"],
        **{
            name: tuple(content[name])
            for name in ("input_of", "output_of", "inputs", "outputs", "input_units", "output_units")
        },
    }
