"""The uncertainty of an identified model as additional noise in its innovations.

Let P be the covariance of the parameters of an identified model and Psi the sensitivity of the whitened innovations of
a window to them. The innovations of a healthy plant then have the covariance I + Psi P Psi', by which they are whitened
again. P is the inverse of the information in the record of identification. Changes of state coordinates, and factors
moved between f and B, change no prediction: Psi is zero along them, and the pseudo-inverse leaves them out.

Two more effects of a short record are taken into account. Its innovations are too small, because the parameters were
fitted to them: their covariance is their energy over the remaining degrees of freedom. And an estimated noise may have
no power at some frequency (often zero, where a constant and an initial state were fitted), so that its predictor never
forgets a deviation: measurement noise is added, n / N of the covariance of the innovations.

The covariance is that of the linearised predictions; the errors of a maximum-likelihood model from a short record are
larger. With a later healthy record, `model_uncertainty(model, data, healthy=...)` multiplies P by the largest factor
that this record allows.

Parameters that are not the most likely ones, such as those of a subspace fit, deviate from these by d = P Psi' r, r the
innovations of the record of identification: d d' is added to P where it is significant.

A plant outside the model class has no true parameters: those that fit best vary with the operating point, by more than
P. The record of identification is therefore cut into sections, by time and by the operating point: behind a controller
the curvature of the plant is attributed to the functions of the inputs, and a loss of effect, which moves the inputs
but not the outputs, would seem too small. Let S be the sensitivity of a section. Parameters that
vary between the sections with the covariance (c - 1) P give the innovations along S P S' (eigenvalues s^2 < 1) the
variance 1 + (c - 2) s^2: one s^2 less than in a later record, because the parameters were fitted to this one. P is
multiplied by the estimate of c (overdispersion) where c = 1 is rejected.

A fault can drive the plant far from where it was identified. What a model of a smooth plant lacks grows with the square
of the distance: where a reading is d half ranges from the middle of its range, d > 1, the effect of the parameters on
it is multiplied by d^2.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array, as_list
from optid.data.record import Data, Experiment
from optid.data.stretches import interpolate_missing
from optid.errors import DataError
from optid.faults.curvature import Products
from optid.faults.false_alarms import CONFIDENCE
from optid.faults.ranges import BEYOND, distance, outside, unknown_effects
from optid.faults.screening import check_causality
from optid.faults.whitening import Nuisance, Predictor, predictor, whiten
from optid.models import HammersteinSS
from optid.models import state_simulation as simulation
from optid.models.experiments import in_units_of

MATRICES = ("A", "B", "C", "D", "E", "L", "K", "offset_x", "offset_y")

STEP = 1e-5  # step of the central differences, relative to the parameter and to the size of its matrix
KNOWN = 1e-12  # share of the largest information below which a direction changes no prediction
FACTORS = 1.0, 1000.0, 300  # the smallest factor, the largest, and their number
SECTIONS = 10  # sections of the record of identification between which the parameters may vary
SMOOTHED = 5  # samples over which the operating point is averaged
REJECTED = 3.0  # standard deviations of the score at which equal parameters of all sections are rejected
LARGEST, OFTEN = 100, 10  # largest number of coefficients of products, and fewest samples for each parameter with them
ITERATIONS = 30  # iterations of the estimate of their variation
DRAWS = 4000  # simulated energies behind the bound of the factor
DIFFUSE = 1e6  # standard deviation of an unknown initial state, relative to its effect


@dataclass(frozen=True, eq=False)
class ModelUncertainty:
    """The covariance of the parameters of an identified model."""

    model: "HammersteinSS"  # the model, with the gain of the predictor
    predictor: Predictor  # of the noise with the corrections for a short record; used for windows
    root: Array  # (parameters, q) with covariance root root'
    readings: int  # number of readings behind it, less one for each initial state estimated
    inflation: float = 1.0  # factor of the covariance, from a healthy record or from the sections of the identification
    # (2, l) lowest and highest readings of the identification; None for a model that is exact
    levels: Array | None = None
    # of the parameters from the most likely ones, in standard deviations; 0 where it is not significant
    deviation: float = 0.0
    # the products whose coefficients are the last parameters; None where they are zero
    curvature: Products | None = None

    @cached_property
    def moves(self) -> list[tuple[HammersteinSS, HammersteinSS, float]]:
        """Two models on both sides along every column of root, and the factor of their difference."""
        theta, steps, back = parameters(self.model)
        root = self.root[: len(theta)]  # those of the model
        largest = np.abs(root / steps[:, None]).max(axis=0, initial=0.0)
        largest[largest == 0] = 1.0
        return [(back(theta + column / size), back(theta - column / size), float(size / 2))
                for column, size in zip(root.T, largest)]  # no parameter moves by more than its step

    @property
    def remark(self) -> str:
        """Advice where the parameters are not the most likely ones; empty otherwise."""
        if not self.deviation:
            return ""
        if self.curvature is not None:
            return (f"The plant is not of the class of the model ({self.deviation:.0f} standard deviations): products "
                    "of its inputs and outputs count as uncertain parameters.")
        return (f"The parameters are {self.deviation:.0f} standard deviations from the most likely ones, so that small "
                "faults stay hidden: fit the model by its prediction errors (hammerstein_ss.exact or ss.exact with "
                "criterion=prediction, behind a controller with feedthrough=false).")

    def distance(self, y: Array) -> Array:
        """Return how far readings (N, l) are from the middle of their identified range, in half ranges, at least one.

        A single reading far out is an outlier: the smallest of three neighbours counts.
        """
        from scipy.ndimage import minimum_filter1d

        return minimum_filter1d(distance(y, self.levels), 3, axis=0, mode="nearest")

    def output_range_notes(self, y: Array) -> list[str]:
        """State the outputs whose readings (N, l) leave the range they were identified over, and since when."""
        if self.levels is None:
            return []
        far, notes = self.distance(y) > BEYOND, []
        for name, low, high, samples in zip(self.model.outputs, *self.levels, map(np.flatnonzero, far.T)):
            if samples.size:
                notes.append(f"{name} is outside the identified range [{low:.4g}, {high:.4g}] in {samples.size} "
                             f"samples, first in sample {samples[0]}: the model is less certain there.")
        return notes

    def sensitivities(self, part: Experiment, x0: Array, present: Array) -> tuple[Array, Array]:
        """Derivatives (N, l, q) and (N, l, n) of the innovations along the columns of root and by the start."""
        columns = np.empty((*present.shape, self.root.shape[1]))
        for j, (plus, minus, factor) in enumerate(self.moves):
            first, second = (
                simulation.run(simulation.prepare_run(moved, "predict", part.u, part.y, None, ""), x0)
                for moved in (plus, minus))
            columns[:, :, j] = np.where(present, (second - first) * factor, 0.0)
        if self.curvature is not None:
            more = self.root[len(self.root) - self.curvature.coefficients(self.model.nx) :]
            products = self.curvature.response(self.predictor, part, present) @ more
            columns -= np.where(present[:, :, None], products, 0.0)
        return columns, self.predictor.jumps(0, present)

    def whitened_parts(self, data: Data) -> Iterator[tuple[Experiment, Array, np.ndarray, Array]]:
        """Yield every experiment with its initial state, which readings are there, and its whitened innovations."""
        raw = in_units_of(self.model, data)
        found: list[Any] = as_list(whiten(self.model, raw, scale=self.predictor))
        for part, white in zip(raw.experiments, found):
            yield part, white.states[0], white.present, white.r.ravel()

    def nuisance(self, part: Experiment, x0: Array, present: Array, *, free_start: bool = True,
                 seen: Callable[[Array], Array] | None = None) -> Nuisance:
        """Return the effect of the uncertainty on the whitened innovations of a record with some readings `present`.

        With `free_start` its initial state (n,) is unknown, because it was estimated from it. Changes (N, l, d) of the
        innovations are whitened by `seen`, by default the predictor.
        """

        def diffuse(changes: Array) -> Array:
            sizes = np.linalg.norm(self.predictor.whitened_columns(changes, present), axis=0)
            return DIFFUSE * changes[:, :, sizes > 0] / sizes[sizes > 0]

        by_parameter, by_start = self.sensitivities(part, x0, present)
        columns: list[Any] = [self.distance(part.y)[:, :, None] ** 2 * by_parameter]
        if free_start:
            columns.append(diffuse(by_start))
        unknown = 0
        if outside(self.model, part.u):
            columns.append(diffuse(self.predictor.respond(*unknown_effects(self.model, part.u), present)))
            unknown = int(np.linalg.matrix_rank(self.predictor.whitened_columns(columns[-1], present)))
        changes = np.concatenate(columns, axis=2)
        white = self.predictor.whiten(changes, present) if seen is None else seen(changes)
        flat = white.reshape(present.size, -1)
        U, s, _ = np.linalg.svd(flat, full_matrices=False)
        return Nuisance(U, s, unknown)


def model_uncertainty(model: HammersteinSS, data: Data, *, healthy: Data | None = None,
                      decoupled: Predictor | None = None) -> ModelUncertainty:
    """Return the covariance of the parameters of a model, from the record it was identified from.

    All entries of the matrices that are not zero throughout, the gain, the offsets and the coefficients of the
    nonlinearities are uncertain; the initial states of the record are, too.

    Args:
        model: with noise covariances.
        data: the record it was identified from.
        healthy: a later healthy record, which was not used to identify it. The covariance is multiplied by the upper
            bound (`CONFIDENCE`) of the factor of this record, at least one. Without it, the covariance is multiplied
            by the variation of the parameters between the sections of `data`, where that is significant.
        decoupled: a predictor decoupled from declared disturbances, in place of that of the model.

    Raises:
        DataError: fewer than two readings for each direction of the parameters that changes the predictions; a model
            of the inverse of a controller.
        StructureError: no noise covariances.
    """
    check_causality(model, data)
    count = sum(len(part.y) for part in data.experiments)
    steady = decoupled
    if steady is None:
        noise = model.noise
        steady = predictor(model if noise is None else replace(
            model, noise=replace(noise, R=noise.R + model.nx / count * noise.innovation)))
    gained = replace(model, K=steady.K)
    own, parts = len(parameters(gained)[0]), in_units_of(model, data).experiments
    readings = np.vstack([part.y for part in parts])
    curvature: Products | None = Products.of(parts)
    if curvature.coefficients(model.nx) > min(LARGEST, count // OFTEN - own):
        curvature = None
    size = own + (0 if curvature is None else curvature.coefficients(model.nx))
    gathered = _gathered(ModelUncertainty(gained, steady, np.eye(size), 0, curvature=curvature), data)
    found = _estimated(gathered, own)
    if curvature is not None and not found.deviation:
        wider = _estimated(gathered, size)
        found = wider if wider.deviation else found
    factor = max(overdispersion(*one) for one in found.sections) if healthy is None else 1.0
    root = np.sqrt(factor) * found.root
    if found.deviation:
        root = np.column_stack([root, found.moved])
    steady = replace(steady, covariance=found.scale**2 * steady.covariance, root=steady.root / found.scale)
    levels = np.array([np.fmin.reduce(readings), np.fmax.reduce(readings)])
    result = ModelUncertainty(gained, steady, root, gathered.readings, factor, levels, found.deviation,
                              curvature if len(root) > own else None)
    return result if healthy is None else _inflated(result, healthy)


class Gathered(NamedTuple):
    """What a record says about parameters."""

    information: Array  # (p, p)
    readings: int  # less those that initial states and decoupled disturbances take
    energy: float  # of the whitened innovations
    # products (p, p) of the sensitivities, and (p,) with the innovations, of sections in the order of time and in that
    # of the operating point
    sections: tuple[list[tuple[Array, Array]], list[tuple[Array, Array]]]


class Estimated(NamedTuple):
    """The covariance of the first of the parameters, the others being zero."""

    root: Array  # (p, q) of the covariance for one section
    moved: Array  # (p,) their deviation from the most likely ones
    deviation: float  # its size, in standard deviations
    scale: float  # of the innovations
    sections: list[Any]  # pairs of arguments of `overdispersion`, for both orders


def _gathered(every: ModelUncertainty, data: Data) -> Gathered:
    """Return what a record says about parameters of unit covariance."""
    steady, size = every.predictor, len(every.root)
    information, readings, energy = np.zeros((size, size)), 0, 0.0
    sections: tuple[list[tuple[Array, Array]], ...] = [], []
    length = max(sum(len(part.y) for part in data.experiments) // SECTIONS, 1)
    for part, x0, present, white in every.whitened_parts(data):
        by_parameter, by_start = (steady.whitened_columns(effect, present)
                                  for effect in every.sensitivities(part, x0, present))
        basis, sizes, _ = np.linalg.svd(by_start, full_matrices=False)
        basis = basis[:, sizes > 1e-9 * max(float(sizes.max(initial=0.0)), 1e-300)]
        rest = by_parameter - basis @ (basis.T @ by_parameter)
        information += rest.T @ rest
        readings += int(present.sum()) - basis.shape[1] - steady.silent * int(present.all(axis=1).sum())
        left = white - basis @ (basis.T @ white)
        energy += float(np.sum(left**2))
        # after a missing reading innovations are larger until the predictor has settled
        sample = np.arange(len(present))
        gap = np.maximum.accumulate(np.where(present.all(axis=1), -steady.settling - 1, sample))
        rest[np.repeat(sample - gap <= steady.settling, present.shape[1])] = 0.0
        count_here = max(round(len(part.y) / length), 1)
        for which, order in enumerate((sample, np.argsort(_operating_point(part.y), kind="stable"))):
            rows = (order[:, None] * present.shape[1] + np.arange(present.shape[1])).ravel()
            edges = np.linspace(0, len(rest), count_here + 1).astype(int)
            sections[which].extend((rest[own].T @ rest[own], rest[own].T @ left[own])
                                   for own in (rows[a:b] for a, b in zip(edges, edges[1:])))
    return Gathered(information, readings, energy, sections)


def _estimated(gathered: Gathered, size: int) -> Estimated:
    """Return the covariance of the first parameters; errors as of `model_uncertainty`."""
    information, readings = gathered.information[:size, :size], gathered.readings
    sizes = np.sqrt(np.diag(information))
    sizes[sizes == 0] = 1.0
    values, axes = np.linalg.eigh(information / np.outer(sizes, sizes))
    known = values > KNOWN * values[-1]
    if readings < 2 * int(known.sum()):
        raise DataError(
            f"{readings} readings (beside the initial states) do not determine the parameters well enough for a "
            f"covariance of the model: {int(known.sum())} directions change its predictions. Use a longer record.")
    scale = float(np.sqrt(gathered.energy / (readings - int(known.sum()))))
    unit = axes[:, known] / np.sqrt(values[known]) / sizes[:, None]
    grams = [[unit.T @ gram[:size, :size] @ unit for gram, _ in one] for one in gathered.sections]
    scores = [[unit.T @ along[:size] / scale for _, along in one] for one in gathered.sections]
    score = np.sum(scores[0], axis=0)
    moved = np.linalg.pinv(np.sum(grams[0], axis=0), rcond=KNOWN, hermitian=True) @ score
    deviation = float(np.sqrt(max(score @ moved, 0.0)))
    if deviation**2 <= len(score) + REJECTED * np.sqrt(2 * len(score)):
        deviation, moved = 0.0, 0 * moved
    left = [[one - part @ moved for one, part in zip(along, gram)] for along, gram in zip(scores, grams)]
    return Estimated(scale * unit, scale * unit @ moved, deviation, scale, list(zip(grams, left)))


def _operating_point(y: Array) -> Array:
    """Return the first principal component (N,) of the outputs, each over its spread, averaged over samples before.

    It does not depend on the innovation of a sample, which an order by its output would select.
    """
    filled = interpolate_missing(y)
    scaled = filled - filled.mean(axis=0)
    scaled /= np.where(scaled.std(axis=0) > 0, scaled.std(axis=0), 1.0)
    along = scaled @ np.linalg.eigh(scaled.T @ scaled)[1][:, -1]
    return np.convolve(np.append(0.0, along), np.full(SMOOTHED, 1 / SMOOTHED))[: len(along)]


def overdispersion(grams: Sequence[Array], correlations: Sequence[Array]) -> float:
    """Return the factor c of the covariance of parameters that vary between sections; 1 where they need not vary.

    Of each section are given S'S (q, q), S being the sensitivity to parameters of unit covariance, and S'r (q,) with
    its whitened innovations r; the sum of the S'S is at most I.
    """
    spreads, squares = [], []
    for gram, along in zip(grams, correlations):
        values, axes = np.linalg.eigh(gram)
        known = values > KNOWN
        spreads.append(values[known])
        squares.append((axes[:, known].T @ along) ** 2 / values[known])
    s2, z2 = np.concatenate(spreads), np.concatenate(squares)
    score = s2 @ (z2 - 1 + s2)
    if score <= REJECTED * np.sqrt(2) * np.linalg.norm(s2 * (1 - s2)):
        return 1.0
    factor = 1.0
    for _ in range(ITERATIONS):
        weights = s2 / (1 + factor * s2) ** 2
        factor = max(1.0, float(2 + weights @ (z2 - 1) / (weights @ s2)))
    return factor


def _inflated(found: ModelUncertainty, healthy: Data) -> ModelUncertainty:
    """Multiply the covariance by the largest factor that a healthy record allows."""
    spreads, squares = [], []
    for part, x0, present, white in found.whitened_parts(healthy):
        nuisance = found.nuisance(part, x0, present)
        axes = nuisance.s < np.sqrt(DIFFUSE)  # the others are those of the initial state
        spreads.append(nuisance.s[axes] ** 2)
        squares.append((nuisance.U[:, axes].T @ white) ** 2)
    factor = largest_factor(np.concatenate(spreads), np.concatenate(squares))
    return replace(found, root=np.sqrt(factor) * found.root, inflation=factor)


def largest_factor(s2: Array, z2: Array) -> float:
    """Return the upper bound of the factor c of the variances 1 + c s^2, at least one.

    It is the largest c for which so small an energy has a probability of 1 - `CONFIDENCE`, the axes weighted by their
    information on c near one: exact for Gaussian innovations that are linear in the parameters. s2 (q,) are squared
    singular values of the nuisance, z2 (q,) squared whitened innovations along its axes.
    """
    weights, factors = s2 / (1 + s2) ** 2, np.geomspace(*FACTORS)
    drawn = np.random.default_rng(0).chisquare(1, (DRAWS, s2.size))
    least = np.quantile(drawn @ (weights * (1 + np.outer(factors, s2))).T, 1 - CONFIDENCE, axis=0)
    allowed = factors[least <= weights @ z2]
    return float(allowed[-1]) if allowed.size else 1.0


def uncertain_start(model: HammersteinSS, steady: Predictor) -> ModelUncertainty:
    """Return the uncertainty of an exact model in records whose initial state is estimated."""
    gained = replace(model, K=steady.K)
    return ModelUncertainty(gained, steady, np.zeros((len(parameters(gained)[0]), 0)), 0)


def parameters(model: HammersteinSS) -> tuple[Array, Array, Callable[[Array], HammersteinSS]]:
    """Return the parameters, a step for each, and the function that builds the model of given parameters."""
    used = [name for name in MATRICES if np.any(getattr(model, name))]
    functions = [*model.nonlinearities, *model.feedback]
    parts = [np.ravel(getattr(model, name)) for name in used] + [np.ravel(f.mu) for f in functions]
    steps = [STEP * (np.abs(part) + np.sqrt(np.mean(part**2)) + 1e-8) for part in parts if part.size]
    edges = np.cumsum([0, *(part.size for part in parts)])

    def back(theta: Array) -> HammersteinSS:
        cut = [theta[a:b] for a, b in zip(edges, edges[1:])]
        changes: dict[str, Any] = {
            name: part.reshape(np.shape(getattr(model, name))) for name, part in zip(used, cut)}
        moved = [replace(f, mu=part) for f, part in zip(functions, cut[len(used) :])]
        inputs = len(model.nonlinearities)
        return replace(model, nonlinearities=tuple(moved[:inputs]), feedback=tuple(moved[inputs:]), **changes)

    return np.concatenate(parts), np.concatenate(steps), back
