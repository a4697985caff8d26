"""Hammerstein-ARX with the rank-one constraint on ``Theta = mu bᵀ`` relaxed: two convex problems.

* `nuclear`: a nuclear-norm penalty in its place.
* `overparametrised`: no constraint; the rank-one factor is split off afterwards (Bai 1998; Luo, Algorithm 3.1).

Named variables: ``a``, ``Theta``, ``offset``; with several inputs the per-channel names carry the input, as in
``Theta[valve]``.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import one_of
from optid.bases.basis import Basis
from optid.certificate.lifting import certify_nuclear
from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import StructureError
from optid.identify.equation_error import EquationError, pose_with_loss
from optid.identify.gauges import FIXED, in_gauge
from optid.models import HammersteinTF
from optid.program.program import Program, Values
from optid.solving.solve import Procedure
from optid.structures.least_squares import LeastSquaresStructure
from optid.structures.lifted_regression import leading_pairs
from optid.structures.rank_one import Core


def nuclear(  # noqa: D417 - the other arguments by reference
    data: Data | Stream, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str],
    nk: int | Sequence[int] = 0, weight: float = 0.0, constraints: Sequence[Any] = (), loss: str = "squares",
    ridge: float = 0.0, curvature: float = 0.0, prior: str = "none", gauge: str = "norm"
) -> Program | Procedure:
    """Pose ``min ‖Y - Phi_y a - Phi_eta vec Theta - d‖² + 2 weight sum_c ‖Theta_c‖_*``.

    The penalty is the convex envelope of the ridge ``weight (‖mu‖² + ‖b‖²)`` on the factors (Falck et al. 2010); it
    shrinks Theta, so a rank-one answer is a start for `hammerstein_arx.exact` rather than its solution.

    Named variables: ``Theta``, ``a``, ``offset``. Other arguments as in `formulations.hammerstein_arx.exact`.

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
    if not weight >= 0:
        raise StructureError(f"the weight of the nuclear norm must not be negative; got {weight!r}")
    return pose_with_loss(loss, data, partial(_programme, builders=constraints, gauge=gauge, weight=float(weight)),
                          convex=True, na=na, nb=nb, nk=nk, basis=basis, ridge=ridge, curvature=curvature, prior=prior)


def overparametrised(  # noqa: D417 - the other arguments by reference
    data: Data | Stream, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str],
    nk: int | Sequence[int] = 0, svd: str = "whitened", constraints: Sequence[Any] = (), loss: str = "squares",
    ridge: float = 0.0, curvature: float = 0.0, prior: str = "none", gauge: str = "norm"
) -> Program | Procedure:
    """Pose the least-squares problem in Theta and split off the rank-one factor afterwards (Algorithm 3.1).

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
    return pose_with_loss(loss, data, partial(_programme, builders=constraints, gauge=gauge, svd=svd), convex=True,
                          na=na, nb=nb, nk=nk, basis=basis, ridge=ridge, curvature=curvature, prior=prior)


def _programme(problem: EquationError, builders: Sequence[Any], gauge: str, weight: float | None = None,
               svd: str = "whitened") -> Program:
    linear = problem.linear_variables()  # a, offset
    theta = {key: cp.Variable(shape, name=key) for key, shape in zip(problem.keys("Theta"), problem.problem.blocks)}
    tau = cp.Parameter(nonneg=True, name="weight", value=weight)
    heights = problem.units.y_scale[0] / np.array(problem.units.u_scale)  # of Theta in the units of the record
    residual = problem.residual(linear, theta.values())
    r = cp.Variable(residual.size, name="residual")

    squares = cp.sum_squares(r) + problem.problem.remainder
    norms = sum(height * cp.normNuc(one) for height, one in zip(heights, theta.values()))
    objective = cp.Minimize(squares if weight is None else squares + 2 / problem.unit * tau * norms)
    constraints = {"residual": (r == residual,)}

    form: dict[str, Any] = {"structure": LeastSquaresStructure(problem.problem, (*linear, *theta))}
    if weight is not None:
        form = {"parameters": {"weight": tau},
                "certify": partial(certify_nuclear, problem.problem, heights / problem.unit)}
    name = "overparametrised" if weight is None else "nuclear"
    return Program(
        f"hammerstein_arx.{name}", objective, constraints, {**linear, **theta, "residual": r}, {},
        partial(_rank_one_model, problem, problem.problem.core, gauge, svd),
        problem.view({**linear, **theta}), structural=frozenset(constraints), derived={"residual": residual},
        scale=problem.problem.scale, unit=problem.unit, compressed=problem, **form).subject_to(*builders)


def _rank_one_model(problem: EquationError, core: Core, gauge: str, svd: str, values: Values) -> HammersteinTF:
    """Return the model of the leading singular pair of every Theta."""
    pairs = [in_gauge(gauge, mu, b.reshape(problem.b_shape(c), order="F"), values.get("a"), problem.layout.inputs[c])
             for c, (mu, b) in enumerate(leading_pairs(core, problem.matrices(values), svd == "whitened"))]
    mus, bs = zip(*pairs)
    return problem.model(values, mus, bs, gauge=gauge, flip=gauge == "norm")
