"""Hammerstein-ARX: ``A(q) y = sum_c B_c(q) f_c(u_c) + d + e`` with ``f_c = mu_cᵀ eta_c``.

Three formulations of one problem (Luo, chapter 3; Bai 1998 for the over-parametrisation):

* `exact`: the bilinear least-squares problem itself. Named variables: ``a``, ``b``, ``mu``, ``offset``, and the
  expression ``Theta = mu bᵀ``.
* `nuclear`: the rank constraint on Theta relaxed to a nuclear-norm penalty. Named variables: ``a``, ``Theta``,
  ``offset``.
* `overparametrised`: the rank constraint dropped, the rank-one factor split off afterwards (Algorithm 3.1). Named
  variables as for `nuclear`.

With several inputs the per-channel names carry the input, as in ``mu[valve]``.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.equation_error import EquationError, compress, residual_programme
from formulations.gauges import check_gauge, scale_fixed
from formulations.losses import degree, with_loss
from optid.bases.basis import Basis
from optid.certificate.lifting import certify_nuclear, certify_rank_one
from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import StructureError
from optid.models import HammersteinARX
from optid.models.gauges import gauge_factor
from optid.program.judging import measure_violation
from optid.program.program import Program, Values
from optid.solving.solve import Procedure
from optid.structures.bilinear import starts
from optid.structures.least_squares import LeastSquaresStructure, RankOneStructure
from optid.structures.rank_one import Core, reduce
from optid.structures.whitening import leading_pair


def exact(data: Data | Stream, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str],
          nk: int | Sequence[int] = 0, constraints: Sequence[Any] = (), loss: str = "squares", ridge: float = 0.0,
          curvature: float = 0.0, gauge: str = "norm") -> Program | Procedure:
    """Pose the bilinear least-squares problem ``min ‖Y - Phi_y a - Phi_eta vec(mu bᵀ) - d‖²``.

    Named variables: ``Theta``, ``a``, ``b``, ``mu``, ``offset``.

    Args:
        data: the record (or a stream larger than memory).
        na: number of past outputs in A.
        nb: number of coefficients of B, one per input or one for all.
        basis: basis of the nonlinearity, one per input or one for all.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders such as ``formulations.constraints.shape.monotone("increasing")`` or ``lambda v: {...}``.
        loss: "squares", "huber[:threshold in robust standard deviations]" or "l1" (reweighted passes; no proof).
        ridge: weight of ``‖mu‖² ‖b‖²``.
        curvature: weight of ``‖b‖²`` times the integral of ``f''²``.
        gauge: "norm" (‖b‖ = 1), "gain" (unit static gain of the linear part) or "b0" (first coefficient one).

    Returns:
        The programme, or a procedure of reweighted programmes for a loss other than squares.

    Raises:
        StructureError: impossible orders, unknown gauge, constraints that do not fit.
        RankError: the record does not determine the parameters.
    """
    check_gauge(gauge)
    options = {"na": na, "nb": nb, "nk": nk, "basis": basis, "ridge": ridge, "curvature": curvature,
               "degree": degree(loss)}

    def pose(weights: list[np.ndarray] | None = None) -> tuple[Program, EquationError]:
        problem = compress(data, weights=weights, **options)
        return _exact(problem, constraints, gauge), problem

    return with_loss(loss, data, pose, convex=False)


def _exact(problem: EquationError, constraints: Sequence[Any], gauge: str) -> Program:
    linear = problem.linear_variables()
    variables: dict[str, cp.Variable] = dict(linear)
    expressions: dict[str, cp.Expression] = dict(linear)
    thetas, gauges, blocks, start = [], [], [], {}
    core = reduce(problem.problem)
    point = core.point(*starts(core, count=1)[0])
    start.update(problem.linear_part(point.w))
    for c in range(len(problem.channels)):
        names = problem.key("mu", c), problem.key("b", c)
        mu = cp.Variable(problem.layout.bases[c].size, name=names[0])
        b = cp.Variable(problem.b_shape(c), name=names[1])
        theta = cp.outer(mu, cp.vec(b, order="F") if b.ndim == 2 else b)
        gauges.append(scale_fixed(gauge, b, linear.get("a")))
        blocks.append(names)
        thetas.append(theta)
        variables[names[0]], variables[names[1]] = mu, b
        expressions[names[0]], expressions[names[1]], expressions[problem.key("Theta", c)] = mu, b, theta
        values = _in_gauge(gauge, point.mus[c], point.bs[c].reshape(b.shape, order="F"), start.get("a"),
                           problem.channels[c])
        start.update(dict(zip(names, values)))
    program = residual_programme(
        problem, "hammerstein_arx.exact", variables, problem.residual(linear, thetas),
        constraints={"gauge": tuple(gauges)}, start=start, recover=lambda values: None,
        view=problem.view(expressions, gauge),
        structure=RankOneStructure(problem.problem, tuple(linear), tuple(blocks), gauge),
        certify=certify_rank_one)
    program = program.subject_to(*constraints)
    signed = _speaks_of_factors(program, {variables[name].id for names in blocks for name in names})

    def recover(values: Values) -> HammersteinARX:
        return problem.model(values, [values[mu] for mu, _ in blocks], [values[b] for _, b in blocks],
                             gauge=gauge, flip=gauge == "norm" and not signed)

    turn = signed and gauge == "norm"
    return replace(program, recover=recover, start=_signed_start(program, blocks) if turn else start)


def _speaks_of_factors(program: Program, factors: set[int]) -> bool:
    """Whether a constraint speaks of a mu or a b itself, and thereby decides their sign, not of ``mu bᵀ`` alone."""
    stand_in = {id(theta): cp.Variable(theta.shape) for name, theta in program.view.inner.items()
                if name.partition("[")[0] == "Theta"}
    return any(v.id in factors for group in program.user_constraints.values() for member in group
               for v in member.tree_copy(stand_in).variables())


def _signed_start(program: Program, blocks: Sequence[tuple[str, str]]) -> dict[str, np.ndarray]:
    """Turn the sign of every (mu, b) of the start to where the constraints are violated least.

    Methods that follow one start would otherwise stay at ``mu = 0`` on a plant whose sign the constraints turn round.
    """
    start = dict(program.start)
    for mu, b in blocks:
        turned = {**start, mu: -start[mu], b: -start[b]}
        sizes = []
        for values in (start, turned):
            program.assign(values)
            sizes.append(measure_violation(program)[0])
        if sizes[1] < sizes[0]:
            start = turned
    return start


def _in_gauge(gauge: str, mu: np.ndarray, b: np.ndarray, a: np.ndarray | None, channel: str
              ) -> tuple[np.ndarray, np.ndarray]:
    if gauge == "norm" and not np.any(b):  # an input without effect: any direction will do
        return np.zeros_like(mu), np.full(b.shape, 1 / np.sqrt(b.size))
    factor = gauge_factor(gauge, np.zeros(0) if a is None else a, b, channel)
    return mu * factor, b / factor


def nuclear(data: Data | Stream, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str],
            nk: int | Sequence[int] = 0, weight: float = 0.0, constraints: Sequence[Any] = (), loss: str = "squares",
            ridge: float = 0.0, curvature: float = 0.0, gauge: str = "norm") -> Program | Procedure:
    """Pose ``min ‖Y - Phi_y a - Phi_eta vec Theta - d‖² + 2 weight sum_c ‖Theta_c‖_*``.

    The penalty is the convex envelope of the ridge ``weight (‖mu‖² + ‖b‖²)`` on the factors (Falck et al. 2010); it
    shrinks Theta, so a rank-one answer is a start for `exact` rather than its solution.

    Named variables: ``Theta``, ``a``, ``offset``.

    Args:
        data: the record.
        na: number of past outputs in A.
        nb: number of coefficients of B, one per input or one for all.
        basis: basis of the nonlinearity, one per input or one for all.
        nk: delay in samples, one per input or one for all.
        weight: weight of the penalty, in units of the objective per unit of Theta.
        constraints: builders in the variables ``a``, ``Theta``, ``offset``.
        loss: as in `exact`; the convex forms carry a dual bound.
        ridge: weight of ``‖Theta‖²``.
        curvature: weight of the integral of ``f''²``.
        gauge: gauge of the reported model.

    Raises:
        StructureError: impossible orders, unknown gauge, nonconvex constraints.
        RankError: the record does not determine the parameters.
    """
    return _relaxed("hammerstein_arx.nuclear", data, constraints, loss, gauge, weight, "whitened",
                    {"na": na, "nb": nb, "nk": nk, "basis": basis, "ridge": ridge, "curvature": curvature,
                     "degree": degree(loss)})


def overparametrised(data: Data | Stream, *, na: int, nb: int | Sequence[int],
                     basis: Basis | str | Sequence[Basis | str], nk: int | Sequence[int] = 0, svd: str = "whitened",
                     constraints: Sequence[Any] = (), loss: str = "squares", ridge: float = 0.0,
                     curvature: float = 0.0, gauge: str = "norm") -> Program | Procedure:
    """Pose the least-squares problem in Theta and split off the rank-one factor afterwards (Algorithm 3.1).

    Named variables: ``Theta``, ``a``, ``offset``.

    Args:
        data: the record.
        na: number of past outputs in A.
        nb: number of coefficients of B, one per input or one for all.
        basis: basis of the nonlinearity, one per input or one for all.
        nk: delay in samples, one per input or one for all.
        svd: "whitened" (in the Kronecker metric of the Gram matrix) or "plain" (as in the dissertation).
        constraints: builders in the variables ``a``, ``Theta``, ``offset``.
        loss: as in `exact`.
        ridge: weight of ``‖Theta‖²``.
        curvature: weight of the integral of ``f''²``.
        gauge: gauge of the reported model.

    Raises:
        StructureError: impossible orders, unknown gauge or split, nonconvex constraints.
        RankError: the record does not determine the parameters.
    """
    if svd not in ("whitened", "plain"):
        raise StructureError(f"svd must be 'whitened' or 'plain'; got {svd!r}")
    return _relaxed("hammerstein_arx.overparametrised", data, constraints, loss, gauge, 0.0, svd,
                    {"na": na, "nb": nb, "nk": nk, "basis": basis, "ridge": ridge, "curvature": curvature,
                     "degree": degree(loss)})


def _relaxed(name: str, data: Data | Stream, constraints: Sequence[Any], loss: str, gauge: str, weight: float,
             svd: str, options: dict[str, Any]) -> Program | Procedure:
    check_gauge(gauge)
    if not weight >= 0:
        raise StructureError(f"the weight of the nuclear norm must not be negative; got {weight!r}")

    def pose(weights: list[np.ndarray] | None = None) -> tuple[Program, EquationError]:
        problem = compress(data, weights=weights, **options)
        return _matrix_programme(name, problem, constraints, gauge, weight, svd), problem

    return with_loss(loss, data, pose, convex=True)


def _matrix_programme(name: str, problem: EquationError, constraints: Sequence[Any], gauge: str, weight: float,
                      svd: str) -> Program:
    linear = problem.linear_variables()
    keys = [problem.key("Theta", c) for c in range(len(problem.channels))]
    thetas = {key: cp.Variable(shape, name=key) for key, shape in zip(keys, problem.problem.blocks)}
    tau = cp.Parameter(nonneg=True, name="weight", value=float(weight))
    nuclear = name.endswith("nuclear")
    heights = [problem.units.y_scale[0] / scale for scale in problem.units.u_scale]  # of Theta in the record's units
    penalty = 2 / problem.unit * tau * sum(
        height * cp.normNuc(t) for t, height in zip(thetas.values(), heights)) if nuclear else 0.0
    program = residual_programme(
        problem, name, {**linear, **thetas}, problem.residual(linear, list(thetas.values())), penalty=penalty,
        start={}, recover=partial(_split_model, problem, reduce(problem.problem), keys, gauge, svd),
        view=problem.view({**linear, **thetas}),
        parameters={"weight": tau} if nuclear else {},
        structure=None if nuclear else LeastSquaresStructure(problem.problem, (*linear, *keys), ()),
        certify=partial(certify_nuclear, problem.problem, np.array(heights) / problem.unit) if nuclear else None)
    return program.subject_to(*constraints)


def _split_model(problem: EquationError, core: Core, keys: Sequence[str], gauge: str, svd: str, values: Values
                 ) -> HammersteinARX:
    mus, bs = [], []
    for c, key in enumerate(keys):
        mu, b = _pair(core, c, np.reshape(values[key], problem.problem.blocks[c]), svd == "whitened")
        mu, b = _in_gauge(gauge, mu, b.reshape(problem.b_shape(c), order="F"), values.get("a"), problem.channels[c])
        mus.append(mu)
        bs.append(b)
    return problem.model(values, mus, bs, gauge=gauge, flip=gauge == "norm")


def _pair(core: Core, c: int, theta: np.ndarray, whitened: bool) -> tuple[np.ndarray, np.ndarray]:
    """Leading singular pair of Theta, in the Kronecker metric of the Gram matrix where that is asked for."""
    if whitened and c in core.kept:
        position = core.kept.index(c)
        left, right = core.whitening.factors_mu[position], core.whitening.factors_b[position]
    else:
        left, right = np.eye(theta.shape[0]), np.eye(theta.shape[1])
    return leading_pair(theta, left, right)
