"""ARMAX: ``A(q) y = sum_c B_c(q) f_c(u_c) + d + C(q) e``, the sum of squared innovations minimised.

`exact` is the Hammerstein model, `linear` (registered as ``armax.exact``) the linear one. Both are procedures of the
prediction-error method (Ljung 1999, section 7.2): starts from ARX and extended least squares, Gauss-Newton with
sensitivities filtered by 1/C, and convex programmes in the tangent of the iterate, in which any constraint and any
conic or quadratic back end may take part. Named variables: ``a``, ``b``, ``mu`` (not in the linear model),
``offset``, ``c``, and ``Theta = mu b0ᵀ + mu0 bᵀ - mu0 b0ᵀ`` about the iterate (mu0, b0). With several inputs the
per-channel names carry the input, as in ``mu[valve]``.

The first innovations of every experiment, whose lags reach before it, count as zero (the conditional method). So does
an innovation that cannot be computed: where the output is missing its prediction takes its place, and where a missing
input leaves no prediction the recursion starts anew. This is the stationary predictor, which does not know that it is
less certain after a gap (a Kalman filter's gain would grow there): A, B and f are told as well as the samples present
allow, C gets a small bias when gaps are many, a few hundredths with a third of the outputs missing at random.
"""

from collections.abc import Sequence
from typing import Any

from formulations.noise_models import PredictionErrors, extended_least_squares, other_zeros, procedure
from formulations.output_error_records import in_own_units
from optid.bases import Linear, fitted_bases
from optid.bases.basis import Basis
from optid.data.record import Data
from optid.identify.arguments import one_output, per_channel, whole_number
from optid.identify.gauges import check_gauge
from optid.solving.solve import Procedure
from optid.statistics import Layout
from optid.statistics.noise_sensitivities import NoiseUnknowns
from optid.statistics.sensitivities import Unknowns


def linear(data: Data, *, na: int, nb: int | Sequence[int], nc: int, nk: int | Sequence[int] = 0,
           constraints: Sequence[Any] = (), offset: bool = True, starts: int = 3, seed: int = 0) -> Procedure:
    """Minimise the innovations of a linear ARMAX model.

    Named variables: ``Theta``, ``a``, ``b``, ``c``, ``offset``.

    Args:
        data: the record; one output; samples may be missing.
        na: order of A.
        nb: number of coefficients of B, one per input or one for all.
        nc: order of C.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders of CVXPY constraints in ``a``, ``b``, ``offset``, ``c``.
        offset: estimate the constant of the equation; False holds it at zero, for centred data.
        starts: number of starts that are compared.
        seed: of the random ones.

    Raises:
        StructureError: impossible orders, several outputs.
        RankError: too few samples for the unknowns.
    """
    return _posed("armax.exact", data, Linear(), False, "none", na, nb, nc, nk, constraints, offset, starts, seed)


def exact(data: Data, *, na: int, nb: int | Sequence[int], nc: int,
          basis: Basis | str | Sequence[Basis | str] = "polynomial:3", nk: int | Sequence[int] = 0,
          constraints: Sequence[Any] = (), gauge: str = "norm", offset: bool = True, starts: int = 3, seed: int = 0
          ) -> Procedure:
    """Minimise the innovations of a Hammerstein ARMAX model.

    Named variables: ``Theta``, ``a``, ``b``, ``c``, ``mu``, ``offset``.

    Args:
        data: the record; one output; samples may be missing.
        na: order of A.
        nb: number of coefficients of B, one per input or one for all.
        nc: order of C.
        basis: basis of the nonlinearity, one per input or one for all; a cubic polynomial by default.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders such as ``formulations.constraints.shape.monotone("increasing")`` or ``lambda v: {...}``.
        gauge: "norm" (‖b‖ = 1), "gain" (unit static gain of the linear part) or "b0" (first coefficient one).
        offset: estimate the constant of the equation; False holds it at zero, for centred data.
        starts: number of starts that are compared.
        seed: of the random ones.

    Raises:
        StructureError: impossible orders, unknown gauge, several outputs.
        RankError: too few samples for the unknowns, or a basis function that no sample excites.
    """
    check_gauge(gauge)
    return _posed("hammerstein_armax.exact", data, basis, True, gauge, na, nb, nc, nk, constraints, offset, starts,
                  seed)


def _posed(name: str, data: Data, basis: Any, free: bool, gauge: str, na: int, nb: Any, nc: int, nk: Any,
           constraints: Sequence[Any], offset: bool, starts: int, seed: int) -> Procedure:
    record = one_output(data, "prediction errors")
    inputs = record.inputs
    record, bases, units = in_own_units(record, fitted_bases(record, basis), offset)
    layout = Layout(whole_number("na", na), per_channel("nb", nb, inputs, low=1), per_channel("nk", nk, inputs, low=0),
                    bases, record.outputs, inputs)
    count = whole_number("starts", starts, 1, "the number of starts")
    plant = Unknowns(layout, record.n_experiments, (free,) * layout.m, bool(offset))
    unknowns = NoiseUnknowns(plant, whole_number("nc", nc))
    criterion = PredictionErrors(record, unknowns, "norm" if free else "none", units)
    found = other_zeros(extended_least_squares(criterion), unknowns, count, seed)
    return procedure(name, criterion, found, constraints, gauge)
