"""Refit of a damaged model, from what broke alone to all parameters, as the record grows: decided by hold-out."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

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
"""Share of the samples after the fault that decides between the two."""

FEWEST = 20
"""Samples after the fault below which all parameters are not tried."""

MARGIN = 2.0
"""By how much the squared innovations of the held-out samples must fall for all parameters to be taken."""

DRAWS = 100

BENDS = (0.01, 0.03, 0.1, 0.2)
"""Curvatures of the prior that are tried."""

STAGES = ("prior", "affected only", "all with prior")


@dataclass(frozen=True, eq=False)
class Values:
    """A damaged nonlinearity after its refit.

    Attributes:
        name: the input.
        u: (P + 1,) nodes.
        healthy: (P + 1,) values before.
        values: (P + 1,) values now, in the scale of the healthy one.
        std: (P + 1,) their standard errors, bounds not counted.
        prior_only: (P + 1,) whether the record says nothing of a value.
        seen: smallest and largest input in the record.
        excitation: smallest eigenvalue of what the record says of the values that it visits, in squared deviations
            of the innovations per half of the healthy range.
    """

    name: str
    u: Array
    healthy: Array
    values: Array
    std: Array
    prior_only: NDArray[np.bool_]
    seen: tuple[float, float]
    excitation: float

    def __str__(self) -> str:
        """Print the values as a table."""
        head = f"  {'u':>9}{'before':>12}{'now':>12}{'+-':>10}"
        rows = [
            f"  {u:>9.3g}{old:>12.4g}{new:>12.4g}{std:>10.2g}{'  prior only' if unseen else ''}"
            for u, old, new, std, unseen in zip(self.u, self.healthy, self.values, self.std, self.prior_only)
        ]
        return "\n".join([f"f of {self.name}", head, *rows])


@dataclass(frozen=True, eq=False)
class Schedule:
    """How the model was refitted.

    Attributes:
        stage: "prior" (too few samples), "affected only" or "all with prior".
        samples: samples after the fault.
        least: fewest samples for a refit.
        held_out: {stage: mean squared whitened innovation of the samples held out}; empty where only one was tried.
        values: the damaged nonlinearities.
        offsets: {fault: size estimated along}.
        fit_interval: 90 % interval of the simulation fit (%) that the uncertainty of the refit leaves; NaN without one.
        active: constraints that bind.
        solution: of the last programme; None without one.
        reason: why this stage.
    """

    stage: str
    samples: int
    least: int
    held_out: dict[str, float]
    values: tuple[Values, ...]
    offsets: dict[str, Array]
    fit_interval: tuple[float, float]
    active: tuple[str, ...]
    solution: "Solution | None" = field(default=None, repr=False)
    reason: str = ""

    def __str__(self) -> str:
        """Say what was refitted from what, and why."""
        lines = [f"refit: {self.stage}, {self.samples} samples after the fault ({self.reason})"]
        if self.solution is not None:
            lines.append(f"  {self.solution.solver}: {self.solution.status}, {self._proof()}")
        if self.active:
            lines.append(f"  binding: {', '.join(self.active)}")
        if np.isfinite(self.fit_interval[0]):
            low, high = self.fit_interval
            lines.append(f"  expected simulation fit {fit_words(low, high)}")
        lines += [f"  {name}: {np.array2string(size, precision=4)}" for name, size in self.offsets.items()]
        return "\n".join([*lines, *(str(values) for values in self.values)])

    def _proof(self) -> str:
        assert self.solution is not None
        return f"gap {self.solution.gap:.1e}" if self.solution.proof else "no proof of global optimality"


def fit_words(low: float, high: float) -> str:
    """Return an interval of a fit in words; a fit below zero is worse than the mean of the outputs, by how much or not.

    Args:
        low: lower end, %.
        high: upper end, %.
    """
    if high <= 0:
        return "none: what is left of the outputs is smaller than the uncertainty of the refit"
    return f"{max(low, 0.0):.1f} to {high:.1f} %"


def refit(
    model: "HammersteinSS", data: Data, damage: Damage, *, constraints: Sequence[Any] | str = "default",
    prior: Prior | None = None, nodes: int = NODES, stage: str = "auto", solver: Any = "auto", seed: int = 0,
) -> tuple["HammersteinSS", Schedule]:
    """Refit what a fault broke, and all parameters once held-out samples say that this is better.

    Args:
        model: the healthy model.
        data: the record with the fault.
        damage: what broke.
        constraints: of the damaged nonlinearities; see `formulations.faults.refit`.
        prior: what is believed beforehand; by default with the curvature that makes the record most probable.
        nodes: values of a nonlinearity that has no nodes of its own.
        stage: "affected only", "all with prior", or "auto": by hold-out.
        solver: back end.
        seed: of the draws behind the interval of the fit.

    Warns:
        DataWarning: too few samples for a refit, with the least number; part of the input range that no sample visits.
    """
    how: dict[str, Any] = {
        "damaged": damage.columns, "offsets": damage.offsets, "prior": prior, "nodes": nodes,
        "known_start": damage.same_onset, "dead": damage.dead,
    }
    try:
        narrow = refitting(model, data, damage.onset, **how)
    except RankError as error:
        warnings.warn(f"{damage.label}: no refit. {error}", DataWarning, stacklevel=3)
        counted = sum(1 if i in damage.dead else nodes for i in damage.columns) + sum(
            c.into_state.shape[1] for c in damage.offsets)
        after = max(0, data.experiments[0].y.shape[0] - damage.onset)
        none = Schedule("prior", after, -(-counted // model.l), {}, (), {}, (float("nan"), float("nan")), (), None,
                        "too few for a refit: the model is what the diagnosis says")
        return damage.believed(model), none
    if prior is None and narrow.curves:
        prior = likeliest(narrow)
        how["prior"], narrow = prior, replace(narrow, prior=prior)
    scores: dict[str, float] = {}
    reason = "as asked for"
    if stage == "auto":
        stage, reason = "affected only", f"fewer than {FEWEST} samples: all parameters are not tried"
        if narrow.samples >= FEWEST and not damage.dead:
            wide = refitting(model, data, damage.onset, **how, whole=True)
            scores = _scores(narrow, wide, constraints, solver)
            better = scores["affected only"] - scores["all with prior"] > MARGIN / _held(narrow)[1]
            stage = "all with prior" if better else "affected only"
            reason = "by hold-out"
        elif damage.dead:
            reason = "a dead actuator has one value"
    problem = narrow if stage == "affected only" else refitting(model, data, damage.onset, **how, whole=True)
    found = _solved(problem, constraints, solver)
    least = -(-sum(1 if c.dead else c.nodes.size for c in problem.curves) // model.l)
    return _told(problem, found, stage, least, scores, reason, seed)


def likeliest(problem: Refitting) -> Prior:
    """Return the prior whose curvature makes the record most probable: how much a fault bends is not known before."""
    priors = [Prior(problem.prior.damaged, curvature, problem.prior.healthy) for curvature in BENDS]
    return max(priors, key=lambda prior: replace(problem, prior=prior).evidence())


def _held(problem: Refitting) -> tuple[int, int]:
    """Samples held out of the last experiment, and their readings."""
    last = problem.windows[-1]
    samples = max(3, int(HELD_OUT * (len(last.u) - int(last.held))))
    return samples, max(1, int(last.present[-samples:].sum()))


def _scores(narrow: Refitting, wide: Refitting, constraints: Sequence[Any] | str, solver: Any) -> dict[str, float]:
    samples, readings = _held(narrow)
    scores = {}
    for word, problem in (("affected only", narrow), ("all with prior", wide)):
        theta = _solved(problem.held_out(samples), constraints, solver).model.theta
        scores[word] = float(np.sum(problem.linearised(theta)[0][-readings:] ** 2)) / readings
    return scores


def _solved(problem: Refitting, constraints: Sequence[Any] | str, solver: Any) -> Any:
    from optid.errors import SolverFailed
    from optid.registry import fault_formulation
    from optid.solving.solve import run

    name = "refit.parameters" if problem.whole else "refit.actuator"
    found = run(fault_formulation(name)(problem, constraints=constraints), solver)
    if found.model is None or found.solution.status.value in ("failed", "infeasible", "unbounded"):
        why = found.solution.reason or found.solution.claimed
        raise SolverFailed(f"the refit found no point that holds ({found.solution.status}: {why}): no model")
    return found


def _told(problem: Refitting, found: Any, stage: str, least: int, scores: dict[str, float], reason: str, seed: int
          ) -> tuple["HammersteinSS", Schedule]:
    theta, model = found.model.theta, found.model.model
    _, sensitivities = problem.linearised(theta)
    covariance: Any = np.linalg.pinv(problem.information(theta, sensitivities), hermitian=True)
    values = tuple(_values(problem, curve, theta, covariance, sensitivities) for curve in problem.curves)
    for one, curve in zip(values, problem.curves):
        if one.prior_only.any() and not curve.dead:
            at = ", ".join(f"{u:.3g}" for u in one.u[one.prior_only])
            warnings.warn(
                f"{one.name}: no sample after the fault lies near {at} (inputs from {one.seen[0]:.3g} to "
                f"{one.seen[1]:.3g}): the values there are prior only.", DataWarning, stacklevel=4,
            )
    unpacked = problem.unpack(theta)
    offsets = {c.label: unpacked[f"size[{c.label}]"] for c in problem.offsets}
    for c in problem.offsets:
        last = 1.0 if c.kind != "drift" else float(len(problem.windows[0].u) - int(problem.windows[0].held))
        size = last * offsets[c.label]
        model = replace(model, offset_x=model.offset_x + c.into_state @ size)
    duals = found.solution.duals
    active = tuple(
        name for name in found.program.user_constraints
        if name in duals and np.max(np.abs(duals[name]), initial=0.0) > 1e-6 * max(found.solution.objective, 1e-300)
    )
    interval = _fit_interval(problem, theta, covariance, seed)
    return model, Schedule(stage, problem.samples, least, scores, values, offsets, interval, active, found.solution,
                           reason)


def _values(problem: Refitting, curve: Curve, theta: Array, covariance: Array, sensitivities: Array) -> Values:
    start = problem.slices[f"mu[{curve.name}]"].start
    part = slice(start, start + curve.nodes.size)
    values = curve.to_nodes @ theta[part]
    spread = curve.to_nodes @ covariance[part, part] @ curve.to_nodes.T
    by_value: Any = sensitivities[:, part] @ np.linalg.inv(curve.to_nodes) * curve.half_range
    seen = ~curve.prior_only
    gram: Any = by_value[:, seen].T @ by_value[:, seen]
    excitation = float(np.linalg.eigvalsh(gram)[0]) if seen.any() else 0.0
    return Values(
        curve.name, curve.nodes, curve.healthy, values, np.sqrt(np.maximum(np.diag(spread), 0.0)),
        curve.prior_only, curve.seen, max(excitation, 0.0),
    )


def _fit_interval(problem: Refitting, theta: Array, covariance: Array, seed: int) -> tuple[float, float]:
    """Return the 5 and 95 % points of the fit of the model to models drawn from what is left of the uncertainty."""
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
