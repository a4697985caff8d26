"""Programmes about faults, posed by registered formulations and solved by any back end.

Every function passes further keyword arguments to its formulation, where they are documented, but for `solver` (the
back end's word, "auto" by default, or a back end of your own) and `settings` (of `optid.solve`, such as accuracy and
time_limit). All raise SolverFailed where the solver gives no point, and the errors of the formulation.
"""

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


def solved(name: str, *arguments: Any, solver: Any = "auto", settings: dict[str, Any] | None = None,
           **structure: Any) -> Any:
    """Return the result of a fault formulation by its registered name.

    Raises:
        SolverFailed: the solver gives no point.
    """
    from optid.solving.solve import run

    outcome = run(fault_formulation(name)(*arguments, **structure), solver, **(settings or {}))
    if outcome.model is None:
        solution = outcome.solution
        raise SolverFailed(f"{solution.solver} gave no usable answer for {name!r}: {solution.reason}")
    return outcome.model


def signature_estimate(found: "Scan", limits: "Thresholds", **how: Any) -> "SparseResult":
    """Choose few faults at few onsets that explain a window, by the group-sparse programme (`fault.signature`).

    Args:
        found: the search of the window.
        limits: its thresholds.
        how: penalty (at one something is active exactly when the search raises an alarm) and constraints.

    Returns:
        The result with its gap; where the solver fails it is not `certified` and says why.
    """
    return solved("fault.signature", found, limits, **how)


def membership(
    model: Any, data: "Data", bounds: Any = None, faults: "Dictionary | None" = None, **how: Any
) -> "Membership":
    """Prove by linear programming that no healthy plant within bounds of its noise made a window (`fault.membership`).

    Args:
        model: the healthy model.
        data: the window; one experiment, some ten to a hundred samples.
        bounds: of the noise: a number of standard deviations (three by default), or {"process": (n,), "output": (l,)}.
        faults: candidates that are tried, too.
        how: onsets, candidates and constraints.
    """
    how |= {} if bounds is None else {"bounds": bounds}
    return solved("fault.membership", model, data, faults=faults, **how)


def profile(found: "Scan", label: str, prior: str = "auto", **how: Any) -> "Profile":
    """Estimate the course of one fault over time (`fault.profile`).

    Args:
        found: the search of the window.
        label: of a candidate with one magnitude.
        prior: "tv" (steps), "trend" (ramps), "smooth" (random walk), or "auto": the better of the first two by BIC.
        how: sign, limit, slew, penalties and constraints.
    """
    return solved("fault.profile", found, label, prior=prior, **how)


def noise_covariance(found: "Dictionary", whitened: "Whitened", **how: Any) -> "CovarianceMatch":
    """Match the covariances of a window by more noise in several places, or any (`fault.noise_covariance`).

    Args:
        found: the candidates: those of kind "noise", or, where there are none, every place of the others.
        whitened: the window; one experiment.
        how: form, lags, onset and constraints.
    """
    return solved("fault.noise_covariance", found, whitened, **how)
