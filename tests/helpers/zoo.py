"""The shipped zoo of programmes with known answers, and back ends that misbehave in a known way."""

import faulthandler
import os
import time

import numpy as np

from optid.backends import Answer, BackEnd, Settings
from optid.conformance.zoo import Case, cases
from optid.core.form import Form
from optid.core.problem import Problem
from optid.core.statement import for_solvers
from optid.core.terms import Expressed
from optid.program.solution import Status

CASES: dict[str, Case] = {case.name: case for case in cases()}


class Anything(Form):
    """The form of any problem, with constraints."""

    word, constrained = "any", True


def anything(problem) -> Anything:
    return Anything()


EVERYTHING = frozenset({"LP", "QP", "SOCP", "SDP", "conic", "NLP"})


def case(name: str) -> Case:
    return CASES[name]


def pose(name: str, objective, constraints: dict, variables, start=None, expressions=None, **parts) -> Problem:
    """State a problem of plain parts in given CVXPY variables, and return it as a programme."""

    def swapped(one, v):
        return one.tree_copy({id(variable): v[variable.name()] for variable in variables})

    def build(v):
        return {key: [swapped(one, v) for one in (group if isinstance(group, list | tuple) else [group])]
                for key, group in constraints.items()}

    begin = {one.name(): np.zeros(one.shape) for one in variables}
    begin |= {key: np.asarray(value, dtype=float) for key, value in (start or {}).items()}
    return for_solvers(Problem(
        name, begin, (Expressed(lambda v: swapped(objective, v)),), restrictions=(build,),
        further=None if expressions is None else lambda v, _: {
            key: swapped(one, v) for key, one in expressions.items()},
        bounds={one.name(): tuple(np.broadcast_to(end, one.shape) for end in one.get_bounds())
                for one in variables if one.attributes["nonneg"] or one.attributes["bounds"] is not None},
        symmetric=frozenset(one.name() for one in variables if one.attributes["symmetric"]), **parts))


def claiming(values: dict, status: Status = Status.OPTIMAL, duals: dict | None = None,
             word: str = "optimal") -> BackEnd:
    """A back end that always gives this answer."""

    def run(program: Problem, settings: Settings) -> Answer:
        return Answer(status, word, {k: np.asarray(v, dtype=float) for k, v in values.items()}, duals or {})

    return BackEnd("liar", EVERYTHING, run, takes=anything)


def _raise(program: Problem, settings: Settings) -> Answer:
    raise ZeroDivisionError("inside the solver")


def _abort(program: Problem, settings: Settings) -> Answer:
    faulthandler.disable()  # the test runner would print the stack of a death that is intended
    os.abort()


def _hang(program: Problem, settings: Settings) -> Answer:
    while True:
        time.sleep(0.01)


RAISING = BackEnd("raising", EVERYTHING, _raise, takes=anything)
ABORTING = BackEnd("aborting", EVERYTHING, _abort, takes=anything)
HANGING = BackEnd("hanging", EVERYTHING, _hang, takes=anything)

__all__ = ["ABORTING", "CASES", "EVERYTHING", "HANGING", "RAISING", "Case", "case", "claiming", "pose"]
