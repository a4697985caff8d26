"""Complete loss of a sensor or an actuator by rank deficiency (dissertation, chapter 7): sliding windows, three tests.

Order: the number of observed states changes. It drops only where the lost channel was the only access to some mode.
Past outputs among the instruments hide the loss of an actuator where process noise reaches the same modes; hence past
and future inputs alone are the instruments by default.
Rows: the outputs of a dead sensor depend on no input. Columns: no output depends on the input of a dead actuator, given
past outputs and the other inputs. Both regress rows y of a Hankel matrix on rows o and t. With z the part of t that o
does not explain and e the residuals of y, both normalised, zero coefficients of t make T = |(1/j) sum_k e_k z_k^T|_F^2
nearly g chi2_h / j, g and h from the covariances of e and z at every lag at which windows overlap
(`optid.identify.order.ranks`). Coefficients Theta add |C_z^(1/2) Theta C_e^(-1/2)|^2.

Every verdict is compared with that of a healthy plant on the same window: neither a weakly excited mode nor an input
at rest counts as a failure. A window that straddles the failure keeps the nominal rank, so that the alarm comes about
one window later. Open loop is assumed: under feedback inputs depend on sensor noise, and no row is zero.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array, check_integer, check_probability, one_of
from optid.data.record import Data
from optid.errors import DataError, RankError, StructureError
from optid.identify.order.ranks import RankTest, lagged_covariances, moments_of_sum, quantile_of_sum, rank_test
from optid.models import HammersteinSS
from optid.phrases import short
from optid.statistics.hankel import HankelStatistics, RegressionRows, hankel_statistics

BLOCK_ROWS = 6
LONG = 20  # windows have at least this many samples per future row of outputs
LEVEL = 1e-3  # probability that a dead channel is not recognised, or a true order rejected, on one window
STILL = 0.1  # smallest excitation, relative to the healthy record, below which no order is estimated
DROPPED = 1e-8  # eigenvalue of the scaled tested rows below which a direction is not excited and not tested
QUIET = 1e-7  # residuals relative to the spread of the healthy output that count as rounding
MARGIN = 3.0  # a test is conclusive where a healthy plant would exceed the threshold this many times


class ChannelRegression(NamedTuple):
    """The regression that tests a channel, as positions (`HankelStatistics.at`): are the coefficients of t zero?"""

    name: str  # the channel, for instance "sensor:y1"
    tested: NDArray[np.intp]  # t
    others: NDArray[np.intp]  # o, the constant (0) among them
    outputs: NDArray[np.intp]  # y


@dataclass(frozen=True, eq=False)
class ZeroTest:
    """Test of one group of coefficients on one window."""

    name: str  # the channel
    statistic: float = float("nan")  # T, without unit; NaN where the window has too few samples
    threshold: float = float("nan")  # quantile of T if the coefficients are zero
    p_value: float = float("nan")  # probability of a larger T if they are zero
    healthy: float = float("inf")  # expected T of a healthy channel on this window; inf without a healthy record
    flat: bool = False  # whether the tested output is constant
    coefficients: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)  # (t, y), in units of the signals

    @property
    def testable(self) -> bool:
        """Whether the window distinguishes a healthy channel from a dead one."""
        return self.healthy > MARGIN * self.threshold

    @property
    def zero(self) -> bool:
        """Whether the coefficients are zero, on a window that would show healthy ones."""
        return self.testable and self.statistic <= self.threshold

    @property
    def ratio(self) -> float:
        """T over its threshold."""
        return self.statistic / self.threshold if self.threshold > 0 else 0.0 if self.statistic == 0 else float("inf")


@dataclass(frozen=True, eq=False)
class WindowVerdict:
    """Verdict of one window."""

    experiment: int  # index of the experiment
    start: int  # first sample of the window
    stop: int  # sample after the last
    order: int | None  # estimated order, None where it cannot be
    order_note: str  # why, or why not
    excitation: float  # smallest eigenvalue of the input Gram matrix, relative to the healthy record
    rows: tuple[ZeroTest, ...]  # one test per sensor
    columns: tuple[ZeroTest, ...]  # one test per actuator
    moving: frozenset[str] = frozenset()  # sensors whose output is autocorrelated, as white noise alone is not
    least_order: int = 0  # smallest order that a healthy plant may show on this window

    @property
    def tests(self) -> tuple[ZeroTest, ...]:
        """Those of the sensors, then those of the actuators."""
        return (*self.rows, *self.columns)

    def is_changed(self, nominal: int) -> bool:
        """Whether the order is outside the range that a healthy plant of the nominal order may show."""
        return self.order is not None and not min(self.least_order, nominal) <= self.order <= nominal

    @property
    def dead(self) -> tuple[str, ...]:
        """Channels that may be dead, the likeliest first; no autocorrelated sensor where an actuator explains it."""
        actuators = [test for test in self.columns if test.zero]
        sensors = [test for test in self.rows if test.zero and not (actuators and test.name in self.moving)]
        return tuple(test.name for test in sorted([*sensors, *actuators], key=lambda test: test.ratio))

    @property
    def untestable(self) -> tuple[str, ...]:
        """Channels for which this window is not conclusive."""
        return tuple(test.name for test in self.tests if not test.testable)


@dataclass(frozen=True, eq=False)
class HardOver:
    """The test of a record."""

    windows: tuple[WindowVerdict, ...]  # verdicts in time
    nominal_order: int  # order of the healthy record
    window: int  # samples of a window
    hop: int  # samples between windows
    block_rows: int  # future block rows
    instruments: str  # "inputs" or "inputs+past"
    name: str = ""  # of the record

    @property
    def alarm(self) -> WindowVerdict | None:
        """The first window with a dead row or column, or the second in a row of an order no healthy plant shows."""
        changed = [verdict.experiment if verdict.is_changed(self.nominal_order) else None for verdict in self.windows]
        return next((verdict for verdict, now, before in zip(self.windows, changed, [None, *changed])
                     if verdict.dead or now is not None and now == before), None)

    @property
    def detected(self) -> bool:
        """Whether there is an alarm."""
        return self.alarm is not None

    @property
    def isolation(self) -> WindowVerdict | None:
        """The first window with a dead row or column; the order may have changed before it."""
        return next((verdict for verdict in self.windows if verdict.dead), None)

    @property
    def candidates(self) -> tuple[str, ...]:
        """The channels that may be dead, the likeliest first; () where only the order changed."""
        return self.isolation.dead if self.isolation is not None else ()

    @property
    def untestable(self) -> tuple[str, ...]:
        """Channels for which no window is conclusive."""
        return tuple(sorted(set.intersection(*(set(verdict.untestable) for verdict in self.windows))))

    def explain(self) -> str:
        """Return the findings in words."""
        at, isolated, dead, order = self.alarm, self.isolation, self.candidates, self.nominal_order
        if at is None:
            words = f"No alarm in {len(self.windows)} windows of {self.window} samples; nominal order {order}."
        else:
            shown = "not estimated" if at.order is None else str(at.order)
            words = (f"Alarm with the window of samples {at.start} to {at.stop - 1}: order {shown}, nominal {order}; "
                     "the failure lies within or before it. ")
            if isolated is None:
                words += "No row and no column is zero: the dynamics changed, no channel is lost entirely."
            elif len(dead) == 1:
                words += f"{dead[0]} is dead: the other channels that can be tested exceed their thresholds."
            else:
                words += f"One of {', '.join(dead)} is dead; rank alone does not say which."
            if isolated is not None and isolated is not at:
                words += f" That showed with the window of samples {isolated.start} to {isolated.stop - 1}."
        least = min((v.least_order for v in self.windows if v.order is not None), default=order)
        if least < order:
            words += f" Modes are so weak that an order of {least} may be that of a healthy plant."
        if self.untestable:
            words += f" Untestable for lack of excitation: {', '.join(self.untestable)}."
        if self.instruments == "inputs+past":
            words += " With past outputs as instruments process noise hides the loss of an actuator from the order."
        return words

    def __str__(self) -> str:
        """Print the first four channels of every window, and what was found."""
        shown = "".join(f"{short(test.name, 13):>14}" for test in self.windows[0].tests[:4])
        lines = ["statistic / threshold of each channel; up to 1 is dead, - is untestable",
                 f"{'samples':<15}{'order':>6}{shown}"]
        for verdict in self.windows:
            cells = "".join(f"{f'{t.ratio:.3g}' if t.testable else '-':>14}" for t in verdict.tests[:4])
            order = "-" if verdict.order is None else verdict.order
            lines.append(f"{f'{verdict.start}-{verdict.stop - 1}':<15}{order:>6}{cells}")
        return "\n".join([*lines, *wrap(self.explain(), 80)])


def hard_over_test(data: Data, healthy: Data, *, model: HammersteinSS | None = None, order: int | None = None,
                   window: int | None = None, hop: int | None = None, block_rows: int = BLOCK_ROWS,
                   instruments: str = "inputs", level: float = LEVEL, white_sensors: bool = True) -> HardOver:
    """Test a record for dead sensors and actuators, window by window.

    Args:
        data: the record to be judged; NaN = missing. Windows never cross from one experiment to the next.
        healthy: a record without failure: nominal order, sizes and what healthy channels show.
        model: its nonlinearities turn u into f(u), without output feedback; None takes the inputs as they are.
        order: nominal order; that of the healthy record when not given.
        window: samples of a window; at least, and by default, 20 per block row and output.
        hop: samples between windows; a quarter of a window when not given.
        block_rows: future block rows alpha, larger than order / outputs; the past has as many.
        instruments: "inputs", or "inputs+past" to see what process noise hides.
        level: probability that a dead channel is not recognised, or the true order rejected, on one window.
        white_sensors: whether the noise of the sensors is white. The sensor of an autocorrelated output is then alive,
            and the only actuator that acts on it is the dead one. False keeps both.

    Raises:
        StructureError: arguments out of range, or a model with feedback.
        DataError: records with other channels.
        RankError: a record shorter than a window, or a healthy record that does not excite the inputs.
    """
    one_of("instruments", instruments, ("inputs", "inputs+past"))
    check_integer(block_rows, "block_rows", 2)
    check_probability(level, "level")
    data, healthy = data.raw(), healthy.raw()
    if (data.inputs, data.outputs) != (healthy.inputs, healthy.outputs):
        raise DataError(f"the healthy record has channels {', '.join((*healthy.inputs, *healthy.outputs))}, the other "
                        f"{', '.join((*data.inputs, *data.outputs))}: they must be the same, in the same order.")
    least = LONG * block_rows * data.l
    window = least if window is None else window
    hop = max(window // 4, 1) if hop is None else hop
    if window < least or hop < 1:
        raise StructureError(f"window={window}, hop={hop}: a window of at least {least} samples (20 per block row and "
                             "output) and a hop of at least 1 are needed.")
    tests = _Tests(healthy, model, int(block_rows), instruments, level, order)
    found = tuple(tests.judge(record[start : start + window], (e, start, start + window))
                  for e, record in enumerate(tests.signals(data)) for start in range(0, len(record) - window + 1, hop))
    if not found:
        raise RankError(f"No experiment has the {window} samples of a window: shorten it or take fewer block rows.")
    if not white_sensors:  # an autocorrelated output tells nothing
        found = tuple(replace(verdict, moving=frozenset()) for verdict in found)
    return HardOver(found, tests.order, window, hop, tests.alpha, instruments, data.name)


class _Tests:
    """The tests of windows of 3 alpha samples of the signals [f(u) | y], compared with a healthy record."""

    def __init__(self, healthy: Data, model: HammersteinSS | None, alpha: int, instruments: str, level: float,
                 order: int | None) -> None:
        if model is not None and model.feedback:
            raise StructureError("The model feeds outputs back: this test is for plants in open loop.")
        if model is not None and (model.inputs, model.outputs) != (healthy.inputs, healthy.outputs):
            raise DataError(f"the model has channels {', '.join((*model.inputs, *model.outputs))}, the record others.")
        self.model, self.alpha, self.level = model, alpha, level
        self.input_of = range(healthy.m) if model is None else model.input_of
        self.u: Any = np.arange(len(self.input_of))
        self.y: Any = len(self.input_of) + np.arange(healthy.l)
        self.sensors = [f"sensor:{c}" for c in healthy.outputs]
        self.actuators = [f"actuator:{c}" for c in healthy.inputs]
        statistics = hankel_statistics(self.signals(healthy), 3 * alpha, centre="mean")
        statistics.check()
        at, past, future = statistics.at, range(alpha), range(alpha, 2 * alpha)
        self.inputs = at(self.u, range(2 * alpha))
        self.regression = RegressionRows(
            np.r_[0, self.inputs, at(self.y if instruments == "inputs+past" else [], past)],
            np.r_[0, at(self.u, future)], at(self.y, future))
        moments = statistics.gram / statistics.windows
        self.sizes = np.sqrt(np.maximum(np.diag(moments) - moments[0]**2, 0))
        for channel, size in zip((*(healthy.inputs[i] for i in self.input_of), *healthy.outputs), self.sizes[1:]):
            if not size > 0:
                raise RankError(f"{channel} is constant in the healthy record: use one in which every channel varies.")
        self.excited = self.excitation(statistics)
        if self.excited < 1e-10:
            raise RankError(f"the inputs of the healthy record do not excite {2 * alpha} block rows (smallest "
                            f"eigenvalue {self.excited:.1e}): use richer inputs or fewer block rows.")
        self.order = self.rank(statistics, LEVEL).order if order is None else order
        self.outputs, self.healthy = coefficients(statistics, self.regression), dict[str, Array]()
        self.healthy = {test.name: test.coefficients for tests in self.channel_tests(statistics)[:2] for test in tests}

    def signals(self, data: Data) -> list[Array]:
        return [np.hstack([e.u if self.model is None else self.model.expand_inputs(e.u), e.y])
                for e in data.experiments]

    def judge(self, record: Array, place: tuple[int, int, int]) -> WindowVerdict:
        try:
            statistics = hankel_statistics([record], 3 * self.alpha, centre="mean", method="gram")
            statistics.check()
        except RankError as error:
            rows, columns = (tuple(ZeroTest(name, healthy=0.0) for name in names)
                             for names in (self.sensors, self.actuators))
            return WindowVerdict(*place, None, str(error), float("nan"), rows, columns)
        excitation = self.excitation(statistics) / self.excited
        order, least = None, 0
        note = f"untestable: smallest eigenvalue of the inputs {excitation:.1e} of the healthy one"
        if excitation >= STILL:
            try:
                test = self.rank(statistics, self.level)
            except (RankError, np.linalg.LinAlgError) as error:  # a constant sensor is no instrument
                note = f"untestable: {error}"
            else:
                order, note = test.order, test.reason
                least = least_order(statistics, self.regression, self.outputs, test, self.order,
                                    self.sizes[self.regression.outputs])
        return WindowVerdict(*place, order, note, excitation, *self.channel_tests(statistics), least)

    def excitation(self, statistics: HankelStatistics) -> float:
        """Smallest eigenvalue of the covariance of the inputs, in units of their healthy sizes."""
        at, moments = self.inputs, statistics.gram / statistics.windows
        covariance = moments[np.ix_(at, at)] - np.outer(moments[0, at], moments[0, at])
        return max(float(np.linalg.eigvalsh(covariance / np.outer(self.sizes[at], self.sizes[at]))[0]), 0.0)

    def rank(self, statistics: HankelStatistics, level: float) -> RankTest:
        return rank_test(statistics, self.regression, rows=2 * self.alpha, level=level,
                         largest=(self.alpha - 1) * len(self.y), scale=self.sizes[self.regression.outputs])

    def channel_tests(self, statistics: HankelStatistics
                      ) -> tuple[tuple[ZeroTest, ...], tuple[ZeroTest, ...], frozenset[str]]:
        """Row tests, column tests, and the sensors whose output is autocorrelated."""
        alpha, at, rows, columns, moving = self.alpha, statistics.at, [], [], set()
        past, future, now, until = range(alpha), range(alpha, 2 * alpha), [alpha], range(alpha + 1)
        test = partial(zero_test, statistics, rows=2 * alpha, level=self.level, scale=self.sizes)
        for s, name in zip(self.y, self.sensors):
            rows.append(test(ChannelRegression(name, self.inputs, np.array([0]), at([s], future)),
                             healthy=self.healthy.get(name)))
            own = test(ChannelRegression(name, at([s], past), np.r_[0, self.inputs], at([s], now)))
            moving |= {name} if own.statistic > own.threshold else set()
        seen = [i for i, row in enumerate(rows) if not row.flat]  # a constant sensor shows no actuator
        for j, name in enumerate(self.actuators):
            if not seen:
                columns.append(ZeroTest(name, healthy=0.0))
                continue
            mine, healthy = np.equal(self.input_of, j), self.healthy[name][:, seen] if self.healthy else None
            others = np.r_[0, at(self.u[~mine], until), at(self.y, past)]
            regression = ChannelRegression(name, at(self.u[mine], until), others, at(self.y[seen], now))
            columns.append(test(regression, healthy=healthy))
        return tuple(rows), tuple(columns), frozenset(moving)


def zero_test(statistics: HankelStatistics, regression: ChannelRegression, *, rows: int, level: float,
              scale: Array | None = None, healthy: Array | None = None) -> ZeroTest:
    """Test whether the coefficients of y on t are zero, given o, from the moments of windows of `rows` + reach samples.

    t and o lie within the first `rows` block rows. The scale is that of all healthy signals, and `healthy` (t, y) are
    the coefficients of a healthy record.
    """
    _, t, o, y = regression
    j, width = statistics.windows, 1 + rows * statistics.d
    gram = statistics.gram[:width, :width] / j
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    size[y] = 1.0  # o and t are scaled to unit size, y keeps its unit
    gram = gram / np.outer(size, size)
    past = np.linalg.pinv(gram[np.ix_(o, o)], rcond=1e-13, hermitian=True) @ gram[np.ix_(o, np.append(t, y))]
    weights = np.eye(width)[:, np.append(t, y)]  # what is left of t and y after o
    weights[o] -= past
    left, on_t = weights.T @ gram @ weights, weights[:, : t.size]
    variances = np.diag(left)[t.size :]
    spread = np.maximum(np.sqrt(np.maximum(variances, 0)) if scale is None else scale[y], 1e-150)
    values, vectors = np.linalg.eigh(left[: t.size, : t.size])
    kept = values > DROPPED * t.size
    values, vectors = values[kept], vectors[:, kept]
    normal = vectors / np.sqrt(values)  # z = normal^T t
    gains = normal.T @ left[: t.size, t.size :]
    theta = normal @ gains
    covariance = (left[t.size :, t.size :] - gains.T @ gains) / np.outer(spread, spread) + QUIET**2 * np.eye(y.size)
    whitener = np.linalg.inv(np.linalg.cholesky((covariance + covariance.T) / 2)).T / spread[:, None]
    shocks, noise = on_t @ normal / size[:, None], (weights[:, t.size :] - on_t @ theta) @ whitener / size[:, None]
    e, z = lagged_covariances(statistics, rows, noise, shocks, o.size + t.size)
    found = ZeroTest(regression.name, float(np.sum((gains @ whitener) ** 2)), coefficients=theta / size[t, None])
    flat = float(np.max(variances / spread**2)) <= QUIET**2
    if not kept.any() or flat:
        expected = float("inf") if kept.any() else 0.0
        return replace(found, statistic=0.0, threshold=0.0, p_value=1.0, healthy=expected, flat=flat)
    mean, variance = moments_of_sum(e, z)
    if healthy is not None:
        gained = np.sqrt(values)[:, None] * vectors.T @ (size[t, None] * healthy) @ whitener
        found = replace(found, healthy=mean / j + float(np.sum(gained**2)))
    if mean <= 0 or variance <= 0:  # residuals are rounding: any coefficient counts
        return replace(found, threshold=0.0, p_value=float(found.statistic == 0))
    quantile, p_value = quantile_of_sum(mean, variance, level, found.statistic * j)
    return replace(found, threshold=quantile / j, p_value=p_value)


def coefficients(statistics: HankelStatistics, regression: RegressionRows) -> Array:
    """Return Pi (y, z), the regression of the outputs on the instruments."""
    size = len(regression.instruments)
    triangle = statistics.triangle(np.append(regression.instruments, regression.outputs))
    scale = np.maximum(np.linalg.norm(triangle[:size, :size], axis=0), 1e-300)
    return np.linalg.lstsq(triangle[:size, :size] / scale, triangle[:size, size:], rcond=1e-13)[0].T / scale


def least_order(statistics: HankelStatistics, regression: RegressionRows, healthy: Array, test: RankTest, order: int,
                scale: Array) -> int:
    """Return the smallest order that a healthy plant, of this order and with Pi (y, z), may show on a window.

    Its outputs are Pi times the instruments and noise, so that Pi L11 Q2 is R22 of the window without noise. An order
    is rejected only where the squares of the singular values after it exceed the threshold.
    """
    instruments, regressors, _ = regression
    triangle = statistics.triangle(instruments) / np.sqrt(statistics.windows)
    basis = np.linalg.qr(triangle[:, np.isin(instruments, regressors)], mode="complete")[0]
    expected = (healthy @ triangle.T @ basis[:, len(regressors) :]) / scale[:, None]
    squares = np.linalg.svd(expected, compute_uv=False)[:order] ** 2
    tails = np.cumsum(squares[::-1])[::-1]
    count = min(order, tails.size, test.thresholds.size)
    sure = tails[:count] > np.maximum(MARGIN * test.thresholds[:count], test.floor**2)
    return count if sure.all() else int(np.argmin(sure))
