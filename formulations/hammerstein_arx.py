"""Hammerstein systems by equation errors, the bilinear least squares: ``A(q) y = sum_c B_c(q) f_c(u_c) + d + e``.

    min over a, mu, b, d:    ‖y - Phi_y a - sum_c Phi_c vec(mu_c b_cᵀ) - d‖²,    f_c = mu_cᵀ eta_c

Phi_y holds past outputs, Phi_c the functions eta_c of past inputs; only products of the columns are needed. A gauge
such as ``‖b_c‖ = 1`` fixes the scale between mu and b; f rises where the output rises, unless constraints decide.

* `exact`: in ``mu`` and ``b``, with the expression ``Theta = mu bᵀ``; proved by the dual of the rank-one constraint.
* `nuclear`: convex in ``Theta``, a nuclear-norm penalty in place of the rank-one constraint.
* `overparametrised`: convex in ``Theta``; the rank-one factor is split off afterwards (Bai 1998; Luo, Algorithm 3.1).

With several inputs the per-channel names carry the input, as in ``mu[valve]``.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from optid.bases import Bases
from optid.core.leaves import Product
from optid.core.problem import Problem
from optid.core.terms import NuclearNorms, Squares
from optid.data.record import Data
from optid.data.streams import Stream
from optid.identify.equation_error import EquationError, pose_with_loss
from optid.models.gauges import Gauge
from optid.solving.solve import Procedure
from optid.solving.steps import steps


@steps(lambda given: {"hammerstein_arx.exact": "NLP rank-one"})
def exact(data: Data | Stream, *, na: int, nb: int | Sequence[int], basis: Bases,
          nk: int | Sequence[int] = 0, constraints: Sequence[Any] = (), loss: str = "squares", ridge: float = 0.0,
          curvature: float = 0.0, prior: str = "none", gauge: Gauge = "norm", offset: bool | str = True
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
    return pose_with_loss(loss, data, partial(_factored, builders=constraints, gauge=gauge), convex=False, na=na,
                          nb=nb, nk=nk, basis=basis, ridge=ridge, curvature=curvature, prior=prior,
                          offset=offset)


def _factored(record: EquationError, builders: Sequence[Any], gauge: Gauge) -> Problem:
    products = tuple(Product(mu, b, gauge) for mu, b in zip(record.keys("mu"), record.keys("b")))
    linear = tuple(record.linear_zeros())  # a, offset

    z = (*linear, *(one.name for one in products))
    objective = Squares.of(record.problem, z)  # ‖R [a; offset; vec mu bᵀ] - s‖²

    problem = Problem("hammerstein_arx.exact", record.rank_one_start(gauge), (objective,), products,
                      partial(record.factored_model, gauge), record.facts(gauge), builders=tuple(builders),
                      **record.common())
    if gauge == "norm" and problem.fixes_signs:
        return problem.beginning(problem.signed_start(), partial(record.factored_model, gauge, signed=True))
    return problem


@steps(lambda given: {"hammerstein_arx.nuclear": "SDP"})
def nuclear(data: Data | Stream, *, na: int, nb: int | Sequence[int], basis: Bases,
            nk: int | Sequence[int] = 0, weight: float = 0.0, constraints: Sequence[Any] = (), loss: str = "squares",
            ridge: float = 0.0, curvature: float = 0.0, prior: str = "none", gauge: Gauge = "norm",
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
    return pose_with_loss(loss, data, partial(_penalised, builders=constraints, gauge=gauge, weight=weight),
                          convex=True, na=na, nb=nb, nk=nk, basis=basis, ridge=ridge, curvature=curvature, prior=prior,
                          offset=offset)


@steps(lambda given: {"hammerstein_arx.overparametrised": "QP" if given["constraints"] else "QP linear"})
def overparametrised(data: Data | Stream, *, na: int, nb: int | Sequence[int],
                     basis: Bases, nk: int | Sequence[int] = 0, svd: Literal["whitened", "plain"] = "whitened",
                     constraints: Sequence[Any] = (), loss: str = "squares", ridge: float = 0.0, curvature: float = 0.0,
                     prior: str = "none", gauge: Gauge = "norm", offset: bool | str = True) -> Problem | Procedure:
    """Minimise the least squares in Theta and split off the rank-one factor afterwards (Algorithm 3.1).

    Named variables: ``Theta``, ``a``, ``offset``. Other arguments as in `nuclear`.

    Args:
        svd: "whitened" (in the Kronecker metric of the Gram matrix) or "plain" (as in the dissertation).

    Raises:
        StructureError: impossible orders, unknown gauge or split, nonconvex constraints.
        RankError: the record does not determine the parameters.
    """
    return pose_with_loss(loss, data, partial(_relaxed, builders=constraints, gauge=gauge, svd=svd), convex=True,
                          na=na, nb=nb, nk=nk, basis=basis, ridge=ridge, curvature=curvature, prior=prior,
                          offset=offset)


def _relaxed(record: EquationError, builders: Sequence[Any], gauge: Gauge, svd: str) -> Problem:
    thetas = {name: np.zeros(shape) for name, shape in zip(record.keys("Theta"), record.problem.blocks)}
    start = {**record.linear_zeros(), **thetas}

    objective = Squares.of(record.problem, tuple(start))  # ‖R [a; offset; vec Theta] - s‖²

    return Problem("hammerstein_arx.overparametrised", start, (objective,), (),
                   partial(record.nearest_model, gauge, svd == "whitened"), record.facts(), builders=tuple(builders),
                   **record.common())


def _penalised(record: EquationError, builders: Sequence[Any], gauge: Gauge, weight: float) -> Problem:
    thetas = {name: np.zeros(shape) for name, shape in zip(record.keys("Theta"), record.problem.blocks)}
    start = {**record.linear_zeros(), **thetas}
    heights = record.units.y_scale[0] / np.array(record.units.u_scale)  # of Theta in the units of the record

    objective = (Squares.of(record.problem, tuple(start)),  # ‖R [a; offset; vec Theta] - s‖²
                 NuclearNorms(dict(zip(thetas, 2 * weight * heights / record.unit))))

    return Problem("hammerstein_arx.nuclear", start, objective, (),
                   partial(record.nearest_model, gauge, True), record.facts(), builders=tuple(builders),
                   weights={"weight": weight}, posed=partial(_penalised, record, builders, gauge),
                   **record.common())
