"""Own ADMM for nuclear norms of Hankel structure; what it returns carries a dual point that proves its gap."""

import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.backends.nuclear_admm import minimise
from optid.program.program import Program
from optid.program.solution import Status
from optid.structures.nuclear_norm import NuclearNormStructure


def run(program: Program, settings: Settings) -> Answer:
    """Solve a programme that carries a `NuclearNormStructure` and no further constraints.

    Options: ``limit`` (iterations at most, default 20,000).
    """
    form = program.structure
    if not isinstance(form, NuclearNormStructure):
        return Answer(Status.FAILED, "the programme carries no nuclear-norm structure")
    weight = float(np.asarray(program.parameters[form.weight].value))
    # half of what the judgement allows at this accuracy
    found = minimise(form.problem, weight, tolerance=0.5 * max(100.0 * settings.accuracy, 1e-7),
                     limit=int(dict(settings.options).get("limit", 20_000)))
    values = {"yhat": found.v} | ({"T": found.theta} if form.problem.parameters else {})
    misfit = (found.v - form.problem.data)[form.problem.known]
    duals = {"structure": -np.ravel(found.multipliers, order="F"), "residual": -2.0 * weight * misfit}
    if found.converged:
        return Answer(Status.LOCAL, "duality gap closed", values, duals, found.iterations)
    return Answer(Status.LIMIT, f"iteration limit at a relative gap of {found.gap:.1e}", values, duals,
                  found.iterations)
