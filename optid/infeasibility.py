"""Explain an infeasible set of constraints by a smallest conflicting subset, in the user's names."""

import cvxpy as cp
import numpy as np

from optid.program import Program


def explain(program: Program) -> str:
    """Return a sentence that lists a conflicting subset of the user's constraints.

    The subset is irreducible: without any one of its members the rest can be satisfied (deletion filter, Chinneck
    and Dravnieks 1991). Constraints that are not convex take part through their linearisation at the start, and the
    sentence says so.
    """
    names = list(program.user_constraints)
    linearised = [name for name in names if not all(c.is_dcp() for c in program.constraints[name])]
    conflict = conflicting_subset(program)
    if conflict is None:
        return (f"{program.name!r} was reported infeasible, but its constraints ({', '.join(names) or 'none'}) can be "
                "satisfied together; try another solver (optid solvers)")
    if len(conflict) == 1:
        text = f"constraint {conflict[0]!r} cannot be satisfied by any model of this structure; relax it or drop it"
    else:
        text = (f"constraints {' and '.join(repr(n) for n in conflict)} contradict each other; "
                "relax or drop one of them (each subset without one of them can be satisfied)")
    used = [name for name in linearised if name in conflict]
    return text + (f" (judged on the linearisation of {', '.join(used)})" if used else "")


def conflicting_subset(program: Program) -> list[str] | None:
    """Return the names of an irreducible infeasible subset, or None where all can be satisfied together."""
    groups = {name: _convex(program, name) for name in program.user_constraints}
    # a structural constraint that is not convex (the norm of b) only fixes a scale: it cannot cause a conflict
    fixed = [c for name in program.structural for c in program.constraints[name] if c.is_dcp()]
    kept = list(groups)
    if _feasible(fixed + [c for name in kept for c in groups[name]]):
        return None
    for name in list(groups):
        trial = [other for other in kept if other != name]
        if not _feasible(fixed + [c for other in trial for c in groups[other]]):
            kept = trial
    return kept


def _convex(program: Program, name: str) -> list[cp.Constraint]:
    found: list[cp.Constraint] = []
    program.assign({key: value for key, value in program.start.items()})
    for member in program.constraints[name]:
        if member.is_dcp():
            found.append(member)
            continue
        expression = member.expr
        linear = np.ravel(expression.value, order="F")
        for variable, gradient in expression.grad.items():
            slope = gradient.toarray() if hasattr(gradient, "toarray") else np.asarray(gradient)
            flat = variable if variable.ndim <= 1 else cp.vec(variable, order="F")
            linear = linear + np.reshape(slope, (variable.size, -1)).T @ (flat - np.ravel(variable.value, order="F"))
        equal = isinstance(member, cp.constraints.Equality | cp.constraints.Zero)
        found.append(linear == 0 if equal else linear <= 0)
    return found


def _feasible(constraints: list[cp.Constraint]) -> bool:
    if not constraints:
        return True
    problem = cp.Problem(cp.Minimize(0), constraints)
    problem.solve(solver=cp.CLARABEL)
    return problem.status not in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE)


