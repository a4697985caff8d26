"""Whether an input has a visible effect on an output, beside a level, a decay, the output's own past and other inputs.

The F test of the input behind a few poles and delays is distorted where lagged outputs and slow inputs
are few: in doubt its law without an effect is simulated (parametric bootstrap).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from optid.arrays import Array
from optid.identify.informativity.bank import responses
from optid.identify.informativity.lags import lag_columns, memory, powers, stack_experiments, test_addition
from optid.identify.informativity.process import LATEST, DelayedResponse, Process
from optid.identify.informativity.signals import RecordSignals, WhitenedRegression, delay, respond
from optid.models.recursions import lfilter
from optid.statistics.coloured import short_autoregression

LEVEL = 0.005
TAUS = (0.2, 3.0, 12.0, 50.0)  # time constants in samples
# delays in samples; not the one that a scan finds, which is the best of many on the same record
DELAYS = (0, 4, 16, 64)
CLEAR, DOUBTFUL = 1e-9, 0.05  # p values between which the law is simulated
DRAWS, WARMING = 399, 200  # simulations, and samples before each
SAMPLES = 30  # per coefficient of the noise model: a longer one takes a slow response for noise
LAGS = 12  # of the other inputs
DECAYS = 30  # time constants of the decay that are compared


@dataclass(frozen=True)
class Effect:
    """The effect of an input on an output: p value of none, and the share of the residual energy that it explains."""

    input: str
    output: str
    p_value: float
    share: float

    @property
    def visible(self) -> bool:
        """Whether there is an effect."""
        return self.p_value <= LEVEL


def effect(signals: RecordSignals, c: int, o: int, process: Process, names: tuple[str, str], least: int = 0,
           seed: int = 0) -> Effect:
    """Test the effect of input c on output o, whose names are given, from a lag on: 1 in a loop."""
    na = memory(signals, o) + 2
    latest = int(LATEST * signals.longest)
    more = [_bank(u[:, c], signals.levels(c), least, latest) for u in signals.u]
    others: list[Array] = [np.column_stack([np.ones(len(u)), *(x for i in range(u.shape[1]) if i != c
                                                  for x in _others(u[:, i], process.responses[i], least, latest).T)])
              for u in signals.u]

    def test_outputs(outputs: tuple[Array, ...]) -> tuple[float, float, int]:
        columns = stack_experiments(signals, na, 0, lambda i, first, last: [
            part[signals.present[i][first:last, o]] for part in (
                np.hstack([others[i][first:last], lag_columns(outputs[i], range(1, na + 1), first, last)]),
                more[i][first:last], outputs[i][first:last])])
        if not columns:
            return 1.0, 0.0, 0
        base, bank, y = columns
        if len(y) <= base.shape[1] + bank.shape[1]:
            return 1.0, 0.0, 0
        found = test_addition(y, base, bank)
        return found.p_value, found.share, found.columns

    outputs = signals.outputs(o)
    p_value, share, columns = test_outputs(outputs)
    if columns and CLEAR < p_value < DOUBTFUL:
        p_value = _simulated(signals, o, outputs, others, p_value, test_outputs, seed)
    return Effect(*names, p_value, share)


def _simulated(signals: RecordSignals, o: int, outputs: tuple[Array, ...], others: list[Array], p_value: float,
               tested: Callable[[tuple[Array, ...]], tuple[float, float, int]], seed: int) -> float:
    """Return the share of simulated outputs without the effect whose p value is as small."""
    smooth, noise, spread = _without_effect(signals, o, outputs, others)
    rng, below = np.random.default_rng(seed), 0
    for draw in range(1, DRAWS + 1):
        drawn = tuple(s + lfilter([1.0], noise, spread * rng.standard_normal(len(s) + WARMING))[WARMING:]
                      for s in smooth)
        below += tested(drawn)[0] <= p_value
        # it is not visible: more draws would change nothing
        if below > LEVEL * (DRAWS + 1):
            return (1 + below) / (draw + 1)
    return (1 + below) / (DRAWS + 1)


def _without_effect(signals: RecordSignals, o: int, outputs: tuple[Array, ...], others: list[Array]
                    ) -> tuple[list[Array], Array, float]:
    """Return level, decay and other inputs as a smooth part, the noise polynomial, and its innovations' spread."""
    present = tuple(there[:, o] for there in signals.present)
    regression = WhitenedRegression(outputs, present, np.ones(1))
    smooth: list[Array] = []
    for _ in range(2):
        found = []
        for tau in np.geomspace(1, 3 * signals.longest, DECAYS):
            pole = float(np.exp(-1 / tau))
            energy, theta, _, _ = regression.solve([x[:, 1:] for x in others], pole)
            found.append((energy, pole, theta))
        _, pole, theta = min(found, key=lambda one: one[0])
        errors = regression.residuals([x[:, 1:] for x in others], theta, pole)
        smooth = [y - np.nan_to_num(e) for y, e in zip(outputs, errors)]
        regression = replace(regression, noise=short_autoregression(errors, min(12, signals.samples // SAMPLES)))
    _, _, white, _ = regression.solve([x[:, 1:] for x in others], pole)
    return smooth, regression.noise, float(np.std(white))


def _bank(x: Array, levels: int, least: int, latest: int) -> Array:
    """Return an input, and its square, behind a few poles after a few delays."""
    return responses(powers(x, levels, 2), TAUS, DELAYS, least, latest)


def _others(x: Array, response: DelayedResponse, least: int, latest: int) -> Array:
    """Return the past of another input: its bank, first lags, and response."""
    first = [delay(x - x[0], least + j) for j in range(LAGS)]
    shaped = respond(response.poles, x)
    return np.column_stack([_bank(x, 1, least, latest), *first, *(delay(shaped, response.nk + j) for j in range(2))])
