"""The shipped zoo of programmes with known answers, and back ends that misbehave in a known way."""

import faulthandler
import os
import time

import numpy as np

from optid.backends import Answer, BackEnd, Settings
from optid.conformance.zoo import Case, cases, pose
from optid.program.program import Program
from optid.program.solution import Status
from optid.program.structure import Structure

CASES: dict[str, Case] = {case.name: case for case in cases()}
EVERYTHING = frozenset({"LP", "QP", "SOCP", "SDP", "conic", "NLP"})


def case(name: str) -> Case:
    return CASES[name]


def claiming(values: dict, status: Status = Status.OPTIMAL, duals: dict | None = None,
             word: str = "optimal") -> BackEnd:
    """A back end that always gives this answer."""

    def run(program: Program, settings: Settings) -> Answer:
        return Answer(status, word, {k: np.asarray(v, dtype=float) for k, v in values.items()}, duals or {})

    return BackEnd("liar", EVERYTHING, run, structures=(Structure,))


def _raise(program: Program, settings: Settings) -> Answer:
    raise ZeroDivisionError("inside the solver")


def _abort(program: Program, settings: Settings) -> Answer:
    faulthandler.disable()  # the test runner would print the stack of a death that is intended
    os.abort()


def _hang(program: Program, settings: Settings) -> Answer:
    while True:
        time.sleep(0.01)


RAISING = BackEnd("raising", EVERYTHING, _raise, structures=(Structure,))
ABORTING = BackEnd("aborting", EVERYTHING, _abort, structures=(Structure,))
HANGING = BackEnd("hanging", EVERYTHING, _hang, structures=(Structure,))

__all__ = ["ABORTING", "CASES", "EVERYTHING", "HANGING", "RAISING", "Case", "case", "claiming", "pose"]
