"""How well a fit knows what it says: standard errors, intervals and bands in the units and gauge of its model.

Every quantity, a coefficient or a whole curve, is a function of the model. Its derivative is taken through the model
itself (unit changes, gauge and rank-one split included), and its error follows from the estimate in the tangent space
of the rank-one manifold. With inequality constraints in reach the interval is that of `optid.identify.intervals`, which
keeps its coverage where treating active constraints as equalities loses it. `optid.identify.resampling` offers the
same quantities from refits.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases.expansions import Linear
from optid.errors import StructureError
from optid.identify.intervals import DRAWS
from optid.identify.tangent import Tangent, linearise

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.models import HammersteinARX

Quantity = Callable[["HammersteinARX"], ArrayLike]
"""A function of the model: a number or an array of fixed shape."""

STEP = 1e-5
"""Step of the central differences, relative to the size of the parameter."""


@dataclass(frozen=True, eq=False)
class Interval:
    """Estimates with their errors; every array has the shape of the quantity.

    Attributes:
        value: the estimate.
        error: standard error; under inequalities the root mean square deviation of the constrained estimate.
        lower: lower end.
        upper: upper end.
        at: where a curve was evaluated (input or frequency), None for coefficients.
    """

    value: Array
    error: Array
    lower: Array
    upper: Array
    at: Array | None = None


class Source(Protocol):
    """Where intervals come from: the linearised problem, or refits.

    Attributes:
        meaning: what the intervals are, in words.
    """

    @property
    def meaning(self) -> str: ...  # noqa: D102

    def limits(self, quantity: Quantity, level: float) -> tuple[Array, Array, Array]:
        """Return (standard error, lower end, upper end) of a quantity, flat and relative to its estimate."""
        ...


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Intervals around a fit, in raw units and in the gauge of ``fit.model``.

    Attributes:
        fit: the fit.
        level: probability that an interval contains the truth.
        source: where they come from; `Linearised` or `optid.identify.resampling.Refits`.
    """

    fit: "Fit" = field(repr=False)
    level: float
    source: Source = field(repr=False)

    @property
    def meaning(self) -> str:
        """What the intervals are, in words."""
        return self.source.meaning

    def at_level(self, level: float) -> "Uncertainty":
        """Return the same with another probability inside.

        Raises:
            StructureError: not a probability between 0 and 1.
        """
        return replace(self, level=_checked_level(level))

    # -- coefficients --------------------------------------------------------------------------------------------

    @cached_property
    def a(self) -> Interval:
        """Coefficients of A, in the shape of ``model.a``."""
        return self.of(lambda model: model.a)

    @cached_property
    def b(self) -> tuple[Interval, ...]:
        """Coefficients of B, one per input, in the gauge of the model."""
        return tuple(self.of(lambda model, c=c: model.b[c]) for c in range(self.fit.model.m))

    @cached_property
    def mu(self) -> tuple[Interval, ...]:
        """Coefficients of the nonlinearities, one per input, in the gauge of the model."""
        return tuple(self.of(lambda model, c=c: model.nonlinearities[c].mu) for c in range(self.fit.model.m))

    @cached_property
    def offset(self) -> Interval:
        """Constants of the equations, (l,)."""
        return self.of(lambda model: model.offset)

    # -- curves --------------------------------------------------------------------------------------------------

    @cached_property
    def f(self) -> tuple[Interval, ...]:
        """Band of every nonlinearity on the grid of its basis; see `band`."""
        return tuple(self.band(c) for c in range(self.fit.model.m))

    def band(self, channel: int = 0, at: ArrayLike | None = None, offset: bool = True) -> Interval:
        """Return the pointwise band of a nonlinearity in the gauge of the model.

        Args:
            channel: index of the input.
            at: (k,) values of the input; the 201 points of ``basis.grid()`` when not given.
            offset: include the offset of f where the model knows it (``model.c0``); where it does not, or with False,
                the band is that of f without constant, which has no width where the basis vanishes.
        """
        model = self.fit.model
        basis = model.nonlinearities[channel].basis
        points = basis.grid() if at is None else np.atleast_1d(np.asarray(at, dtype=float))
        if isinstance(basis, Linear) or not offset or model.c0 is None:
            found = self.of(lambda model: model.nonlinearities[channel](points))
        else:
            found = self.of(lambda model: model.nonlinearities[channel](points) + model.c0)
        return replace(found, at=points)

    def frequency_response(self, w: ArrayLike | None = None) -> tuple[Interval, Interval]:
        """Return the bands of magnitude and phase (radians, unwrapped along w) of the linear part A^-1 B.

        Args:
            w: (k,) frequencies in radians per unit of time; 200 up to the Nyquist frequency when not given.

        Returns:
            magnitude and phase, each of shape (k, l, m), in the gauge of the model. The magnitude is treated on a
            logarithmic scale, so that its band is positive.
        """
        nyquist = np.pi / self.fit.model.dt
        points = np.linspace(nyquist / 200, nyquist, 200) if w is None else np.atleast_1d(np.asarray(w, dtype=float))
        reference = self.fit.model.frequency_response(points)
        phase = np.unwrap(np.angle(reference), axis=0)
        log = self.of(lambda model: np.log(np.abs(model.frequency_response(points))))
        turn = self.of(lambda model: phase + np.angle(model.frequency_response(points) / reference))
        value = np.exp(log.value)
        size = Interval(value, value * log.error, np.exp(log.lower), np.exp(log.upper), points)
        return size, replace(turn, at=points)

    def of(self, quantity: Quantity) -> Interval:
        """Return the interval of any smooth real function of the model.

        Args:
            quantity: model -> number or array, such as ``lambda model: model.static_gain(0.5)``.

        Raises:
            StructureError: a quantity that is not real or changes its shape with the model.
        """
        value = np.asarray(quantity(self.fit.model))
        if np.iscomplexobj(value):
            raise StructureError("the quantity is complex; take its real and imaginary part, or modulus and angle")
        error, lower, upper = self.source.limits(quantity, self.level)
        value = value.astype(float)
        return Interval(value, error.reshape(value.shape), value + lower.reshape(value.shape),
                        value + upper.reshape(value.shape))

    def table(self) -> list[tuple[str, float, float, float, float]]:
        """Return (name, estimate, standard error, lower, upper) of every coefficient that tables of the model show."""
        found = self.of(lambda model: np.array([value for _, value in model.coefficients()]))
        return [(name, *_row(found, i)) for i, (name, _) in enumerate(self.fit.model.coefficients())]


@dataclass(frozen=True, eq=False)
class Linearised:
    """Intervals from the linearised problem.

    Attributes:
        fit: the fit.
        tangent: its linearisation.
    """

    fit: "Fit"
    tangent: Tangent

    @property
    def meaning(self) -> str:
        """What the intervals are, in words."""
        return self.tangent.meaning

    @property
    def noise(self) -> Array:
        """Estimated covariance (l, l) of the equation error e, in raw units."""
        transform = getattr(self.fit.data, "transform", None)
        scale = np.ones(len(self.tangent.noise)) if transform is None else np.array(transform.y_scale)
        return self.tangent.noise * np.outer(scale, scale)

    def covariance(self, quantity: Quantity) -> Array:
        """Covariance (q, q) of a quantity, flattened, without regard to inequalities."""
        scattered = self.slopes(quantity) @ self.tangent.local.scatter
        return scattered @ scattered.T

    def limits(self, quantity: Quantity, level: float) -> tuple[Array, Array, Array]:
        """Return (standard error, lower end, upper end) of a quantity, flat and relative to its estimate."""
        return self.tangent.local.limits(self.slopes(quantity), level)

    def slopes(self, quantity: Quantity) -> Array:
        """Derivatives (q, n) of a quantity in the whitened tangent coordinates, by central differences.

        Raises:
            StructureError: the quantity changes its shape with the model.
        """
        columns = []
        for above, below, gap in self._neighbours:
            high, low = (np.ravel(np.asarray(quantity(model), dtype=float)) for model in (above, below))
            if high.shape != low.shape:
                raise StructureError("the quantity changes its shape with the model, so it has no derivative")
            columns.append((high - low) / gap)
        return np.column_stack(columns) @ self.tangent.directions

    @cached_property
    def _neighbours(self) -> list[tuple["HammersteinARX", "HammersteinARX", float]]:
        """Models a small step above and below in every unknown of the programme, and the distance between them."""
        x, found = self.tangent.x, []
        sizes = self.tangent.values(np.abs(x))
        scale = np.concatenate([np.full(part.size, max(float(np.max(part)), 1e-300)) for part in sizes.values()])
        for j, step in enumerate(STEP * np.maximum(np.abs(x), 1e-2 * scale)):
            above, below = x.copy(), x.copy()
            above[j] += step
            below[j] -= step
            found.append((self._model(above), self._model(below), float(above[j] - below[j])))
        return found

    def _model(self, x: Array) -> "HammersteinARX":
        """Build the reported model from the unknowns of the programme, with the signs of ``fit.model``."""
        model = self.fit.program.recover(self.tangent.values(x))
        transform = getattr(self.fit.data, "transform", None)
        if transform is not None:
            model = model.with_transform(transform)
        return aligned(model, self.fit.model)


def uncertainty(fit: "Fit", level: float = 0.95, draws: int = DRAWS, seed: int = 0) -> Uncertainty:
    """Linearise a fit and return its standard errors, intervals and bands.

    Args:
        fit: a least-squares fit (``arx``, ``hammerstein_arx.exact`` or ``.overparametrised``), or one of prediction
            errors (``oe.exact``, ``hammerstein_oe.exact``), whose errors count as white; with ``ridge`` or
            ``curvature`` the intervals are those of the posterior whose prior is the penalty.
        level: probability that an interval contains the truth, in (0, 1).
        draws: random draws for intervals under inequality constraints, at least 100.
        seed: seed of the draws.

    Raises:
        StructureError: an impossible level, a fit that is not least squares (robust loss, nuclear norm), or an active
            constraint without linearisation; the message names it and what to use instead.
        RankError: parameters without effect on the predictions.
    """
    if not hasattr(fit.program.compressed, "lifted"):
        advice = "; use optid.bootstrap" if fit.model is not None and fit.model.structure == "arx" else ""
        raise StructureError("they follow from compressed least squares, which "
                             f"{fit.formulation!r} does not keep{advice}")
    return Uncertainty(fit, _checked_level(level), Linearised(fit, linearise(fit, draws, seed)))


def aligned(model: Any, reference: Any) -> Any:
    """Give every f and B of a model the sign nearest to that of a reference; predictions do not change."""
    signs = [-1.0 if float(np.sum(b * other)) < 0 else 1.0 for b, other in zip(model.b, reference.b)]
    if all(sign > 0 for sign in signs):
        return model
    return replace(model, b=tuple(sign * b for sign, b in zip(signs, model.b)),
                   nonlinearities=tuple(replace(f, mu=sign * f.mu) for sign, f in zip(signs, model.nonlinearities)))


def _row(interval: Interval, i: int) -> tuple[float, float, float, float]:
    value, error, lower, upper = (float(np.ravel(part)[i]) for part in
                                  (interval.value, interval.error, interval.lower, interval.upper))
    return value, error, lower, upper


def _checked_level(level: float) -> float:
    if not 0 < level < 1:
        raise StructureError(f"level={level!r}: a probability between 0 and 1, such as 0.95")
    return float(level)
