"""A low-order transfer function with dead time from every input to every output, before any model is posed.

    y(k) = level + sum_c q^-nk_c B_c(q) / A_c(q) f_c(u_c(k)) + decay + v(k),    N(q) v = white

A bank of poles at all delays gives starts, Gauss-Newton steps over the poles with everything linear projected out
refine them, and the Bayesian information criterion chooses order, delay, zeros, an integrator, and whether f is
straight. The scan is repeated after the errors are whitened: coloured noise hides a dead time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.data.record import Data
from optid.identify.informativity.bank import Start, apart, scan
from optid.identify.informativity.descent import (
    ROUNDING,
    Drive,
    FittedTerm,
    Term,
    columns_of,
    refine_poles,
    slowest_of,
)
from optid.identify.informativity.signals import Poles, RecordSignals, WhitenedRegression, delay, respond
from optid.models.roots import roots_of
from optid.statistics.coloured import short_autoregression

LATEST = 0.25  # longest delay as a share of the longest experiment
KEPT = 4  # delays of the scan that are refined
NOISE = 4  # order of the noise model, at most
TURNS, SETTLED = 5, 0.01  # scans with a better noise model; largest change of its coefficients that is none
LARGEST, MOVES = 4, 30  # poles, at most; steps from a structure to a neighbour, at most
LEVELS, NODES = 5, 7  # values of an input up to which f is a straight line; nodes of a bent one
LIKELY = 3.84  # 95 % quantile of chi-square with one degree of freedom: twice the log likelihood ratio
UNIT = 0.3  # share of the longest experiment beyond which a time constant is compared with an integrator
FILLED = 20  # missing samples of an input up to which they are estimated
EXACT = 1e-16  # mean square of errors, over the variance of the output, at which a response is exact


@dataclass(frozen=True, eq=False)
class DelayedResponse:
    """The response of an output to an input: ``q^-nk B(q) / A(q)``, in the units of the record.

    Attributes:
        poles: (n,) of A.
        nk: lag of the first coefficient of B; a held input acts nk - 1 samples late.
        b: (nb,) coefficients of B.
        lag_interval: 95 % interval of nk.
        nodes, values: of f, piecewise linear with slope one on average; None where it is straight.
    """

    poles: Poles
    nk: int
    b: Array
    lag_interval: tuple[int, int]
    nodes: Array | None = None
    values: Array | None = None

    @property
    def integrates(self) -> bool:
        """Whether a pole is 1."""
        return bool(np.any(self.poles == 1))

    @property
    def gain(self) -> float:
        """Static gain B(1)/A(1), infinite with a pole at 1."""
        rest = float(np.real(np.prod(1 - self.poles)))
        return float(self.b.sum() / rest) if rest else float(np.copysign(np.inf, self.b.sum()))


@dataclass(frozen=True, eq=False)
class Process:
    """The responses of one output to all inputs.

    Attributes:
        output: its name.
        responses: one per input.
        noise: polynomial [1, a1, ...] that whitens what they leave.
        residuals: what they leave, beside level and decay, (T,) per experiment in the unit of the output.
        explained: share of the variance of the output that they explain.
        criterion: Bayesian information criterion.
        points: the responses as they were found, one per input.
    """

    output: str
    responses: tuple[DelayedResponse, ...]
    noise: Array
    residuals: tuple[Array, ...] = field(repr=False)
    explained: float
    criterion: float
    points: tuple[FittedTerm, ...] = field(repr=False)


def processes(data: Data, least: int = 0, known: Sequence[Process] = ()) -> tuple[Process, ...]:
    """Find low-order transfer functions with dead time, one `Process` per output; a record of any kind has some.

    Args:
        data: the record; of a long one the first 30,000 samples are read.
        least: smallest lag of an input; 1 where the input answers the output without delay, in a loop.
        known: those of a smaller `least`, one per output; the search goes on from responses that come late enough.
    """
    signals, before = RecordSignals.of(data), known or [None] * len(data.outputs)
    late = [p is not None and all(r.nk >= least for r in p.responses) for p in before]
    return tuple(p if p is not None and kept else _process(signals, o, name, least, p)
                 for o, (name, p, kept) in enumerate(zip(data.outputs, before, late)))


def _process(signals: RecordSignals, o: int, name: str, least: int, known: Process | None) -> Process:
    regression = WhitenedRegression(signals.outputs(o), tuple(there[:, o] for there in signals.present), np.ones(1))
    longest = max(int(LATEST * signals.longest), min(least, signals.longest - 1))
    u = [signals.inputs(c) for c in range(len(signals.u_scale))]
    points: list[FittedTerm | None] = [None] * len(u)
    if known is not None and len(u) > 1:
        points = [p if p.term.lag >= least else None for p in known.points]
        regression = replace(regression, noise=known.noise)
    inputs = range(1) if len(u) == 1 else sorted(  # the one that explains most first
        range(len(u)), key=lambda c: next(scan(regression, u[c], longest, False))[0].energy)
    whole = not any(lost.any() for lost in signals.lost)
    first = apart(regression, signals.u, least, longest) if len(u) > 1 else ()
    for turn in range(TURNS):
        before = [None if p is None else p.term.key for p in points]
        for c in inputs:
            y = _without(regression.y, [p for i, p in enumerate(points) if p is not None and i != c])
            for i in (i for i, p in enumerate(points) if p is None and i != c):
                y = tuple(rest - response for rest, response in zip(y, first[i]))
            points[c] = _found(replace(regression, y=y), u[c], signals.levels(c), least, longest, points[c],
                               len(u) == 1)
        found = [p for p in points if p is not None]
        for c in inputs:
            rest = replace(regression, y=_without(regression.y, [p for i, p in enumerate(found) if i != c]))
            u[c] = _completed(rest, found[c], u[c], [lost[:, c] for lost in signals.lost])
        columns, theta, slowest = _joint(regression, found)
        errors = regression.residuals(columns, theta, slowest)
        noise = short_autoregression(errors, min(NOISE, regression.count // 30))
        size = max(noise.size, regression.noise.size)
        change = np.pad(noise, (0, size - noise.size)) - np.pad(regression.noise, (0, size - regression.noise.size))
        same = before == [p.term.key for p in found]
        exact = all(p.energy <= EXACT * regression.count for p in found)
        if exact or np.max(np.abs(change)) < SETTLED and (same or (turn == 0 and whole)):
            break
        regression = replace(regression, noise=noise)
    spread = float(np.nanvar(np.concatenate(errors)))
    energy = float(np.mean(np.concatenate([(y - y.mean()) ** 2 for y in regression.y])))
    scale = float(signals.y_scale[o])
    responses = [_response(signals, c, o, p, _interval(replace(regression, y=_without(
        regression.y, [q for q in found if q is not p])), p, least, longest)) for c, p in enumerate(found)]
    return Process(name, tuple(responses), noise, tuple(scale * e for e in errors), 1 - spread / max(energy, 1e-300),
                   sum(p.criterion for p in found), tuple(found))


def _found(regression: WhitenedRegression, u: tuple[Array, ...], levels: int, least: int, longest: int,
           before: FittedTerm | None, alone: bool) -> FittedTerm:
    """Return the best response to one input, whose f is bent where that pays.

    What several inputs leave of each other looks like a response that first goes the wrong way: none is tried then.
    """
    straight = Drive(u)
    start = None if before is None else before.term
    *scans, turned = scan(regression, u, longest)
    best = plain = _searched(regression, straight, least, longest, start, scans)
    if alone:
        best = _turned(regression, straight, least, longest, plain, turned)
    if levels <= LEVELS:
        return best
    whole = np.concatenate(straight.values)
    nodes = np.unique(np.quantile(whole, np.linspace(0, 1, NODES)))
    if nodes.size < 4:
        return best
    starts = [best.term, plain.term] if before is None or before.drive.nodes is None else [
        before.term, best.term, plain.term]
    squares = Drive(tuple((u - whole.mean()) ** 2 for u in straight.values))
    even = next(scan(regression, squares.values, longest, False))
    if even and even[0].energy < 0.9 * best.energy and even[0].lag >= least:  # f is nearly even
        starts[-1] = Term.of(even[0].poles, even[0].lag)
    # that of a straight f may be far from the one found for a bent f
    for term in {term.key: term for term in reversed(starts)}.values():
        for _ in range(2):
            bent = _bent(regression, straight, term, nodes)
            if bent is None:
                break
            found = _searched(regression, bent, least, longest, term)
            term = found.term
            if found.criterion < best.criterion:
                best = found
    return best


def _turned(regression: WhitenedRegression, drive: Drive, least: int, longest: int, plain: FittedTerm,
            starts: Sequence[Start]) -> FittedTerm:
    """Return the better of a response and one with a zero, which may go the wrong way at first: like one that is late.

    It lies at one of the delays at which the scan is better than at both neighbours.
    """
    energy = {one.lag: one.energy for one in starts if one.lag >= least}
    lowest = [one for one in starts if one.lag >= least and one.energy <= min(
        energy.get(one.lag - 1, np.inf), energy.get(one.lag + 1, np.inf))]
    found = [refine_poles(regression, drive, Term.of(one.poles, one.lag, one.zeros),
                          plain.criterion) for one in lowest[:2]]
    best = min(found, key=lambda p: p.criterion, default=plain)
    return _searched(regression, drive, least, longest, best.term) if best.criterion < plain.criterion else plain


def _searched(regression: WhitenedRegression, drive: Drive, least: int, longest: int, start: Term | None,
              scans: Sequence[Sequence[Start]] = ()) -> FittedTerm:
    """Refine the best of scans, and then neighbouring structures as long as the criterion falls."""
    tried: dict[tuple[int, ...], FittedTerm] = {}

    def fit_term(term: Term) -> FittedTerm:
        if term.key not in tried:
            least = min((p.criterion for p in tried.values()), default=np.inf)
            tried[term.key] = refine_poles(regression, drive, term, least)
        return tried[term.key]

    terms = [] if start is None else [start]
    for starts in scans:
        late = [one for one in starts if one.lag >= least]
        terms += [Term.of(one.poles, one.lag) for one in late[: KEPT if start is None else 2]]
    best = min(map(fit_term, terms), key=lambda p: p.criterion)
    exact = EXACT * regression.count
    oscillating = list(_oscillating(regression, drive, best.term)) if scans else []
    for _ in range(MOVES):
        if best.energy <= exact:
            break
        near = [fit_term(term) for term in (*oscillating, *_neighbours(best.term, least, longest, drive))]
        better = min(near, key=lambda p: p.criterion)
        if not better.criterion < best.criterion - 1e-6:
            break
        best, oscillating = better, []
    return best


def _neighbours(term: Term, least: int, longest: int, drive: Drive) -> Iterator[Term]:
    """Yield the structures one step from a structure."""
    for lag in (term.lag - 1, term.lag + 1):
        if least <= lag <= longest:
            yield replace(term, lag=lag)
    if term.zeros < term.order:
        yield replace(term, zeros=term.zeros + 1)
        if term.lag > least:
            yield replace(term, zeros=term.zeros + 1, lag=term.lag - 1)
    if term.zeros:
        yield replace(term, zeros=term.zeros - 1)
    if 0 < term.order < LARGEST:
        fastest = min(term.taus, default=term.pairs[0][0] if term.pairs else 0.0)
        yield replace(term, taus=(*term.taus, fastest - 0.7))
    if len(term.taus) + term.integrates > 1:
        fewer = tuple(sorted(term.taus)[1:])
        yield replace(term, taus=fewer)
        yield replace(term, taus=fewer, lag=min(term.lag + 1, longest))
    if term.pairs and term.order > 2:
        yield replace(term, pairs=tuple(sorted(term.pairs)[1:]))
    slow = max(term.taus, default=-np.inf)
    if not term.integrates and slow > np.log(UNIT * max(len(u) for u in drive.values)):
        yield replace(term, taus=tuple(t for t in term.taus if t != slow), integrates=True)


def _oscillating(regression: WhitenedRegression, drive: Drive, term: Term) -> Iterator[Term]:
    """Yield structures with the complex pairs of a longer autoregression with the delayed input."""
    n = 2 * LARGEST
    rows, targets = [], []
    for y, u in zip(regression.y, drive.values):
        v = delay(u - u[0], term.lag)
        if len(y) > 3 * n:
            lags = ((x, j) for x, first in ((y, 1), (v, 0)) for j in range(first, n))
            rows.append(np.column_stack([x[n - j : len(x) - j] for x, j in lags]))
            targets.append(y[n:])
    if not rows or sum(map(len, rows)) < 6 * n:
        return
    x, y = np.vstack(rows), np.concatenate(targets)
    theta = np.linalg.lstsq(np.column_stack([x, np.ones(len(x))]), y, rcond=1e-9)[0]
    found = roots_of(-theta[: n - 1])
    pairs = sorted((p for p in found if p.imag > 0.02 and 0.6 < abs(p) < 1), key=lambda p: -abs(p))[:2]
    for p in pairs:
        alone = Term.of([p, p.conjugate()], term.lag, 1)
        yield alone
        yield replace(alone, taus=(max(term.taus, default=1.0),))
    if len(pairs) == 2:
        yield replace(Term.of([q for p in pairs for q in (p, p.conjugate())], term.lag, 2))


def _bent(regression: WhitenedRegression, drive: Drive, term: Term, nodes: Array) -> Drive | None:
    """Fit f, piecewise linear between nodes, through a response; with slope one on average."""
    hats = [np.column_stack([np.interp(u, nodes, one) for one in np.eye(nodes.size)[1:]]) for u in drive.values]
    columns = [np.column_stack([delay(respond(term.poles, h), term.lag) for h in hat.T]) for hat in hats]
    _, theta, _, _ = regression.solve(columns, slowest_of(term.poles))
    heights = np.concatenate([[0.0], theta])
    values = [np.interp(u, nodes, heights) for u in drive.values]
    spread = float(np.std(np.concatenate(values)))
    if not np.isfinite(spread) or spread == 0:
        return None
    heights = heights / spread
    return Drive(tuple(np.interp(u, nodes, heights) for u in drive.values), nodes, heights)


def _completed(regression: WhitenedRegression, point: FittedTerm, u: tuple[Array, ...],
               lost: Sequence[NDArray[np.bool_]]) -> tuple[Array, ...]:
    """Estimate a few missing samples of an input from what they do to the output; more of them stay as they are."""
    places = [(i, k) for i, one in enumerate(lost) for k in np.flatnonzero(one).tolist() if k]
    if not 0 < len(places) <= FILLED or point.drive.nodes is not None:
        return u
    own = columns_of(point.term, u)
    columns = [[x @ point.theta] for x in own]
    for place, k in places:
        for i, record in enumerate(u):
            pulse = np.zeros(len(record))
            pulse[k if i == place else 0] = i == place
            columns[i].append(columns_of(point.term, [pulse])[0] @ point.theta)
    _, theta, _, _ = regression.solve([np.column_stack(x) for x in columns], slowest_of(point.term.poles))
    filled = [x.copy() for x in u]
    for (i, k), value in zip(places, theta[1:] / (theta[0] or 1.0)):
        filled[i][k] += value
    return tuple(filled)


def _without(y: Sequence[Array], points: Sequence[FittedTerm]) -> tuple[Array, ...]:
    """Return the output less the responses to some inputs."""
    rest = list(y)
    for p in points:
        rest = [r - x @ p.theta for r, x in zip(rest, columns_of(p.term, p.drive.values))]
    return tuple(rest)


def _joint(regression: WhitenedRegression, points: Sequence[FittedTerm]) -> tuple[list[Array], Array, float]:
    """Return the columns of all responses, their coefficients together, and the slowest pole."""
    each = [columns_of(p.term, p.drive.values) for p in points]
    columns = [np.hstack(several) for several in zip(*each)]
    slowest = max((slowest_of(p.term.poles) for p in points), key=abs)
    return columns, regression.solve(columns, slowest)[1], slowest


def _interval(regression: WhitenedRegression, point: FittedTerm, least: int, longest: int) -> tuple[int, int]:
    """Return the delays that the likelihood does not exclude, poles and coefficients refitted at each."""
    ends, floor = [], ROUNDING**2 * regression.count
    for sign in (-1, 1):
        lag, term, step, grows = point.term.lag, point.term, 1, True
        while step:  # twice as far as long as nothing excludes it: an input without effect has any delay
            there = lag + sign * step
            found = refine_poles(regression, point.drive,
                                 replace(term, lag=there)) if least <= there <= longest else None
            if found is None or regression.count * np.log(max(found.energy, floor) / max(point.energy, floor)) > LIKELY:
                step, grows = step // 2, False
            else:
                lag, term, step = there, found.term, 2 * step if grows else step // 2
        ends.append(lag)
    return ends[0], ends[1]


def _response(signals: RecordSignals, c: int, o: int, point: FittedTerm, interval: tuple[int, int]) -> DelayedResponse:
    """Write a response in the units of the record."""
    term, drive = point.term, point.drive
    poles = term.poles
    unit = float(np.prod(np.abs(1 - poles[poles != 1])))
    slope, nodes, heights = 1.0, None, None
    if drive.nodes is not None and drive.heights is not None:
        u = np.concatenate(signals.inputs(c))
        v = np.concatenate(drive.values)
        slope = float(np.polyfit(u, v, 1)[0]) or 1.0
        nodes = drive.nodes * signals.u_scale[c]
        heights = drive.heights / slope * signals.u_scale[c]
    b = point.theta * unit * slope * signals.y_scale[o] / signals.u_scale[c]
    return DelayedResponse(poles, term.lag, b, interval, nodes, heights)
