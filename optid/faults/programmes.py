"""Programmes about faults, posed by registered formulations and solved by any back end."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from optid.registry import fault_formulation

if TYPE_CHECKING:
    from optid.faults.calibration import Thresholds
    from optid.faults.scanning import Scan
    from optid.faults.sparse import SparseResult


def _solved(name: str, *arguments: Any, solver: Any, settings: dict[str, Any] | None, **structure: Any) -> Any:
    from optid.solving import run

    return run(fault_formulation(name)(*arguments, **structure), solver, **(settings or {})).model


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
        settings: of `optid.solving.solve`, such as accuracy and time_limit.

    Returns:
        The result with its gap; where the solver fails it is not `certified` and says why.

    Raises:
        StructureError: thresholds that do not fit, a window that is too long, a solver that takes no such programme.
    """
    return _solved("fault.signature", found, limits, penalty=penalty, constraints=constraints, solver=solver,
                   settings=settings)
