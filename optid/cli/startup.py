"""What a command does before its heavy imports: refuse words that nothing is called."""

from collections.abc import Iterable

from optid.registry import CONSTRAINTS, FORMULATIONS, entry_point


def check_names(formulation: str, constraints: Iterable[str] | None, solver: str = "auto") -> None:
    """Refuse names of formulations, constraints and solvers that do not exist.

    Raises:
        LookupFailed: with the nearest name.
        SolverMissing: a solver that is not installed.
    """
    entry_point(FORMULATIONS, formulation)
    check_constraints(constraints)
    check_solver(solver)


def check_constraints(constraints: Iterable[str] | None) -> None:
    """Refuse names of constraints that do not exist (`LookupFailed`)."""
    for word in constraints or ():
        if word != "none":
            entry_point(CONSTRAINTS, word.partition(":")[0])


def check_solver(solver: str) -> None:
    """Refuse a solver that does not exist (`LookupFailed`) or is not installed (`SolverMissing`)."""
    if solver != "auto":
        from optid.backends.choice import find

        find(solver)
