"""What a command does before its heavy imports: refuse words that nothing is called, and keep the imports short."""

import sys
from collections.abc import Iterable
from importlib import import_module
from types import ModuleType
from typing import Any

from optid.registry import CONSTRAINTS, FORMULATIONS, entry_point

POSTPONED = {"scipy.stats": "entropy", "scipy.signal": "fftconvolve", "scipy.optimize._shgo": "shgo"}
"""What CVXPY imports, itself or through scipy.optimize, for one function each; all take as long as the rest of it."""


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


def import_cvxpy() -> None:
    """Import CVXPY without the large packages of which it needs one function each (`POSTPONED`)."""
    stubs = {name: _stub(name, function) for name, function in POSTPONED.items() if name not in sys.modules}
    sys.modules.update(stubs)
    try:
        import_module("cvxpy")
    finally:
        for name in stubs:
            del sys.modules[name]


def _stub(name: str, function: str) -> ModuleType:
    """Return a module whose one function imports the true one when it is called."""

    def call(*arguments: Any, **keywords: Any) -> Any:
        return getattr(import_module(name), function)(*arguments, **keywords)

    stub = ModuleType(name)
    setattr(stub, function, call)
    return stub
