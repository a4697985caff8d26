"""Subspace identification of Hammerstein state-space models, with several channels and nonlinear output feedback.

    x(k+1) = A x + B f(u) + E g(y) + w,    y(k) = C x + D f(u) + d + v

Three methods, each a procedure of the same steps (`optid.identify.subspace.procedure`): the observability matrix Gamma
from projections of block Hankel matrices; (A, C) from its shift invariance, with the constraints on poles ("shift",
"shift with fixed P", "centre"); then (x0, B, D, E, d) as least squares with the constraints on coefficients ("split").

    min over P, Q:    ‖Gamma_up Q - Gamma_dn P‖      A = Q P^-1     (the fit weighted by P: Lacy and Bernstein 2003)
    min over A:       ‖Gamma_up A - Gamma_dn‖        P given
    max over P:       the margin of A in the inequalities
    min over x0, ...: ‖R [x0; offset; vec Theta_1; ...] - s‖²,    Theta_i = mu_i [B_i; D_i]ᵀ

P is definite with trace n, and any `Rule` about poles that is a linear matrix inequality in P and Q = A P takes part
(Miller and de Callafon 2013). R and s are the record, compressed. The last step is either factored, every channel rank
one and certified as such, in ``x0``, ``offset``, ``mu``, ``b`` (= [B_i; D_i]) and, for an output that is fed back, ``mu
feedback``, ``b feedback``; or lumped, ``Theta_i`` as it comes, convex, the factors split off afterwards in the metric
of the least squares, in ``x0``, ``offset``, ``Theta``, ``Theta feedback``. Linear channels alone always take this form.

With several inputs the per-channel names carry the input, as in ``mu[valve]``. Constraints may use in either form
``Theta`` (P, n + l), the lumped ``Bu`` (n, p), ``Du`` (l, p) and ``Ez`` (n, q); where every channel is linear ``B``
(n, m) and ``D`` (l, m) too. ``reference`` of the view holds A and C.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import cvxpy as cp
import numpy as np
from cvxpy.constraints.psd import PSD

from formulations.constraints.poles import stable
from formulations.constraints.rule import Rule
from optid.bases import Bases
from optid.core.leaves import Product
from optid.core.problem import Problem
from optid.core.terms import Expressed, Length, Squares
from optid.data.record import Data
from optid.identify.subspace.procedure import SubspaceSteps, subspace_steps
from optid.identify.subspace.realisation import Realisation
from optid.identify.subspace.shift import ShiftStep
from optid.solving.solve import Procedure

DEFINITE = 1e-3  # least eigenvalue of P where its trace is n: bounds the norm of P^-1
Noise = Literal["white", "coloured"]
Feedback = Bases | None | Sequence[Bases | None]  # one basis for all outputs, or one per output


def _shift(step: ShiftStep, rules: Sequence[Rule], given: tuple[np.ndarray, np.ndarray] | None = None) -> Problem:
    """Return min ‖residual‖ under rules: in P and Q, weighted by P; with P and a start for A given, in A alone.

    The model is A. Where a plant obeys almost exactly, the square of the norm would vanish in the tolerance.
    """
    n = len(step.basis)
    common: dict[str, Any] = {"model": step.recover, "facts": {"reference": {"A": step.free}}, "scale": step.size}
    if given is None:
        contracted = step.free * min(1.0, 0.5 / max(np.max(np.abs(np.linalg.eigvals(step.free))), 1e-12))
        root = np.hstack([-np.kron(step.change.T, step.low), np.kron(step.change.T, step.top)])
        return Problem(
            "shift", {"P": np.eye(n), "Q": contracted},
            (Length(root, np.zeros(len(root)), ("P", "Q")),),  # ‖(top Q - low P) change‖
            restrictions=(_normalised,), builders=tuple(rules), symmetric=frozenset({"P"}), **common)
    p = (given[0] + given[0].T) / 2
    target = np.ravel(step.low @ step.change, order="F")
    return Problem(
        "shift with fixed P", {"A": step.inner(given[1])},
        (Length(np.kron(step.change.T, step.top), target, ("A",)),),  # ‖(top A - low) change‖
        further=lambda variables, _: {"P": cp.Constant(p), "Q": variables["A"] @ p, "A": None},
        builders=tuple(rules), **common)


def _centre(step: ShiftStep, a: np.ndarray, rules: Sequence[Rule]) -> Problem:
    """Return the problem for the P that leaves a given A the largest margin in the matrix inequalities."""
    inner = step.inner(a)

    def ease(view: Any) -> dict[str, list[Any]]:
        # the rules hold at A already: here they are not the user's, so that their prices stay those of the fit
        return {"margin": [one.args[0] - view["margin"] * np.eye(one.args[0].shape[0]) >> 0
                           if isinstance(one, PSD) else one for rule in rules for one in rule.members(view)]}

    return Problem(
        "centre", {"P": np.eye(len(a)), "margin": np.zeros(())}, (Expressed(lambda v: -v["margin"]),),
        further=lambda variables, _: {"Q": inner @ variables["P"]}, facts={"reference": {"A": step.free}},
        restrictions=(_normalised, ease), symmetric=frozenset({"P"}))


def _normalised(view: Any) -> dict[str, list[Any]]:
    p = view["P"]
    return {"positive": [p - DEFINITE * np.eye(p.shape[0]) >> 0], "trace": [cp.trace(p) == p.shape[0]]}


def _split(step: Realisation) -> Problem:
    """Return the least squares for given (A, C), ``‖R [x0; offset; vec Theta_1; ...] - s‖²``."""
    thetas = tuple(theta for _, _, theta in step.names)

    def further(variables: Mapping[str, Any], _: object) -> dict[str, Any]:
        return step.expressions([variables[theta] for theta in thetas])

    return Problem(
        "split", step.start(), (Squares.of(step.problem, (*step.linear, *thetas)),),
        tuple(Product(mu, b) for mu, b, _ in step.names) if step.factored else (),
        step.model, step.facts(), further, **step.common())


SUBSPACE = SubspaceSteps(_shift, _centre, _split, stable)


@subspace_steps()
def sid(data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "linear",
        noise: Noise = "white", weighting: str = "moesp", offset: bool = True,
        feedthrough: bool | Sequence[bool] = True, observer: str = "auto", split: str = "exact",
        stability: str = "auto", constraints: Sequence[Any] = ()) -> Procedure:
    """Identify an open-loop system from projections on past inputs and outputs (Verhaegen and Dewilde 1992).

    Named variables: ``Bu``, ``Du``, ``Theta``, ``b``, ``mu``, ``offset``, ``x0``.

    Args:
        data: the record.
        nx: order; "auto" for the least after which singular values are noise, "gap" for their largest gap (SLICOT).
        block_rows: block rows of the future, and as many of the past; more than the order. None chooses, and for A and
            C estimates missing outputs that leave few complete windows (`optid.identify.subspace.imputation`).
        basis: basis of the input nonlinearity, one per input or one for all; linear by default.
        noise: "white" has past outputs as instruments, for less variance, also under process noise; "coloured" inputs
            alone, consistent under coloured measurement noise.
        weighting: of the singular values, "moesp", "cva" or "plain" (see `optid.identify.subspace.projection`), or
            "best", whose (A, C) leaves the smallest error.
        offset: estimate a constant; False takes the record as it is.
        feedthrough: whether the inputs act on the outputs at once, one for all or one per input.
        observer: for the step in B, D and x0: "none" minimises the simulation error, "kalman" a prediction error,
            "auto" the first unless A is unstable.
        split: "exact" keeps every channel rank one in that step, "lumped" splits afterwards.
        stability: "auto" brings poles of an unstable estimate to modulus 0.999, "free" leaves them.
        constraints: rules about poles and about coefficients; variables as above.

    Raises:
        StructureError: words or orders that do not fit.
        RankError: the record does not determine the model; the message names the channel.
        DataError: a channel that is constant.
    """
    return SUBSPACE.fit(
        "hammerstein_ss.sid", data, nx=nx, block_rows=block_rows, basis=basis,
        instruments="inputs+past" if noise == "white" else "inputs", weighting=weighting, offset=offset,
        feedthrough=feedthrough, observer=observer, split=split, stability=stability, constraints=tuple(constraints))


@subspace_steps()
def sivid(data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "polynomial:3",
          feedback_basis: Feedback = None, instruments: Literal["past", "inputs", "inputs+past"] = "past",
          form: str = "projection", tolerance: float = 0.05, weighting: str = "moesp", offset: bool = True,
          feedthrough: bool | Sequence[bool] = True, observer: str = "auto", split: str = "exact",
          stability: str = "auto", constraints: Sequence[Any] = ()) -> Procedure:
    """Identify a system with nonlinear feedback by instrumental variables, singular directions left out.

    With past instruments their correlation with the regressors loses rank as the record grows; directions below
    `tolerance` are dropped by pseudo-inverse (Luo and Leonessa 2008).

    Named variables: ``Bu``, ``Du``, ``Theta``, ``b``, ``mu``, ``offset``, ``x0``. Other arguments as in `sid`.

    Args:
        feedback_basis: basis of the feedback, None for no feedback, one for all outputs or one per output.
        instruments: "past", "inputs" or "inputs+past".
        form: "projection" or "correlation".
        tolerance: singular value of the projected regressors, over the largest, below which a direction is dropped.

    Raises:
        StructureError, RankError, DataError: as `sid`; RankError also where the feedback basis is linear in y.
    """
    return SUBSPACE.fit(
        "hammerstein_ss.sivid", data, nx=nx, block_rows=block_rows, basis=basis, feedback_basis=feedback_basis,
        instruments=instruments, form=form, tolerance=tolerance, weighting=weighting, offset=offset,
        feedthrough=feedthrough, observer=observer, split=split, stability=stability, constraints=tuple(constraints))


@subspace_steps()
def asivid(data: Data, *, nx: int | str = "auto", block_rows: int | None = None, basis: Bases = "polynomial:3",
           feedback_basis: Feedback = None, noise: Noise = "coloured", iterations: int = 2, form: str = "projection",
           weighting: str = "moesp", offset: bool = True, feedthrough: bool | Sequence[bool] = True,
           observer: str = "auto", split: str = "exact", stability: str = "auto", constraints: Sequence[Any] = ()
           ) -> Procedure:
    """Identify a system with nonlinear feedback with instruments augmented by simulated, noise-free feedback.

    They keep the regressors regular and the estimate consistent under coloured noise.
    Named variables: ``Bu``, ``Du``, ``Theta``, ``b``, ``mu``, ``offset``, ``x0``. Other arguments as in `sivid`.

    Args:
        noise: "coloured" keeps measured outputs out of the instruments; "white" adds the past of the outputs and of
            their feedback functions.
        iterations: simulations of the feedback, each with the model of the one before; 0 uses past and future inputs
            (and with noise="white" the past outputs) alone.

    Raises:
        StructureError, RankError, DataError: as `sivid`, with a DataWarning also where simulated feedback says little.
    """
    kind = ("simulated" if iterations else "inputs") + ("+past" if noise == "white" else "")
    return SUBSPACE.fit(
        "hammerstein_ss.asivid", data, nx=nx, block_rows=block_rows, basis=basis, feedback_basis=feedback_basis,
        instruments=kind, form=form, iterations=iterations, weighting=weighting, offset=offset, feedthrough=feedthrough,
        observer=observer, split=split, stability=stability, constraints=tuple(constraints))
