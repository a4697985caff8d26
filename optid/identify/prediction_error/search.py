"""The search for the best optimum of a transfer-function model, and the entry into constraints from there."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.prediction_error.descent import Descent, agreement, best_of, descend, with_poles
from optid.identify.prediction_error.tangent_fit import TangentFit, violation
from optid.identify.prediction_error.transfer_errors import TransferErrors
from optid.models.roots import contained

# samples, from the middle of the record, on which starts are compared; the winner descends on the whole record
SEARCH = 5_000
# starts of different methods that may make further ones unnecessary without a noise filter, see `descent.best_of`
SUFFICIENT = 3
# radii tried to bring the poles of a start into the region of the constraints
PULLS = (1.0, 0.999, 0.99, 0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.3, 0.1, 0.0)
ENTRIES = 3  # different optima from which the constrained iteration may start


def search(criterion: TransferErrors, starts: Callable[[TransferErrors], Iterable[tuple[str, Array]]]
           ) -> tuple[Descent, list[Descent], dict[str, Any]]:
    """Descend from every start and return the best optimum, the other ones, and the figures of the comparison.

    On long records the starts (name, point) of a criterion are compared on a part, and the winner descends on the
    whole. Where no start has a stable predictor a `RankError` is raised.
    """
    part, filtered = _part(criterion), criterion.unknowns.innovations
    found = best_of(part, starts(part), enough=None if filtered else SUFFICIENT)
    if not found:
        raise RankError(f"no start has a stable {'predictor' if filtered else 'simulation'}; use other orders")
    while True:  # what arrived as far as starts are compared may still end at the border of stability
        best, x = found[0], np.zeros(criterion.unknowns.size)
        x[: criterion.unknowns.shared] = best.x[: criterion.unknowns.shared]
        final = descend(criterion, best.x if part is criterion else x, start=best.start)
        if best.border or not final.border or len(found) == 1 or found[1].border:
            break
        found = [*found[1:], replace(best, border=True)]
    agreed, sentence = agreement(found, 1e-12 * part.energy)
    figures: dict[str, Any] = {"starts": sentence}
    if filtered:
        figures["starts that agree"] = agreed
    figures[f"{criterion.errors} of the starts"] = criterion.unit * np.array(
        sorted((one.value for one in found), reverse=True))
    others = [one for one in found[1:] if abs(one.value - best.value) > 1e-3 * best.value] if part is criterion else []
    return replace(final, steps=final.steps + best.steps), others, figures


def _part(criterion: TransferErrors) -> TransferErrors:
    """The middle of a long record, or the record itself where it is short or the middle is mostly missing."""
    data = criterion.data
    if data.n_samples <= 2 * SEARCH:
        return criterion
    sizes = [e.n_samples for e in data.experiments]
    if max(sizes) < SEARCH:  # many short experiments
        cut = data.select(experiments=list(range(int(np.searchsorted(np.cumsum(sizes), SEARCH)) + 1)))
    else:
        first = (max(sizes) - SEARCH) // 2
        cut = data.select(experiments=[int(np.argmax(sizes))]).window(first, first + SEARCH)
    if 2 * _complete(cut) < _complete(data):
        return criterion
    return replace(criterion, data=cut, unknowns=replace(criterion.unknowns, experiments=cut.n_experiments))


def _complete(data: Data) -> float:
    """Share of the samples of which no channel is missing."""
    return float(np.mean(np.concatenate([np.isfinite(record).all(axis=1) for record in data.records])))


def entry(fit: TangentFit, criterion: TransferErrors, found: Sequence[Descent]) -> Array:
    """Return where to start under the constraints: the best of the optima whose poles are pulled into the region.

    What belongs to the pulled poles is estimated anew; without constraints on the poles alone they stay.
    """
    if not fit.constraints:
        return fit.signed(found[0].x)
    at, ends = criterion.unknowns.slices["a"], []
    for one in found[:ENTRIES]:
        x = fit.signed(one.x)
        for radius in PULLS:
            pulled = x[at] if radius == 1.0 else contained(x[at], radius)
            program = fit.pose(np.concatenate([pulled, x[at.stop :]]), one.at, 0.0)
            a = program.variables.get("a")
            others = [name for name, group in program.user_constraints.items()
                      if a is not None and any({v.id for v in c.variables()} != {a.id} for c in group)]
            if violation(program.without(*others, "residual", "gauge")) <= 1e-9:  # those on the poles alone hold
                again = one if radius == 1.0 else with_poles(criterion, x, pulled)
                ends.append((again.value, again.x))
                break
    return fit.signed(min(ends, key=lambda end: end[0])[1] if ends else found[0].x)
