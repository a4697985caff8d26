"""Fault formulations, solved by any back end.

Every function passes further keyword arguments to its formulation (`formulations/faults`), where they are documented,
but for `solver` (name of a back end, "auto" by default, or a back end) and `settings` (of `optid.solve`, such as
accuracy and time_limit). All raise SolverFailed where the solver returns no point, and the errors of the formulation.
"""

from typing import TYPE_CHECKING, Any

from optid.errors import SolverFailed
from optid.registry import fault_formulation

if TYPE_CHECKING:
    from optid.data.record import Data
    from optid.faults.consistency.bounded_noise import Membership
    from optid.faults.consistency.profiles import Profile
    from optid.faults.false_alarms import Thresholds
    from optid.faults.search.scanning import Scan
    from optid.faults.search.sparse import SparseResult
    from optid.faults.signatures import Dictionary


def solve_registered(name: str, *arguments: Any, solver: Any = "auto", settings: dict[str, Any] | None = None,
                     **structure: Any) -> Any:
    """Return the result of a fault formulation by its registered name."""
    from optid.solving.solve import run

    outcome = run(fault_formulation(name)(*arguments, **structure), solver, **(settings or {}))
    if outcome.model is None:
        solution = outcome.solution
        raise SolverFailed(f"{solution.solver} gave no usable answer for {name!r}: {solution.reason}")
    return outcome.model


def signature_estimate(found: "Scan", limits: "Thresholds", **how: Any) -> "SparseResult":
    """Choose few faults at few onsets that explain a window, by the group-sparse programme (`fault.signature`).

    Further arguments are penalty (at one a group is active exactly when the search raises an alarm) and constraints.
    Where the solver fails, the result is not `certified` and its status gives the reason.
    """
    return solve_registered("fault.signature", found, limits, **how)


def membership(model: Any, data: "Data", bounds: Any = None, faults: "Dictionary | None" = None,
               **how: Any) -> "Membership":
    """Prove by linear programming that no healthy plant within bounds of its noise made a window (`fault.membership`).

    Bounds are a number of standard deviations (three by default) or {"process": (n,), "output": (l,)}; candidates of
    `faults` are tested, too. Further arguments are onsets, candidates and constraints.
    """
    how |= {} if bounds is None else {"bounds": bounds}
    return solve_registered("fault.membership", model, data, faults=faults, **how)


def profile(found: "Scan", label: str, prior: str = "auto", **how: Any) -> "Profile":
    """Estimate the course of one fault, of a candidate with one magnitude, over time (`fault.profile`).

    The prior is "tv" (steps), "trend" (ramps), "smooth" (random walk), or "auto": the better of the first two by BIC.
    Further arguments are sign, limit, slew, penalties and constraints.
    """
    return solve_registered("fault.profile", found, label, prior=prior, **how)
