"""Refit of a damaged model: of the damaged part alone, or of all parameters where hold-out favours it."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataWarning, RankError
from optid.faults.repair.curves import Curve
from optid.faults.repair.damage import Damage
from optid.faults.repair.refitting import NODES, Prior, Refitting, refitting

if TYPE_CHECKING:
    from optid.models import HammersteinSS
    from optid.program.solution import Solution

HELD_OUT = 0.3
"""Share of the samples after the fault that is held out."""

FEWEST = 20
"""Samples after the fault below which all parameters are not tried."""

MARGIN = 2.0
"""Reduction of the squared innovations of the held-out samples from which all parameters are refitted."""

DRAWS = 100

BENDS = (0.01, 0.03, 0.1, 0.2)
"""Curvatures of the prior that are tried."""

STAGES = ("affected only", "all with prior")


@dataclass(frozen=True, eq=False)
class Schedule:
    """How the model was refitted."""

    stage: str  # "prior" (too few samples), "affected only" or "all with prior"
    samples: int  # samples after the fault
    least: int  # fewest samples for a refit
    # {stage: mean squared whitened innovation of the samples held out}; empty where only one was tried
    held_out: dict[str, float]
    values: tuple[Curve, ...]  # the damaged nonlinearities
    offsets: dict[str, Array]  # {fault: estimated size}
    # 90 % interval of the simulation fit (%) from the uncertainty of the refit; NaN without one
    fit_interval: tuple[float, float]
    active: tuple[str, ...]  # constraints that bind
    solution: "Solution | None" = field(default=None, repr=False)  # of the last programme; None without one
    reason: str = ""  # why this stage

    def __str__(self) -> str:
        """Return the stage, the reason, the fit expected and the values."""
        lines = [f"refit: {self.stage}, {self.samples} samples after the fault ({self.reason})"]
        if self.solution is not None:
            proof = f"gap {self.solution.gap:.1e}" if self.solution.proof else "no proof of global optimality"
            lines.append(f"  {self.solution.solver}: {self.solution.status}, {proof}")
        if self.active:
            lines.append(f"  binding: {', '.join(self.active)}")
        if np.isfinite(self.fit_interval[0]):
            low, high = self.fit_interval
            lines.append(f"  expected simulation fit {fit_words(low, high)}")
        lines += [f"  {name}: {np.array2string(size, precision=4)}" for name, size in self.offsets.items()]
        return "\n".join([*lines, *(str(values) for values in self.values)])


def fit_words(low: float, high: float) -> str:
    """Return the words for an interval of a fit (%); below zero its value means nothing."""
    if high <= 0:
        return "none: the simulated outputs are smaller than the uncertainty of the refit"
    return f"{max(low, 0.0):.1f} to {high:.1f} %"


def refit(
    model: "HammersteinSS", data: Data, damage: Damage, *, constraints: Sequence[Any] | str = "default",
    prior: Prior | None = None, nodes: int = NODES, stage: str = "auto", solver: Any = "auto", seed: int = 0,
) -> tuple["HammersteinSS", Schedule]:
    """Refit what a fault broke, or all parameters where that predicts held-out samples better.

    Arguments other than the damage are those of `reformulate`.

    Warns:
        DataWarning: too few samples for a refit, with the least number; part of the input range that no sample visits.
    """
    try:
        narrow = refitting(model, data, damage, prior=prior, nodes=nodes)
    except RankError as error:
        warnings.warn(f"{damage.label}: no refit. {error}", DataWarning, stacklevel=3)
        counted = sum(1 if i in damage.dead else nodes for i in damage.columns) + sum(
            c.into_state.shape[1] for c in damage.offsets)
        after = max(0, data.experiments[0].y.shape[0] - damage.onset)
        none = Schedule("prior", after, -(-counted // model.l), {}, (), {}, (float("nan"), float("nan")), (), None,
                        "too few for a refit: the model is that of the diagnosis")
        return damage.believed(model), none
    if prior is None and narrow.curves:  # of the curvatures the one that makes the record most probable
        tried = [replace(narrow, prior=replace(narrow.prior, curvature=curvature)) for curvature in BENDS]
        narrow = max(tried, key=Refitting.evidence)
    scores: dict[str, float] = {}
    reason = "as asked for"
    if stage == "auto":
        stage, reason = "affected only", f"fewer than {FEWEST} samples: all parameters are not tried"
        if damage.dead:
            reason = "a dead actuator has one value" if narrow.samples >= FEWEST else reason
        elif narrow.samples >= FEWEST:
            last = narrow.windows[-1]
            samples = max(3, int(HELD_OUT * (len(last.u) - int(last.held))))
            readings = max(1, int(last.present[-samples:].sum()))
            for word in STAGES:
                problem = replace(narrow, whole=word == "all with prior")
                theta = _solved(problem.held_out(samples), constraints, solver).model.theta
                scores[word] = float(np.sum(problem.linearised(theta)[0][-readings:] ** 2)) / readings
            better = scores["affected only"] - scores["all with prior"] > MARGIN / readings
            stage, reason = STAGES[int(better)], "by hold-out"
    problem = replace(narrow, whole=stage == "all with prior")
    found = _solved(problem, constraints, solver)
    theta, model = found.model.theta, found.model.model
    sensitivities = problem.linearised(theta)[1]
    covariance = problem.covariance(sensitivities)
    curves = tuple(_estimated(problem, curve, theta, covariance, sensitivities) for curve in problem.curves)
    for one in curves:
        if one.prior_only.any() and not one.dead:
            at = ", ".join(f"{u:.3g}" for u in one.nodes[one.prior_only])
            warnings.warn(
                f"{one.name}: no sample after the fault lies near {at} (inputs from {one.seen[0]:.3g} to "
                f"{one.seen[1]:.3g}): the values there are prior only.", DataWarning, stacklevel=3,
            )
    offsets = {c.label: problem.unpack(theta)[f"size[{c.label}]"] for c in problem.offsets}
    for c in problem.offsets:
        last = 1.0 if c.kind != "drift" else float(len(problem.windows[0].u) - int(problem.windows[0].held))
        model = replace(model, offset_x=model.offset_x + c.into_state @ (last * offsets[c.label]))
    duals, objective = found.solution.duals, max(found.solution.objective, 1e-300)
    active = tuple(name for name in found.program.user_constraints
                   if np.max(np.abs(duals.get(name, 0.0)), initial=0.0) > 1e-6 * objective)
    least = -(-sum(curve.values_open for curve in curves) // model.l)
    return model, Schedule(stage, problem.samples, least, scores, curves, offsets,
                           _fit_interval(problem, theta, covariance, seed), active, found.solution, reason)


def _solved(problem: Refitting, constraints: Sequence[Any] | str, solver: Any) -> Any:
    from optid.errors import SolverFailed
    from optid.registry import fault_formulation
    from optid.solving.solve import run

    name = "refit.parameters" if problem.whole else "refit.actuator"
    found = run(fault_formulation(name)(problem, constraints=constraints), solver)
    if found.model is None or found.solution.status.value in ("failed", "infeasible", "unbounded"):
        why = found.solution.reason or found.solution.claimed
        raise SolverFailed(f"the refit found no feasible point ({found.solution.status}: {why}): no model")
    return found


def _estimated(problem: Refitting, curve: Curve, theta: Array, covariance: Array, sensitivities: Array) -> Curve:
    part, seen = problem.part(curve), ~curve.prior_only
    spread = curve.to_nodes @ covariance[part, part] @ curve.to_nodes.T
    by_value: Any = sensitivities[:, part] @ np.linalg.inv(curve.to_nodes)[:, seen] * curve.half_range
    excitation = float(np.linalg.eigvalsh(by_value.T @ by_value)[0]) if seen.any() else 0.0
    return replace(curve, values=curve.to_nodes @ theta[part], excitation=max(excitation, 0.0),
                   std=np.sqrt(np.maximum(np.diag(spread), 0.0)))


def _fit_interval(problem: Refitting, theta: Array, covariance: Array, seed: int) -> tuple[float, float]:
    """Return the 5 and 95 % points of the fit of the model to models drawn from the posterior of the unknowns."""
    sizes, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    u = np.vstack([w.u for w in problem.windows])[-2000:]
    model = problem.model_at(theta)
    if not model.is_stable or model.feedback or model.L.any():
        return float("nan"), float("nan")
    x0 = np.linalg.lstsq(np.eye(model.nx) - model.A, model.B @ model.expanded(u[:1])[0] + model.offset_x, rcond=None)[0]
    own, fits = model.simulate(u, x0=x0), []
    rng = np.random.default_rng(seed)
    for _ in range(DRAWS):
        other = problem.model_at(theta + root @ rng.standard_normal(theta.size))
        if not other.is_stable:
            continue
        y = other.simulate(u, x0=x0)
        size = float(np.linalg.norm(y - y.mean(axis=0)))
        fits.append(100 * (1 - float(np.linalg.norm(y - own)) / size) if size > 0 else 100.0)
    if len(fits) < DRAWS / 2:
        return float("nan"), float("nan")
    low, high = np.quantile(fits, [0.05, 0.95])
    return float(low), float(high)
