"""Whether a record comes from a closed loop: does the past of an output act on an input?

Sims' test: in open loop the future of an input says nothing about an output beyond the past of both, for any input.
The past is the first lags of the input and its response through the dead time and the poles of a low-order model, so
that neither is missed. An input that answers without delay shows at the same sample: with a sign opposite to that of
the gain it is the answer of a controller (Sims 1972; Gustavsson, Ljung and Söderström 1977). In a quiet loop the output
has little future to tell, but between the moves of its set-point the input follows the outputs by one law.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from optid.arrays import Array
from optid.data.repeats import copies
from optid.identify.informativity.lags import lag_columns, memory, powers, stack_experiments, test_addition
from optid.identify.informativity.process import Process
from optid.identify.informativity.signals import RecordSignals, delay, respond

LEVEL = 2e-4  # of the test of one input, shared by the outputs
LED = 0.9  # share of the innovations of one of several inputs that outputs must leave at most, if its future is silent
SUPPORTED = 0.05  # of the future of one of several inputs, where its present has the sign of a controller
LEADS, LAGS, SHAPED = 6, 12, 4  # future and past samples of an input; samples of its response
TIED = 1e-3  # share of the innovations of an input that outputs do not explain, below which nothing else moved it
EXACT = 1e-6  # the same for an input that answers at once
MOVING = 0.5  # share of the samples at which an input must change to be such an answer
LAW = 0.3  # median error of an input from its past and the outputs, over that from its past alone, that is a law
MEMORY, TURNS = 6, 12  # samples that a law reaches back; turns of its regression
PREDICTED = 1e-6  # median error of an input, over its spread, from its own past alone that leaves no law to find

Word = Literal["open", "closed", "regulated"]


@dataclass(frozen=True)
class Loop:
    """How an input depends on the outputs.

    Attributes:
        word: "open"; "closed" where outputs act on it; "regulated" where nothing else moved it.
        p_value: of the future of the input, the smallest over the outputs.
        outside: share of the innovations of the input that past and present outputs do not explain.
        output: the output that acts on it.
        follows: whether that was seen in a law at most samples, not in the p value.
    """

    word: Word
    p_value: float = 1.0
    outside: float = 1.0
    output: str = ""
    follows: bool = False


def loop(signals: RecordSignals, c: int, processes: tuple[Process, ...], names: tuple[str, ...]) -> Loop:
    """Test whether outputs act on input c; the processes have an input act at the next sample at the earliest."""
    found = [_tested(signals, c, o, process) for o, process in enumerate(processes)]
    level = LEVEL / len(found)
    free = outside(signals, c)
    for o, (future, now, same) in enumerate(found):
        # one of several inputs may act at once with another sign than later: its future or a large share must support
        # that this is an answer
        against = not same and (signals.u[0].shape[1] == 1 or future < SUPPORTED or free < LED)
        answered = now < level and (against or (free < EXACT and _moving(signals, c) > MOVING))
        if future < level or answered:
            return Loop("regulated" if free < TIED else "closed", min(future, now) if answered else future, free,
                        names[o])
        if not (same and now < level) and _follows(signals, c, o):  # else it is the plant that answers at once
            return Loop("closed", future, free, names[o], follows=True)
    return Loop("open", min(p for p, _, _ in found), free)


def _tested(signals: RecordSignals, c: int, o: int, process: Process) -> tuple[float, float, bool]:
    """Return p values of the future of input c and of its present, and whether the latter has the sign of the gain."""
    lags, leads = min(LAGS, signals.longest // 12), min(LEADS, signals.longest // 25)
    if leads < 1 or lags < 1:
        return 1.0, 1.0, True
    na = memory(signals, o) + 2
    levels = signals.levels(c)

    def build(i: int, first: int, last: int) -> list[Array]:
        u, y = signals.u[i], signals.y[i][:, o]
        past = [np.ones((last - first, 1)), lag_columns(y, range(1, na + 1), first, last)]
        for other in range(u.shape[1]):
            response = process.responses[other]
            for x in powers(u[:, other], signals.levels(other)):
                shaped = respond(response.poles, x)
                past += [lag_columns(x, range(1, lags + 1), first, last),
                         np.column_stack([delay(shaped, max(response.nk, 1) + j)[first:last] for j in range(SHAPED)])]
        now = np.column_stack([x[first:last] for x in powers(u[:, c], levels)])
        there = signals.present[i][first:last, o]
        return [part[there] for part in (np.hstack(past), now, lag_columns(u[:, c], range(-leads, 0), first, last),
                                         y[first:last])]

    columns = stack_experiments(signals, max(na, lags), leads, build)
    if not columns or len(columns[3]) < 2 * columns[0].shape[1]:
        return 1.0, 1.0, True
    past, now, future, y = columns
    again = _repeats(signals, c)
    ahead = test_addition(y, np.hstack([past, now]), future, again)
    present = test_addition(y, past, now, again)
    slope = float(np.linalg.lstsq(np.hstack([past, now[:, :1]]), y, rcond=1e-10)[0][-1])
    response = process.responses[c]
    sign = float(response.b.sum()) * (-1.0 if np.count_nonzero(response.poles.real > 1) % 2 else 1.0)
    return ahead.p_value, present.p_value, slope * sign > 0


def _repeats(signals: RecordSignals, c: int) -> float:
    """Return the samples of a record over those within which input c makes new moves."""
    new = sum(group[0].last - group[0].first for group in copies([u[:, None] for u in signals.inputs(c)]))
    return signals.samples / new


def setpoint(signals: RecordSignals, c: int) -> int | None:
    """Return another input that, with the outputs, determines input c: the set-point of its controller, if any."""
    others = [other for other in range(len(signals.u_scale)) if other != c]
    return next((other for other in others if outside(signals, c, beside=(other,)) < TIED), None)


def outside(signals: RecordSignals, c: int, order: int = 12, beside: tuple[int, ...] = ()) -> float:
    """Return the share of the innovations of input c, beyond its own past, that past and present outputs leave.

    The outputs, and the inputs `beside` them.
    """
    order = max(min(order, signals.longest // 12), 1)
    columns = stack_experiments(signals, order, 0, lambda i, first, last: (
        np.hstack([np.ones((last - first, 1)), lag_columns(signals.u[i][:, c], range(1, order + 1), first, last)]),
        np.hstack([lag_columns(x, range(order + 1), first, last)
                   for x in (*signals.y[i].T, *(signals.u[i][:, other] for other in beside))]),
        signals.u[i][first:last, c]))
    if not columns:
        return 1.0
    own, outputs, u = columns
    return 1.0 - test_addition(u, own, outputs).share


def _moving(signals: RecordSignals, c: int) -> float:
    return float(np.mean(np.concatenate([np.diff(u) != 0 for u in signals.inputs(c)])))


def _follows(signals: RecordSignals, c: int, o: int) -> bool:
    """Whether input c follows output o and its own past by one law at most samples, whatever moves it at others."""
    if _moving(signals, c) < MOVING:
        return False
    columns = stack_experiments(signals, MEMORY, 0, lambda i, first, last: (
        np.hstack([np.ones((last - first, 1)), lag_columns(signals.u[i][:, c], range(1, MEMORY + 1), first, last)]),
        lag_columns(signals.y[i][:, o], range(MEMORY + 1), first, last), signals.u[i][first:last, c]))
    if not columns or len(columns[2]) < 20 * MEMORY:
        return False
    own, output, u = columns
    alone = _median_error(u, own)
    return alone > PREDICTED and _median_error(u, np.hstack([own, output])) < LAW * alone


def _median_error(target: Array, columns: Array) -> float:
    """Return the median absolute error of a least-absolute regression, by reweighting; single jumps do not move it."""
    weights = np.ones((len(target), 1))
    error = target
    for _ in range(TURNS):
        x = np.linalg.lstsq(weights * columns, weights[:, 0] * target, rcond=1e-12)[0]
        error = np.abs(target - columns @ x)
        weights = 1 / np.sqrt(np.maximum(error, 1e-9))[:, None]
    return float(np.median(error))
