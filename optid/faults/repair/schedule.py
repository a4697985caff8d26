"""Refit of a damaged model: of the damaged part alone, or of all parameters where hold-out favours it."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataWarning
from optid.faults.repair.curves import Curve
from optid.faults.repair.damage import Damage
from optid.faults.repair.promise import CONFIDENCE, Promise, errors, rms, upper_rms
from optid.faults.repair.refitting import NODES, RefitPrior, Refitting, refitting
from optid.models import HammersteinSS
from optid.models.experiments import in_units_of
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

    stage: str  # "prior" (too few samples), "affected only", "all with prior" or "none" (not offered)
    samples: int  # samples after the fault
    least: int  # fewest samples for a refit
    # {stage: mean squared whitened innovation of the samples held out}; empty where only one was tried
    held_out: dict[str, float]
    values: tuple[Curve, ...]  # the damaged nonlinearities
    offsets: dict[str, Array]  # {fault: estimated size}
    promise: Promise | None  # what is known of its errors; None without a refit
    active: tuple[str, ...]  # constraints that bind
    solution: Solution | None = field(default=None, repr=False)  # of the last programme; None without one
    reason: str = ""  # why this stage

    def __str__(self) -> str:
        lines = [f"refit: {self.stage}, {self.samples} samples after the fault ({self.reason})"]
        if self.solution is not None:
            proof = f"gap {self.solution.gap:.1e}" if self.solution.proof else "no proof of global optimality"
            lines.append(f"  {self.solution.solver}: {self.solution.status}, {proof}")
        if self.active:
            lines.append(f"  binding: {', '.join(self.active)}")
        if self.promise is not None:
            refusal = self.promise.refusal
            seen = ", ".join(f"{one.name} from {one.seen[0]:.4g} to {one.seen[1]:.4g}" for one in self.values)
            lines.append(f"  not offered: {refusal}" if refusal else f"  {self.promise}")
            lines += [f"  as long as the inputs stay where they were: {seen}"] * bool(seen and not refusal)
        lines += [f"  {name}: {np.array2string(size, precision=4)}" for name, size in self.offsets.items()]
        return "\n".join([*lines, *(str(values) for values in self.values)])


@dataclass(frozen=True)
class RefitRules:
    """How a damaged part is refitted; the attributes are arguments of `reformulate`."""

    constraints: Sequence[Any] | str = "default"
    prior: RefitPrior | None = None
    nodes: int = NODES
    stage: str = "auto"
    solver: Any = "auto"
    seed: int = 0


def refit(model: HammersteinSS, data: Data, damage: Damage, rules: RefitRules, healthy: Data | None = None
          ) -> tuple[HammersteinSS, Schedule]:
    """Refit what a fault broke, or all parameters where that predicts held-out samples better.

    The model, the data and `healthy` are those of `reformulate`. A repair that is not offered leaves the model as it
    was.

    Warns:
        DataWarning: too few samples for a refit, with the least number; part of the input range that no sample visits.
    """
    narrow, stage = refitting(model, data, damage, prior=rules.prior, nodes=rules.nodes), rules.stage
    if narrow.shortage:
        warnings.warn(f"{damage.label}: no refit. {narrow.shortage}", DataWarning, stacklevel=3)
        return damage.nominal_model(model), Schedule("prior", narrow.samples, narrow.least, {}, (), {}, None, (), None,
                                                     "too few for a refit: the model is that of the diagnosis")
    if rules.prior is None and narrow.curves:  # of the curvatures the one that makes the record most probable
        tried = [replace(narrow, prior=replace(narrow.prior, curvature=curvature)) for curvature in BENDS]
        narrow = max(tried, key=Refitting.evidence)
    scores: dict[str, float] = {}
    tried_on: dict[str, Any] = {}
    last = narrow.windows[-1]
    samples = max(3, int(HELD_OUT * (len(last.u) - int(last.held))))
    reason = "as asked for"
    if stage == "auto":
        stage, reason = "affected only", f"fewer than {FEWEST} samples: all parameters are not tried"
        if damage.dead:
            reason = "a dead actuator has one value" if narrow.samples >= FEWEST else reason
        elif narrow.samples >= FEWEST:
            readings = max(1, int(last.present[-samples:].sum()))
            for word in STAGES:
                problem = replace(narrow, whole=word == "all with prior")
                tried_on[word] = _solved(problem.held_out(samples), rules)
                theta = tried_on[word].model.theta
                scores[word] = float(np.sum(problem.linearise(theta)[0][-readings:] ** 2)) / readings
            better = scores["affected only"] - scores["all with prior"] > MARGIN / readings
            stage, reason = STAGES[int(better)], "by hold-out"
    problem = replace(narrow, whole=stage == "all with prior")
    found = _solved(problem, rules)
    before, theta = model, found.model.theta
    sensitivities = problem.linearise(theta)[1]
    covariance = problem.covariance(sensitivities)
    curves = tuple(_estimated(problem, curve, theta, covariance, sensitivities) for curve in problem.curves)
    for one in curves:
        if one.prior_only.any() and not one.dead:
            at = ", ".join(f"{u:.3g}" for u in one.nodes[one.prior_only])
            warnings.warn(
                f"{one.name}: no sample after the fault lies near {at} (inputs from {one.seen[0]:.3g} to "
                f"{one.seen[1]:.3g}): the values there are prior only.", DataWarning, stacklevel=3)
    offsets = {c.label: problem.unpack(theta)[f"size[{c.label}]"] for c in problem.offsets}
    model = _plant(problem, theta)
    duals, objective = found.solution.duals, max(found.solution.objective, 1e-300)
    active = tuple(name for name in found.problem.constraint_names
                   if np.max(np.abs(duals.get(name, 0.0)), initial=0.0) > 1e-6 * objective)
    promised = None
    if narrow.samples >= FEWEST:
        trial = tried_on.get(stage) or _solved(problem.held_out(samples), rules)
        raw = in_units_of(before, data)
        ends, first = raw.select(experiments=raw.n_experiments - 1), raw.select(experiments=0)
        held = ends.window(ends.n_samples - samples, ends.n_samples)
        sound = first.window(0, damage.onset) if healthy is None and damage.onset >= FEWEST else healthy
        with warnings.catch_warnings(action="ignore", category=DataWarning):
            repaired, unrepaired = errors(_plant(problem, trial.model.theta), held), errors(before, held)
            promised = Promise(
                before.outputs, upper_rms(np.full((1, before.l), np.nan) if sound is None else errors(before, sound)),
                upper_rms(repaired), rms(unrepaired), rms(repaired),
                _spread(problem, theta, covariance, ends, rules.seed),
                np.sqrt(np.diag(problem.steady.covariance)), not model.is_stable)
    refused = promised is not None and bool(promised.refusal)
    schedule = Schedule("none" if refused else stage, problem.samples, problem.least, scores, curves, offsets, promised,
                        active, found.solution, reason)
    return before if refused else model, schedule


def _plant(problem: Refitting, theta: Array) -> HammersteinSS:
    """Return the model of a refit, with what the faults add at the end of the record."""
    model = problem.model_at(theta)
    for c in problem.offsets:
        last = float(c.fault_kind.progress(problem.windows[0].since)[-1])
        size = problem.unpack(theta)[f"size[{c.label}]"]
        model = replace(model, offset_x=model.offset_x + c.into_state @ (last * size))
    return model


def _solved(problem: Refitting, rules: RefitRules) -> Any:
    from optid.errors import SolverFailed
    from optid.registry import fault_formulation
    from optid.solving.solve import run

    name = "refit.parameters" if problem.whole else "refit.actuator"
    found = run(fault_formulation(name)(problem, constraints=rules.constraints), rules.solver)
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


def _spread(problem: Refitting, theta: Array, covariance: Array, data: Data, seed: int) -> Array:
    """Return the rms difference (l,) that models drawn from the posterior of the unknowns reach with `CONFIDENCE`."""
    sizes, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    model, count = problem.model_at(theta), min(len(problem.windows[-1].u), 2000)
    record = data.window(data.n_samples - count, data.n_samples)
    own, found = errors(model, record), []
    rng = np.random.default_rng(seed)
    for _ in range(DRAWS):
        other = problem.model_at(theta + root @ rng.standard_normal(theta.size))
        if other.is_stable == model.is_stable:
            found.append(rms(errors(other, record) - own))
    if len(found) < DRAWS / 2:
        return np.full(model.l, np.inf)
    return np.quantile(np.nan_to_num(np.array(found)), CONFIDENCE, axis=0)
