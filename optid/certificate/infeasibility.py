"""Explain an infeasible set of constraints by a smallest conflicting subset, in the user's names."""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp

from optid.certificate.lifting import lift, places
from optid.program.expressions import flat, flat_value, jacobians, solve_quietly
from optid.program.limits import EQUALITIES
from optid.program.program import Program
from optid.structures.least_squares import rank_one_of


def explain(program: Program) -> str:
    """Return a sentence that lists a conflicting subset of the user's constraints.

    The subset is irreducible: without any one of its members the rest can be satisfied (deletion filter, Chinneck
    and Dravnieks 1991). Constraints that are neither convex nor linear in ``mu bᵀ`` take part through their
    linearisation at the start, and the sentence says so.
    """
    conflict = conflicting_subset(program)
    if conflict is None:
        names = ", ".join(program.user_constraints) or "none"
        return (f"{program.name!r} was reported infeasible, but its constraints ({names}) can be "
                "satisfied together; try another solver (optid solvers)")
    if len(conflict) == 1:
        text = f"constraint {conflict[0]!r} cannot be satisfied by any model of this structure; relax it or drop it"
    else:
        text = (f"constraints {' and '.join(repr(n) for n in conflict)} contradict each other; "
                "relax or drop one of them (each subset without one of them can be satisfied)")
    form = rank_one_of(program)
    stand_in = {} if form is None else places(program, form).stand_in
    used = [name for name in conflict
            if not all(c.is_dcp() or c.tree_copy(stand_in).is_dcp() for c in program.constraints[name])]
    return text + (f" (judged on the linearisation of {', '.join(used)})" if used else "")


def conflicting_subset(program: Program) -> list[str] | None:
    """Return the names of an irreducible infeasible subset, or None where all can be satisfied together.

    What can be satisfied is judged on a convex outer approximation, so that a subset returned is a contradiction
    indeed: bilinear constraints are read as constraints on the matrices ``mu bᵀ``.
    """
    kept = list(program.user_constraints)
    if satisfiable(program, kept):
        return None
    for name in list(kept):
        trial = [other for other in kept if other != name]
        if not satisfiable(program, trial):
            kept = trial
    return kept


def satisfiable(program: Program, names: Sequence[str]) -> bool:
    """Whether the named constraints can hold together, as far as a convex outer approximation tells."""
    form = rank_one_of(program)
    # a structural constraint that is not convex (the norm of b) only fixes a scale: it cannot cause a conflict
    structural = [c for name, group in program.constraints.items() if name in program.structural for c in group]
    found = [c for c in structural if c.is_dcp()]
    where = None if form is None else places(program, form)
    if program.start:
        program.assign(program.start)
    for member in (c for name in names for c in program.constraints[name]):
        copy = member if where is None else member.tree_copy(where.stand_in)
        found.append(member if member.is_dcp() else copy if copy.is_dcp() else _linearised(member))
    if form is not None and where is not None:
        lifted = lift(program.without(*(set(program.user_constraints) - set(names))), form)
        count = len(lifted.linear.right)  # these are there already
        lifted.add_products(form.problem)
        rows = lifted.linear.rows[count:]
        if len(rows):
            thetas = [flat(theta) for theta in where.stand_in.values()]
            found.append(rows[:, form.problem.linear :] @ cp.hstack(thetas) <= lifted.linear.right[count:])
    if not found:
        return True
    bs = [program.variables[b] for _, b in form.blocks] if form is not None and form.gauge == "norm" else []
    used = {v.id for name in names for c in program.constraints[name] for v in c.variables()}
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
