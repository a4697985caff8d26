"""The observability matrix of a record: order, weighting, missing outputs and simulated instruments."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optid.arrays import Array, check_integer
from optid.errors import DataWarning, RankError
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
    else:
        alpha = check_integer(given, "block_rows", 2)
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
    windows, imputed = _Windows(plan, plan.records, expansion, alpha, plan.instruments), {}
    if _lacks_windows(plan, expansion, alpha):
        imputation = impute(plan.data, lambda filled: _estimated(replace(windows, records=filled), preliminary))
        windows, imputed = replace(windows, records=imputation.records), {"missing outputs": str(imputation)}
        warnings.warn(f"missing outputs leave too few complete windows of {2 * alpha} samples; {imputation}. The "
                      "criterion of the last step uses the samples present", DataWarning, stacklevel=2)
    windows = windows.instrumented()
    projection, expansion = windows.projected(), windows.expansion
    nx, reason = windows.order(projection)
    figures: dict[str, Any] = {
        "order": nx, **({"order chosen": reason} if reason else {}), "block rows": alpha,
        "windows": projection.statistics.windows, **imputed, "instruments": windows.instruments}
    if plan.weighting == BEST:
        projection = windows.best_weighting(projection, nx)
        figures["weighting"] = f"{projection.weighting}: the smallest error on the record"
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
    return replace(windows.observability(projection, nx), figures=figures)


def _lacks_windows(plan: Plan, expansion: Expansion, alpha: int) -> bool:
    """Whether missing outputs cost many of the windows, and those left are few for the rows of the Hankel matrix.

    Block rows that were asked for stay: what is missing is then refused.
    """
    gaps = any(plan.data.missing[name] for name in plan.data.outputs)
    if not gaps or plan.block_rows is not None and not plan.imputes:
        return False
    complete, candidates = count_windows(plan.records, 2 * alpha)
    return complete < INTACT * candidates and complete < SCARCE * 2 * alpha * (expansion.p + expansion.q + expansion.l)


def _estimated(windows: "_Windows", preliminary: Preliminary) -> HammersteinSS:
    """Return the preliminary model of records whose missing outputs are estimated."""
    plan = windows.plan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # about a model that only serves to estimate
        if windows.expansion.q and not plan.instruments.endswith("past"):  # a model that predicts; the last counts
            plan = replace(plan, instruments=f"{plan.instruments}+past")
        return preliminary(replace(windows, plan=plan, instruments=plan.instruments).instrumented().ordered())


@dataclass(frozen=True, eq=False)
class _Windows:
    """Signals in windows of 2 alpha samples, and the instruments for them."""

    plan: Plan
    records: list[Array]
    expansion: Expansion
    alpha: int
    instruments: str

    def projected(self) -> Projection:
        plan = self.plan
        return project(self.records, self.expansion, self.alpha, instruments=self.instruments, offset=plan.offset,
                       form=plan.form, tolerance=plan.tolerance,
                       weighting=WEIGHTINGS[0] if plan.weighting == BEST else plan.weighting)

    def ordered(self) -> Observability:
        """Return the observability matrix in the weighting that was asked for."""
        projection = self.projected()
        return self.observability(projection, self.order(projection)[0])

    def observability(self, projection: Projection, nx: int) -> Observability:
        return Observability(self.plan, self.records, self.expansion, projection.gamma(nx), projection.scale)

    def instrumented(self) -> "_Windows":
        """Return the same with simulated outputs where these are instruments.

        Any preliminary model will do for the simulation, which depends on the inputs alone. The first one has past
        outputs as instruments; where the regressors are singular then, it has no feedback.
        """
        plan, raw = self.plan, self.records
        if not plan.instruments.startswith("simulated"):
            return self
        if not self.expansion.q:
            return replace(self, instruments=plan.instruments.replace("simulated", "inputs"))
        windows = replace(self, instruments="inputs+past")
        for i in range(plan.iterations):
            try:
                found = windows.ordered()
            except RankError:
                if i:
                    raise
                found = replace(self, expansion=self.expansion.without_feedback(), instruments="inputs").ordered()
            a = found.contracted()
            step = found.step(a)
            bu, du, ez, d, _ = step.matrices(step.least_squares())
            outputs = simulate_clipped(raw, found.expansion, a, step.form.c, bu, du, ez, d)
            windows = replace(self, records=[np.hstack([record, y]) for record, y in zip(raw, outputs)],
                              expansion=self.expansion.with_simulated(), instruments=plan.instruments)
        return windows

    def best_weighting(self, projection: Projection, nx: int) -> Projection:
        """Return the projection in the weighting whose (A, C) leaves the smallest error on the record.

        None is best on all records: the canonical weighting has the smaller variance where the order suffices, the
        others keep the outputs with most energy where it does not. A stable estimate comes before one that had to be
        moved.
        """
        tried = []
        for word in WEIGHTINGS:
            weighted = replace(projection, weighting=word)
            found = self.observability(weighted, nx)
            error = found.step(found.contracted(), instruments=False).problem.remainder
            tried.append((spectral_radius(found.pair()[0]) >= 1, error, weighted))
        return min(tried, key=lambda one: one[:2])[2]

    def order(self, projection: Projection) -> tuple[int, str]:
        """Return the order, and where it was to be found the reason in words."""
        nx, values, reason = self.plan.order, projection.values, ""
        rank = projection.rank
        if self.plan.nx == "auto" and rank <= min(self.alpha - 1, values.size - 1):  # a record without noise
            nx, reason = rank, f"{rank}: the singular values after it are rounding"
        elif self.plan.nx == "auto":
            try:
                nx, reason = order_test(self.records, self.expansion, self.alpha, instruments=self.instruments,
                                        offset=self.plan.offset).choice
            except RankError:  # singular regressors, or a record too short for the distribution
                nx = None
        if nx is None:
            nx = largest_gap(values, min(self.alpha - 1, values.size // 2))
            following = values[nx] if nx < values.size else 0.0
            reason = f"{nx}: the largest gap of the singular values, {values[nx - 1]:.3g} before {following:.3g}"
        if nx > rank:
            raise RankError(f"order {nx}, but the projected outputs have rank {rank}: use nx={rank} or less, more "
                            "block rows or a richer input.")
        return nx, reason
