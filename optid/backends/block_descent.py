"""Own block descent for group-sparse least squares; what it returns carries a dual point that proves its gap."""

import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.backends.group_descent import minimise
from optid.program.program import Program
from optid.program.solution import Status
from optid.structures.group_sparse import GroupSparseStructure


def run(program: Program, settings: Settings) -> Answer:
    """Solve a programme that carries a `GroupSparseStructure` and no further constraints.

    Options: ``limit`` (rounds at most, default 2,000).
    """
    form = program.structure
    if not isinstance(form, GroupSparseStructure):
        return Answer(Status.FAILED, "the programme carries no group-sparse structure")
    penalty = float(np.asarray(program.parameters[form.penalty].value))
    if not penalty > 0:
        return Answer(Status.FAILED, f"the penalty is {penalty}; this method needs a positive one")
    start = form.flat(program.start) if settings.warm and program.start else None
    found = minimise(form.problem, penalty, tolerance=settings.accuracy,
                     limit=int(dict(settings.options).get("limit", 2000)), start=start)
    values = form.shaped(found.a)
    duals = {form.residual: -found.point}
    if found.converged or found.gap <= max(100 * settings.accuracy, 1e-7):  # what the judgement allows
        return Answer(Status.LOCAL, "duality gap closed", values, duals, found.rounds)
    return Answer(Status.LIMIT, f"stopped at a relative gap of {found.gap:.1e}", values, duals, found.rounds)
