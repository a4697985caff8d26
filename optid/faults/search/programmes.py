"""Programmes about faults, posed by registered formulations and solved by any back end."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from optid.errors import SolverFailed
from optid.registry import fault_formulation

if TYPE_CHECKING:
    from optid.data.record import Data
    from optid.faults.consistency.bounded_noise import Membership
    from optid.faults.consistency.noise_matching import CovarianceMatch
    from optid.faults.consistency.profiles import Profile
    from optid.faults.search.calibration import Thresholds
    from optid.faults.search.scanning import Scan
    from optid.faults.search.sparse import SparseResult
    from optid.faults.signatures import Dictionary
    from optid.faults.whitening import Whitened


def _solved(name: str, *arguments: Any, solver: Any, settings: dict[str, Any] | None, **structure: Any) -> Any:
    from optid.solving.solve import run

    outcome = run(fault_formulation(name)(*arguments, **structure), solver, **(settings or {}))
    if outcome.model is None:
        solution = outcome.solution
        raise SolverFailed(f"{solution.solver} gave no usable answer for {name!r}: {solution.reason}")
    return outcome.model


def signature_estimate(
    found: "Scan", limits: "Thresholds", *, penalty: float = 1.0, constraints: Sequence[Any] = (), solver: Any = "auto",
    settings: dict[str, Any] | None = None,
) -> "SparseResult":
    """Choose few faults at few onsets that explain a window, by the group-sparse programme.

    Args:
        found: the search of the window.
        limits: its thresholds.
        penalty: lambda; at one something is active exactly when the search raises an alarm.
        constraints: further constraints on the named variables ``a[label]`` and ``size[label]`` (onsets, d).
        solver: the back end's word, "auto", or a back end of your own.
        settings: of `optid.solve`, such as accuracy and time_limit.

    Returns:
        The result with its gap; where the solver fails it is not `certified` and says why.

    Raises:
        StructureError: thresholds that do not fit, a window that is too long, a solver that takes no such programme.
    """
    return _solved("fault.signature", found, limits, penalty=penalty, constraints=constraints, solver=solver,
                   settings=settings)


def membership(
    model: Any, data: "Data", bounds: Any = None, faults: "Dictionary | None" = None, *,
    onsets: Sequence[int] | str = "all", candidates: bool = True, constraints: Sequence[Any] = (), solver: Any = "auto",
    settings: dict[str, Any] | None = None,
) -> "Membership":
    """Prove by linear programming that no healthy plant within bounds of its noise has made a window.

    Args:
        model: the healthy model.
        data: the window; one experiment, some ten to a hundred samples.
        bounds: of the noise: a number of standard deviations (three by default), or {"process": (n,), "output": (l,)}.
        faults: candidates that are tried, too.
        onsets: "all", the onsets that are tried, or "course": a fault of any course.
        candidates: whether candidates are tried although a healthy plant is possible.
        constraints: further constraints on the states ``x`` (deviations from a simulation) and ``t``.
        solver: as in `signature_estimate`.
        settings: as there.

    Raises:
        DataError: several experiments, a missing input.
        StructureError: no noise covariances, bounds of another shape, onsets outside the window.
    """
    how = {} if bounds is None else {"bounds": bounds}
    return _solved("fault.membership", model, data, faults=faults, onsets=onsets, candidates=candidates,
                   constraints=constraints, solver=solver, settings=settings, **how)


def profile(
    found: "Scan", label: str, prior: str = "auto", *, sign: str | None = None, limit: float | None = None,
    slew: float | None = None, penalties: Sequence[float] | None = None, constraints: Sequence[Any] = (),
    solver: Any = "auto", settings: dict[str, Any] | None = None,
) -> "Profile":
    """Estimate the course of one fault over time.

    Args:
        found: the search of the window.
        label: of a candidate with one magnitude.
        prior: "tv" (steps), "trend" (ramps), "smooth" (random walk), or "auto": the better of the first two by BIC.
        sign: "positive" or "negative", of the course.
        limit: largest size of the course.
        slew: largest change from one sample to the next, the first from zero.
        penalties: shares of the largest penalty that are tried.
        constraints: further constraints on the course ``f`` (N,) and on ``changes``.
        solver: as in `signature_estimate`.
        settings: as there.

    Raises:
        DataError: the window sees nothing of the fault.
        SolverFailed: no solver gave a point.
        StructureError: words or numbers that do not fit, a candidate without a course.
    """
    return _solved("fault.profile", found, label, prior=prior, sign=sign, limit=limit, slew=slew, penalties=penalties,
                   constraints=constraints, solver=solver, settings=settings)


def noise_covariance(
    found: "Dictionary", whitened: "Whitened", *, form: str = "places", lags: int | None = None, onset: int = 0,
    constraints: Sequence[Any] = (), solver: Any = "auto", settings: dict[str, Any] | None = None,
) -> "CovarianceMatch":
    """Match the covariances of a window by more noise in several places at once, or by any covariance.

    Args:
        found: the candidates: those of kind "noise", or, where there are none, every place of the others.
        whitened: the window; one experiment.
        form: "places" (non-negative variances) or "full" (positive semidefinite covariances of any noise).
        lags: largest lag; None for the settling of the predictor, at most a tenth of the window.
        onset: first sample that is used.
        constraints: further constraints on ``rho``, or ``Q`` and ``R``.
        solver: as in `signature_estimate`.
        settings: as there.

    Raises:
        DataError: too few readings.
        StructureError: words or numbers that do not fit.
    """
    return _solved("fault.noise_covariance", found, whitened, form=form, lags=lags, onset=onset,
                   constraints=constraints, solver=solver, settings=settings)
