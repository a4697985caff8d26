"""The observability matrix of a record: order, weighting, missing outputs and simulated instruments."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import DataWarning, RankError, StructureError
from optid.identify.order.signals import order_test
from optid.identify.subspace.imputation import count_windows, impute
from optid.identify.subspace.instruments import simulate_clipped
from optid.identify.subspace.observer import ObserverForm, ObserverProblem, observer_gain, observer_problem
from optid.identify.subspace.plan import BEST, Plan
from optid.identify.subspace.projection import (
    WEIGHTINGS,
    Projection,
    check_order,
    largest_gap,
    project,
    scaled_pair,
    weakest_feedback,
)
from optid.models.hammerstein_ss import HammersteinSS
from optid.models.roots import spectral_radius
from optid.statistics.channels import check_channels
from optid.statistics.expansion import Expansion

WEAK = 0.1
"""Share of the energy of the feedback functions that the simulated ones explain below which the user is told."""

SCARCE, INTACT = 20, 0.8
"""Missing outputs are estimated where fewer complete windows than this are left per row of the Hankel matrix, and a
smaller share than this of all windows."""

INSIDE = 0.999
"""Modulus to which the poles of an unstable estimate are brought."""


@dataclass(frozen=True, eq=False)
class Observability:
    """An estimate of the observability matrix, and the record on which the other matrices follow from it.

    Attributes:
        plan: what was asked for.
        records: raw channels, with simulated outputs where the expansion reads them.
        expansion: the signals.
        gamma: (rows l, n) observability matrix, in units of the outputs.
        scale: (l,) sizes of the outputs, by which it and the residuals are divided.
        figures: what was measured on the way.
    """

    plan: Plan
    records: list[Array]
    expansion: Expansion
    gamma: Array
    scale: Array
    figures: dict[str, Any] = field(default_factory=dict)

    def pair(self) -> tuple[Array, Array, Array]:
        """Return (A, C) by least squares, and gamma of the outputs divided by their sizes."""
        return scaled_pair(self.gamma, self.scale)

    def contracted(self) -> Array:
        """Return A by least squares, contracted where it is unstable: for simulations and comparisons."""
        a = self.pair()[0]
        radius = spectral_radius(a)
        return a if radius < 1 else a * (INSIDE / radius)

    def step(self, a: Array, *, instruments: bool = True) -> ObserverProblem:
        """Compress the least squares for B, D, E, offset and x0 with a given A.

        Args:
            a: (n, n).
            instruments: take simulated feedback functions as instruments where the noise may be coloured; where past
                outputs may be instruments, it is white and least squares has the smaller variance.
        """
        plan, c = self.plan, self.gamma[: len(self.scale)].copy()
        closed = plan.observer == "kalman" or (plan.observer == "auto" and spectral_radius(a) >= 1)
        gain = observer_gain(a, c) if closed else np.zeros((len(a), len(c)))
        form = ObserverForm(a, c, gain, self.expansion, len(self.records), plan.direct(), plan.offset, 1 / self.scale)
        coloured = instruments and self.expansion.simulated and not plan.instruments.endswith("past")
        return observer_problem(self.records, form, instruments=coloured,
                                targets=[record[:, plan.data.m :] for record in plan.records])


Preliminary = Callable[[Observability], HammersteinSS]
"""Returns the least-squares model with its noise model, without constraints."""


def prepared(plan: Plan) -> tuple[Expansion, int]:
    """Return the signals of a plan and its number of block rows, after the checks of its channels.

    Raises:
        StructureError: an order that the block rows cannot carry.
        DataError: a constant channel.
    """
    expansion, given = plan.expansion(), plan.block_rows
    check_channels(plan.records, plan.data.inputs, plan.data.outputs)
    if given is None:
        alpha = expansion.block_rows(plan.records, plan.order)
    elif isinstance(given, bool) or not isinstance(given, int | np.integer) or given < 2:
        raise StructureError(f"block_rows={given!r}: a whole number from 2, larger than the order.")
    else:
        alpha = int(given)
    if plan.order is not None:
        check_order(plan.order, alpha, plan.data.l)
    return expansion, alpha


def estimate_observability(plan: Plan, preliminary: Preliminary) -> Observability:
    """Project, find the order and choose the weighting; where missing outputs leave few windows, estimate them first.

    Args:
        plan: what is asked for.
        preliminary: of a record with estimated outputs.

    Raises:
        RankError: the record does not determine the model.

    Warns:
        DataWarning: missing outputs are estimated; the simulated feedback explains little of the measured one.
    """
    expansion, alpha = prepared(plan)
    records, imputed = plan.records, {}
    if _lacks_windows(plan, expansion, alpha):
        imputation = impute(plan.data, lambda filled: _estimated(plan, expansion, alpha, filled, preliminary))
        records, imputed = imputation.records, {"missing outputs": str(imputation)}
        warnings.warn(f"missing outputs leave too few complete windows of {2 * alpha} samples; {imputation}. The "
                      "criterion of the last step uses the samples present", DataWarning, stacklevel=2)
    records, expansion, instruments = _instrumented(plan, records, expansion, alpha)
    projection = _projected(plan, records, expansion, alpha, instruments)
    nx, reason = _order(plan, projection, records, expansion)
    figures: dict[str, Any] = {"order": nx, **({"order chosen": reason} if reason else {}), "block rows": alpha,
                               "windows": projection.statistics.windows, **imputed, "instruments": instruments}
    if plan.weighting == BEST:
        projection, figures["weighting"] = _best_weighting(plan, records, expansion, projection, nx)
    height = 1.0 if plan.weighting == "cva" else plan.units.y_scale[0]  # unit of the singular values
    figures |= {"singular values": height * projection.values, "condition of R11": projection.blocks.condition}
    if expansion.simulated:
        share, output = weakest_feedback(projection, expansion)
        figures["share of the feedback that the simulated one explains"] = share
        if share < WEAK:
            warnings.warn(f"the simulated feedback of output {output!r} explains {100 * share:.1f} % of the measured "
                          "one: its effect will be uncertain. Use noise='white' where the noise allows it, more "
                          "iterations or a stronger input.", DataWarning, stacklevel=2)
    if projection.blocks.discarded:
        figures["regressor directions left out"] = projection.blocks.discarded
    return Observability(plan, records, expansion, projection.gamma(nx), projection.scale, figures)


def _lacks_windows(plan: Plan, expansion: Expansion, alpha: int) -> bool:
    """Whether missing outputs cost many of the windows, and those left are few for the rows of the Hankel matrix.

    Block rows that were asked for stay: what is missing is then refused.
    """
    gaps = any(plan.data.missing[name] for name in plan.data.outputs)
    if not gaps or plan.block_rows is not None and not plan.imputes:
        return False
    complete, candidates = count_windows(plan.records, 2 * alpha)
    return complete < INTACT * candidates and complete < SCARCE * 2 * alpha * (expansion.p + expansion.q + expansion.l)


def _estimated(plan: Plan, expansion: Expansion, alpha: int, records: list[Array], preliminary: Preliminary
               ) -> HammersteinSS:
    """Return the preliminary model of records whose missing outputs are estimated."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # about a model that only serves to estimate
        if expansion.q and not plan.instruments.endswith("past"):  # a model that predicts; the last one is consistent
            plan = replace(plan, instruments=f"{plan.instruments}+past")
        records, expansion, instruments = _instrumented(plan, records, expansion, alpha)
        return preliminary(_ordered(plan, records, expansion, alpha, instruments))


def _instrumented(plan: Plan, raw: list[Array], expansion: Expansion, alpha: int
                  ) -> tuple[list[Array], Expansion, str]:
    """Return the records, with simulated outputs where these are instruments, their signals, and the instruments.

    Any preliminary model will do for the simulation, which depends on the inputs alone. The first one has past outputs
    as instruments; where the regressors are singular then, it has no feedback.
    """
    if not plan.instruments.startswith("simulated"):
        return raw, expansion, plan.instruments
    if not expansion.q:
        return raw, expansion, plan.instruments.replace("simulated", "inputs")
    signals, records, kind = expansion, raw, "inputs+past"
    for i in range(plan.iterations):
        try:
            found = _ordered(plan, records, signals, alpha, kind)
        except RankError:
            if i:
                raise
            signals = expansion.without_feedback()
            found = _ordered(plan, records, signals, alpha, "inputs")
        a = found.contracted()
        step = found.step(a)
        bu, du, ez, d, _ = step.matrices(step.least_squares())
        outputs = simulate_clipped(raw, signals, a, step.form.c, bu, du, ez, d)
        records = [np.hstack([record, y]) for record, y in zip(raw, outputs)]
        signals, kind = expansion.with_simulated(), plan.instruments
    return records, signals, plan.instruments


def _ordered(plan: Plan, records: list[Array], expansion: Expansion, alpha: int, instruments: str) -> Observability:
    projection = _projected(plan, records, expansion, alpha, instruments)
    nx, _ = _order(plan, projection, records, expansion)
    return Observability(plan, records, expansion, projection.gamma(nx), projection.scale)


def _projected(plan: Plan, records: list[Array], expansion: Expansion, alpha: int, instruments: str) -> Projection:
    return project(records, expansion, alpha, instruments=instruments, offset=plan.offset, form=plan.form,
                   tolerance=plan.tolerance, weighting=WEIGHTINGS[0] if plan.weighting == BEST else plan.weighting)


def _best_weighting(plan: Plan, records: list[Array], expansion: Expansion, projection: Projection, nx: int
                    ) -> tuple[Projection, str]:
    """Return the projection in the weighting whose (A, C) leaves the smallest error on the record, and its word.

    None is best on all records: the canonical weighting has the smaller variance where the order suffices, the others
    keep the outputs with most energy where it does not. A stable estimate comes before one that had to be moved.
    """
    tried = []
    for word in WEIGHTINGS:
        weighted = replace(projection, weighting=word)
        found = Observability(plan, records, expansion, weighted.gamma(nx), weighted.scale)
        error = found.step(found.contracted(), instruments=False).problem.remainder
        tried.append((spectral_radius(found.pair()[0]) >= 1, error, word, weighted))
    _, _, word, best = min(tried, key=lambda one: one[:2])
    return best, f"{word}: the smallest error on the record"


def _order(plan: Plan, projection: Projection, records: list[Array], expansion: Expansion) -> tuple[int, str]:
    """Return the order, and where it was to be found the reason in words."""
    nx, values, reason = plan.order, projection.values, ""
    rank = projection.rank
    if plan.nx == "auto" and rank <= min(projection.block_rows - 1, values.size - 1):  # a record without noise
        nx, reason = rank, f"{rank}: the singular values after it are rounding"
    elif plan.nx == "auto":
        try:
            nx, reason = order_test(records, expansion, projection.block_rows, instruments=projection.instruments,
                                    offset=plan.offset).choice
        except RankError:  # singular regressors, or a record too short for the distribution
            nx = None
    if nx is None:
        nx = largest_gap(values, min(projection.block_rows - 1, values.size // 2))
        following = values[nx] if nx < values.size else 0.0
        reason = f"{nx}: the largest gap of the singular values, {values[nx - 1]:.3g} before {following:.3g}"
    if nx > rank:
        raise RankError(f"order {nx}, but the projected outputs have rank {rank}: use nx={rank} or less, more block "
                        "rows or a richer input.")
    return nx, reason
