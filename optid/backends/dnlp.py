"""All private names of CVXPY that optid needs, in one place, for the versions pinned in the project file."""

import cvxpy as cp
from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC, SOLVER_MAP_QP


def conic_capabilities() -> dict[str, tuple[set[str], bool]]:
    """Return {lower-case solver name: (programme classes, installed)} for CVXPY's conic and QP interfaces."""
    installed = set(cp.installed_solvers())
    found: dict[str, tuple[set[str], bool]] = {}
    for name, interface in SOLVER_MAP_CONIC.items():
        cones = {c.__name__ for c in interface.SUPPORTED_CONSTRAINTS}
        classes = {"LP"}
        if "SOC" in cones:
            classes |= {"QP", "SOCP"}
        if cones & {"PSD", "SvecPSD"}:
            classes |= {"QP", "SOCP", "SDP"}
        if "ExpCone" in cones:
            classes |= {"conic"}
        found[name.lower()] = (classes, name in installed)
    for name in SOLVER_MAP_QP:
        classes, present = found.get(name.lower(), (set(), name in installed))
        found[name.lower()] = (classes | {"LP", "QP"}, present)
    return found
