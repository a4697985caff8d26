"""Complete loss of a sensor or an actuator by rank deficiency (dissertation, chapter 7): sliding windows, three tests.

Order: the number of states that the instruments show changes. It drops only where the lost channel was the only access
to some mode, and an actuator's loss is hidden by past outputs among the instruments as soon as there is process noise:
process noise then reaches the same modes. Hence past and future inputs alone are the instruments by default.
Rows: the outputs of a dead sensor depend on no input. Columns: no output depends on the input of a dead actuator, given
past outputs and the other inputs. Both work on every plant.
A mode too weak to be seen on a window is no failure: behind every smaller order stands what a healthy plant would show.
A window that straddles the failure sees an average of both plants and keeps the nominal rank, and its rows and columns
are not zero: the alarm comes about one window after the failure. Meant as confirmation beside faster detectors.

Nothing is said where the inputs do not move: behind every verdict stands what a healthy channel would have shown on the
same window. Open loop is assumed: under feedback inputs depend on sensor noise, and rows of dead sensors are not zero.
"""

from dataclasses import dataclass, replace
from textwrap import wrap
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array, check_integer, check_probability, one_of
from optid.data.record import Data
from optid.errors import DataError, RankError, StructureError
from optid.faults.rank.window_tests import ZeroTest, coefficients, least_order, smallest_excitation, zero_test
from optid.identify.order.ranks import RankTest, rank_test
from optid.statistics.hankel import HankelStatistics, hankel_statistics

if TYPE_CHECKING:
    from optid.models.hammerstein_ss import HammersteinSS

INSTRUMENTS = ("inputs", "inputs+past")
BLOCK_ROWS = 6
LONG = 20
"""Windows have at least this many samples per future row of outputs."""

LEVEL = 1e-3
"""Probability that the row or column of a dead channel is not recognised, or a true order rejected, on one window."""

STILL = 0.1
"""Smallest excitation, relative to the healthy record, below which no order is estimated."""


@dataclass(frozen=True, eq=False)
class WindowVerdict:
    """What one window says.

    Attributes:
        experiment: index of the experiment.
        start: first sample of the window.
        stop: sample after the last.
        order: estimated order, None where it cannot be.
        order_note: why, or why not.
        excitation: smallest eigenvalue of the input Gram matrix, relative to the healthy record.
        rows: one test per sensor.
        columns: one test per actuator.
        moving: sensors whose output has a memory that white sensor noise has not; a dead sensor has none.
        least_order: order that a healthy plant would show at least on this window; a weak mode may go unseen.
    """

    experiment: int
    start: int
    stop: int
    order: int | None
    order_note: str
    excitation: float
    rows: tuple[ZeroTest, ...]
    columns: tuple[ZeroTest, ...]
    moving: frozenset[str] = frozenset()
    least_order: int = 0

    @property
    def tests(self) -> tuple[ZeroTest, ...]:
        """Those of the sensors, then those of the actuators."""
        return (*self.rows, *self.columns)

    def changed(self, nominal: int) -> bool:
        """Whether the order is another one than a healthy plant of the nominal order would show."""
        return self.order is not None and not min(self.least_order, nominal) <= self.order <= nominal

    @property
    def dead(self) -> tuple[str, ...]:
        """Channels that may be dead, the likeliest first.

        Where a dead actuator would explain it too, a sensor that still moves by itself is not among them.
        """
        actuators = [test for test in self.columns if test.zero]
        sensors = [test for test in self.rows if test.zero and not (actuators and test.name in self.moving)]
        found = [*sensors, *actuators]
        return tuple(test.name for test in sorted(found, key=lambda test: test.ratio))

    @property
    def untestable(self) -> tuple[str, ...]:
        """Channels of which this window can say nothing."""
        return tuple(test.name for test in self.tests if not test.testable)


@dataclass(frozen=True, eq=False)
class HardOver:
    """The test of a record.

    Attributes:
        windows: verdicts in time.
        nominal_order: order of the healthy record.
        window: samples of a window.
        hop: samples between windows.
        block_rows: future block rows.
        instruments: "inputs" or "inputs+past".
        name: of the record.
    """

    windows: tuple[WindowVerdict, ...]
    nominal_order: int
    window: int
    hop: int
    block_rows: int
    instruments: str
    name: str = ""

    @property
    def alarm(self) -> WindowVerdict | None:
        """The first window with a dead row or column, or the second in a row of an order no healthy plant shows."""
        before = None
        for verdict in self.windows:
            changed = verdict.changed(self.nominal_order)
            if verdict.dead or changed and before == verdict.experiment:
                return verdict
            before = verdict.experiment if changed else None
        return None

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
        """Channels of which no window can say anything."""
        found = [set(verdict.untestable) for verdict in self.windows]
        return tuple(sorted(set.intersection(*found))) if found else ()

    def explain(self) -> str:
        """Say in words what was found."""
        if self.alarm is None:
            words = f"No alarm in {len(self.windows)} windows of {self.window} samples; nominal order "
            words += f"{self.nominal_order}."
        else:
            at, isolated, dead = self.alarm, self.isolation, self.candidates
            order = "not estimated" if at.order is None else str(at.order)
            words = (f"Alarm with the window of samples {at.start} to {at.stop - 1}: order {order}, nominal "
                     f"{self.nominal_order}; the failure lies within or before it. ")
            if isolated is None:
                words += "No row and no column is zero: the dynamics changed, no channel is lost entirely."
            elif len(dead) == 1:
                words += f"{dead[0]} is dead: the other channels that can be tested exceed their thresholds."
            else:
                words += f"One of {', '.join(dead)} is dead; rank alone does not say which."
            if isolated is not None and isolated is not at:
                words += f" That showed with the window of samples {isolated.start} to {isolated.stop - 1}."
        least = min((v.least_order for v in self.windows if v.order is not None), default=self.nominal_order)
        if least < self.nominal_order:
            words += f" Modes are so weak that an order of {least} may be that of a healthy plant."
        if self.untestable:
            words += f" Untestable for lack of excitation: {', '.join(self.untestable)}."
        if self.instruments == "inputs+past":
            words += " With past outputs as instruments process noise hides the loss of an actuator from the order."
        return words

    def __str__(self) -> str:
        """Print the first four channels of every window, and what was found."""
        names = [test.name for test in self.windows[0].tests[:4]]
        shown = "".join(f"{name if len(name) <= 13 else name[:12] + '.':>14}" for name in names)
        lines = ["statistic / threshold of each channel; up to 1 is dead, - is untestable",
                 f"{'samples':<15}{'order':>6}{shown}"]
        for verdict in self.windows:
            cells = "".join(f"{f'{t.ratio:.3g}' if t.testable else '-':>14}" for t in verdict.tests[:4])
            order = "-" if verdict.order is None else verdict.order
            lines.append(f"{f'{verdict.start}-{verdict.stop - 1}':<15}{order:>6}{cells}")
        return "\n".join([*lines, *wrap(self.explain(), 80)])


class _Healthy(NamedTuple):
    """What a healthy record shows: order, coefficients of all outputs, sizes, excitation, coefficients of the tests."""

    order: int
    outputs: Array
    sizes: Array
    excitation: float
    rows: tuple[Array, ...]
    columns: tuple[Array, ...]


def hard_over_test(
    data: Data, healthy: Data, *, model: "HammersteinSS | None" = None, order: int | None = None,
    window: int | None = None, hop: int | None = None, block_rows: int = BLOCK_ROWS, instruments: str = "inputs",
    level: float = LEVEL, white_sensors: bool = True,
) -> HardOver:
    """Test a record for dead sensors and actuators, window by window.

    Args:
        data: the record to be judged; NaN = missing. Windows never cross from one experiment to the next.
        healthy: a record without failure: nominal order, sizes and what healthy channels show.
        model: its input nonlinearities turn u into f(u); None takes the inputs as they are. No output feedback.
        order: nominal order; that of the healthy record when not given.
        window: samples of a window; at least, and by default, 20 per block row and output.
        hop: samples between windows; a quarter of a window when not given.
        block_rows: future block rows alpha, larger than order / outputs; the past has as many.
        instruments: "inputs", or "inputs+past" to see what process noise hides.
        level: probability that a dead channel is not recognised, or the true order rejected, on one window.
        white_sensors: whether the noise of the sensors is white: an output with a memory then still sees the plant, and
            where its sensor or the only actuator that it shows may be dead, it is the actuator. False keeps both.

    Raises:
        StructureError: arguments out of range, or a model with feedback.
        DataError: records with other channels.
        RankError: a record shorter than a window, or a healthy record that does not excite the inputs.
    """
    one_of("instruments", instruments, INSTRUMENTS)
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
    tests = _Tests(data, model, int(block_rows), instruments, level)
    nominal, found = tests.reference(healthy, order), []
    for e, record in enumerate(tests.signals(data)):
        for start in range(0, len(record) - window + 1, hop):
            verdict = tests.judge(record[start : start + window], nominal, (e, start, start + window))
            found.append(verdict if white_sensors else replace(verdict, moving=frozenset()))
    if not found:
        raise RankError(f"No experiment has the {window} samples of a window: shorten it or take fewer block rows.")
    return HardOver(tuple(found), nominal.order, window, hop, tests.alpha, instruments, data.name)


class _Tests:
    """The tests of windows of 3 alpha samples of the signals [f(u) | y], and their positions among them."""

    def __init__(self, data: Data, model: "HammersteinSS | None", alpha: int, instruments: str, level: float) -> None:
        if model is not None and model.feedback:
            raise StructureError("The model feeds outputs back: this test is for plants in open loop.")
        if model is not None and (model.inputs, model.outputs) != (data.inputs, data.outputs):
            raise DataError(f"the model has channels {', '.join((*model.inputs, *model.outputs))}, the record others.")
        self.model, self.alpha, self.instruments, self.level = model, alpha, instruments, level
        self.input_of = range(data.m) if model is None else model.input_of
        self.u = range(len(self.input_of))
        self.y = range(len(self.u), len(self.u) + data.l)
        self.channels = (*(data.inputs[i] for i in self.input_of), *data.outputs)
        self.sensors, self.actuators = ([f"{place}:{c}" for c in names] for place, names in
                                        (("sensor", data.outputs), ("actuator", data.inputs)))

    def signals(self, data: Data) -> list[Array]:
        return [np.hstack([e.u if self.model is None else self.model.expanded(e.u), e.y]) for e in data.experiments]

    def reference(self, healthy: Data, order: int | None) -> _Healthy:
        statistics = hankel_statistics(self.signals(healthy), 3 * self.alpha, centre="mean")
        statistics.check()
        mean = statistics.gram[0] / statistics.windows
        sizes = np.sqrt(np.maximum(np.diag(statistics.gram) / statistics.windows - mean**2, 0))
        for channel, size in zip(self.channels, sizes[1:]):
            if not size > 0:
                raise RankError(f"{channel} does not move in the healthy record: take one in which every channel does.")
        excitation = self.excitation(statistics, sizes)
        if excitation < 1e-10:
            raise RankError(f"the inputs of the healthy record do not excite {2 * self.alpha} block rows (smallest "
                            f"eigenvalue {excitation:.1e}): use richer inputs or fewer block rows.")
        z, _, y = self.positions(statistics)
        if order is None:
            order = self.rank(statistics, sizes, LEVEL).order
        rows, columns, _ = self.channel_tests(statistics, sizes, None, LEVEL)
        theta = (tuple(coefficients for _, coefficients in part) for part in (rows, columns))
        return _Healthy(order, coefficients(statistics, z, y), sizes, excitation, *theta)

    def judge(self, record: Array, nominal: _Healthy, place: tuple[int, int, int]) -> WindowVerdict:
        try:
            statistics = hankel_statistics([record], 3 * self.alpha, centre="mean", method="gram")
            statistics.check()
        except RankError as error:
            rows, columns = (tuple(ZeroTest(name, *3 * (np.nan,), healthy=0.0) for name in names)
                             for names in (self.sensors, self.actuators))
            return WindowVerdict(*place, None, str(error), float("nan"), rows, columns)
        excitation = self.excitation(statistics, nominal.sizes) / nominal.excitation
        rows, columns, moving = self.channel_tests(statistics, nominal.sizes, nominal, self.level)
        order, least = None, 0
        note = f"untestable: smallest eigenvalue of the inputs {excitation:.1e} of the healthy one"
        if excitation >= STILL:
            z, phi, y = self.positions(statistics)
            try:
                test = self.rank(statistics, nominal.sizes, self.level)
            except RankError as error:
                note = f"untestable: {error}"
            else:
                order, note = test.order, test.reason
                least = least_order(statistics, z, phi, nominal.outputs, test, nominal.order, nominal.sizes[y])
        return WindowVerdict(*place, order, note, excitation, tuple(t for t, _ in rows), tuple(t for t, _ in columns),
                             moving, least)

    def excitation(self, statistics: HankelStatistics, sizes: Array) -> float:
        every = statistics.at(self.u, range(2 * self.alpha))
        return smallest_excitation(statistics, every, sizes[every])

    def positions(self, statistics: HankelStatistics) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Instruments, regressors and outputs of the order test."""
        at, past, future = statistics.at, range(self.alpha), range(self.alpha, 2 * self.alpha)
        z = np.r_[0, at(self.u, range(2 * self.alpha)), at(self.y if self.instruments == "inputs+past" else [], past)]
        return z, np.r_[0, at(self.u, future)], at(self.y, future)

    def rank(self, statistics: HankelStatistics, sizes: Array, level: float) -> RankTest:
        z, phi, y = self.positions(statistics)
        return rank_test(statistics, z, phi, y, rows=2 * self.alpha, level=level,
                         largest=(self.alpha - 1) * len(self.y), scale=sizes[y])

    def channel_tests(
        self, statistics: HankelStatistics, sizes: Array, nominal: _Healthy | None, level: float
    ) -> tuple[list[tuple[ZeroTest, Array]], list[tuple[ZeroTest, Array]], frozenset[str]]:
        """Row tests, column tests, and the sensors that move by themselves."""
        alpha, at, rows, columns, moving = self.alpha, statistics.at, [], [], set()
        past, future, now, until = range(alpha), range(alpha, 2 * alpha), [alpha], range(alpha + 1)

        def test(tested: NDArray[np.intp], others: NDArray[np.intp], y: NDArray[np.intp], name: str,
                 theta: Array | None) -> tuple[ZeroTest, Array]:
            return zero_test(statistics, tested, others, y, rows=2 * alpha, level=level, name=name, scale=sizes[y],
                             coefficients=theta)

        every = at(self.u, range(2 * alpha))
        for i, (s, name) in enumerate(zip(self.y, self.sensors)):
            rows.append(test(every, np.zeros(1, dtype=np.intp), at([s], future), name,
                             None if nominal is None else nominal.rows[i]))
            own, _ = test(at([s], past), np.r_[0, every], at([s], now), name, None)
            if own.statistic > own.threshold:
                moving.add(name)
        seen = [i for i, (row, _) in enumerate(rows) if not row.flat]  # flat sensors tell nothing of actuators
        for j, name in enumerate(self.actuators):
            if not seen:
                columns.append((ZeroTest(name, *3 * (np.nan,), healthy=0.0), np.zeros((0, 0))))
                continue
            group, others = ([c for c in self.u if (self.input_of[c] == j) == own] for own in (True, False))
            columns.append(test(at(group, until), np.r_[0, at(others, until), at(self.y, past)],
                                at([self.y[i] for i in seen], now), name,
                                None if nominal is None else nominal.columns[j][:, seen]))
        return rows, columns, frozenset(moving)
