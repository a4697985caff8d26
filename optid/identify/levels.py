"""Whether the experiments of a record have levels of their own: one constant of the equation against one for each.

Both are compared by the Bayesian information criterion (Schwarz, Annals of Statistics 6, 1978) of an ARX model, from
two passes over the record. The past of the outputs takes up the colour of
the noise; what is left of it could otherwise pass for levels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.equation_error import EquationError, EquationStructure, compress

LAGS = 4  # past outputs, several, so that they take up the colour of the noise, and lags of every input
FLOOR = 1e-12  # residual standard deviation, as a share of that of the output, that counts as zero


@dataclass(frozen=True)
class LevelEvidence:
    """The evidence for levels of the experiments."""

    one: float  # Bayesian information criterion with one constant for all experiments; small is good
    each: float  # the same with one for each
    experiments: int  # number of experiments

    @property
    def offset(self) -> bool | str:
        """The argument ``offset`` of a formulation that is to be preferred, "each" or True."""
        return "each" if self.each < self.one else True

    def __str__(self) -> str:
        word = "have levels of their own" if self.offset == "each" else "share one level"
        return (f"the {self.experiments} experiments {word}: BIC {self.each:.1f} with one constant each, "
                f"{self.one:.1f} with one for all")


def level_evidence(data: Data, nk: int | Sequence[int] = 0) -> LevelEvidence:
    """Compare one constant for all experiments of a record in memory with one for each; nk are the delays.

    Raises:
        StructureError: a single experiment.
        RankError: the record does not determine the model.
        DataError: an experiment without a sample of an output.
    """
    if data.n_experiments == 1:
        raise StructureError("the record has one experiment, so that it has one level")
    one, each = (compress(data, EquationStructure(LAGS, LAGS, nk, "linear", offset=offset))
                 for offset in (True, "each"))
    return LevelEvidence(_criterion(one), _criterion(each), data.n_experiments)


def _criterion(problem: EquationError) -> float:
    """Return the Bayesian information criterion of the equation errors of all outputs, in the units of the record."""
    statistics, n, l = problem.statistics, problem.layout.n_columns, problem.layout.l  # noqa: E741
    rest = np.abs(np.diag(statistics.root)[n:]) / np.sqrt(statistics.rows)
    least = FLOOR * np.sqrt(problem.energy / statistics.rows)
    sizes = np.maximum(rest, least) * np.array(problem.units.y_scale)
    parameters = l * (n + statistics.constants)
    return float(2 * statistics.rows * np.sum(np.log(sizes)) + parameters * np.log(statistics.rows))
