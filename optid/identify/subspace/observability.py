"""The observability matrix of a record: order, weighting, missing outputs and simulated instruments."""

import warnings
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optid.arrays import Array, check_integer
from optid.errors import DataWarning, RankError, StructureError
from optid.identify.noise import with_noise_or_reason
from optid.identify.order.ranks import largest_gap, order_test
from optid.identify.subspace.imputation import impute
from optid.identify.subspace.plan import BEST, Plan
from optid.identify.subspace.projection import WEIGHTINGS, Projection, project, realise, weakest_feedback
from optid.identify.subspace.realisation import Realisation, observer_problem
from optid.identify.subspace.regressors import ObserverForm
from optid.models.hammerstein_ss import HammersteinSS
from optid.models.kalman import kalman_gain
from optid.models.roots import spectral_radius
from optid.statistics.expansion import Expansion
from optid.statistics.hankel import complete_runs

WEAK = 0.1  # share of the energy of the feedback that simulated feedback explains, below which a warning is given
# missing outputs are estimated where fewer complete windows than this are left per row of the Hankel matrix, and a
# smaller share than this of all windows
SCARCE, INTACT = 20, 0.8
LEAST = 1e-10  # relative singular value below which a direction is always dropped
INSIDE = 0.999  # modulus to which the poles of an unstable estimate are brought


@dataclass(frozen=True, eq=False)
class Windows:
    """The signals of a record in windows of 2 alpha samples."""

    plan: Plan  # the request
    records: list[Array]  # raw channels, with simulated outputs where the expansion reads them
    expansion: Expansion  # the signals
    alpha: int  # block rows of the past and of the future

    @classmethod
    def of(cls, plan: Plan) -> "Windows":
        """Return the signals of a plan; too few block rows are a `StructureError`."""
        expansion, nx = plan.expansion(), plan.order
        alpha = (expansion.block_rows(plan.records, nx) if plan.block_rows is None
                 else check_integer(plan.block_rows, "block_rows", 2))
        if nx is not None and alpha <= nx:
            raise StructureError(f"{alpha} block rows for order {nx}: more block rows than states are required; use "
                                 f"block_rows={nx + 1} or more, or nx={alpha - 1} or less.")
        return cls(plan, plan.records, expansion, alpha)

    def are_scarce(self) -> bool:
        """Whether missing outputs leave few complete windows for the rows of the Hankel matrix.

        With block rows given by the user, missing outputs are estimated only where the plan says so.
        """
        plan, x, rows = self.plan, self.expansion, 2 * self.alpha
        gaps = any(plan.data.missing[name] for name in plan.data.outputs)
        if not gaps or plan.block_rows is not None and not plan.imputes:
            return False
        runs = [run for record in self.records for run in complete_runs(record, rows)]
        complete, candidates = (sum(max(len(part) - rows + 1, 0) for part in parts) for parts in (runs, self.records))
        return complete < INTACT * candidates and complete < SCARCE * rows * (x.p + x.q + x.l)

    def project(self) -> Projection:
        """Return the projection with the instruments and the weighting of the plan."""
        plan = self.plan
        found = project(self.records, self.expansion, self.alpha, instruments=plan.instruments, offset=plan.offset,
                        form=plan.form, tolerance=None if plan.tolerance is None else max(plan.tolerance, LEAST))
        return found if plan.weighting == BEST else replace(found, weighting=plan.weighting)

    def observability_matrix(self) -> "Observability":
        """Return the observability matrix in the weighting of the plan."""
        projection = self.project()
        return self.observability(projection, self.order(projection)[0])

    def observability(self, projection: Projection, nx: int) -> "Observability":
        """Return the observability matrix of a projection for order nx."""
        return Observability(self, projection.gamma(nx), projection.scale)

    def with_instruments(self) -> "Windows":
        """Return the same with outputs simulated by preliminary models where these are instruments.

        The first model has past outputs as instruments; where the regressors are then singular, it has no feedback.
        """
        plan, raw = self.plan, self.records
        if not plan.instruments.startswith("simulated"):
            return self
        if not self.expansion.q:
            return replace(self, plan=replace(plan, instruments=plan.instruments.replace("simulated", "inputs")))
        from optid.identify.subspace.instruments import simulate_clipped  # compiled code is loaded where it is needed

        windows = replace(self, plan=replace(plan, instruments="inputs+past"))
        for i in range(plan.iterations):
            try:
                found = windows.observability_matrix()
            except RankError:
                if i:
                    raise
                found = replace(self, plan=replace(plan, instruments="inputs"),
                                expansion=self.expansion.without_feedback()).observability_matrix()
            a = found.estimate_dynamics()
            step = found.step(a)
            outputs = simulate_clipped(raw, found.windows.expansion, a, step.form.c,
                                       step.matrices(step.least_squares()))
            windows = replace(self, records=[np.hstack([record, y]) for record, y in zip(raw, outputs)],
                              expansion=replace(self.expansion, simulated=True))
        return windows

    def best_weighting(self, projection: Projection, nx: int) -> Projection:
        """Return the projection in the weighting whose (A, C) leaves the smallest error, a stable one if there is."""
        tried = []
        for word in WEIGHTINGS:
            weighted = replace(projection, weighting=word)
            found = self.observability(weighted, nx)
            error = found.step(found.estimate_dynamics(), instruments=False).problem.remainder
            tried.append((spectral_radius(found.least_squares()) >= 1, error, weighted))
        return min(tried, key=lambda one: one[:2])[2]

    def order(self, projection: Projection) -> tuple[int, str]:
        """Return the order, and the reason where it was estimated."""
        nx, values, reason = self.plan.order, projection.values, ""
        rank = projection.rank
        if self.plan.nx == "auto" and rank <= min(self.alpha - 1, values.size - 1):  # a record without noise
            nx, reason = rank, f"{rank}: the following singular values are rounding"
        elif self.plan.nx == "auto":
            try:
                nx, reason = order_test(self.records, self.expansion, self.alpha, instruments=self.plan.instruments,
                                        offset=self.plan.offset).choice
            except RankError:  # singular regressors, or a record too short for the distribution
                nx = None
        if nx is None:
            floor = 10 * values.size * np.finfo(float).eps * values[0]  # the rounding of the decomposition
            nx = largest_gap(values, min(self.alpha - 1, values.size // 2), floor)
            following = values[nx] if nx < values.size else 0.0
            reason = f"{nx}: the largest gap of the singular values, {values[nx - 1]:.3g} before {following:.3g}"
        if nx > rank:
            raise RankError(f"order {nx}, but the projected outputs have rank {rank}: use nx={rank} or less, more "
                            "block rows or a richer input.")
        return nx, reason


@dataclass(frozen=True, eq=False)
class Observability:
    """An estimate of the observability matrix, and the record from which the other matrices are estimated."""

    windows: Windows  # the record
    gamma: Array  # (rows l, n) observability matrix, in units of the outputs
    scale: Array  # (l,) sizes of the outputs, by which it and the residuals are divided
    figures: dict[str, Any] = field(default_factory=dict)  # for the fit

    @property
    def scaled(self) -> Array:
        """Gamma of the outputs divided by their sizes."""
        return self.gamma / np.tile(self.scale, len(self.gamma) // len(self.scale))[:, None]

    def least_squares(self) -> Array:
        """Return A (n, n) by least squares."""
        return realise(self.scaled, len(self.scale))[0]

    def estimate_dynamics(self) -> Array:
        """Return A by least squares, contracted where it is unstable."""
        a = self.least_squares()
        radius = spectral_radius(a)
        return a if radius < 1 else a * (INSIDE / radius)

    def step(self, a: Array, *, instruments: bool = True) -> Realisation:
        """Compress the least squares for B, D, E, offset and x0 with a given A (n, n).

        Simulated feedback functions are instruments unless the noise counts as white (past outputs as instruments).
        """
        plan, records, expansion = self.windows.plan, self.windows.records, self.windows.expansion
        c = self.gamma[: len(self.scale)].copy()
        closed = plan.observer == "kalman" or (plan.observer == "auto" and spectral_radius(a) >= 1)
        # noise of the same size at all outputs, in the units of their residuals
        level = float(np.mean(np.sum(c**2, axis=1))) * np.eye(len(c))
        gain = np.array(kalman_gain(a, c, np.eye(len(a)), level).K) if closed else np.zeros((len(a), len(c)))
        coloured = instruments and expansion.simulated and not plan.instruments.endswith("past")
        form = ObserverForm(a, c, gain, expansion, len(records), plan.direct(), plan.offset, 1 / self.scale, coloured)
        return observer_problem(records, form, plan, [record[:, plan.data.m :] for record in plan.records])

    def model(self) -> HammersteinSS:
        """Return the least-squares model without constraints, A contracted; errors as of `step`."""
        step = self.step(self.estimate_dynamics())
        return step.model(step.start())


def estimate_observability(plan: Plan) -> Observability:
    """Project, estimate the order and choose the weighting; missing outputs that leave few windows are estimated first.

    What the record does not determine is a `RankError`. Estimated outputs, and simulated feedback that explains little
    of the measured one, cause a `DataWarning`.
    """
    windows, imputed = Windows.of(plan), {}
    if windows.are_scarce():
        filled, how = impute(plan.data, lambda records: _preliminary(replace(windows, records=records)))
        windows, imputed = replace(windows, records=filled), {"missing outputs": how}
        warnings.warn(f"missing outputs leave too few complete windows of {2 * windows.alpha} samples; {how}. The "
                      "criterion of the last step uses the samples present", DataWarning, stacklevel=2)
    windows = windows.with_instruments()
    projection, expansion = windows.project(), windows.expansion
    nx, reason = windows.order(projection)
    figures: dict[str, Any] = {
        "order": nx, **({"order chosen": reason} if reason else {}), "block rows": windows.alpha,
        "windows": projection.statistics.windows, **imputed, "instruments": windows.plan.instruments}
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


def _preliminary(windows: Windows) -> HammersteinSS:
    """Return the model, with its noise model, of records whose missing outputs are estimated."""
    plan = windows.plan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # about a model that only serves to estimate
        if windows.expansion.q and not plan.instruments.endswith("past"):  # a model that predicts; the last counts
            plan = replace(plan, instruments=f"{plan.instruments}+past")
        found = replace(windows, plan=plan).with_instruments().observability_matrix()
        return with_noise_or_reason(found.model(), plan.data)[0]
