"""The errors of a state-space model, simulation (K = 0) or innovation form, and their sensitivities, chunk by chunk.

The unknowns are full matrices; changes of the states, and the scale between mu and b, are projected out at every
iterate (data-driven local coordinates, McKelvey, Helmersson and Ribarits 2004). Sensitivities are recursions along the
run of the simulator (`optid.models.state_kernels`), and a chunk is reduced to a factor of [sensitivities | errors]. The
error of a missing output is left out, without a correction, and the model output is fed back.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp

from optid.arrays import Array
from optid.bases import Basis, Linear
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import DataError, RankError, StructureError
from optid.identify.prediction_error.compressed_errors import CompressedStates
from optid.identify.prediction_error.criterion import Criterion
from optid.identify.subspace.realisation import state_model
from optid.models import HammersteinSS, Nonlinearity
from optid.models import state_simulation as simulation
from optid.models.roots import spectral_radius
from optid.models.state_signals import Stretch
from optid.program.units import outer_bases
from optid.statistics.linearised import Linearised, Method, linearise_errors
from optid.statistics.state_unknowns import SIMULATORS, StatePoint, StateUnknowns

STABLE = 1 - 1e-9
HUGE = 1e250  # sum of squared sensitivities beyond which a run counts as one that leaves its range
NUMBERS = 500_000  # entries of the sensitivities formed at a time
WILD = 10.0  # times the range of the record that the run of an iterate must not leave
ROUNDING = 1e-9  # share of an interval within which its ends are the same
FLOOR = 1e-7  # smallest standard deviation of an error that weights may rest on, as a share of that of its output
DEPENDENT = 1e-12  # smallest eigenvalue of the correlation of errors that can be weighted
HEIGHTS = frozenset({"mu", "Theta", "offset", "x0", "states", "static", "mu feedback", "Theta feedback"})
"""Named quantities in the unit of the outputs; A, C, K and the norm of b have none."""


@dataclass(frozen=True, eq=False)
class StateErrors(Criterion):
    """The weighted sum of squared errors of all outputs."""

    data: Data  # the record
    unknowns: StateUnknowns  # their order, and the criterion
    weight: Array  # (l, l) weight of the errors
    units: Transform  # from those of the models of points to those of the record
    limit: float = STABLE  # modulus below which the poles that carry the state must stay
    # constraints on poles that every iterate satisfies: model -> violation, "" for none
    checks: tuple[Callable[[Any], str], ...] = ()
    shifts: Array | None = None
    gauge: ClassVar[str] = "norm"

    def key(self, name: str, number: int) -> str:
        """Return the name of a quantity of an input, a family of feedback functions or a latent signal."""
        x = self.unknowns.expansion
        if name in ("c", "g", "z"):
            word = {"c": "mu latent", "g": "b latent", "z": "z"}[name]
            return word if len(self.unknowns.latent) == 1 else f"{word}[{number + 1}]"
        if name in ("nu", "e"):
            word = {"nu": "mu feedback", "e": "b feedback"}[name]
            return word if x.l == 1 else f"{word}[{x.output_names[x.feedback[number].output]}]"
        return name if x.m == 1 else f"{name}[{x.input_names[number]}]"

    def facts(self) -> dict[str, Any]:
        """Return what constraints may ask besides named expressions: keyword arguments of a `View`."""
        x = self.unknowns.expansion
        return {"gauge": self.gauge, "channels": x.input_names, "outputs": x.output_names, "units": self.units,
                "heights": HEIGHTS, "courses": frozenset({"output"}),
                "bases": dict(zip(x.input_names, outer_bases(x.inputs, self.units)))}

    def model(self, values: Mapping[str, Array], constrained: bool = True) -> HammersteinSS:
        """Return the model of named values, in the units of the problem; without constraints in its usual gauge."""
        found = self.at(self.unknowns.unpack(self.variables.pack(values)))
        return found.regauge("norm") if any(self.unknowns.free) and not constrained else found

    @property
    def bends(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether outputs or latent signals of a run act on its states."""
        return self.limits is not None

    @cached_property
    def limits(self) -> tuple[Any, ...] | None:
        """Ranges that runs must not leave, where outputs or latent signals act on states."""
        unknowns = self.unknowns
        if unknowns.innovations or not (unknowns.expansion.feedback or unknowns.latent):
            return None
        return tuple(simulation.allowed_range([e.y], WILD) for e in self.data.experiments)

    def compressed_near(self, at: Linearised, x: Array) -> CompressedStates:
        """Return the compressed errors near x, ``at`` the errors there."""
        return CompressedStates(self, at, x)

    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x; of infinite value where a run leaves the range allowed."""
        n, p, experiments = self.unknowns.memory, self.unknowns.shared, self.unknowns.experiments
        try:
            return linearise_errors(self.rows(x), experiments, n, p, self.gauge_rows(x), method)
        except (FloatingPointError, DataError):
            nothing = (np.eye(n), np.zeros((n, p)), np.zeros(n))
            return Linearised(np.eye(p), np.zeros(p), (nothing,) * experiments, np.inf, 0, 1.0, "gram")

    def rows(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return a generator of the weighted rows [x0 | shared | error] of experiment i, zero where y is missing."""
        unknowns, covariance = self.unknowns, np.linalg.inv(self.weight)
        point, model = self._placed(x)
        chunk = max(32, NUMBERS // ((unknowns.memory + unknowns.shared + 1) * unknowns.l))

        def weighted_blocks(index: int) -> Iterator[tuple[Array, int]]:
            for block in _runs(self._job(model, index), unknowns, point, index, chunk):
                count = int(np.count_nonzero(~np.isnan(block[:, :, -1])))
                block = _weighted(block, covariance)
                if not np.vdot(block, block) < HUGE:
                    raise FloatingPointError
                yield block.reshape(-1, block.shape[2]), count

        return weighted_blocks

    def admissible(self, x: Array) -> bool:
        """Whether the matrix that carries the state is stable enough, and the constraints on poles hold."""
        if not np.all(np.isfinite(x)):
            return False
        point = self.unknowns.unpack(x)
        if spectral_radius(point.A - point.K @ point.C) >= self.limit:
            return False
        return not self.checks or not any(check(self.at(point)) for check in self.checks)

    def gain_sign(self, x: Array, b: str) -> float:
        """Return the sign of the gain from an input, or of the largest entry of what a latent signal adds."""
        return float(self._placed(x)[1].gain_signs[int(b[1:])]) if b.startswith("b") else super().gain_sign(x, b)

    def gauge_rows(self, x: Array) -> Array:
        """Orthonormal directions (rows, shared) of theta that a step does not take, since they change no output."""
        at, rows = self.unknowns.slices, list(self.unknowns.similarity(x))
        for mu, b in self.unknowns.products:
            row = np.zeros(self.unknowns.shared)
            row[at[mu]], row[at[b]] = x[at[mu]], -x[at[b]]
            rows.append(row)
        if not rows:
            return np.zeros((0, self.unknowns.shared))
        values, vectors = np.linalg.svd(np.array(rows), full_matrices=False)[1:]
        return vectors[values > 1e-12 * values[0]]

    def value(self, x: Array) -> float:
        """Return the weighted sum of squared errors; infinite where a run leaves the range allowed."""
        try:
            found, covariance = self.residuals(x), np.linalg.inv(self.weight)
        except DataError:
            return np.inf
        total = sum(float(np.sum(_weighted(e[:, :, None], covariance) ** 2)) for e in found)
        return total if np.isfinite(total) else np.inf

    def residuals(self, x: Array) -> list[Array]:
        """Return the errors (N, l) of every experiment, NaN where y is missing; a run out of range: `DataError`."""
        point, model = self._placed(x)
        return [simulation.run(self._job(model, i), point.x0[i]) - e.y for i, e in enumerate(self.data.experiments)]

    def run_states(self, point: StatePoint) -> list[Array]:
        """Return the states (N, n) of the run of every experiment, whatever its range."""
        _, model = self._placed(self.unknowns.pack(point))
        return [simulation.run_states(self._job(model, i, within=False), x0) for i, x0 in enumerate(point.x0)]

    def _job(self, model: HammersteinSS, index: int, within: bool = True) -> simulation.Run:
        e, limits = self.data.experiments[index], self.limits[index] if within and self.limits else None
        return simulation.prepare_run(model, SIMULATORS[self.unknowns.criterion], e.u, e.y, limits, "")

    def output_weights(self, i: int) -> sp.csr_array:
        """Return the matrix that weighs the outputs of an experiment, column by column, as far as they are present."""
        here, covariance = np.isfinite(self.data.experiments[i].y), np.linalg.inv(self.weight)
        blocks = []
        for pattern in np.unique(here[here.any(axis=1)], axis=0):
            there = np.flatnonzero(pattern)
            picked = sp.eye_array(len(here)).tocsr()[np.flatnonzero((here == pattern).all(axis=1))]
            blocks.append(sp.kron(weight_root(covariance, ~pattern)[there], picked))
        return sp.csr_array(sp.vstack(blocks))

    def reweight(self, x: Array, full: bool) -> "StateErrors":
        """Return the criterion weighted by the inverse (co)variance of the errors at x.

        A fixed point is stationary for the determinant of the covariance (``full``), or the product of the variances.
        """
        errors = np.vstack(self.residuals(x))
        floor = FLOOR * np.nanstd(np.vstack([e.y for e in self.data.experiments]), axis=0)
        complete = errors[~np.isnan(errors).any(axis=1)]
        variances = np.maximum(np.nanmean(errors**2, axis=0), floor**2)
        covariance = np.diag(variances)
        if full and len(complete) > 10 * errors.shape[1]:
            covariance = complete.T @ complete / len(complete) + np.diag(floor**2)
            self._check_rank(covariance)
        return replace(self, weight=np.linalg.inv(covariance))

    def _check_rank(self, covariance: Array) -> None:
        """Refuse errors of outputs that determine one another: `RankError`."""
        sizes = np.sqrt(np.diag(covariance))
        values, axes = np.linalg.eigh(covariance / np.outer(sizes, sizes))
        if values[0] < DEPENDENT:
            names = [name for name, share in zip(self.data.outputs, axes[:, 0]) if abs(share) > 0.1]
            remedy = "leave one of them out"
            if any(self.unknowns.feedthrough):
                remedy += ("; if a controller computes an input from them at once, what was fitted is its inverse: fit "
                           "without it, feedthrough=false")
            raise RankError(f"the prediction errors of {', '.join(names)} determine one another to {DEPENDENT:.0e} of "
                            f"their variance, so that they cannot be weighted: {remedy}")

    def level(self, x: Array, full: bool = False) -> float:
        """Return the log determinant that `reweight` lowers, which compares points of different weights."""
        return -float(np.linalg.slogdet(self.reweight(x, full).weight)[1])

    def _placed(self, x: Array) -> tuple[StatePoint, HammersteinSS]:
        """Return the point and the model at x; the last ones are kept, since every step asks twice."""
        key = x.tobytes()
        if key not in self._last:
            point = self.unknowns.unpack(x)
            model = self.at(point)
            if self.unknowns.levels:  # the constants are states of the run
                model = replace(model, offset_y=np.zeros(model.l)).with_level_states
            self._last.clear()
            self._last[key] = point, model
        return self._last[key]

    @cached_property
    def _last(self) -> dict[bytes, tuple[StatePoint, HammersteinSS]]:
        return {}

    def at(self, point: StatePoint) -> HammersteinSS:
        """Build the model of a point."""
        levels, offset = None, point.offset
        if self.unknowns.levels:
            levels = point.x0[:, self.unknowns.n :] + (0.0 if self.shifts is None else self.shifts)
            offset = levels.mean(axis=0)
        matrices = {"A": point.A, "B": point.b, "C": point.C, "D": point.d, "K": point.K, "offset_y": offset}
        plain = state_model(self.unknowns.expansion, self.data, matrices, point.mus, point.nus, point.e)
        plain = replace(plain, levels=levels)
        if not self.unknowns.latent:
            return plain
        functions = [Nonlinearity(one.basis, one.vectors @ c) for one, c in zip(self.unknowns.latent, point.cs)]
        return replace(plain, latent=tuple(functions), Ez=point.Ez, Fz=point.Fz, Cz=point.Cz, Dz=point.Dz,
                       offset_z=point.offset_z)

    def point_of(self, model: HammersteinSS) -> StatePoint:
        """Return the point of a model of the same structure, initial states zero; refuse others (`StructureError`)."""
        unknowns, x = self.unknowns, self.unknowns.expansion
        if model.nx != unknowns.n or model.m != x.m or model.l != x.l or len(model.nonlinearities) != x.m:
            raise StructureError(f"a start has {model.nx} states, {model.m} inputs and {model.l} outputs, the fit "
                                 f"{unknowns.n}, {x.m} and {x.l}")
        pairs = [(f.basis, basis) for f, basis in zip(model.nonlinearities, x.inputs)]
        pairs += [(g.basis, family.basis) for g, family in zip(model.feedback, x.feedback)]
        pairs += [(h.basis, one.basis) for h, one in zip(model.latent, unknowns.latent)]
        if not all(_same(one, other) for one, other in pairs) or len(model.feedback) > len(x.feedback) or (
                len(model.latent) != len(unknowns.latent)):
            raise StructureError("a start has other basis functions than the fit: give it the same bases")
        mus = [np.ones(1) if not free else f.mu for f, free in zip(model.nonlinearities, unknowns.free)]
        scale = [1.0 if free else float(f.mu[0]) for f, free in zip(model.nonlinearities, unknowns.free)]
        nus: list[Any] = [np.ones(family.size) for family in x.feedback]
        columns = np.zeros((unknowns.n, len(x.feedback)))
        constant, injection = np.array(model.offset_x), np.array(model.L)
        for f, (g, family) in enumerate(zip(model.feedback, x.feedback)):
            nu = np.linalg.lstsq(family.vectors, g.mu)[0]
            constant += model.E[:, f] * (nu @ family.intercept)
            injection += np.outer(model.E[:, f], nu @ family.slope)
            nus[f], columns[:, f] = (nu, model.E[:, f]) if family.size > 1 else (np.ones(1), model.E[:, f] * nu[0])
        # the rest of L goes into A, the constant of the state into that of the output
        A, b = model.A + injection @ model.C, (model.B + injection @ model.D) * scale
        constant = constant + injection @ model.offset_y
        shift = np.linalg.lstsq(np.eye(unknowns.n) - A, constant)[0]
        gain = model.K + injection if unknowns.innovations else np.zeros_like(model.K)
        d = model.D * scale * np.array(unknowns.feedthrough)
        constant = model.offset_y + model.C @ shift
        offset = constant if unknowns.constant else np.zeros(unknowns.l)
        x0 = np.zeros((unknowns.experiments, unknowns.memory))
        x0[:, unknowns.n :] = constant[: unknowns.memory - unknowns.n]
        cs = tuple(np.linalg.lstsq(one.vectors, h.mu)[0] for one, h in zip(unknowns.latent, model.latent))
        return StatePoint(A, np.array(model.C), gain, offset, tuple(mus), b, d, tuple(nus), columns, x0, cs,
                          model.Ez + injection @ model.Fz, model.Fz, model.Cz, model.Dz, model.offset_z)


def _same(one: Basis, other: Basis) -> bool:
    """Whether two bases have the same functions, up to the rounding of their intervals by a change of units."""
    if isinstance(one, Linear) and isinstance(other, Linear):
        return True
    ends, others = (np.array(basis.interval or (np.nan, np.nan)) for basis in (one, other))
    near = bool(np.allclose(ends, others, rtol=0, atol=ROUNDING * max(np.ptp(ends), 1e-300), equal_nan=True))
    return near and one.to_dict() | {"interval": None} == other.to_dict() | {"interval": None}


def _weighted(block: Array, covariance: Array) -> Array:
    """Weigh rows (T, l, q), the last column the errors, in place where that is possible; zero where one is missing."""
    missing = np.isnan(block[:, :, -1])
    if missing.any():
        block[missing] = 0.0
        for pattern in np.unique(missing, axis=0):
            rows = (missing == pattern).all(axis=1)
            block[rows] = weight_root(covariance, pattern) @ block[rows]
        return block
    root = weight_root(covariance, missing[0])
    if np.any(root - np.diag(np.diag(root))):
        return root @ block
    block *= np.diag(root)[:, None]
    return block


def weight_root(covariance: Array, missing: Any) -> Array:
    """Return the square root R of the weight of the outputs present, with e^T R^T R e the weighted square."""
    here, root = np.flatnonzero(~missing), np.zeros((missing.size, missing.size))
    if here.size:
        root[np.ix_(here, here)] = np.linalg.cholesky(np.linalg.inv(covariance[np.ix_(here, here)])).T
    return root


def _runs(job: simulation.Run, unknowns: StateUnknowns, point: StatePoint, index: int, chunk: int) -> Iterator[Array]:
    """Yield the sensitivities and the errors in the last column, (T, l, memory + shared + 1), chunk by chunk."""
    from optid.models.state_kernels import sensitivities

    n, l, parts = unknowns.memory, unknowns.l, job.model.parts  # noqa: E741
    direct, state, turn = unknowns.direct(point), point.x0[index].copy(), np.eye(n, n + unknowns.shared)
    for first in range(0, len(job.u), chunk):
        samples = slice(first, min(first + chunk, len(job.u)))
        eta = [basis.values(job.u[samples, c]) for c, basis in enumerate(unknowns.expansion.inputs)]
        f = np.column_stack([part @ mu for part, mu in zip(eta, point.mus)])
        stretch, block = simulation.stretch_of(job, samples, f), np.empty((len(f), l, turn.shape[1] + 1))
        run = simulation.march(job, first, stretch, state)
        about = simulation.signals(job, stretch, *run)
        values = _values(unknowns, point, stretch, run, about.slopes, job.u[samples], [f, *eta])
        sensitivities(parts, direct, about._replace(values=values), turn, block)
        block[:, :, -1] = run[1] - job.y[samples]
        yield block


def _values(unknowns: StateUnknowns, point: StatePoint, stretch: Stretch, run: tuple[Array, Array], slopes: Array,
            u: Array, driven: Sequence[Array]) -> Array:
    """Return the signals of a run (T, s) that multiply unknowns, in the order of `StateUnknowns.signals`.

    The run has states and outputs; ``driven`` are f of the inputs u (T, m), and the functions of every input.
    """
    (states, outputs), (f, *eta) = run, driven
    missing, one, states = np.isnan(stretch.y), np.ones((len(u), 1)), states[:, : unknowns.n]
    fed, argument = np.where(missing, outputs, stretch.y), np.hstack([states, u, one])
    zeta = [family.values(fed) for family in unknowns.expansion.feedback]
    z = (stretch.z + states @ point.Cz.T).T
    phi = [latent.basis.values(signal) @ latent.vectors for latent, signal in zip(unknowns.latent, z)]
    g, w = ([part @ one for part, one in zip(parts, of)] for parts, of in ((zeta, point.nus), (phi, point.cs)))
    innovations = np.where(missing, 0.0, stretch.y - outputs)
    return np.column_stack([states, innovations, f, *g, *w, one, *eta, *zeta, *phi,
                            *(slope[:, None] * argument for slope in slopes.T)])
