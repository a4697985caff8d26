"""What to do while a diagnosis names several faults: wait, act for the worst of them, or ask the plant.

Refitting the wrong part is worse than doing nothing, so that as long as several explanations are left the model stays
the healthy one. How soon the ordinary input tells them apart, and how much sooner a probe would, is computed from what
each of them leaves in the whitened innovations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.repair.allocation import ACTIVE, REACHED, Target
from optid.faults.repair.allocation_problem import AllocationProblem, Member
from optid.faults.repair.damage import Damage
from optid.faults.repair.inversion import Inverse
from optid.faults.whitening import predictor

if TYPE_CHECKING:
    from optid.faults.diagnosis.answers import Answer
    from optid.models import HammersteinSS
    from optid.program.solution import Solution

APART = 4.0
"""Distance of two explanations in the whitened innovations at which one of them is dropped nearly always."""

PATIENCE = 20
"""Samples that are waited for before anything else is done."""

LENGTH = 20
"""Samples of a probe."""

HOLD = 5
"""Samples that a level of a probe is held."""

STARTS = 12
ROUNDS = 100


@dataclass(frozen=True, eq=False)
class Probe:
    """An input that tells explanations apart.

    Attributes:
        u: (L, m) inputs, within their bounds.
        separation: smallest distance of two members in the whitened innovations over the probe.
        ordinary: the same of an input with random levels, median of several; of the input given as `before`.
        bound: no input within the bounds separates the worst pair by more.
        pair: the two members that it separates least.
    """

    u: Array
    separation: float
    ordinary: float
    bound: float
    pair: tuple[str, str]

    def __str__(self) -> str:
        """Say what it achieves."""
        return (
            f"probe of {len(self.u)} samples: {self.pair[0]} and {self.pair[1]} come apart by {self.separation:.3g} "
            f"standard deviations\n  (random levels {self.ordinary:.3g}; at most {self.bound:.3g} possible)"
        )


@dataclass(frozen=True, eq=False)
class Robust:
    """Control that is right for every member: the worst of them is made least.

    Attributes:
        problem: the members in the v of the healthy nonlinearities.
        inverses: f^-1 of the healthy nonlinearities.
        low: (m,) least inputs.
        high: (m,) largest inputs.
        labels: of the members.
        input_of: the input of every column.
        solver: back end.
    """

    problem: AllocationProblem
    inverses: tuple[Inverse, ...]
    low: Array
    high: Array
    labels: tuple[str, ...]
    input_of: tuple[int, ...]
    solver: Any = "auto"

    def attainable(self, reference: ArrayLike) -> Target:
        """Return the inputs whose worst member rests nearest to a reference; y is that member's.

        Raises:
            StructureError: a reference of the wrong size, or a solver that finds no point.
        """
        from optid.registry import fault_formulation
        from optid.solving.solve import solve

        r = np.atleast_1d(np.asarray(reference, dtype=float))
        if r.shape != self.problem.weights.shape or not np.all(np.isfinite(r)):
            raise StructureError(f"reference of shape {r.shape}: {self.problem.weights.shape} finite numbers needed.")
        solution = solve(fault_formulation("allocation.target")(self.problem, reference=r), self.solver)
        if not solution.has_point:
            raise StructureError(f"no resting point was found: {solution.status} ({solution.reason})")
        v = np.clip(solution.values["v"], self.problem.low, self.problem.high)
        misses = [np.linalg.norm(self.problem.weights * (m.rest_output(v) - r)) for m in self.problem.members]
        worst = int(np.argmax(misses))
        member, distance = self.problem.members[worst], float(misses[worst])
        reached = distance <= REACHED * np.sqrt(self.problem.scale)
        slack = 1e-6 * self.problem.half
        at_end = (v <= self.problem.low + slack) | (v >= self.problem.high - slack)
        miss = self.problem.weights**2 * (member.rest_output(v) - r)
        slopes = np.abs((miss @ member.gain()) / max(distance, 1e-300))
        limiting = {} if reached else {
            name: float(slope) for name, slope, held in zip(self.problem.names, slopes, at_end)
            if held and slope > ACTIVE * slopes.max()
        }
        return Target(r, member.rest_output(v), self.inputs(v), v, member.rest_state(v), distance, reached, limiting,
                      solution)

    def step(self, states: Sequence[ArrayLike], reference: ArrayLike, horizon: int = 40, effort: float = 1e-3) -> Array:
        """Return the inputs (m,) of this sample: predictive control with the worst member made least.

        Args:
            states: (n,) predicted state of every member.
            reference: (l,) outputs wanted.
            horizon: samples.
            effort: as `optid.faults.repair.control.Controller`.

        Raises:
            StructureError: not one state per member, or a solver that finds no point.
        """
        from optid.registry import fault_formulation
        from optid.solving.solve import solve

        if len(states) != len(self.labels):
            raise StructureError(f"{len(states)} states for {len(self.labels)} members ({', '.join(self.labels)}).")
        goal = self.attainable(reference)
        program = fault_formulation("allocation.track")(
            self.problem, reference=goal.reference, states=[np.asarray(x, dtype=float) for x in states], goal=goal.v,
            horizon=horizon, effort=effort,
        )
        solution: Solution = solve(program, self.solver, prove=False)
        if not solution.has_point:
            raise StructureError(f"the controller found no point: {solution.status} ({solution.reason})")
        return self.inputs(np.clip(solution.values["v"][0], self.problem.low, self.problem.high))

    def inputs(self, v: Array) -> Array:
        """Return the inputs (m,) whose healthy nonlinearities have the values v."""
        u = (self.low + self.high) / 2
        for i, (one, c) in enumerate(zip(self.inverses, self.input_of)):
            u[c] = float(one(np.array(v[i]), float(u[c])))
        return np.clip(u, self.low, self.high)

    def __str__(self) -> str:
        """Say for whom it is right."""
        return f"control that is right for {', '.join(self.labels)}"


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """What is advised while several explanations are left.

    Attributes:
        action: "wait", "probe" or "robust".
        reason: why.
        labels: of the members, the most probable first.
        posteriors: their probabilities.
        wait: samples after which the ordinary input has told the closest pair apart; inf where it never will.
        robust: control for all of them; None where there is none, see `reason`.
        probe: an input that tells them apart; None where no input can.
    """

    action: str
    reason: str
    labels: tuple[str, ...]
    posteriors: tuple[float, ...]
    wait: float
    robust: Robust | None = field(repr=False)
    probe: Probe | None = field(repr=False)

    def __str__(self) -> str:
        """Say what is advised, and why."""
        members = ", ".join(f"{label} ({100 * p:.0f} %)" for label, p in zip(self.labels, self.posteriors))
        lines = [f"{len(self.labels)} explanations are left: {members}", f"  advice: {self.action}; {self.reason}"]
        return "\n".join(lines + [f"  {line}" for line in str(self.probe or "").splitlines()])


def robust_allocation(
    model: "HammersteinSS", inverses: tuple[Inverse, ...], members: Sequence[Damage], low: Array, high: Array,
    weights: Array, solver: Any = "auto",
) -> Robust:
    """Prepare the control of a plant of which several explanations are left.

    Every member is a gain and a constant of the v of the healthy nonlinearities, as the diagnosis estimates them.

    Raises:
        StructureError: an input with several nonlinearities, a nonlinearity that turns back, or nonlinear feedback.
    """
    if len(set(model.input_of)) < len(model.input_of) or any(one.turns for one in inverses):
        raise StructureError("The members share no v: an input has several nonlinearities, or one that turns back.")
    plants = [
        Member.of(model, one.gains, one.constants) for one in members
    ]
    plants = [Member(p.A, p.B, p.C, p.D, p.d + one.added, p.c) for p, one in zip(plants, members)]
    problem = AllocationProblem(
        tuple(plants), np.array([one.v_low for one in inverses]), np.array([one.v_high for one in inverses]),
        tuple(f"actuator:{model.inputs[c]}" for c in model.input_of), model.outputs, weights,
    )
    return Robust(problem, inverses, low, high, tuple(one.label for one in members), model.input_of, solver)


def probe_input(
    model: Any, members: Sequence["Damage | Answer"], *, length: int = LENGTH, hold: int = HOLD,
    low: ArrayLike | None = None, high: ArrayLike | None = None, seed: int = 0,
) -> Probe:
    """Find an input that tells several explanations apart soonest.

    What two of them leave in the innovations differs by M v + d, v being f(u) over the probe. The input with the
    largest smallest distance lies in a corner of the bounds; it is sought from several starts, level by level, and
    compared with a bound from the largest singular value of M.

    Args:
        model: the healthy model, or the dictionary that holds it.
        members: answers of a diagnosis, or damages; at least two.
        length: samples.
        hold: samples that a level is held.
        low: (m,) least inputs; the intervals of the bases by default.
        high: (m,) largest inputs.
        seed: of the starts.

    Raises:
        StructureError: fewer than two members, an impossible length, or members whose difference depends on no input.
    """
    from optid.faults.repair.allocation import _bounds
    from optid.faults.repair.damage import damages

    plant = getattr(model, "model", model)
    broken = [one for member in members for one in ([member] if isinstance(member, Damage) else damages(plant, member))]
    if len(broken) < 2:
        raise StructureError("A probe tells several explanations apart: give at least two.")
    if length < 2 or hold < 1:
        raise StructureError(f"length={length!r}, hold={hold!r}: at least 2 samples, and levels of at least one.")
    least, most = _bounds(plant, low, high)
    rows, constant = _responses(plant, broken, length)
    pairs = [(i, j) for i in range(len(broken)) for j in range(i)]
    differences = [(rows[i] - rows[j], constant[i] - constant[j]) for i, j in pairs]
    moving = [float(np.abs(M).max(initial=0.0)) for M, _ in differences]
    if max(moving) <= 1e-12:
        raise StructureError(
            "What these explanations leave differs by nothing that an input changes: a probe cannot help. Wait, or "
            "check the parts by hand."
        )
    levels = _Levels(plant, least, most, length, hold)

    def separation(u: Array) -> tuple[float, int]:
        v = levels.values(u).ravel()
        found = [float(np.linalg.norm(M @ v + d)) for M, d in differences]
        return min(found), int(np.argmin(found))

    rng = np.random.default_rng(seed)
    ordinary = float(np.median([separation(levels.random(rng))[0] for _ in range(STARTS)]))
    best, reached = levels.random(rng), -1.0
    for _ in range(STARTS):
        u = levels.corner(rng)
        value = separation(u)[0]
        for _ in range(ROUNDS):
            improved = False
            for k in range(u.shape[0]):
                for c in range(u.shape[1]):
                    trial = u.copy()
                    trial[k, c] = least[c] if u[k, c] == most[c] else most[c]
                    new = separation(trial)[0]
                    if new > value * (1 + 1e-12):
                        u, value, improved = trial, new, True
            if not improved:
                break
        if value > reached:
            best, reached = u, value
    size = levels.largest()
    bounds = [float(np.linalg.norm(M, 2)) * size + float(np.linalg.norm(d)) for M, d in differences]
    pair = pairs[separation(best)[1]]
    return Probe(levels.inputs(best), reached, ordinary, min(bounds), (broken[pair[1]].label, broken[pair[0]].label))


class _Levels:
    """Inputs with levels that are held."""

    def __init__(self, model: "HammersteinSS", low: Array, high: Array, length: int, hold: int) -> None:
        self.model, self.low, self.high, self.length, self.hold = model, low, high, length, hold
        self.count = -(-length // hold)

    def random(self, rng: np.random.Generator) -> Array:
        return rng.uniform(self.low, self.high, (self.count, self.low.size))

    def corner(self, rng: np.random.Generator) -> Array:
        return np.where(rng.random((self.count, self.low.size)) < 0.5, self.low, self.high)

    def inputs(self, u: Array) -> Array:
        return np.repeat(u, self.hold, axis=0)[: self.length]

    def values(self, u: Array) -> Array:
        return self.model.expanded(self.inputs(u))

    def largest(self) -> float:
        """Largest norm of f(u) over the probe."""
        points = np.linspace(self.low, self.high, 201)
        return float(np.sqrt(self.length * np.sum(np.max(self.model.expanded(points) ** 2, axis=0))))


def _responses(model: "HammersteinSS", members: Sequence[Damage], length: int) -> tuple[list[Array], list[Array]]:
    """What each member leaves in the whitened innovations: M v + d, M (length l, length r), d (length l,)."""
    steady, r, count = predictor(model), model.B.shape[1], length
    impulse_x, impulse_y = np.zeros((count, model.nx, r)), np.zeros((count, model.l, r))
    impulse_x[1], impulse_y[0] = model.B, model.D
    if count == 1:
        impulse_x[0] = 0.0
    one = steady.whitened(steady.respond(impulse_x, impulse_y))
    rows, constants = [], []
    for member in members:
        change = member.gains - 1
        M = np.zeros((count, model.l, count, r))
        for k in range(count):
            M[k:, :, k, :] = one[: count - k] * change
        added = np.asarray(model.B @ member.constants + member.added)
        direct = np.asarray(model.D @ member.constants)
        x, y = np.tile(added, (count, 1))[:, :, None], np.tile(direct, (count, 1))[:, :, None]
        x[0] = 0.0
        constants.append(steady.whitened(steady.respond(x, y)).ravel())
        rows.append(M.reshape(count * model.l, count * r))
    return rows, constants


def advise(
    model: "HammersteinSS", members: Sequence[Damage], u: Array | None, robust: Robust | None, why_not: str,
    *, action: str = "auto", seed: int = 0,
) -> Ambiguity:
    """Choose between waiting, probing and acting robustly.

    Args:
        model: the healthy model.
        members: the explanations that are left.
        u: (N, m) recent inputs, from which the ordinary input is judged; None where there are none.
        robust: control for all of them, where there is one.
        why_not: why there is none.
        action: "wait", "probe", "robust", or "auto".
        seed: of the probe.

    Raises:
        StructureError: an action that is unknown, or not possible here.
    """
    if action not in ("auto", "wait", "probe", "robust"):
        raise StructureError(f"if_ambiguous={action!r}: use 'auto', 'wait', 'probe' or 'robust'.")
    wait = _waiting(model, members, u)
    probe, no_probe = None, ""
    try:
        probe = probe_input(model, members, seed=seed)
    except StructureError as error:
        no_probe = str(error)
    if action == "probe" and probe is None or action == "robust" and robust is None:
        raise StructureError(no_probe if action == "probe" else why_not)
    soon = f"about {wait:.0f} more samples tell them apart"
    waiting = soon if np.isfinite(wait) else "waiting will not tell them apart"
    reason = f"as asked for ({waiting})"
    if action == "auto":
        if wait <= PATIENCE:
            action, reason = "wait", waiting
        elif probe is not None and probe.separation >= APART and probe.separation > 1.2 * probe.ordinary:
            action, reason = "probe", f"{waiting}; {len(probe.u)} samples of the probe do"
        elif robust is not None:
            action, reason = "robust", f"{waiting}, and no short probe does"
        else:
            action, reason = "wait", f"{waiting}; no robust control: {why_not}"
    return Ambiguity(action, reason, tuple(one.label for one in members), tuple(one.posterior for one in members), wait,
                     robust, probe)


def _waiting(model: "HammersteinSS", members: Sequence[Damage], u: Array | None) -> float:
    """Samples until the closest pair is apart under the ordinary input."""
    if len({tuple(one.sensors) for one in members}) > 1 and not any(
        np.any(one.gains != 1) or np.any(one.constants) or np.any(one.added) for one in members
    ):
        return float("inf")
    count = 60
    inputs = None if u is None else u[-count:]
    if inputs is None or len(inputs) < 2 or np.isnan(inputs).any():
        return float("inf")
    rows, constants = _responses(model, members, len(inputs))
    v = model.expanded(inputs).ravel()
    traces = [(M @ v + d).reshape(len(inputs), -1) for M, d in zip(rows, constants)]
    rates = [
        float(np.mean(np.sum((traces[i] - traces[j])[len(inputs) // 3 :] ** 2, axis=1)))
        for i in range(len(traces)) for j in range(i)
    ]
    return APART**2 / min(rates) if min(rates) > 1e-9 else float("inf")
