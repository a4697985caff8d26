"""Hammerstein-ARX: ``A(q) y = sum_c B_c(q) f_c(u_c) + d + e`` with ``f_c = mu_cᵀ eta_c``, the bilinear least squares.

* `exact`: in ``mu`` and ``b``, with the expression ``Theta = mu bᵀ``.
* `nuclear`: convex in ``Theta``, a nuclear-norm penalty in place of the rank-one constraint.
* `overparametrised`: convex in ``Theta``; the rank-one factor is split off afterwards (Bai 1998; Luo, Algorithm 3.1).

With several inputs the per-channel names carry the input, as in ``mu[valve]``.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from optid.arrays import check_weight, one_of
from optid.bases.basis import Basis
from optid.core.leaves import Product
from optid.core.problem import Problem
from optid.core.terms import NuclearNorms, Squares, Values
from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import StructureError
from optid.identify.equation_error import EquationError, pose_with_loss
from optid.identify.gauges import FIXED, in_gauge
from optid.models import HammersteinTF
from optid.solving.solve import Procedure
from optid.solving.steps import steps
from optid.structures.bilinear import starts
from optid.structures.lifted_regression import leading_pairs


@steps(lambda given: {"hammerstein_arx.exact": "NLP rank-one"})
def exact(data: Data | Stream, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str],
          nk: int | Sequence[int] = 0, constraints: Sequence[Any] = (), loss: str = "squares", ridge: float = 0.0,
          curvature: float = 0.0, prior: str = "none", gauge: str = "norm", offset: bool | str = True
          ) -> Problem | Procedure:
    """Minimise the bilinear least squares ``‖Y - Phi_y a - Phi_eta vec(mu bᵀ) - d‖²``.

    Named variables: ``Theta``, ``a``, ``b``, ``mu``, ``offset``.

    Args:
        data: the record (or a stream larger than memory).
        na: number of past outputs in A.
        nb: number of coefficients of B, one per input or one for all.
        basis: basis of the nonlinearity, one per input or one for all, such as triangular:10 or polynomial:4.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders such as ``formulations.constraints.shape.monotone("increasing")`` or ``lambda v: {...}``.
        loss: "squares", "huber[:threshold in robust standard deviations]" or "l1" (no proof: reweighted passes).
        ridge: weight of ``‖mu‖² ‖b‖²``.
        curvature: weight of ``‖b‖²`` times the integral of ``f''²``.
        prior: on A and on every row of Theta along the lags: "none", "tc" (decaying, rough), "dc" (with a correlation
            of neighbours) or "ss" (smooth); its hyperparameters maximise the marginal likelihood of the record.
        gauge: "norm" (‖b‖ = 1), "gain" (unit static gain of the linear part) or "b0" (first coefficient one).
        offset: True for one constant of the equation, "each" for one for every experiment, as of sensors with other
            zeros; see `optid.models.model.Model.levels`.

    Raises:
        StructureError: impossible orders, unknown gauge, constraints that do not fit.
        RankError: the record does not determine the parameters.
    """
    one_of("gauge", gauge, FIXED)
    return pose_with_loss(loss, data, partial(_factored, builders=constraints, gauge=gauge), convex=False, na=na,
                          nb=nb, nk=nk, basis=basis, ridge=ridge, curvature=curvature, prior=prior,
                          offset=offset)


def _factored(record: EquationError, builders: Sequence[Any], gauge: str) -> Problem:
    if gauge == "gain" and record.layout.l > 1:
        raise StructureError("gauge 'gain' is defined for one output; use 'norm' or 'b0'")
    products = tuple(Product(mu, b, gauge) for mu, b in zip(record.keys("mu"), record.keys("b")))
    linear = tuple(record.linear_zeros())  # a, offset

    z = (*linear, *(one.name for one in products))
    objective = Squares.of(record.problem, z)  # ‖R [a; offset; vec mu bᵀ] - s‖²

    problem = Problem("hammerstein_arx.exact", _start(record, products), (objective,), products,
                      partial(_factored_model, record, gauge, False), record.facts(gauge), builders=tuple(builders),
                      **record.common())
    if gauge == "norm" and problem.fixes_signs:
        return problem.beginning(problem.signed_start(), partial(_factored_model, record, gauge, True))
    return problem


def _factored_model(record: EquationError, gauge: str, signed: bool, x: Values) -> HammersteinTF:
    """Return the model of values; `signed` keeps their signs, else f rises where the output rises."""
    return record.model(x, [x[name] for name in record.keys("mu")], [x[name] for name in record.keys("b")],
                        gauge=gauge, flip=gauge == "norm" and not signed)


def _start(record: EquationError, products: Sequence[Product]) -> dict[str, np.ndarray]:
    """Return the best rank-one start without the constraints, in the gauge."""
    core = record.problem.core
    point = core.point(*starts(core, count=1)[0])
    part = record.linear_part(point.w)
    start = {name: part[name] for name in record.linear_zeros()}
    for c, (one, channel) in enumerate(zip(products, record.layout.inputs)):
        b = point.bs[c].reshape(record.b_shape(c), order="F")
        start.update(zip((one.mu, one.b), in_gauge(one.gauge, point.mus[c], b, record.past(start), channel)))
    return start


@steps(lambda given: {"hammerstein_arx.nuclear": "SDP"})
def nuclear(data: Data | Stream, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str],
            nk: int | Sequence[int] = 0, weight: float = 0.0, constraints: Sequence[Any] = (), loss: str = "squares",
            ridge: float = 0.0, curvature: float = 0.0, prior: str = "none", gauge: str = "norm",
            offset: bool | str = True) -> Problem | Procedure:
    """Minimise ``‖Y - Phi_y a - Phi_eta vec Theta - d‖² + 2 weight sum_c ‖Theta_c‖_*``.

    The penalty is the convex envelope of the ridge ``weight (‖mu‖² + ‖b‖²)`` on the factors (Falck et al. 2010); it
    shrinks Theta, so a rank-one answer is a start for `exact` rather than its solution.

    Named variables: ``Theta``, ``a``, ``offset``. Other arguments as in `exact`.

    Args:
        weight: weight of the penalty, in units of the objective per unit of Theta.
        constraints: builders in the variables ``a``, ``Theta``, ``offset``.
        loss: "squares", "huber[:threshold in robust standard deviations]" or "l1", all with a dual bound.
        ridge: weight of ``‖Theta‖²``.
        curvature: weight of the integral of ``f''²``.
        gauge: gauge of the reported model: "norm", "gain" or "b0".

    Raises:
        StructureError: impossible orders, unknown gauge, nonconvex constraints.
        RankError: the record does not determine the parameters.
    """
    one_of("gauge", gauge, FIXED)
    check_weight(weight, "weight (of the nuclear norm)")
    return pose_with_loss(loss, data, partial(_penalised, builders=constraints, gauge=gauge, weight=float(weight)),
                          convex=True, na=na, nb=nb, nk=nk, basis=basis, ridge=ridge, curvature=curvature, prior=prior,
                          offset=offset)


@steps(lambda given: {"hammerstein_arx.overparametrised": "QP" if given["constraints"] else "QP linear"})
def overparametrised(data: Data | Stream, *, na: int, nb: int | Sequence[int],
                     basis: Basis | str | Sequence[Basis | str], nk: int | Sequence[int] = 0, svd: str = "whitened",
                     constraints: Sequence[Any] = (), loss: str = "squares", ridge: float = 0.0, curvature: float = 0.0,
                     prior: str = "none", gauge: str = "norm", offset: bool | str = True) -> Problem | Procedure:
    """Minimise the least squares in Theta and split off the rank-one factor afterwards (Algorithm 3.1).

    Named variables: ``Theta``, ``a``, ``offset``. Other arguments as in `nuclear`.

    Args:
        svd: "whitened" (in the Kronecker metric of the Gram matrix) or "plain" (as in the dissertation).

    Raises:
        StructureError: impossible orders, unknown gauge or split, nonconvex constraints.
        RankError: the record does not determine the parameters.
    """
    one_of("gauge", gauge, FIXED)
    if svd not in ("whitened", "plain"):
        raise StructureError(f"svd must be 'whitened' or 'plain'; got {svd!r}")
    return pose_with_loss(loss, data, partial(_relaxed, builders=constraints, gauge=gauge, svd=svd), convex=True,
                          na=na, nb=nb, nk=nk, basis=basis, ridge=ridge, curvature=curvature, prior=prior,
                          offset=offset)


def _relaxed(record: EquationError, builders: Sequence[Any], gauge: str, svd: str) -> Problem:
    thetas = {name: np.zeros(shape) for name, shape in zip(record.keys("Theta"), record.problem.blocks)}
    start = {**record.linear_zeros(), **thetas}

    objective = Squares.of(record.problem, tuple(start))  # ‖R [a; offset; vec Theta] - s‖²

    return Problem("hammerstein_arx.overparametrised", start, (objective,), (),
                   partial(_rank_one_model, record, gauge, svd), record.facts(), builders=tuple(builders),
                   **record.common())


def _penalised(record: EquationError, builders: Sequence[Any], gauge: str, weight: float) -> Problem:
    thetas = {name: np.zeros(shape) for name, shape in zip(record.keys("Theta"), record.problem.blocks)}
    start = {**record.linear_zeros(), **thetas}
    heights = record.units.y_scale[0] / np.array(record.units.u_scale)  # of Theta in the units of the record

    objective = (Squares.of(record.problem, tuple(start)),  # ‖R [a; offset; vec Theta] - s‖²
                 NuclearNorms(dict(zip(thetas, 2 * weight * heights / record.unit))))

    return Problem("hammerstein_arx.nuclear", start, objective, (),
                   partial(_rank_one_model, record, gauge, "whitened"), record.facts(), builders=tuple(builders),
                   weights={"weight": weight}, posed=partial(_penalised, record, builders, gauge),
                   **record.common())


def _rank_one_model(problem: EquationError, gauge: str, svd: str, values: Values) -> HammersteinTF:
    """Return the model of the leading singular pair of every Theta."""
    pairs = leading_pairs(problem.problem.core, problem.matrices(values), svd == "whitened")
    mus, bs = zip(*(in_gauge(gauge, mu, b.reshape(problem.b_shape(c), order="F"), problem.past(values), channel)
                    for c, ((mu, b), channel) in enumerate(zip(pairs, problem.layout.inputs))))
    return problem.model(values, mus, bs, gauge=gauge, flip=gauge == "norm")
