"""Standard errors, intervals and bands of a fit, in the units and gauge of its model.

Every quantity, a coefficient or a whole curve, is a function of the model, and is differentiated through it (unit
changes, gauge and rank-one split included); its error follows from the estimate in the tangent space of the rank-one
manifold. Near inequality constraints the interval is that of `optid.identify.intervals`. `optid.identify.resampling`
gives the same quantities from refits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_probability
from optid.bases.expansions import Linear
from optid.errors import DataError, StructureError
from optid.identify.intervals import DRAWS
from optid.identify.tangent import Quantity, Tangent, linearise
from optid.models.state_simulation import prepare_run, run_states
from optid.threads import one_thread


@dataclass(frozen=True, eq=False)
class Interval:
    """Estimates with their errors and the ends of their intervals; every array has the shape of the quantity.

    Attributes:
        error: standard error; under inequalities the root mean square deviation of the constrained estimate.
        at: where a curve was evaluated (input or frequency), None for coefficients.
    """

    value: Array
    error: Array
    lower: Array
    upper: Array
    at: Array | None = None


@dataclass(frozen=True, eq=False)
class Refits:
    """Intervals from the scatter of refits of a reference model, in its gauge and with its signs.

    The kind is "percentile" (quantiles of the refits) or "basic" (the same reflected at the estimate).
    """

    reference: Any
    models: tuple[Any, ...] = field(repr=False)
    kind: Literal["percentile", "basic"]

    @property
    def meaning(self) -> str:
        """Description of the intervals."""
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
    """Intervals around a fitted model, in raw units and in its gauge, which contain the truth with probability `level`.

    Attributes:
        source: where they come from.
        point: (m,) inputs at which `table` lists the static gain of a state-space model; None for zero.
        state: (n,) from which its equilibrium there is looked for; None for zero.
        profiles: intervals by profile likelihood, as of `optid.solving.solve.Evidence`; None without.
    """

    model: Any = field(repr=False)
    level: float
    source: Tangent | Refits = field(repr=False)
    point: Array | None = field(default=None, repr=False)
    state: Array | None = field(default=None, repr=False)
    profiles: Any = field(default=None, repr=False)

    @property
    def meaning(self) -> str:
        """Description of the intervals."""
        return self.source.meaning

    def at_level(self, level: float) -> "Uncertainty":
        """Return the same intervals at another level, a probability."""
        check_probability(level, "level")
        return self if level == self.level else replace(self, level=float(level))

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
        return tuple(self.coefficients(c) for c in range(self.model.m))

    def coefficients(self, index: int, family: str = "nonlinearities") -> Interval:
        """Return those of the coefficients of a function; the family is "nonlinearities", "feedback" or "latent"."""
        return self.of(lambda model: getattr(model, family)[index].mu)

    @cached_property
    def offset(self) -> Interval:
        """Constants of the equations, (l,)."""
        return self.of(lambda model: model.offset)

    @cached_property
    def f(self) -> tuple[Interval, ...]:
        """Band of every nonlinearity on the grid of its basis; see `band`."""
        return tuple(self.band(c) for c in range(self.model.m))

    def band(self, channel: int = 0, at: ArrayLike | None = None, offset: bool = True, *,
             family: str = "nonlinearities") -> Interval:
        """Return the pointwise band of a nonlinearity in the gauge of the model.

        Args:
            channel: index of the input, or of the function in its family.
            at: (k,) values of the input; the 201 points of ``basis.grid()`` when not given.
            offset: include the offset of f where it is determined (``model.c0``); otherwise the band is that of f
                without constant, which has no width where the basis vanishes.
            family: "nonlinearities", "feedback" or "latent": functions of inputs, outputs and latent signals.
        """
        model = self.model
        basis = getattr(model, family)[channel].basis
        points = basis.grid() if at is None else np.atleast_1d(np.asarray(at, dtype=float))
        with_offset = offset and not isinstance(basis, Linear) and model.c0 is not None
        found = self.of(lambda model: getattr(model, family)[channel](points) + (model.c0 if with_offset else 0.0))
        return replace(found, at=points)

    def frequency_response(self, w: ArrayLike | None = None, factors: Quantity | None = None
                           ) -> tuple[Interval, Interval]:
        """Return the bands (k, l, m) of magnitude and phase (radians, unwrapped along w) of the linear part A^-1 B.

        They are in the gauge of the model, at frequencies w (k,) in radians per unit of time; 200 up to the Nyquist
        frequency when not given. The magnitude is treated on a logarithmic scale, so that its band is positive.
        `factors`, a function of the model, gives what every input (m,) is multiplied with, such as a slope of f.
        """
        def response(model: Any) -> Array:
            return model.frequency_response(points) * (1.0 if factors is None else np.asarray(factors(model)))

        nyquist = np.pi / self.model.dt
        points = np.linspace(nyquist / 200, nyquist, 200) if w is None else np.atleast_1d(np.asarray(w, dtype=float))
        reference = response(self.model)
        phase = np.unwrap(np.angle(reference), axis=0)
        with np.errstate(all="ignore"):  # a response of zero has no logarithm, and a wide band may have no upper end
            log = self.of(lambda model: np.log(np.abs(response(model))))
            turn = self.of(lambda model: phase + np.angle(response(model) / reference))
            value = np.exp(log.value)
            size = Interval(value, value * log.error, np.exp(log.lower), np.exp(log.upper), points)
        return size, replace(turn, at=points)

    def of(self, quantity: Quantity) -> Interval:
        """Return the interval of any smooth real function of the model, such as ``lambda m: m.static_gain(0.5)``.

        A quantity that is not real, or changes its shape with the model, is a `StructureError`.
        """
        value = np.asarray(quantity(self.model))
        if np.iscomplexobj(value):
            raise StructureError("the quantity is complex; take its real and imaginary part, or modulus and angle")
        error, lower, upper = self.source.limits(quantity, self.level)
        value = value.astype(float)
        return Interval(value, error.reshape(value.shape), value + lower.reshape(value.shape),
                        value + upper.reshape(value.shape))

    def with_profile(self, name: str, row: Sequence[float]) -> Array:
        """Return (estimate, standard error, lower, upper) of a parameter, with the ends of its profile if any."""
        coloured = "coloured" in getattr(self.source, "words", ())
        ends = None if self.profiles is None else self.profiles(name, self.level, row[0], row[1], coloured)
        return np.array(row if ends is None else (*row[:2], *ends), dtype=float)

    def table(self) -> list[tuple[str, float, float, float, float]]:
        """Return (name, estimate, standard error, lower, upper) of what tables of the model show.

        Those are the coefficients of a transfer function. Of a state-space model, whose matrices depend on the choice
        of its states, they are the poles and, where the model and its neighbours rest, the static gain.
        """
        if self.model.structure != "ss":
            names = [name for name, _ in self.model.coefficients()]
            rows = self._rows(names, lambda model: np.array([value for _, value in model.coefficients()]))
            return [(name, *self.with_profile(name, row)) for name, *row in rows]
        poles = self.model.poles[self.model.poles.imag >= 0]
        names = [f"pole {i + 1}{part}" for i, pole in enumerate(poles)
                 for part in ([", real", ", imaginary"] if pole.imag else [""])]

        def parts(model: Any) -> Array:
            nearest = [model.poles[np.argmin(np.abs(model.poles - pole))] for pole in poles]
            return np.array([part for now, pole in zip(nearest, poles)
                             for part in ([now.real, now.imag] if pole.imag else [now.real])])

        rows, names = self._rows(names, parts), [
            f"static gain[{y},{u}]" for y in self.model.outputs for u in self.model.inputs]
        point = np.zeros(self.model.m) if self.point is None else self.point
        try:
            near = self.model.equilibrium(point, self.state)[0]  # its neighbours might find another one from elsewhere
            return rows + self._rows(names, lambda model: np.ravel(model.gain_at_rest(point, near)))
        except StructureError:  # a pole at one, or no rest there
            return rows

    def _rows(self, names: Sequence[str], quantity: Quantity) -> list[tuple[str, float, float, float, float]]:
        """Return (name, estimate, standard error, lower, upper) of every entry of a quantity."""
        found = self.of(quantity)
        rows = np.column_stack([found.value, found.error, found.lower, found.upper]).tolist()
        return [(name, *row) for name, row in zip(names, rows)]


@one_thread
def uncertainty(fit: Any, level: float = 0.95, draws: int = DRAWS, seed: int = 0) -> Uncertainty:
    """Linearise a fit and return its standard errors, intervals and bands.

    Args:
        fit: a least-squares fit (``arx``, ``hammerstein_arx.exact`` or ``.overparametrised``), or one of prediction
            errors: of transfer functions (``oe.exact``, ``hammerstein_oe.exact``), whose errors count as white, or of
            state-space models (``hammerstein_ss.exact``, ``lfr.exact``), whose simulation errors may be coloured. With
            ``ridge`` or ``curvature`` the intervals are those of the posterior whose prior is the penalty.
        level: probability that an interval contains the truth, in (0, 1).
        draws: random draws for intervals under inequality constraints, at least 100.
        seed: seed of the draws.

    Raises:
        StructureError: an impossible level, a fit that is not least squares (robust loss, nuclear norm), or an active
            constraint without linearisation; the message names it and what to use instead.
        RankError: parameters without effect on the predictions.
    """
    check_probability(level, "level")
    def rebuild(values: dict[str, Array]) -> Any:
        model = fit.problem.model(values)
        for transform in filter(None, (fit.problem.compressed.outward, getattr(fit.data, "transform", None))):
            model = model.with_transform(transform)
        return align_signs(model, fit.model)

    source = linearise(fit, rebuild, draws, seed)
    _ = source.neighbours  # so that models which cannot be differentiated are refused here, not by a table of them
    if fit.model.structure != "ss":
        evidence = fit.outcome.evidence
        return Uncertainty(fit.model, float(level), source, profiles=evidence and evidence.profiles)
    experiments = fit.data.raw().experiments
    point = np.nanmean(np.vstack([e.u for e in experiments]), axis=0)
    return Uncertainty(fit.model, float(level), source, point, _mean_state(fit.model, experiments))


def _mean_state(model: Any, experiments: Sequence[Any]) -> Array | None:
    """Return the mean state (n,) of a free run over the longest experiment; None where there is none."""
    try:
        u = max((e.u for e in experiments), key=len)
        return run_states(prepare_run(model, "free", u, None, None, ""), np.zeros(model.nx)).mean(axis=0)
    except DataError:
        return None


def align_signs(model: Any, reference: Any) -> Any:
    """Give every f and B of a model the sign nearest to that of a reference; predictions do not change."""
    signs = np.array([-1.0 if float(np.sum(f.mu * other.mu)) < 0 else 1.0
                      for f, other in zip(model.nonlinearities, reference.nonlinearities)])
    return model if np.all(signs > 0) else model.with_signs(signs)
