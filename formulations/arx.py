"""Linear equations ``A(q) y = sum_c B_c(q) u_c + d + e`` with constraints: the smallest example of a formulation.

    min over a, b, d:    ‖y - Phi [a; b; d]‖²  (+ sigma² bᵀ P^-1 b, of a finite response with a prior)

Phi holds past outputs and inputs; only its products with itself and with y are needed. P is a kernel of stable
responses (Chen, Ohlsson and Ljung 2012). With ``offset="each"`` an experiment has a constant of its own, which is
eliminated; the mean of all remains as the unknown ``offset``.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from optid.bases import Linear
from optid.core.problem import Problem
from optid.core.terms import Squares, Values
from optid.data.record import Data
from optid.data.streams import Stream
from optid.identify.equation_error import EquationError, pose_with_loss
from optid.models import HammersteinTF
from optid.solving.solve import Procedure
from optid.solving.steps import steps


@steps(lambda given: {"arx": "QP" if given["constraints"] else "QP linear"})
def arx(data: Data | Stream, *, na: int, nb: int | Sequence[int], nk: int | Sequence[int] = 0,
        constraints: Sequence[Any] = (), loss: str = "squares", ridge: float = 0.0, prior: str = "none",
        offset: bool | str = True) -> Problem | Procedure:
    """Minimise ``‖Y - Phi_y a - Phi_u b - d‖²``.

    Named variables: ``a``, ``b``, ``offset``.

    Args:
        data: the record.
        na: number of past outputs in A.
        nb: number of coefficients of B, or of the impulse response, one per input or one for all.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders of CVXPY constraints in the named variables.
        loss: "squares", "huber[:threshold]" or "l1".
        ridge: weight of ``‖b‖²``.
        prior: on the impulse responses: "none", "tc" (decaying, rough), "dc" (with a correlation of neighbours) or "ss"
            (smooth); its hyperparameters maximise the marginal likelihood of the record.
        offset: True for one constant of the equation, "each" for one for every experiment, as of sensors with other
            zeros; see `optid.models.model.Model.levels`.

    Raises:
        StructureError: impossible orders or nonconvex constraints.
        RankError: the record does not determine the parameters.
    """
    return pose_with_loss(loss, data, lambda record: _problem(record, constraints), convex=True,
                          na=na, nb=nb, nk=nk, basis=Linear(), ridge=ridge, prior=prior, offset=offset)


@steps(lambda given: {"arx": "QP" if given["constraints"] else "QP linear"})
def fir(data: Data | Stream, *, nb: int | Sequence[int] = 50, nk: int | Sequence[int] = 0, prior: str = "dc",
        constraints: Sequence[Any] = (), offset: bool | str = True) -> Problem | Procedure:
    """Minimise ``‖Y - Phi_u b - d‖² + penalty(b)``, b the impulse responses of all inputs.

    Named variables: ``b``, ``offset``. Arguments as in `arx`, as are the errors raised.
    """
    return arx(data, na=0, nb=nb, nk=nk, prior=prior, constraints=constraints, offset=offset)


def _problem(record: EquationError, constraints: Sequence[Any]) -> Problem:
    names = record.keys("b")
    start = {**record.linear_zeros(), **{name: np.zeros(record.b_shape(c)) for c, name in enumerate(names)}}

    objective = Squares.of(record.problem, tuple(start))  # ‖R [a; offset; b] - s‖²

    def model(x: Values) -> HammersteinTF:
        return record.model(x, [np.ones(1)] * len(names), [x[name] for name in names], gauge="none", flip=False)

    return Problem("arx", start, (objective,), model=model, facts=record.facts(), builders=tuple(constraints),
                   **record.common())
