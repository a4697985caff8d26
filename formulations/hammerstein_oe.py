"""Output error: ``y = A(q)^-1 [sum_c B_c(q) f_c(u_c) + d] + e``, the sum of squared simulation errors minimised.

`exact` is the Hammerstein model, `linear` (registered as ``oe.exact``) the linear one. Both are procedures: starts
(`formulations.output_error_starts`), Gauss-Newton descents on streamed sensitivities (`optid.statistics.sensitivities`)
and, at the optimum or under constraints, convex programmes in the tangent of the iterate
(`formulations.prediction_error`, `formulations.output_error_programme`). Named variables: ``a``, ``b``, ``mu`` (not in
the linear model), ``offset``, ``x0`` ((n,), or (n, experiments)) and the affine expression
``Theta = mu b0ᵀ + mu0 bᵀ - mu0 b0ᵀ`` about the iterate (mu0, b0), which is ``mu bᵀ`` there. With several inputs the
per-channel names carry the input, as in ``mu[valve]``.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from formulations.output_error import OutputError
from formulations.output_error_programme import Posing
from formulations.output_error_records import check_excited, check_inputs_differ, check_rows, plant_record
from formulations.output_error_starts import RADIUS, blank, equation_error, iterated, perturbed, subspace, with_poles
from formulations.prediction_error import Descent, agreement, best_of, descend, refine
from optid.bases import Linear
from optid.bases.basis import Basis
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.arguments import one_output, whole_number
from optid.identify.gauges import check_gauge
from optid.models.roots import contained
from optid.program.units import energy_unit
from optid.solving.solve import Procedure
from optid.statistics import Layout
from optid.statistics.sensitivities import Unknowns

Array = np.ndarray

SEARCH = 5_000
"""Samples, from the middle of the record, on which starts are compared; the winner descends on the whole record."""

SUFFICIENT = 3
"""Starts of different methods that may make further ones unnecessary, see `formulations.prediction_error.best_of`."""


def linear(data: Data, *, na: int, nb: int | Sequence[int], nk: int | Sequence[int] = 0,
           constraints: Sequence[Any] = (), offset: bool = True, starts: int = 6, seed: int = 0) -> Procedure:
    """Minimise the simulation error of a linear model.

    Named variables: ``Theta``, ``a``, ``b``, ``offset``, ``x0``.

    Args:
        data: the record; one output. Samples may be missing: it is cut where inputs are, see `optid.data.stretches`.
        na: number of poles.
        nb: number of coefficients of B, one per input or one for all.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders of CVXPY constraints in ``a``, ``b``, ``offset``, ``x0``.
        offset: estimate the constant of the equation; False holds it at zero, for centred data.
        starts: number of starts that are compared at most; three suffice where they agree on a model that explains
            nine tenths of the output.
        seed: of the random ones.

    Raises:
        StructureError: impossible orders, several outputs.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns, or inputs that the record does not tell apart.
    """
    record, layout, units = plant_record(one_output(data, "simulation errors"), na, nb, nk, Linear(), offset)
    check_inputs_differ(record, layout)
    return _procedure("oe.exact", record, layout, units, False, offset, constraints, "none", starts, seed)


def exact(data: Data, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str] = "polynomial:3",
          nk: int | Sequence[int] = 0, constraints: Sequence[Any] = (), gauge: str = "norm", offset: bool = True,
          starts: int = 6, seed: int = 0) -> Procedure:
    """Minimise the simulation error of a Hammerstein model.

    Named variables: ``Theta``, ``a``, ``b``, ``mu``, ``offset``, ``x0``.

    Args:
        data: the record; one output. Samples may be missing: it is cut where inputs are, see `optid.data.stretches`.
        na: number of poles.
        nb: number of coefficients of B, one per input or one for all.
        basis: basis of the nonlinearity, one per input or one for all; a cubic polynomial by default.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders such as ``formulations.constraints.shape.monotone("increasing")`` or ``lambda v: {...}``.
        gauge: "norm" (‖b‖ = 1), "gain" (unit static gain of the linear part) or "b0" (first coefficient one).
        offset: estimate the constant of the equation; False holds it at zero, for centred data.
        starts: number of starts that are compared at most; three suffice where they agree on a model that explains
            nine tenths of the output.
        seed: of the random ones.

    Raises:
        StructureError: impossible orders, unknown gauge, several outputs.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns, a basis function that no sample excites, or inputs that the record
            does not tell apart.
    """
    check_gauge(gauge)
    record, layout, units = plant_record(one_output(data, "simulation errors"), na, nb, nk, basis, offset)
    check_excited(record, layout)
    check_inputs_differ(record, layout)
    return _procedure("hammerstein_oe.exact", record, layout, units, True, offset, constraints, gauge, starts, seed)


# -- the procedure ---------------------------------------------------------------------------------------------------


def _procedure(name: str, data: Data, layout: Layout, units: Transform, free: bool, offset: bool,
               constraints: Sequence[Any], gauge: str, starts: int, seed: int) -> Procedure:
    count = whole_number("starts", starts, 1, "the number of starts")
    unknowns = Unknowns(layout, data.n_experiments, (free,) * layout.m, bool(offset))
    check_rows(data, unknowns)
    return _run(name, OutputError(data, unknowns, "norm" if free else "none", units), constraints, gauge, count, seed)


def _run(name: str, criterion: OutputError, constraints: Sequence[Any], gauge: str, starts: int, seed: int
         ) -> Procedure:
    found, others, figures = _searched(criterion, starts, seed)
    posing = Posing(name, replace(criterion, gauge=gauge), tuple(constraints))
    posing = replace(posing, usual=posing.values(posing.criterion.normalised(found.x)))
    x = posing.entry([found, *others])
    evidence = yield from refine(posing.posed(), replace(found, x=x), figures, x)
    return evidence


def search(criterion: OutputError, count: int, seed: int) -> tuple[Descent, dict[str, Any]]:
    """Descend from several starts and return the best optimum with what is to be said about the others.

    On long records the starts are compared on a part, and the winner descends on the whole.
    """
    found, _, figures = _searched(criterion, count, seed)
    return found, figures


def _searched(criterion: OutputError, count: int, seed: int) -> tuple[Descent, list[Descent], dict[str, Any]]:
    """Return the best optimum, the other ones, and what is to be said about them."""
    part = _part(criterion)
    found = best_of(part, _starts(part, count, seed), enough=SUFFICIENT)
    if not found:
        raise RankError("no start has a stable simulation; use other orders")
    _, sentence = agreement(found, 1e-12 * part.energy)
    best = found[0]
    x = np.zeros(criterion.unknowns.size)
    x[: criterion.unknowns.shared] = best.x[: criterion.unknowns.shared]
    final = descend(criterion, best.x if part is criterion else x, start=best.start)
    values = energy_unit(criterion.units) * np.array(sorted((one.value for one in found), reverse=True))
    figures = {"starts": sentence, "simulation errors of the starts": values}
    others = [one for one in found[1:] if abs(one.value - best.value) > 1e-3 * best.value] if part is criterion else []
    return replace(final, steps=final.steps + best.steps), others, figures


def _part(criterion: OutputError) -> OutputError:
    """The record itself, or the middle of a long one."""
    data = criterion.data
    if data.n_samples <= 2 * SEARCH:
        return criterion
    longest = int(np.argmax([e.n_samples for e in data.experiments]))
    size = data.experiments[longest].n_samples
    if size < SEARCH:  # many short experiments
        kept, total = [], 0
        for i, e in enumerate(data.experiments):
            if total < SEARCH:
                kept, total = [*kept, i], total + e.n_samples
        return replace(criterion, data=data.select(experiments=kept),
                       unknowns=replace(criterion.unknowns, experiments=len(kept)))
    first = (size - SEARCH) // 2
    cut = data.select(experiments=[longest]).window(first, first + SEARCH)
    return replace(criterion, data=cut, unknowns=replace(criterion.unknowns, experiments=1))


def _starts(criterion: OutputError, count: int, seed: int) -> Iterator[tuple[str, Array]]:
    """Yield starts one by one, each estimated when it is asked for: those of other methods first, then moved poles."""
    data, unknowns = criterion.data, criterion.unknowns
    at = unknowns.slices["a"]
    first = equation_error(data, unknowns)
    first = blank(unknowns) if first is None else first
    base = with_poles(criterion, criterion.normalised(first), contained(first[at], RADIUS), "ARX")
    yield "ARX", base.x
    done = 1
    for name in ("Steiglitz-McBride", "instruments", "subspace"):
        if done == count:
            return
        if name == "subspace":
            a = subspace(data, unknowns)
            one = None if a is None else with_poles(criterion, base.x, a, name)
        else:
            one = iterated(criterion, base.x, "sm" if name == "Steiglitz-McBride" else "iv")
        if one is not None:
            done += 1
            yield name, one.x
    rng = np.random.default_rng(seed)
    for i in range(1, (count - done if unknowns.layout.na else 0) + 1):
        a = perturbed(rng, base.x[at])
        yield f"perturbed {i}", with_poles(criterion, base.x, a, "").x
