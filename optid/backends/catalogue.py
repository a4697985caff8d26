"""The solvers optid comes with an interface to, as data: what each takes, and which package it needs.

A solver's code is imported when it is first asked to solve something.
"""

from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from operator import attrgetter
from typing import Any

from optid.backends.back_end import BackEnd

CONIC: dict[str, tuple[str, str, str]] = {
    "clarabel": ("LP QP SOCP SDP conic", "clarabel", "clarabel"),
    "cbc": ("LP", "cylp", "cylp"),
    "copt": ("LP QP SOCP SDP conic", "coptpy", "coptpy"),
    "cosmo": ("LP QP SOCP SDP conic", "cosmopy", ""),
    "cplex": ("LP QP SOCP", "cplex", "cplex"),
    "cuclarabel": ("LP QP SOCP conic", "juliacall", ""),
    "cuopt": ("LP QP SOCP", "cuopt", "cuopt"),
    "cvxopt": ("LP QP SOCP SDP", "cvxopt", "cvxopt"),
    "daqp": ("LP QP", "daqp", "daqp"),
    "ecos": ("LP QP SOCP conic", "ecos", "ecos"),
    "ecos_bb": ("LP QP SOCP conic", "ecos", ""),
    "glop": ("LP", "ortools", "ortools"),
    "glpk": ("LP", "cvxopt", "cvxopt"),
    "gurobi": ("LP QP SOCP", "gurobipy", "gurobipy"),
    "highs": ("LP QP", "highspy", "highspy"),
    "knitro": ("LP QP SOCP SDP conic", "knitro", "knitro"),
    "moreau": ("LP QP SOCP SDP conic", "moreau", ""),
    "mosek": ("LP QP SOCP SDP", "mosek", "Mosek"),
    "mpax": ("LP QP", "mpax", "mpax"),
    "nag": ("LP QP SOCP", "naginterfaces", ""),
    "osqp": ("LP QP", "osqp", "osqp"),
    "pdcs": ("LP QP SOCP conic", "juliacall", ""),
    "pdlp": ("LP", "ortools", "ortools"),
    "piqp": ("LP QP", "piqp", "piqp"),
    "proxqp": ("QP", "proxsuite", "proxsuite"),  # calls feasible linear programmes infeasible, whatever its tolerances
    "qoco": ("LP QP SOCP", "qoco", "qoco"),
    "qpalm": ("LP QP", "qpalm", "qpalm"),
    "scip": ("LP QP", "pyscipopt", "pyscipopt"),  # branches for minutes on a cone, then fails in its LP solver
    "scipy": ("LP", "scipy", ""),
    "scs": ("LP QP SOCP SDP conic", "scs", "scs"),
    "sdpa": ("LP QP SOCP SDP", "sdpap", "sdpa-python"),
    "xpress": ("LP QP SOCP", "xpress", "xpress"),
}
"""{word: (classes that pass `optid.conformance.checks`, package to import, pip name)} of the solvers under CVXPY.

Left out are glpk_mi and diffcp, other interfaces to glpk (for integers) and to clarabel and scs (for derivatives).
"""

WITHOUT_DUALS = {"scip"}  # none for quadratic programmes, wrong ones for linear programmes (its presolve is not undone)
WARM = {"clarabel", "daqp", "osqp", "piqp", "proxqp", "scs"}


@dataclass(frozen=True)
class _Function:
    """A function "module:name" and its first argument, if any; imported at the first call, or by who receives it."""

    target: str
    word: str = ""

    def __call__(self, *arguments: Any) -> Any:
        module, _, name = self.target.partition(":")
        return attrgetter(name)(import_module(module))(*filter(None, [self.word]), *arguments)

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        with suppress(ImportError):  # which the call says
            import_module(self.target.partition(":")[0])  # before the time limit of another process begins


_RANK_ONE = _Function("optid.core.least_squares:RankOneForm.of")


def back_ends() -> list[BackEnd]:
    """Return all of them, installed or not."""
    return [
        *(BackEnd(name, frozenset(classes.split()), _Function("optid.backends.conic:solve_with", name),
                  installed=_is_installed(package), pip=pip, duals=name not in WITHOUT_DUALS,
                  warm=name in WARM, about="through CVXPY")
          for name, (classes, package, pip) in CONIC.items()),
        *(BackEnd(name, frozenset({"LP", "QP", "NLP"}), _Function("optid.backends.casadi:solve_with", name),
                  installed=_is_installed("casadi"), pip="casadi", warm=True,
                  about=f"interior point with exact Hessians, through CasADi; {more}")
          for name, more in (("ipopt", "large sparse programmes"), ("fatrop", "blind to infeasibility"))),
        BackEnd("uno", frozenset({"LP", "QP", "NLP"}), _Function("optid.backends.uno:run"),
                installed=_is_installed("unopy") and _is_installed("sparsediffpy"), pip="unopy sparsediffpy", warm=True,
                about="SQP through CVXPY's derivative engine; small dense programmes"),
        BackEnd("lstsq", frozenset(), _Function("optid.backends.lstsq:run"), form="linear",
                takes=_Function("optid.core.least_squares:LinearForm.of"),
                about="one factorisation, for least squares without products and constraints"),
        BackEnd("gauss_newton", frozenset(), _Function("optid.backends.gauss_newton:run"),
                form="rank-one", takes=_RANK_ONE, warm=True,
                thorough={"starts": 32, "directions": 16, "descents": 12},
                about="own Gauss-Newton for rank-one least squares; QPs of the same layer under constraints"),
        BackEnd("alternating", frozenset(), _Function("optid.solving.alternating:run"),
                form="rank-one", takes=_RANK_ONE, warm=True,
                about="alternating convex half-steps for rank-one least squares, through any convex back end"),
        BackEnd("admm", frozenset(), _Function("optid.backends.admm:run"), form="nuclear",
                takes=_Function("optid.core.low_rank:LowRankForm.of"),
                about="own ADMM for nuclear-norm subspace fits; stops by the duality gap"),
        BackEnd("block_descent", frozenset(), _Function("optid.backends.block_descent:run"),
                form="group-sparse",
                takes=_Function("optid.core.group_sparse:GroupSparseForm.of"), warm=True,
                about="own active-set block descent for group-sparse programmes; stops by the duality gap"),
    ]


def _is_installed(package: str) -> bool:
    return find_spec(package) is not None
