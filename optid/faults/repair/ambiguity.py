"""Advice while a diagnosis names several faults: wait, control the worst case, or apply a probing input.

Refitting the wrong part is worse than no refit, so that the model stays the healthy one while several explanations are
left. The samples until the ordinary input, or a probe, isolates one of them follow from the signatures of all of them
in the whitened innovations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.diagnosis.answers import FaultAnswer
from optid.faults.repair.allocation import Allocation, input_bounds
from optid.faults.repair.damage import Damage, damages
from optid.faults.whitening import predictor
from optid.models import HammersteinSS

APART = 4.0
"""Distance of two explanations in the whitened innovations at which one is rejected nearly always."""

PATIENCE = 20
"""Longest wait, in samples, that is advised before other actions."""

RECENT = 60
"""Samples of the ordinary input from which the wait is extrapolated."""

STARTS = 12
ROUNDS = 100


@dataclass(frozen=True, eq=False)
class Probe:
    """An input that isolates explanations."""

    u: Array  # (L, m) inputs, within their bounds
    separation: float  # smallest distance of two members in the whitened innovations over the probe
    ordinary: float  # the same of an input with random levels, median of several
    bound: float  # upper bound of the separation of the worst pair by any input within the bounds
    pair: tuple[str, str]  # the two members with the smallest distance

    def __str__(self) -> str:
        return (
            f"probe of {len(self.u)} samples: {self.pair[0]} and {self.pair[1]} differ by {self.separation:.3g} "
            f"standard deviations\n  (random levels {self.ordinary:.3g}; at most {self.bound:.3g} possible)")


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """Advice while several explanations are left."""

    action: str  # "wait", "probe" or "robust"
    reason: str  # of the action
    labels: tuple[str, ...]  # of the members, the most probable first
    posteriors: tuple[float, ...]  # their probabilities
    wait: float  # samples after which the ordinary input isolates the closest pair; inf where it never does
    robust: Allocation | None = field(repr=False)  # control for all of them; None where there is none, see `reason`
    probe: Probe | None = field(repr=False)  # an input that isolates them; None where no input does

    def __str__(self) -> str:
        members = ", ".join(f"{label} ({100 * p:.0f} %)" for label, p in zip(self.labels, self.posteriors))
        lines = [f"{len(self.labels)} explanations are left: {members}", f"  advice: {self.action}; {self.reason}"]
        return "\n".join(lines + [f"  {line}" for line in str(self.probe or "").splitlines()])


def probe_input(
    model: Any, members: Sequence[Damage | FaultAnswer], *, length: int = 20, hold: int = 5,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None, seed: int = 0,
) -> Probe:
    """Return the input that maximises the smallest distance between several explanations.

    The signatures of two of them in the innovations differ by M v + d, v being f(u) over the probe. The best input lies
    in a corner of the bounds; it is searched from several starts, level by level, and compared with a bound from the
    largest singular value of M.

    Args:
        model: the healthy model, or the dictionary that holds it.
        members: answers of a diagnosis, or damages; at least two.
        length: samples.
        hold: samples per level.
        low: (m,) least inputs; the intervals of the bases by default.
        high: (m,) largest inputs.
        seed: of the starts.

    Raises:
        StructureError: fewer than two members, an impossible length, or members whose difference depends on no input.
    """
    plant = getattr(model, "model", model)
    broken = [one for member in members for one in ([member] if isinstance(member, Damage) else damages(plant, member))]
    if len(broken) < 2:
        raise StructureError("A probe isolates one of several explanations: give at least two.")
    if length < 2 or hold < 1:
        raise StructureError(f"length={length!r}, hold={hold!r}: at least 2 samples, and levels of at least one.")
    least, most = input_bounds(plant, low, high)
    pairs = list(combinations(range(len(broken)), 2))
    left = _responses(plant, broken, length)
    differences = [(left[i][0] - left[j][0], left[i][1] - left[j][1]) for i, j in pairs]
    if max(float(np.abs(M).max()) for M, _ in differences) <= 1e-12:
        raise StructureError(
            "These explanations differ by nothing that an input changes: no probe isolates one. Wait, or check the "
            "parts by hand.")

    def course(levels: Array) -> Array:
        return np.repeat(levels, hold, axis=0)[:length]

    def separation(levels: Array) -> tuple[float, int]:
        v = plant.expand_inputs(course(levels)).ravel()
        found = [float(np.linalg.norm(M @ v + d)) for M, d in differences]
        return min(found), int(np.argmin(found))

    rng, shape = np.random.default_rng(seed), (-(-length // hold), least.size)
    ordinary = float(np.median([separation(rng.uniform(least, most, shape))[0] for _ in range(STARTS)]))
    best, reached = rng.uniform(least, most, shape), -1.0
    for _ in range(STARTS):
        levels = np.where(rng.random(shape) < 0.5, least, most)
        value = separation(levels)[0]
        for _ in range(ROUNDS):
            improved = False
            for k, c in np.ndindex(shape):
                trial = levels.copy()
                trial[k, c] = least[c] if levels[k, c] == most[c] else most[c]
                new = separation(trial)[0]
                if new > value * (1 + 1e-12):
                    levels, value, improved = trial, new, True
            if not improved:
                break
        if value > reached:
            best, reached = levels, value
    points = plant.expand_inputs(np.linspace(least, most, 201))
    size = float(np.sqrt(length * np.sum(np.max(points**2, axis=0))))  # largest norm of f(u) over the probe
    bound = min(float(np.linalg.norm(M, 2)) * size + float(np.linalg.norm(d)) for M, d in differences)
    i, j = pairs[separation(best)[1]]
    return Probe(course(best), reached, ordinary, bound, (broken[i].label, broken[j].label))


def _responses(model: HammersteinSS, members: Sequence[Damage], length: int) -> list[tuple[Array, Array]]:
    """Signature of each member in the whitened innovations: M v + d, M (length l, length r), d (length l,)."""
    steady, (n, r), l = predictor(model), model.B.shape, model.l  # noqa: E741
    x, y = np.zeros((length, n, r)), np.zeros((length, l, r))
    x[1], y[0] = model.B, model.D
    one, blocks = steady.whiten(steady.respond(x, y)), np.zeros((length, l, length, r))
    for k in range(length):
        blocks[k:, :, k, :] = one[: length - k]
    found = []
    for member in members:
        x = np.tile(model.B @ member.constants + member.added, (length, 1))[:, :, None]
        x[0] = 0.0
        y = np.tile(model.D @ member.constants, (length, 1))[:, :, None]
        d = steady.whiten(steady.respond(x, y)).ravel()
        found.append(((blocks * (member.gains - 1)).reshape(length * l, length * r), d))
    return found


def advise(
    model: HammersteinSS, members: Sequence[Damage], u: Array | None, control: Allocation | str, bounds: Any, *,
    action: str = "auto", seed: int = 0,
) -> Ambiguity:
    """Return advice: "wait", "probe" or "robust", or the better one ("auto").

    The wait follows from recent inputs u (N, m); `control` is the robust one, or the reason why there is none; `bounds`
    are the least and largest inputs.

    Raises:
        StructureError: an action that is not possible.
    """
    wait, (low, high) = _waiting(model, members, u), bounds
    robust, why_not = (None, control) if isinstance(control, str) else (control, "")
    probe, no_probe = None, ""
    try:
        probe = probe_input(model, members, low=low, high=high, seed=seed)
    except StructureError as error:
        no_probe = str(error)
    if action == "probe" and probe is None or action == "robust" and robust is None:
        raise StructureError(no_probe if action == "probe" else why_not)
    soon = f"about {wait:.0f} more samples isolate one"
    waiting = soon if np.isfinite(wait) else "waiting isolates none"
    reason = f"as requested ({waiting})"
    if action == "auto":
        if wait <= PATIENCE:
            action, reason = "wait", waiting
        elif probe is not None and probe.separation >= APART and probe.separation > 1.2 * probe.ordinary:
            action, reason = "probe", f"{waiting}; {len(probe.u)} samples of the probe isolate one"
        elif robust is not None:
            action, reason = "robust", f"{waiting}, nor does a short probe"
        else:
            action, reason = "wait", f"{waiting}; no robust control: {why_not}"
    return Ambiguity(action, reason, tuple(one.label for one in members), tuple(one.posterior for one in members), wait,
                     robust, probe)


def _waiting(model: HammersteinSS, members: Sequence[Damage], u: Array | None) -> float:
    """Samples until the ordinary input isolates one of the closest pair."""
    plain = all(np.all(one.gains == 1) and not one.constants.any() and not one.added.any() for one in members)
    if plain and len({one.sensors for one in members}) > 1:
        return float("inf")
    inputs = np.zeros((0, model.m)) if u is None else u[-RECENT:]
    if len(inputs) < 2 or np.isnan(inputs).any():
        return float("inf")
    v = model.expand_inputs(inputs).ravel()
    traces = [(M @ v + d).reshape(len(inputs), -1) for M, d in _responses(model, members, len(inputs))]
    rate = min(float(np.mean(np.sum((one - other)[len(inputs) // 3 :] ** 2, axis=1)))
               for one, other in combinations(traces, 2))
    return APART**2 / rate if rate > 1e-9 else float("inf")
