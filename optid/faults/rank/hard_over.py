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

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array, check_integer, check_probability, one_of
from optid.data.record import Data
from optid.errors import DataError, RankError, StructureError
from optid.faults.rank.order_power import Positions, coefficients, least_order
from optid.faults.rank.zero_tests import ZeroTest, smallest_excitation, zero_test
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
        return tuple(test.name for test in (*self.rows, *self.columns) if not test.testable)


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
        names = [test.name for test in (*self.windows[0].rows, *self.windows[0].columns)]
        lines = ["statistic / threshold of each channel; up to 1 is dead, - is untestable"]
        shown = [name if len(name) <= 13 else name[:12] + "." for name in names][:4]
        lines.append(f"{'samples':<15}{'order':>6}" + "".join(f"{name:>14}" for name in shown))
        for verdict in self.windows:
            tests = [*verdict.rows, *verdict.columns][:4]
            cells = "".join(f"{f'{t.ratio:.3g}' if t.testable else '-':>14}" for t in tests)
            order = "-" if verdict.order is None else verdict.order
            lines.append(f"{f'{verdict.start}-{verdict.stop - 1}':<15}{order:>6}{cells}")
        from textwrap import wrap

        return "\n".join([*lines, *wrap(self.explain(), 80)])


@dataclass(frozen=True, eq=False)
class _Layout:
    """Positions of the signals [f(u) | y] in windows of 3 alpha samples."""

    inputs: tuple[tuple[int, ...], ...]
    p: int
    l: int  # noqa: E741 - the field's letter
    alpha: int

    @property
    def all(self) -> range:
        return range(self.p)

    @property
    def y(self) -> range:
        return range(self.p, self.p + self.l)


@dataclass(frozen=True, eq=False)
class _Healthy:
    """What a healthy record shows: order, coefficients of all outputs, sizes, excitation, coefficients of the tests."""

    order: int
    outputs: Array
    sizes: Array
    excitation: float
    rows: tuple[Array, ...]
    columns: tuple[Array, ...]


def hard_over_test(
    data: Data,
    healthy: Data,
    *,
    model: "HammersteinSS | None" = None,
    order: int | None = None,
    window: int | None = None,
    hop: int | None = None,
    block_rows: int = BLOCK_ROWS,
    instruments: str = "inputs",
    level: float = LEVEL,
    white_sensors: bool = True,
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
    layout = _layout(data, model, int(block_rows))
    nominal = _reference(_signals(healthy, model), layout, healthy, order, instruments)
    found = []
    for e, record in enumerate(_signals(data, model)):
        for start in range(0, len(record) - window + 1, hop):
            verdict = _judged(record[start : start + window], layout, nominal, data, instruments, level,
                              (e, start, start + window))
            found.append(verdict if white_sensors else replace(verdict, moving=frozenset()))
    if not found:
        raise RankError(f"No experiment has the {window} samples of a window: shorten it or take fewer block rows.")
    return HardOver(tuple(found), nominal.order, window, hop, layout.alpha, instruments, data.name)


def _layout(data: Data, model: "HammersteinSS | None", alpha: int) -> _Layout:
    if model is None:
        return _Layout(tuple((i,) for i in range(data.m)), data.m, data.l, alpha)
    if model.feedback:
        raise StructureError("The model feeds outputs back: this test is for plants in open loop.")
    if (model.inputs, model.outputs) != (data.inputs, data.outputs):
        raise DataError(f"the model has channels {', '.join((*model.inputs, *model.outputs))}, the record others.")
    groups = tuple(tuple(c for c, i in enumerate(model.input_of) if i == j) for j in range(data.m))
    return _Layout(groups, len(model.input_of), data.l, alpha)


def _signals(data: Data, model: "HammersteinSS | None") -> Iterator[Array]:
    for e in data.experiments:
        yield np.hstack([e.u if model is None else model.expanded(e.u), e.y])


def _reference(
    records: Iterator[Array], layout: _Layout, data: Data, order: int | None, instruments: str
) -> _Healthy:
    alpha = layout.alpha
    statistics = hankel_statistics(list(records), 3 * alpha, centre="mean")
    statistics.check()
    mean = statistics.gram[0] / statistics.windows
    sizes = np.sqrt(np.maximum(np.diag(statistics.gram) / statistics.windows - mean**2, 0))
    for c, size in enumerate(sizes[1 : 1 + statistics.d]):
        if not size > 0:
            channel = (*(data.inputs[i] for i, g in enumerate(layout.inputs) for _ in g), *data.outputs)[c]
            raise RankError(f"{channel} does not move in the healthy record: take one in which every channel does.")
    every = statistics.at(layout.all, range(2 * alpha))
    excitation = smallest_excitation(statistics, every, sizes[every])
    if excitation < 1e-10:
        raise RankError(f"the inputs of the healthy record do not excite {2 * alpha} block rows (smallest eigenvalue "
                        f"{excitation:.1e}): use richer inputs or fewer block rows.")
    z, phi, y = _positions(statistics, layout, instruments)
    if order is None:
        order = _rank(statistics, z, phi, y, layout, sizes, LEVEL).order
    rows, columns, _ = _tests(statistics, layout, data, sizes, None, LEVEL)
    return _Healthy(order, coefficients(statistics, z, y), sizes, excitation, tuple(t for _, t in rows),
                    tuple(t for _, t in columns))


def _judged(
    record: Array, layout: _Layout, nominal: _Healthy, data: Data, instruments: str, level: float,
    place: tuple[int, int, int],
) -> WindowVerdict:
    alpha = layout.alpha
    names = [f"sensor:{c}" for c in data.outputs], [f"actuator:{c}" for c in data.inputs]
    nothing = [tuple(ZeroTest(name, float("nan"), float("nan"), float("nan"), 0.0) for name in kind) for kind in names]
    try:
        statistics = hankel_statistics([record], 3 * alpha, centre="mean", method="gram")
        statistics.check()
    except RankError as error:
        return WindowVerdict(*place, None, str(error), float("nan"), nothing[0], nothing[1])
    every = statistics.at(layout.all, range(2 * alpha))
    excitation = smallest_excitation(statistics, every, nominal.sizes[every]) / nominal.excitation
    rows, columns, moving = _tests(statistics, layout, data, nominal.sizes, nominal, level)
    order, least, note = None, 0, f"untestable: smallest eigenvalue of the inputs {excitation:.1e} of the healthy one"
    if excitation >= STILL:
        z, phi, y = _positions(statistics, layout, instruments)
        try:
            test = _rank(statistics, z, phi, y, layout, nominal.sizes, level)
        except RankError as error:
            note = f"untestable: {error}"
        else:
            order, note = test.order, test.reason
            least = least_order(statistics, z, phi, nominal.outputs, test, nominal.order, nominal.sizes[y])
    return WindowVerdict(*place, order, note, excitation, tuple(t for t, _ in rows), tuple(t for t, _ in columns),
                         moving, least)


def _positions(statistics: HankelStatistics, layout: _Layout, instruments: str
               ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Instruments, regressors and outputs of the order test."""
    alpha, at = layout.alpha, statistics.at
    z = [np.zeros(1, dtype=np.intp), at(layout.all, range(2 * alpha))]
    if instruments == "inputs+past":
        z.append(at(layout.y, range(alpha)))
    phi = np.concatenate([np.zeros(1, dtype=np.intp), at(layout.all, range(alpha, 2 * alpha))])
    return np.concatenate(z), phi, at(layout.y, range(alpha, 2 * alpha))


def _rank(
    statistics: HankelStatistics, z: Positions, phi: Positions, y: NDArray[np.intp], layout: _Layout, sizes: Array,
    level: float,
) -> RankTest:
    return rank_test(statistics, z, phi, y, rows=2 * layout.alpha, level=level, largest=(layout.alpha - 1) * layout.l,
                     scale=sizes[y])


def _tests(
    statistics: HankelStatistics, layout: _Layout, data: Data, sizes: Array, nominal: _Healthy | None, level: float
) -> tuple[list[tuple[ZeroTest, Array]], list[tuple[ZeroTest, Array]], frozenset[str]]:
    """Row tests, column tests, and the sensors that move by themselves."""
    alpha, at = layout.alpha, statistics.at
    past, future, now = range(alpha), range(alpha, 2 * alpha), range(alpha, alpha + 1)
    every = at(layout.all, range(2 * alpha))
    rows, columns, moving = [], [], set()
    for i, (s, channel) in enumerate(zip(layout.y, data.outputs)):
        name, y = f"sensor:{channel}", at([s], future)
        rows.append(zero_test(statistics, every, [0], y, rows=2 * alpha, level=level, name=name, scale=sizes[y],
                              coefficients=None if nominal is None else nominal.rows[i]))
        own = zero_test(statistics, at([s], past), np.concatenate([[0], every]), at([s], now), rows=2 * alpha,
                        level=level, scale=sizes[at([s], now)])[0]
        if own.statistic > own.threshold:
            moving.add(name)
    seen = [i for i, (test, _) in enumerate(rows) if not test.flat]  # flat sensors tell nothing of actuators
    y = at([layout.y[i] for i in seen], now)
    for j, (group, channel) in enumerate(zip(layout.inputs, data.inputs)):
        if not seen:
            columns.append((ZeroTest(f"actuator:{channel}", *3 * (float("nan"),), healthy=0.0), np.zeros((0, 0))))
            continue
        others = [c for c in layout.all if c not in group]
        rest = np.concatenate([[0], at(others, range(alpha + 1)), at(layout.y, past)])
        columns.append(zero_test(statistics, at(group, range(alpha + 1)), rest, y, rows=2 * alpha, level=level,
                                 name=f"actuator:{channel}", scale=sizes[y],
                                 coefficients=None if nominal is None else nominal.columns[j][:, seen]))
    return rows, columns, frozenset(moving)
