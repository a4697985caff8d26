"""Explain an infeasible set of constraints by a smallest conflicting subset, in the user's names."""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp

from optid.certificate.lifting import lift
from optid.core.least_squares import RankOneForm
from optid.core.leaves import Affine
from optid.core.problem import Problem
from optid.program.expressions import flat, flat_value, jacobians, solve_quietly
from optid.program.limits import EQUALITIES


def explain(problem: Problem) -> str:
    """Return a sentence that lists a conflicting subset of the user's constraints.

    The subset is irreducible: without any one of its members the rest can be satisfied (deletion filter, Chinneck
    and Dravnieks 1991). Constraints that are not convex in the leaves take part through their linearisation at the
    start, and the sentence says so.
    """
    conflict = conflicting_subset(problem)
    if conflict is None:
        names = ", ".join(problem.constraint_names) or "none"
        return (f"{problem.name!r} was reported infeasible, but its constraints ({names}) can be "
                "satisfied together; try another solver (optid solvers)")
    if len(conflict) == 1:
        text = f"constraint {conflict[0]!r} cannot be satisfied by any model of this structure; relax it or drop it"
    else:
        text = (f"constraints {' and '.join(repr(n) for n in conflict)} contradict each other; "
                "relax or drop one of them (each subset without one of them can be satisfied)")
    bent = {one.name for one in problem.constraints() if not one.limit.member.is_dcp()}
    used = [name for name in conflict if name in bent]
    return text + (f" (judged on the linearisation of {', '.join(used)})" if used else "")


def conflicting_subset(problem: Problem) -> list[str] | None:
    """Return the names of an irreducible infeasible subset, or None where all can be satisfied together.

    What can be satisfied is judged on a convex outer approximation, so that a subset returned is a contradiction
    indeed: every leaf is free, constraints about ``mu bᵀ`` are read as those of a matrix.
    """
    kept = list(problem.constraint_names)
    if satisfiable(problem, kept):
        return None
    for name in list(kept):
        trial = [other for other in kept if other != name]
        if not satisfiable(problem, trial):
            kept = trial
    return kept


def satisfiable(problem: Problem, names: Sequence[str]) -> bool:
    """Whether the named constraints can hold together, as far as a convex outer approximation tells."""
    form, space = RankOneForm.of(problem), problem.space
    if not problem.constraints():
        return True
    space.assign(problem.leaf_values(problem.start))
    found: list[Any] = [flat(space.variables[leaf.name]) == flat(leaf.express(space.variables))
                        for leaf in problem.leaves if isinstance(leaf, Affine)]  # other leaves are free
    for one in problem.constraints():
        member = one.limit.member
        if one.name in names:
            found.append(member if member.is_dcp() else _linearised(member))
        elif one.name in problem.structural and member.is_dcp():  # one that is not convex cannot cause a conflict
            found.append(member)
    if form is not None:
        lifted = lift(problem, form, names)
        count = len(lifted.linear.right)  # these are there already
        lifted.add_products(form.problem)
        rows = lifted.linear.rows[count:]
        if len(rows):
            thetas = [flat(space.variables["Theta" + mu[len("mu"):]]) for mu, _ in form.blocks]
            found.append(rows[:, form.problem.linear :] @ cp.hstack(thetas) <= lifted.linear.right[count:])
    if not found:
        return True
    bs = [space.variables[b] for _, b in form.blocks] if form is not None and form.gauge == "norm" else []
    used = {v.id for one in problem.constraints() if one.name in names for v in one.limit.member.variables()}
    return _feasible(found) and all(_has_length(b, found) for b in bs if b.id in used)


def _feasible(members: Sequence[Any]) -> bool:
    problem = cp.Problem(cp.Minimize(0), list(members))
    for solver in ("CLARABEL", "SCS"):
        try:
            solve_quietly(problem, solver)
            break
        except cp.SolverError:  # it failed; where both fail, the constraints count as satisfiable
            continue
    else:
        return True
    return problem.status not in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE)  # an inaccurate proof is one as well


def _has_length(b: cp.Variable, members: Sequence[Any]) -> bool:
    """Whether b can have length one beside other constraints: then one entry has a modulus of 1 / sqrt(size)."""
    least = b.size**-0.5
    return any(_feasible([*members, sign * flat(b)[i] >= least]) for i in range(b.size) for sign in (1, -1))


def _linearised(member: Any) -> Any:
    expression, slopes = member.expr, jacobians(member.expr)
    if slopes is None:  # without a gradient it counts as satisfiable
        return cp.Constant(0.0) <= 0
    linear: Any = flat_value(expression)
    for variable, slope in slopes.items():
        linear = linear + slope @ (flat(variable) - flat_value(variable))
    return linear == 0 if isinstance(member, EQUALITIES) else linear <= 0
