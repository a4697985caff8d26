"""How well a fit knows what it says: standard errors, intervals and bands in the units and gauge of its model.

Every quantity, a coefficient or a whole curve, is a function of the model. Its derivative is taken through the model
itself (unit changes, gauge and rank-one split included), and its error follows from the estimate in the tangent space
of the rank-one manifold. With inequality constraints in reach the interval is that of `optid.identify.intervals`, which
keeps its coverage where treating active constraints as equalities loses it. `optid.identify.resampling` offers the
same quantities from refits.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases.expansions import Linear
from optid.errors import StructureError
from optid.identify.intervals import DRAWS
from optid.identify.tangent import Quantity, Tangent, linearise


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


@dataclass(frozen=True, eq=False)
class Refits:
    """Intervals from the scatter of refits.

    Attributes:
        reference: the fitted model.
        models: the refitted models, in its gauge and with its signs.
        kind: "percentile" (quantiles of the refits) or "basic" (the same reflected at the estimate).
    """

    reference: Any
    models: tuple[Any, ...] = field(repr=False)
    kind: Literal["percentile", "basic"]

    @property
    def meaning(self) -> str:
        """What the intervals are, in words."""
        return f"{self.kind} intervals of {len(self.models)} refits to resampled residuals"

    def limits(self, quantity: Quantity, level: float) -> tuple[Array, Array, Array]:
        """Return (standard error, lower end, upper end) of a quantity, flat and relative to its estimate."""
        value = np.ravel(np.asarray(quantity(self.reference), dtype=float))
        deviations = np.array([np.ravel(np.asarray(quantity(model), dtype=float)) - value for model in self.models])
        low, high = np.quantile(deviations, [0.5 - level / 2, 0.5 + level / 2], axis=0)
        error = np.std(deviations, axis=0, ddof=1)
        return (error, low, high) if self.kind == "percentile" else (error, -high, -low)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Intervals around a fitted model, in raw units and in its gauge.

    Attributes:
        model: the fitted model.
        level: probability that an interval contains the truth.
        source: where they come from.
    """

    model: Any = field(repr=False)
    level: float
    source: Tangent | Refits = field(repr=False)

    @property
    def meaning(self) -> str:
        """What the intervals are, in words."""
        return self.source.meaning

    # -- coefficients --------------------------------------------------------------------------------------------

    @cached_property
    def a(self) -> Interval:
        """Coefficients of A, in the shape of ``model.a``."""
        return self.of(lambda model: model.a)

    @cached_property
    def b(self) -> tuple[Interval, ...]:
        """Coefficients of B, one per input, in the gauge of the model."""
        return tuple(self.of(lambda model, c=c: model.b[c]) for c in range(self.model.m))

    @cached_property
    def mu(self) -> tuple[Interval, ...]:
        """Coefficients of the nonlinearities, one per input, in the gauge of the model."""
        return tuple(self.of(lambda model, c=c: model.nonlinearities[c].mu) for c in range(self.model.m))

    @cached_property
    def offset(self) -> Interval:
        """Constants of the equations, (l,)."""
        return self.of(lambda model: model.offset)

    # -- curves --------------------------------------------------------------------------------------------------

    @cached_property
    def f(self) -> tuple[Interval, ...]:
        """Band of every nonlinearity on the grid of its basis; see `band`."""
        return tuple(self.band(c) for c in range(self.model.m))

    def band(self, channel: int = 0, at: ArrayLike | None = None, offset: bool = True) -> Interval:
        """Return the pointwise band of a nonlinearity in the gauge of the model.

        Args:
            channel: index of the input.
            at: (k,) values of the input; the 201 points of ``basis.grid()`` when not given.
            offset: include the offset of f where the model knows it (``model.c0``); where it does not, or with False,
                the band is that of f without constant, which has no width where the basis vanishes.
        """
        model = self.model
        basis = model.nonlinearities[channel].basis
        points = basis.grid() if at is None else np.atleast_1d(np.asarray(at, dtype=float))
        with_offset = offset and not isinstance(basis, Linear) and model.c0 is not None
        found = self.of(lambda model: model.nonlinearities[channel](points) + (model.c0 if with_offset else 0.0))
        return replace(found, at=points)

    def frequency_response(self, w: ArrayLike | None = None) -> tuple[Interval, Interval]:
        """Return the bands of magnitude and phase (radians, unwrapped along w) of the linear part A^-1 B.

        Args:
            w: (k,) frequencies in radians per unit of time; 200 up to the Nyquist frequency when not given.

        Returns:
            magnitude and phase, each of shape (k, l, m), in the gauge of the model. The magnitude is treated on a
            logarithmic scale, so that its band is positive.
        """
        nyquist = np.pi / self.model.dt
        points = np.linspace(nyquist / 200, nyquist, 200) if w is None else np.atleast_1d(np.asarray(w, dtype=float))
        reference = self.model.frequency_response(points)
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
        value = np.asarray(quantity(self.model))
        if np.iscomplexobj(value):
            raise StructureError("the quantity is complex; take its real and imaginary part, or modulus and angle")
        error, lower, upper = self.source.limits(quantity, self.level)
        value = value.astype(float)
        return Interval(value, error.reshape(value.shape), value + lower.reshape(value.shape),
                        value + upper.reshape(value.shape))

    def table(self) -> list[tuple[str, float, float, float, float]]:
        """Return (name, estimate, standard error, lower, upper) of every coefficient that tables of the model show."""
        found = self.of(lambda model: np.array([value for _, value in model.coefficients()]))
        rows = np.column_stack([found.value, found.error, found.lower, found.upper]).tolist()
        return [(name, *row) for (name, _), row in zip(self.model.coefficients(), rows)]


def uncertainty(fit: Any, level: float = 0.95, draws: int = DRAWS, seed: int = 0) -> Uncertainty:
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
    check_level(level)
    transform = getattr(fit.data, "transform", None)

    def rebuild(values: dict[str, Array]) -> Any:
        model = fit.program.recover(values)
        return aligned(model if transform is None else model.with_transform(transform), fit.model)

    return Uncertainty(fit.model, float(level), linearise(fit, rebuild, draws, seed))


def aligned(model: Any, reference: Any) -> Any:
    """Give every f and B of a model the sign nearest to that of a reference; predictions do not change."""
    signs = [-1.0 if float(np.sum(b * other)) < 0 else 1.0 for b, other in zip(model.b, reference.b)]
    if all(sign > 0 for sign in signs):
        return model
    return replace(model, b=tuple(sign * b for sign, b in zip(signs, model.b)),
                   nonlinearities=tuple(replace(f, mu=sign * f.mu) for sign, f in zip(signs, model.nonlinearities)))


def check_level(level: float) -> None:
    """Refuse what is no probability between 0 and 1 (`StructureError`)."""
    if not 0 < level < 1:
        raise StructureError(f"level={level!r}: a probability between 0 and 1, such as 0.95")
