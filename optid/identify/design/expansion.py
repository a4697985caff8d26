"""The expanded regressor of a record: functions of the inputs, and functions of the outputs orthogonal to 1 and y."""

import warnings
from collections.abc import Sequence

import numpy as np

from optid.bases import feedback_bases, fitted_bases
from optid.bases.basis import Basis
from optid.data.record import Data
from optid.errors import DataWarning
from optid.statistics.expansion import Expansion, expand
from optid.statistics.hankel import hankel_statistics

Bases = Basis | str | Sequence[Basis | str]
FeedbackBases = Basis | str | None | Sequence[Basis | str | None]


def expansion_of(data: Data, basis: Bases, feedback_basis: FeedbackBases = None) -> Expansion:
    """Fit the bases to a record; whether the functions of outputs are nearly linear is for `check_feedback` to say.

    Args:
        data: the record.
        basis: of the inputs, one for all or one per input.
        feedback_basis: of the outputs, as in `optid.bases.feedback_bases`.

    Raises:
        StructureError: a wrong number of bases.
        DataError: a constant channel.
        RankError: functions of an output that are linear on the record.
    """
    records = [np.hstack([e.u, e.y]) for e in data.experiments]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return expand(records, fitted_bases(data, basis), feedback_bases(data, feedback_basis), data.inputs,
                      data.outputs)


def expanded_condition(data: Data, expansion: Expansion, rows: int) -> float:
    """Return the condition number of all windows of the expanded signals about their means, columns scaled.

    Args:
        data: the record.
        expansion: of it.
        rows: block rows, the samples of a window.

    Returns:
        An estimate in the 1-norm; inf when the windows are singular.

    Raises:
        RankError: no complete window.
    """
    count = expansion.p + expansion.q
    records = [np.hstack([e.u, e.y]) for e in data.experiments]
    return hankel_statistics(records, rows, lambda raw: expansion(raw)[:, :count], names=expansion.names[:count],
                             centre="mean").condition
