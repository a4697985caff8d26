"""Box-Jenkins: ``y = A(q)^-1 [sum_c B_c(q) f_c(u_c) + d] + C(q)/D(q) e``, the sum of squared innovations minimised.

`exact` is the Hammerstein model, `linear` (registered as ``bj.exact``) the linear one. Both are procedures of the
prediction-error method (Ljung 1999, section 4.2): starts from the output-error fit and from ARMAX, with the noise model
of the output left over (Hannan and Rissanen 1982), Gauss-Newton, and convex programmes in the tangent of the iterate,
in which any constraint and any conic or quadratic back end may take part. Named variables: ``a``, ``b``, ``mu`` (not
in the linear model), ``offset``, ``c``, ``d``, ``x0`` ((n,), or (n, experiments)), and
``Theta = mu b0ᵀ + mu0 bᵀ - mu0 b0ᵀ`` about the iterate (mu0, b0). With several inputs the per-channel names carry the
input, as in ``mu[valve]``.

Every experiment has its own initial state of the plant; the noise starts from rest. Where the output is missing the
innovation counts as zero and the prediction takes its place, with the consequences told in
`formulations.hammerstein_armax`; where an input is missing the record is cut.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from formulations.hammerstein_oe import search
from formulations.noise_models import PredictionErrors, arma, extended_least_squares, other_zeros, procedure
from formulations.output_error import OutputError
from formulations.output_error_records import check_excited, check_inputs_differ, check_rows, plant_record
from formulations.output_error_starts import RADIUS, with_poles
from optid.bases import Linear
from optid.bases.basis import Basis
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import OptidError
from optid.identify.arguments import one_output, whole_number
from optid.identify.gauges import check_gauge
from optid.models.roots import contained
from optid.solving.solve import Procedure
from optid.statistics import Layout
from optid.statistics.noise_sensitivities import NoisePoint, NoiseUnknowns
from optid.statistics.sensitivities import Unknowns, simulate

Array = np.ndarray


def linear(data: Data, *, na: int, nb: int | Sequence[int], nc: int, nd: int, nk: int | Sequence[int] = 0,
           constraints: Sequence[Any] = (), offset: bool = True, starts: int = 4, seed: int = 0) -> Procedure:
    """Minimise the innovations of a linear Box-Jenkins model.

    Named variables: ``Theta``, ``a``, ``b``, ``c``, ``d``, ``offset``, ``x0``.

    Args:
        data: the record; one output. Samples may be missing: it is cut where inputs are, see `optid.data.stretches`.
        na: number of poles of the plant.
        nb: number of coefficients of B, one per input or one for all.
        nc: order of C.
        nd: order of D.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders of CVXPY constraints in ``a``, ``b``, ``offset``, ``c``, ``d``, ``x0``.
        offset: estimate the constant of the equation; False holds it at zero, for centred data.
        starts: number of starts that are compared.
        seed: of the random ones.

    Raises:
        StructureError: impossible orders, several outputs.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns.
    """
    record, layout, units = plant_record(one_output(data, "prediction errors"), na, nb, nk, Linear(), offset)
    return _posed("bj.exact", record, layout, units, False, "none", nc, nd, constraints, offset, starts, seed)


def exact(data: Data, *, na: int, nb: int | Sequence[int], nc: int, nd: int,
          basis: Basis | str | Sequence[Basis | str] = "polynomial:3", nk: int | Sequence[int] = 0,
          constraints: Sequence[Any] = (), gauge: str = "norm", offset: bool = True, starts: int = 4, seed: int = 0
          ) -> Procedure:
    """Minimise the innovations of a Hammerstein Box-Jenkins model.

    Named variables: ``Theta``, ``a``, ``b``, ``c``, ``d``, ``mu``, ``offset``, ``x0``.

    Args:
        data: the record; one output. Samples may be missing: it is cut where inputs are, see `optid.data.stretches`.
        na: number of poles of the plant.
        nb: number of coefficients of B, one per input or one for all.
        nc: order of C.
        nd: order of D.
        basis: basis of the nonlinearity, one per input or one for all; a cubic polynomial by default.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders such as ``formulations.constraints.shape.monotone("increasing")`` or ``lambda v: {...}``.
        gauge: "norm" (‖b‖ = 1), "gain" (unit static gain of the linear part) or "b0" (first coefficient one).
        offset: estimate the constant of the equation; False holds it at zero, for centred data.
        starts: number of starts that are compared.
        seed: of the random ones.

    Raises:
        StructureError: impossible orders, unknown gauge, several outputs.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns, or a basis function that no sample excites.
    """
    check_gauge(gauge)
    record, layout, units = plant_record(one_output(data, "prediction errors"), na, nb, nk, basis, offset)
    check_excited(record, layout)
    return _posed("hammerstein_bj.exact", record, layout, units, True, gauge, nc, nd, constraints, offset, starts, seed)


def _posed(name: str, data: Data, layout: Layout, units: Transform, free: bool, gauge: str, nc: int, nd: int,
           constraints: Sequence[Any], offset: bool, starts: int, seed: int) -> Procedure:
    count = whole_number("starts", starts, 1, "the number of starts")
    plant = Unknowns(layout, data.n_experiments, (free,) * layout.m, bool(offset))
    unknowns = NoiseUnknowns(plant, whole_number("nc", nc), whole_number("nd", nd))
    check_rows(data, plant)
    check_inputs_differ(data, layout)
    criterion = PredictionErrors(data, unknowns, "norm" if free else "none", units)
    return procedure(name, criterion, _starts(criterion, count, seed), constraints, gauge)


def _starts(criterion: PredictionErrors, count: int, seed: int) -> dict[str, Array]:
    """Plants of an output-error and of an ARMAX fit, each with the noise model of what they leave of the output."""
    data, unknowns = criterion.data, criterion.unknowns
    plain = OutputError(data, unknowns.plant, criterion.gauge)
    plants = {"output error": search(plain, min(count, 4), seed)[0].x}
    if count > 1 and unknowns.layout.na:
        armax = _armax_plant(criterion, plain)
        plants |= {} if armax is None else {"ARMAX": armax}
    found = {}
    for name, x in plants.items():
        point = unknowns.plant.unpack(x)
        rest = [e.y[:, 0] - y for e, y in zip(data.experiments, simulate(data, unknowns.plant, point))]
        found[name] = unknowns.pack(NoisePoint(point, *arma(rest, unknowns.nc, unknowns.nd or 0)))
    return other_zeros(found, unknowns, count, seed)


def _armax_plant(criterion: PredictionErrors, plain: OutputError) -> Array | None:
    """Return the plant of extended least squares with as many zeros of C as poles, its states fitted."""
    unknowns = criterion.unknowns
    alike = NoiseUnknowns(unknowns.plant, max(unknowns.nc, unknowns.layout.na))
    try:
        x = next(iter(extended_least_squares(replace(criterion, unknowns=alike)).values()))
    except OptidError:  # a plant that least squares of the equation error does not determine has the other start
        return None
    x = unknowns.plant.pack(alike.unpack(x).plant)
    at = unknowns.plant.slices["a"]
    return with_poles(plain, plain.normalised(x), contained(x[at], RADIUS), "ARMAX").x
