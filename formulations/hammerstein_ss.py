"""Subspace identification of Hammerstein state-space models, with several channels and nonlinear output feedback.

    x(k+1) = A x + B f(u) + E g(y) + w,    y(k) = C x + D f(u) + d + v

Three methods, each a procedure of the same steps: (A, C) from projections of block Hankel matrices, constraints on the
poles there; then (x0, B, D, E, d) as one least-squares programme with the constraints on coefficients, rank one per
channel and certified; then the innovation form from the residuals.

* `sid`: past inputs and outputs as instruments (MOESP; Verhaegen and Dewilde 1992), for open loop.
* `sivid`: instrumental variables with nonlinear feedback, singular regressors by pseudo-inverse (Luo and
  Leonessa 2008).
* `asivid`: instruments augmented by future inputs and by the feedback functions of simulated, noise-free outputs, which
  keeps the regressors regular and the estimate consistent under coloured noise.
"""

from collections.abc import Sequence
from typing import Any

from formulations.subspace_procedure import identified
from optid.arrays import check_integer, one_of
from optid.bases import Bases, FeedbackBases
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.subspace.plan import in_record_units, planned
from optid.identify.subspace.steps import subspace_steps
from optid.solving.solve import Procedure

NOISES = ("white", "coloured")


@subspace_steps()
def sid(data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "linear",
        noise: str = "white", weighting: str = "moesp", offset: bool = True, feedthrough: bool | Sequence[bool] = True,
        observer: str = "auto", split: str = "exact", stability: str = "auto",
        constraints: Sequence[Any] = ()) -> Procedure:
    """Identify an open-loop system from projections on past inputs and outputs.

    Named variables: ``Bu``, ``Du``, ``Theta``, ``b``, ``mu``, ``offset``, ``x0``.

    Args:
        data: the record.
        nx: order; "auto" for the smallest order after which the singular values are noise (`optid.identify.order`),
            "gap" for the largest gap between them (SLICOT's rule).
        block_rows: block rows of the future, and as many of the past; more than the order. None chooses; where missing
            outputs then leave few complete windows, they are estimated (`optid.identify.subspace.imputation`), for the
            choice of A and C only.
        basis: basis of the input nonlinearity, one per input or one for all; linear by default.
        noise: "white" uses past outputs as instruments (less variance; process noise may be present), "coloured" inputs
            alone (consistent under coloured measurement noise).
        weighting: weighting of the singular values: "moesp", "cva" or "plain" (`optid.identify.subspace.projection`),
            or "best" for the one whose (A, C) leaves the smallest error on the record.
        offset: estimate a constant; False takes the record as it is.
        feedthrough: whether the inputs act on the outputs at once, one for all or one per input.
        observer: for the step in B, D and x0: "none" minimises the simulation error, "kalman" a prediction error,
            "auto" the first unless A is unstable.
        split: "exact" keeps every channel rank one in that step (certified), "lumped" splits afterwards (convex).
        stability: "auto" brings poles of an unstable estimate to modulus 0.999, "free" leaves them.
        constraints: rules about poles and about coefficients; variables as in `formulations.subspace_procedure`.

    Raises:
        StructureError: words or orders that do not fit.
        RankError: the record does not determine the model; the message names the channel.
        DataError: a channel that is constant.
    """
    one_of("noise", noise, NOISES)
    plan = planned("hammerstein_ss.sid", data, nx=nx, block_rows=block_rows, basis=basis,
                   instruments="inputs+past" if noise == "white" else "inputs", weighting=weighting, offset=offset,
                   feedthrough=feedthrough, observer=observer, split=split, stability=stability,
                   constraints=tuple(constraints))
    return in_record_units(identified(plan), plan)


@subspace_steps()
def sivid(data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "polynomial:3",
          feedback_basis: FeedbackBases = None, instruments: str = "past", form: str = "projection",
          tolerance: float = 0.05, weighting: str = "moesp", offset: bool = True,
          feedthrough: bool | Sequence[bool] = True, observer: str = "auto", split: str = "exact",
          stability: str = "auto", constraints: Sequence[Any] = ()) -> Procedure:
    """Identify a system with nonlinear feedback by instrumental variables, singular directions left out.

    With past instruments the correlation of instruments and regressors loses rank as the record grows; the directions
    below `tolerance` are dropped (pseudo-inverse), which is what distinguishes the method from `asivid`.

    Named variables: ``Bu``, ``Du``, ``Theta``, ``b``, ``mu``, ``offset``, ``x0``. Other arguments as in `sid`.

    Args:
        feedback_basis: basis of the feedback, None for no feedback, one for all outputs or one per output.
        instruments: "past", "inputs" or "inputs+past".
        form: "projection" or "correlation".
        tolerance: singular value of the projected regressors, relative to the largest, below which a direction is
            dropped.

    Raises:
        StructureError, RankError, DataError: as `sid`; RankError also where the feedback basis is linear in y.

    Warns:
        DataWarning: the feedback basis is nearly linear in y.
    """
    one_of("instruments", instruments, ("past", "inputs", "inputs+past"))
    if not 0 <= tolerance < 1:
        raise StructureError(f"tolerance={tolerance!r}: it must be a number in [0, 1).")
    plan = planned("hammerstein_ss.sivid", data, nx=nx, block_rows=block_rows, basis=basis,
                   feedback_basis=feedback_basis, instruments=instruments, form=form, tolerance=max(tolerance, 1e-10),
                   weighting=weighting, offset=offset, feedthrough=feedthrough, observer=observer, split=split,
                   stability=stability, constraints=tuple(constraints))
    return in_record_units(identified(plan), plan)


@subspace_steps()
def asivid(data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "polynomial:3",
           feedback_basis: FeedbackBases = None, noise: str = "coloured", iterations: int = 2, form: str = "projection",
           weighting: str = "moesp", offset: bool = True, feedthrough: bool | Sequence[bool] = True,
           observer: str = "auto", split: str = "exact", stability: str = "auto",
           constraints: Sequence[Any] = ()) -> Procedure:
    """Identify a system with nonlinear feedback with instruments augmented by simulated, noise-free feedback.

    Named variables: ``Bu``, ``Du``, ``Theta``, ``b``, ``mu``, ``offset``, ``x0``. Other arguments as in `sivid`.

    Args:
        noise: "coloured" keeps measured outputs out of the instruments; "white" adds the past of the outputs and of
            their feedback functions.
        iterations: simulations of the feedback with a preliminary model, each with the model of the one before; 0 uses
            past and future inputs (and with noise="white" the past outputs) alone.

    Raises:
        StructureError, RankError, DataError: as `sivid`.

    Warns:
        DataWarning: the feedback basis is nearly linear in y; the simulated feedback explains little of the measured.
    """
    one_of("noise", noise, NOISES)
    check_integer(iterations, "iterations", 0)
    kind = "simulated" if iterations else "inputs"
    plan = planned("hammerstein_ss.asivid", data, nx=nx, block_rows=block_rows, basis=basis,
                   feedback_basis=feedback_basis, instruments=kind + ("+past" if noise == "white" else ""), form=form,
                   iterations=int(iterations), weighting=weighting, offset=offset, feedthrough=feedthrough,
                   observer=observer, split=split, stability=stability, constraints=tuple(constraints))
    return in_record_units(identified(plan), plan)
