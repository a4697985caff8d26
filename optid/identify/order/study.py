"""Study of the order of a record: states, lags, and a recommendation with its reasons."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optid.arrays import Array, check_integer
from optid.bases import Bases, FeedbackBases, Linear
from optid.data.record import Data
from optid.errors import DataError, DataWarning, RankError, StructureError
from optid.identify.order.lags import LagScan, scan_lags
from optid.identify.order.ranks import RankTest, order_test
from optid.identify.order.states import StateCriteria, state_criteria
from optid.registry import Rendered
from optid.statistics.expansion import Expansion, check_channels, expand
from optid.statistics.hankel import hankel_statistics
from optid.threads import one_thread

FEWEST, PER_ROW = 2, 1.5  # block rows at least; windows per row of the longest windows that are wanted


@dataclass(frozen=True, eq=False, repr=False)
class OrderStudy(Rendered):
    """The result of `order` on the record named `data`; `print` it.

    Attributes:
        block_rows: future block rows.
        ranks: test of the singular values.
        states: criteria by number of states, on prediction errors.
        lags: scan of na, nb, nk, the best of which is recommended; None for a reason in `notes`.
        nx: recommended number of states, for these reasons.
        notes: limitations of the result; each is also a DataWarning.
        findings: what reading the record derived, assumed or repaired.
    """

    data: str
    block_rows: int
    ranks: RankTest
    states: StateCriteria
    lags: LagScan | None
    nx: int
    reasons: tuple[str, ...]
    notes: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()


@one_thread
def order(data: Data, *, basis: Bases | None = None, feedback_basis: FeedbackBases = None,
          block_rows: int | None = None, nx: int | None = None, na: int = 8, nb: int = 6, nk: int = 8,
          holdout: float = 0.3, level: float | None = None) -> OrderStudy:
    """Estimate the order of a record without a model of its noise.

    The number of states is the smallest order whose trailing singular values are noise (`optid.identify.order.ranks`).
    It is compared with criteria on prediction errors, a part held out, and a scan of lags.

    Args:
        data: the record; NaN = missing, several experiments of any lengths.
        basis: functions of the inputs, one basis or one per input; linear when not given.
        feedback_basis: functions of the outputs that are fed back, one basis or one per output; none when not given.
        block_rows: future block rows, larger than the order; 10, or fewer on a short record.
        nx: largest order of interest, which the block rows must be able to show.
        na: largest number of output lags of the scan.
        nb: largest number of input lags of the scan.
        nk: largest delay of the scan.
        holdout: share of every experiment, from its end, that is held out; 0 for none.
        level: probability of rejecting the true order; min(0.01, 10 / N) when not given.

    Raises:
        StructureError: an argument out of its range.
        DataError: duplicated or constant channels, or no complete sample.
        RankError: too short a record or experiment, or inputs that do not excite the block rows.

    Warns:
        DataWarning: no scan of lags or no hold-out is possible; also in `OrderStudy.notes`.
    """
    if not 0 <= holdout < 1:
        raise StructureError(f"holdout must be a share from 0 to below 1; got {holdout!r}.")
    if nx is not None:
        check_integer(nx, "nx")
    data = data.raw()
    records = data.records
    check_channels(records, data.inputs, data.outputs)
    expansion = expand(data, Linear() if basis is None else basis, feedback_basis)
    alpha = block_rows_for(records, expansion, block_rows, nx)
    notes: list[str] = []
    ranks = order_test(*(with_simulated_outputs(records, expansion, alpha) if expansion.q else (records, expansion)),
                       alpha, level=level)
    largest = min((alpha - 1) * data.l, ranks.singular_values.size - 1, alpha * (expansion.p + expansion.q + data.l))
    train, test = _parts(data, holdout, alpha, notes)
    whole = hankel_statistics(records, 2 * alpha, expansion, names=expansion.names, centre="mean")
    parts = [hankel_statistics(part.records, 2 * alpha, expansion, names=expansion.names, centre=whole.centre)
             for part in (train, test) if part is not None]
    states = state_criteria(whole, expansion, alpha, max(largest, 1), *parts)
    lags = None
    try:
        with warnings.catch_warnings(action="ignore", category=DataWarning):
            lags = scan_lags(data if train is None else train, expansion.inputs, na=na, nb=nb, nk=nk, test=test)
    except RankError as error:
        notes.append(f"No scan of lags. {error}")
    if ranks.exhausted:
        notes.append("Every order that the block rows can show was rejected: use more block rows, or a basis for the "
                     "inputs if the plant is not linear.")
    for note in notes:
        warnings.warn(note, DataWarning, stacklevel=2)
    return OrderStudy(data.name, alpha, ranks, states, lags, ranks.choice[0], _reasons(ranks, states, lags),
                      tuple(notes), data.findings)


def block_rows_for(records: Sequence[Array], expansion: Expansion, given: int | None, nx: int | None = None) -> int:
    """Return the future block rows: as given, or 10, or more for a large order, or fewer on a short record.

    Fewer than 2, or too few for nx, are a `StructureError`; an experiment shorter than three times as many samples is a
    `RankError`.
    """
    alpha = check_integer(given, "block_rows", FEWEST) if given is not None else expansion.block_rows(
        records, nx, spans=3, per_row=PER_ROW, least=FEWEST)
    if nx is not None and (alpha - 1) * expansion.l < nx:
        raise StructureError(f"{alpha} block rows of {expansion.l} outputs show orders up to "
                             f"{(alpha - 1) * expansion.l}, not {nx}: use block_rows={-(-nx // expansion.l) + 1} or "
                             "more.")
    for i, record in enumerate(records):
        if len(record) < 3 * alpha:
            raise RankError(f"Experiment {i + 1} has {len(record)} samples, fewer than three times the {alpha} block "
                            "rows: leave it out or use fewer block rows.")
    return alpha


def with_simulated_outputs(records: Sequence[Array], expansion: Expansion, alpha: int) -> tuple[list[Array], Expansion]:
    """Append outputs simulated from the inputs: least squares on the functions of the last 2 alpha samples.

    Functions of them are instruments, since they are free of noise. They are NaN in the first 2 alpha - 1 samples of an
    experiment, and after a missing input.
    """
    rows = 2 * alpha
    open_loop = expansion.without_feedback()
    statistics = hankel_statistics(records, rows, open_loop, names=open_loop.names, centre="mean")
    statistics.check()
    past = np.concatenate([[0], statistics.at(open_loop.eta)])
    now = statistics.at(open_loop.y, [rows - 1])
    theta = np.linalg.lstsq(statistics.gram[np.ix_(past, past)], statistics.gram[np.ix_(past, now)], rcond=1e-12)[0]
    weights = theta[1:].reshape(rows, open_loop.p, expansion.l)
    m, centre = expansion.m, statistics.centre
    extended = []
    for record in records:
        eta = open_loop(record)[:, : open_loop.p] - centre[: open_loop.p]
        count = len(record) - rows + 1
        simulated = np.full((len(record), expansion.l), np.nan)
        simulated[rows - 1 :] = theta[0] + centre[open_loop.p :]
        for i in range(rows):
            simulated[rows - 1 :] += eta[i : i + count] @ weights[i]
        extended.append(np.hstack([record[:, : m + expansion.l], simulated]))
    return extended, replace(expansion, simulated=True)


def _parts(data: Data, holdout: float, alpha: int, notes: list[str]) -> tuple[Data | None, Data | None]:
    if not holdout:
        return None, None
    try:
        train, test = data.split(1 - holdout)
        for part in (train, test):
            hankel_statistics(part.records, 2 * alpha, method="gram").check(1.2)
    except (DataError, RankError) as error:
        notes.append(f"Nothing is held out: the record is too short for it. {error}")
        return None, None
    return train, test


def _reasons(ranks: RankTest, states: StateCriteria, lags: LagScan | None) -> tuple[str, ...]:
    n = ranks.choice[0]
    found = [f"singular values: {ranks.reason}" if ranks.order else
             "no singular value is significant: the outputs may not depend on the inputs; nx = 1 is the minimum"]
    others = {"the largest ratio of singular values": ranks.ratio_order}
    others |= {{"aic": "AIC", "aicc": "AICc", "bic": "BIC"}.get(k, k): v for k, v in states.best().items()}
    agree = [name for name, value in others.items() if value == n]
    differ = [f"{name} gives {value}" for name, value in others.items() if value != n]
    if agree:
        found.append(f"{', '.join(agree)} agree{'s' if len(agree) == 1 else ''}")
    if differ:
        found.append("; ".join(differ) + ": criteria on prediction errors also count states of the noise, and hold-out "
                     "depends on the prediction only")
    if lags is not None:
        best, other = lags.best("bic"), lags.best("fit") if any(np.isfinite(c.fit) for c in lags.candidates) else None
        found.append(f"lags: {best} has the least BIC of {len(lags.candidates)} structures on {lags.rows} rows")
        if edge := lags.at_the_edge:
            found.append(f"{' and '.join(edge)} {'is' if len(edge) == 1 else 'are'} the largest compared: compare "
                         "larger ones, or use a state-space model")
        if other is not None and other != best:
            found.append(f"{other} predicts the part held out {other.fit - best.fit:.2f} points better")
    return tuple(found)
