"""Least squares without products or constraints by one factorisation, beside the iterations of general solvers."""

import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.core.least_squares import LinearForm
from optid.core.problem import Problem
from optid.program.solution import Status
from optid.structures.rank_one import Point


def run(problem: Problem, settings: Settings) -> Answer:
    """Solve a programme of the form `LinearForm` without further constraints; there are no options.

    Of several minimisers it returns the shortest, with the columns at length one.
    """
    from scipy.linalg import lstsq

    form = LinearForm.of(problem)
    assert form is not None
    root, target = form.problem.root, form.problem.target
    lengths = np.linalg.norm(root, axis=0)
    lengths[lengths == 0] = 1.0
    found = lstsq(root / lengths, target, lapack_driver="gelsy")
    z = found[0] / lengths  # pyright: ignore[reportOptionalSubscript]
    return Answer(Status.LOCAL, "factorised", form.unpack(Point(z, (), ()), problem.shapes))
