"""How much every input excites: moves, levels and sinusoids, and inputs from which nothing can be learned.

n sinusoids determine 2 n numbers of a linear response. One move from rest determines a gain, time constants and a dead
time, four numbers; what a record holds beyond that is noise.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.identify.design.rules import LONGEST, Check, many_lines, remaining_shares
from optid.identify.informativity.signals import RecordSignals, beginning, hold_last
from optid.phrases import plural

ONE_MOVE = 4  # numbers that one move determines
MOST_LINES, LINES = 3, 1e-4  # sinusoids that are looked for; share of the variance that they must leave at most
TOGETHER = 1e-8  # share of an input's energy that another leaves, below which they move together
COPY = 1e-8  # the same for an output, earlier or later
SAME = 0.01  # difference from one of the factor of a copied column
AFTER = 3  # samples that must follow the first move


@dataclass(frozen=True)
class InputExcitation:
    """How an input moves.

    Attributes:
        input: its name.
        moves: samples at which it changes, all experiments together.
        held: whether it is held at most samples.
        lines: sinusoids that it consists of; None where they are many.
        ramp: whether it rises evenly with time.
    """

    input: str
    moves: int
    held: bool
    lines: int | None
    ramp: bool

    @property
    def numbers(self) -> int | None:
        """How many numbers of a linear response it determines; None for many."""
        if self.moves <= 1:
            return ONE_MOVE if self.moves else 0
        return None if self.lines is None else 2 * self.lines

    @property
    def finding(self) -> str:
        """What it determines, where that is little; else ""."""
        if self.moves == 1:
            return (f"input {self.input!r} moves once: a step determines gain, time constants and dead time, "
                    f"{ONE_MOVE} numbers and no static curve")
        if self.lines is not None:
            waves = "is a sinusoid" if self.lines == 1 else f"consists of {self.lines} sinusoids"
            return f"input {self.input!r} {waves}: it determines {self.numbers} numbers of a linear response"
        return ""


def excitation(records: Sequence[Array], name: str) -> InputExcitation:
    """Describe how an input (T,) per experiment moves."""
    moves = sum(int(np.count_nonzero(np.diff(u))) for u in records)
    moving = [(u - u.mean()) / np.ptp(u) for u in records if np.ptp(u) > 0]  # in any unit, at any level
    lines = _lines(max(moving, key=len)[:LONGEST]) if moving else None
    ramp = moves > 1 and len(moving) == len(records) and all(map(_even, moving))
    return InputExcitation(name, moves, 2 * moves < sum(map(len, records)), lines, ramp)


def _lines(x: Array) -> int | None:
    if x.size < 8 * MOST_LINES or many_lines(x, MOST_LINES, LINES):
        return None
    shares = remaining_shares(x[:, None], MOST_LINES, LINES)
    periods_seen = np.mean(np.diff(np.sign(x - x.mean())) != 0) * x.size >= 4
    return int(shares.size - 1) if shares[-1] <= LINES and periods_seen else None


def _even(x: Array) -> bool:
    """Whether samples (T,) about their mean follow a straight line."""
    k = np.arange(len(x)) - (len(x) - 1) / 2
    rest = x - k * (k @ x) / max(float(k @ k), 1.0)
    return len(x) > 2 and bool(rest @ rest <= 1e-8 * float(x @ x))


def check_numbers(data: Data, arguments: Mapping[str, Any]) -> Check | None:
    """Compare the coefficients of a linear model with the numbers that the inputs determine; None for other models.

    The check is fine where an input determines many.
    """
    inputs = data.inputs
    na, nb, nx = (arguments.get(name) for name in ("na", "nb", "nx"))
    given = [nb] * len(inputs) if isinstance(nb, int) else nb if isinstance(nb, list | tuple) else []
    each = [b for b in given if isinstance(b, int)]
    if isinstance(na, int) and na > 0 and len(given) == len(each) == len(inputs):
        asked, words = na + sum(each), f"na {na} and nb {' '.join(map(str, each))}"
    elif isinstance(nx, int):
        asked, words = nx * (1 + len(inputs)), f"nx {nx}"
    else:
        return None
    u, found, most = [hold_last(e.u) for e in beginning(data)], [], 0
    enough = Check("numbers", np.inf, "fine", "the inputs determine more numbers than the model has")
    for c, name in enumerate(inputs):
        found.append(excitation([samples[:, c] for samples in u], name))
        if found[-1].numbers is None or (most := most + found[-1].numbers) >= asked:
            return enough
    if not most:
        return enough
    return Check("numbers", float(most), "error",
                 f"{'; '.join(one.finding for one in found)}. {words} ask for {asked}: use lower orders, or move the "
                 "input more often")


def hopeless(signals: RecordSignals, inputs: tuple[str, ...], found: list[InputExcitation]) -> str:
    """Return why nothing can be learned from an input, however the outputs answer, "" where something can."""
    for c, one in enumerate(found):
        if not one.moves:
            return f"input {one.input!r} does not move"
        if one.ramp:
            return (f"input {one.input!r} rises evenly with time, as a clock does: its effect cannot be distinguished "
                    "from a drift of the output")
        left = max((len(u) - 1 - int(np.flatnonzero(np.diff(u))[0]) for u in signals.inputs(c) if np.ptp(u)), default=0)
        if left <= AFTER:
            return (f"input {one.input!r} moves for the first time {plural(left, 'sample', '')} before the end: its "
                    "effect is not in the record")
    for first, second in combinations(range(len(inputs)), 2):
        x, y = (np.concatenate(signals.inputs(c)) for c in (first, second))
        if 1 - (x @ y) ** 2 / max(float((x @ x) * (y @ y)), 1e-300) < TOGETHER:
            ratio = float(x @ y) / float(x @ x) * signals.u_scale[second] / signals.u_scale[first]
            return (f"inputs {inputs[first]!r} and {inputs[second]!r} always move together (the second is {ratio:.4g} "
                    "times the first, but for a constant): the record determines the sum of their effects; leave one "
                    "out")
    return ""


@dataclass(frozen=True)
class Copy:
    """An input that is an output some samples earlier or later, but for a factor and a constant."""

    input: str
    output: str
    late: int
    factor: float

    @property
    def controller(self) -> bool:
        """Whether it may be the answer of a proportional controller, and is no copied column."""
        return self.late >= 0 and abs(self.factor - 1) > SAME

    @property
    def sentence(self) -> str:
        """What it is, and what to do."""
        samples = f"{plural(abs(self.late), 'sample', '')} "
        when = f"{samples}later" if self.late > 0 else f"{samples}before" if self.late else "the same sample"
        if self.controller:
            return (f"cannot be identified: input {self.input!r} is {self.factor:.4g} times output {self.output!r} but "
                    f"for a constant, {when}, as behind a proportional controller at constant set-point, and nothing "
                    "else moved it; move the set-point, or choose the column of the actuator")
        return (f"input {self.input!r} is output {self.output!r}, {when}: it says nothing about a plant; choose the "
                "column of the actuator")


def copies(signals: RecordSignals, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Iterator[Copy]:
    """Yield the inputs that are outputs."""
    for (c, name), (o, output) in product(enumerate(inputs), enumerate(outputs)):
        if (found := _copied(signals, c, o)) is not None:
            late, factor = found
            yield Copy(name, output, late, factor * float(signals.u_scale[c] / signals.y_scale[o]))


def _copied(signals: RecordSignals, c: int, o: int) -> tuple[int, float] | None:
    """Return how many samples after output o an equal input c comes, and its factor; None where it does not."""
    i = int(np.argmax([len(u) for u in signals.u]))
    u, y = signals.u[i][:, c], signals.y[i][:, o]
    n, half = 2 * len(u), len(u) // 2
    du, dy = np.sign(np.diff(u)), np.sign(np.diff(y))  # a jump at the end of a column that was shifted counts little
    correlation = np.abs(np.fft.irfft(np.fft.rfft(du, n) * np.conj(np.fft.rfft(dy, n)), n))
    late = int(np.argmax(np.concatenate([correlation[-half:], correlation[: half + 1]]))) - half
    a, b = u[max(late, 0) : len(u) + min(late, 0)], y[max(-late, 0) : len(y) - max(late, 0)]
    a, b = a - a.mean(), b - b.mean()
    rest = 1 - (a @ b) ** 2 / max(float((a @ a) * (b @ b)), 1e-300)
    return (late, float(a @ b) / float(b @ b)) if rest < COPY else None
