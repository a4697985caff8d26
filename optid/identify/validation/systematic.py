"""The part of what a simulation leaves that the inputs explain: the error of the response, apart from the noise.

What a model leaves of the outputs is regressed on its own past and on the inputs behind a bank of poles, behind the
poles and dead time found in the record, and on their powers. The F test says whether inputs explain any of it; the
part that they explain without the past is measured by the spread of the simulated output.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.identify.informativity import Informativity
from optid.identify.informativity.lags import lag_columns, memory, powers, stack_experiments, test_addition
from optid.identify.informativity.signals import RecordSignals, delay, hold_last, respond

LEVEL = 1e-3
TAUS = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0)  # time constants of the bank, in samples
LAGS = 2  # samples of a response behind the poles of the record
FADING = (0.01, *np.geomspace(0.2, 300, 25))  # time constants of noise at irregular times, in mean sampling times
ROWS = 8  # samples per column, at least


@dataclass(frozen=True)
class Systematic:
    """The error of the response to the inputs, the largest over the outputs."""

    share: float  # its spread over that of the simulated output
    p_value: float  # of none
    output: str  # where it is

    @property
    def found(self) -> bool:
        """Whether inputs explain a part of the residuals."""
        return self.p_value < LEVEL


def systematic(data: Data, runs: Sequence[Array], told: Informativity) -> Systematic | None:
    """Measure what the inputs explain of the residuals of simulated outputs (N, l) by experiment.

    None where the record is too short, or nothing was simulated.
    """
    raw = data.raw()
    found: list[Systematic] = []
    for o, name in enumerate(data.outputs):
        errors = [e.y[:, o] - run[:, o] for e, run in zip(raw.experiments, runs)]
        if sum(int(np.isfinite(e).sum()) for e in errors) < 3 * ROWS:
            continue
        one = _measured(raw, errors, [run[:, o] for run in runs], told, o)
        if one is not None:
            found.append(replace(one, output=name))
    return max(found, key=lambda s: (s.found, s.share), default=None)


def _measured(raw: Data, errors: list[Array], runs: list[Array], told: Informativity, o: int) -> Systematic | None:
    whole = RecordSignals.of(raw)
    kept = len(whole.y)
    present = [np.isfinite(e[: len(y)])[:, None] for e, y in zip(errors[:kept], whole.y)]
    y = [hold_last(e[: len(y)][:, None]) for e, y in zip(errors[:kept], whole.y)]
    signals = replace(whole, y=tuple(y), present=tuple(present))
    rows = sum(int(there.sum()) for there in present)
    times = [np.arange(float(len(u))) if e.stamps is None else e.stamps[: len(u)] / raw.dt
             for e, u in zip((e for e in raw.experiments if e.n_samples > 1), whole.u)]
    columns = [_columns(u, whole, told, o) if raw.is_regular else _columns_in_time(u, whole, t)
               for u, t in zip(whole.u, times)]
    most = max(rows // ROWS, 1)
    columns = [c[:, :most] for c in columns]
    na = memory(signals, 0) + 1
    parts = stack_experiments(signals, na, 0, lambda i, first, last: [
        part[present[i][first:last, 0]] for part in (
            np.hstack([np.ones((last - first, 1)), lag_columns(y[i][:, 0], range(1, na + 1), first, last)]),
            columns[i][first:last], y[i][first:last, 0])])
    if not parts or len(parts[2]) < parts[0].shape[1] + 2 * parts[1].shape[1]:
        return None
    past, inputs, error = parts
    p_value = test_addition(error, past, inputs).p_value if raw.is_regular else test_addition(*_white_in_time([
        (e[here], c[here[:, 0]], t[here[:, 0]]) for e, c, t, here in zip(y, columns, times, present)])).p_value
    alone = test_addition(error, np.ones((len(error), 1)), inputs)
    rest = float(np.var(error))
    spare = max(len(error) - 1 - alone.columns, 1)
    explained = rest * max(alone.share - (1 - alone.share) * alone.columns / spare, 0.0)
    spread = float(np.nanstd(np.concatenate(runs)))
    return Systematic(float(np.sqrt(explained) / spread) if spread > 0 else np.inf, p_value, "")


def _columns(u: Array, signals: RecordSignals, told: Informativity, o: int) -> Array:
    """Return the inputs behind the dynamics of the record, then behind the bank, the most telling columns first."""
    first: list[Array] = []
    more: list[Array] = []
    for c in range(u.shape[1]):
        response = told.processes[o].responses[c] if told.processes else None
        for x in powers(u[:, c], signals.levels(c)):
            if response is not None:
                shaped = respond(response.poles[response.poles != 1], x)
                first += [delay(shaped, response.nk + j) for j in range(LAGS)]
            lag = 0 if response is None else response.nk
            more += [delay(respond((float(np.exp(-1 / tau)) if tau else 0.0,), x), late)
                     for tau in TAUS for late in sorted({told.least, max(lag, told.least)})]
    return np.column_stack([*first, *more])


def _columns_in_time(u: Array, signals: RecordSignals, t: Array) -> Array:
    """Return the inputs behind the bank at irregular times (N,), in mean sampling times; the responses are exact."""
    from optid.models.process_dynamics import ProcessDynamics, ProcessStructure  # numba

    found = [x for c in range(u.shape[1]) for x in powers(u[:, c], signals.levels(c))]
    whole = np.column_stack(found)
    bank = (ProcessDynamics(ProcessStructure(1, delay=False), np.array([tau])) for tau in TAUS if tau)
    return np.hstack([whole, *(one.response(t, t, whole - whole[0])[:, 0] for one in bank)])


def _white_in_time(rows: Sequence[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    """Return errors (N,), a constant (N, 1) and columns (N, k) at irregular times, filtered so that the noise is white.

    Its correlation over a time h is taken to be exp(-h / tau), at the most likely tau: in the order of the samples the
    past says too little, and inputs would seem to explain what noise did before a gap.
    """
    def at_rate(tau: float) -> tuple[Array, float]:
        found, cost = [], 0.0
        for errors, columns, t in rows:
            z = np.column_stack([errors, np.ones(len(errors)), columns])
            a = np.exp(-np.diff(t) / tau)
            size = np.sqrt(-np.expm1(-2 * np.diff(t) / tau))
            found.append(np.vstack([z[:1], (z[1:] - a[:, None] * z[:-1]) / size[:, None]]))
            cost += 2 * float(np.sum(np.log(size)))
        whole = np.vstack(found)
        rest = whole[:, 0] - whole[:, 1:2] @ np.linalg.lstsq(whole[:, 1:2], whole[:, 0])[0]
        return whole, len(whole) * float(np.log(max(rest @ rest, 1e-300))) + cost

    best = min((at_rate(tau) for tau in FADING), key=lambda one: one[1])[0]
    return best[:, 0], best[:, 1:2], best[:, 2:]
