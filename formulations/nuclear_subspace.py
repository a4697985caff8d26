"""Subspace identification with the nuclear norm in place of a truncated rank.

    min over yhat, T:   ‖ W1 ( H(yhat) - T_u H(eta) - T_z H(zeta) - T_y H(y) ) W2 ‖_*  +  lambda ‖ yhat - y ‖²

H is the block Hankel matrix of the record; what remains of the outputs when the known signals are taken off has the
rank of the order. Missing outputs are free variables. Three forms:

* "predictor": T_u lower block Toeplitz, T_z and T_y strictly so, no weights (N2SID of Verhaegen and Hansson 2016,
  here with functions of the inputs and of fed-back outputs). In predictor form feedback does no harm.
* "projection": T_u unstructured, which is the projection on the complement of the inputs (Liu and Vandenberghe 2009).
* "instruments": that projection, correlated with past inputs and outputs in the weights of the instrumental-variable
  method (Liu, Hansson and Vandenberghe 2013): a small matrix.

The dual bound of every programme is computed in closed form from a feasible dual point. The order and (A, C) are read
off the matrix; everything else is done by the steps of the other subspace methods.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from formulations.hammerstein_ss import SUBSPACE, Feedback
from optid.bases import Bases
from optid.core.low_rank import LowRank
from optid.core.problem import Problem
from optid.data.record import Data
from optid.identify.subspace.low_rank import Structured, fit_low_rank
from optid.identify.subspace.procedure import subspace_steps
from optid.solving.solve import Procedure


@subspace_steps({"low rank": "SDP nuclear"})
def nuclear(data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "linear",
            feedback_basis: Feedback = None,
            form: Literal["predictor", "projection", "instruments"] = "predictor",
            weight: float | str | Sequence[float] = "auto", noise: float | None = None, hold_out: float = 0.3,
            offset: bool = True, feedthrough: bool | Sequence[bool] = True, observer: str = "auto",
            split: str = "exact", stability: str = "auto", constraints: Sequence[Any] = ()) -> Procedure:
    """Identify a state-space model from a low-rank Hankel matrix found by convex optimisation.

    Named variables: ``T``, ``output``, ``yhat``. Other arguments as in `formulations.hammerstein_ss.sid`.

    Args:
        data: the record; missing outputs are estimated, windows with missing inputs left out.
        nx: order, or "auto": chosen with the weight by simulation of the parts held out; with one weight, the number
            of singular values above a thousandth of the largest, at most ten.
        block_rows: block rows, more than the order. None chooses.
        feedback_basis: basis of the feedback, None for none; needs form "predictor".
        form: "predictor", "projection" or "instruments".
        weight: weight of the misfit, or several, or "auto": the one that simulates the last part of every experiment
            best. It is the inverse of the noise variance relative to the variance of the outputs.
        noise: standard deviation of the noise in units of the output, instead of a weight (one output, or outputs of
            one size).
        hold_out: part of every experiment kept back to choose a weight.

    Raises:
        StructureError: words or orders that do not fit, or a record too long for the method.
        RankError: the record does not determine the model.
        DataError: a channel that is constant.
    """
    return fit_low_rank(
        low_rank, SUBSPACE, data, weight, noise, hold_out, nx=nx, block_rows=block_rows, basis=basis,
        feedback_basis=feedback_basis, instruments=form, offset=offset, feedthrough=feedthrough, observer=observer,
        split=split, stability=stability, constraints=tuple(constraints))


def low_rank(structured: Structured, weight: float) -> Problem:
    """State the convex problem for a weight lambda.

    Named variables: ``yhat`` (samples, l), outputs of mean zero and unit variance, and, in predictor form, ``T``, one
    column per output. The expression ``output`` is yhat in units of the data.
    """
    matrix = LowRank(structured.problem)  # W1 (H(yhat) - T_u H(eta) - ...) W2
    misfit = matrix.misfit(weight)  # lambda ‖yhat - y‖²

    return Problem(
        "low rank", matrix.start(), (matrix, misfit), (), structured.decompose,
        {"units": structured.windows.plan.units, "courses": frozenset({"output"})}, structured.in_units,
        scale=weight * float(np.sum(structured.problem.data**2)),
        weights={"weight": weight}, posed=partial(low_rank, structured))
