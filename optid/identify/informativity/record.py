"""What a record can tell, put together: findings in sentences, and the reason where nothing can be identified."""

from dataclasses import dataclass, field, replace
from weakref import WeakKeyDictionary

import numpy as np

from optid.data.channels import interval_text
from optid.data.record import Data
from optid.identify.informativity.effect import Effect, effect
from optid.identify.informativity.excitation import InputExcitation, copies, excitation, hopeless
from optid.identify.informativity.feedback import TIED, Loop, loop, outside, setpoint
from optid.identify.informativity.process import Process, processes
from optid.identify.informativity.signals import RecordSignals
from optid.phrases import p_equals, plural
from optid.registry import Rendered
from optid.threads import one_thread

IRREGULAR = "the samples were taken at irregular times"
PAIRS = 16  # inputs times outputs up to which a record is examined
SAME = 0.03  # difference of a gain from one, and of two levels over the spread, below which they are equal
SHORTEST = 12  # samples of the longest experiment that are


@dataclass(frozen=True, eq=False, repr=False)
class Informativity(Rendered):
    """What a record can tell, before any model.

    Attributes:
        inputs, outputs: names of the channels.
        loops: how every input depends on the outputs.
        effects: of every input on every output, the inputs of one output together.
        excitations: how every input moves.
        processes: low-order dynamics and dead times, one per output.
        reason: why nothing can be identified from it; "" where something can.
        findings: what the user should know, one sentence each.
        untested: why nothing was examined; "" where it was.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    loops: tuple[Loop, ...] = field(default=(), repr=False)
    effects: tuple[Effect, ...] = field(default=(), repr=False)
    excitations: tuple[InputExcitation, ...] = field(default=(), repr=False)
    processes: tuple[Process, ...] = field(default=(), repr=False)
    reason: str = ""
    findings: tuple[str, ...] = ()
    untested: str = ""

    @property
    def loop(self) -> Loop:
        """The loop of the input that depends on the outputs most; open where none does."""
        rank = ("open", "closed", "regulated").index
        return max(self.loops, key=lambda one: rank(one.word), default=Loop("open"))

    @property
    def lags(self) -> tuple[int, ...]:
        """Lag of the first coefficient of every input, the earliest over the outputs on which it acts."""
        inputs = range(len(self.inputs))
        seen = [[p for p in self.processes if self.acts(c, p.output)] or self.processes for c in inputs]
        return tuple(min(p.responses[c].nk for p in seen[c]) for c in inputs)

    @property
    def least(self) -> int:
        """Smallest lag at which an input may act: 1 in a loop, where what acts at once is the controller."""
        return int(self.loop.word != "open")

    @property
    def moves(self) -> int:
        """Moves of the input that moves least."""
        return min((one.moves for one in self.excitations), default=0)

    def without_effect(self, c: int) -> bool:
        """Whether input c has no visible effect on any output."""
        return bool(self.effects) and not any(self.acts(c, name) for name in self.outputs)

    def acts(self, c: int, output: str) -> bool:
        """Whether input c has a visible effect on an output, as far as that was tested."""
        tested = [one for one in self.effects if one.input == self.inputs[c] and one.output == output]
        return all(one.visible for one in tested)


@one_thread
def informativity(data: Data) -> Informativity:
    """Examine a record, once: excitation, feedback, effects of the inputs, dead times and low-order dynamics.

    Args:
        data: the record; the first 30,000 samples of a longer one are read. At irregular times nothing but the moves
            of the inputs is examined.
    """
    data = data.raw()
    if data not in _KNOWN:
        with np.errstate(all="ignore"):
            _KNOWN[data] = _examined(data)
    return _KNOWN[data]


_KNOWN: WeakKeyDictionary[Data, Informativity] = WeakKeyDictionary()


def _examined(data: Data) -> Informativity:
    m, l = len(data.inputs), len(data.outputs)  # noqa: E741 - the field's letter
    if m * l > PAIRS:
        return _untested(data, f"{m} inputs by {l} outputs are more than {PAIRS} pairs")
    if max(e.n_samples for e in data.experiments) < SHORTEST:
        return _untested(data, f"no experiment has {SHORTEST} samples")
    signals = RecordSignals.of(data)
    if not signals.y or any(np.ptp(np.concatenate(signals.outputs(o))) == 0 for o in range(l)):
        return _untested(data, "an output does not move")
    moves = [excitation(signals.inputs(c), name) for c, name in enumerate(data.inputs)]
    if not data.is_regular:
        return replace(_untested(data, IRREGULAR), excitations=tuple(moves))
    copy = next(copies(signals, data.inputs, data.outputs), None)
    if reason := hopeless(signals, data.inputs, moves) or ("" if copy is None else copy.sentence):
        regulated = copy.input if copy is not None and copy.controller else None
        loops = tuple(Loop("regulated" if name == regulated else "open") for name in data.inputs)
        return Informativity(data.inputs, data.outputs, loops, excitations=tuple(moves), reason=reason,
                             findings=(reason,))
    found, loops = _loops(data, signals)
    least = int(any(one.word != "open" for one in loops))
    whole = Informativity(data.inputs, data.outputs, loops, (), tuple(moves), found)
    reason = _regulated(whole)
    if not reason:
        effects = tuple(effect(signals, c, o, found[o], (u, y), least) for o, y in enumerate(data.outputs)
                        for c, u in enumerate(data.inputs))
        whole = replace(whole, effects=effects)
        reason = _led(whole, signals) or _ineffective(whole)
    return replace(whole, reason=reason, findings=tuple(_findings(whole, data, reason)))


def _loops(data: Data, signals: RecordSignals) -> tuple[tuple[Process, ...], tuple[Loop, ...]]:
    """Return processes and loops: in a loop the input acts one sample later at the earliest."""
    inputs = range(len(data.inputs))
    tied = any(outside(signals, c) < TIED for c in inputs)
    found = () if tied else processes(data)
    if not tied and all(r.nk for p in found for r in p.responses):
        return found, tuple(loop(signals, c, found, data.outputs) for c in inputs)
    later = processes(data, 1, found)
    loops = tuple(loop(signals, c, later, data.outputs) for c in inputs)
    if any(one.word != "open" for one in loops):  # what acts at once is a controller
        return later, loops
    return found or processes(data), loops


def _untested(data: Data, why: str) -> Informativity:
    return Informativity(data.inputs, data.outputs, untested=why)


def _regulated(found: Informativity) -> str:
    for name, one in zip(found.inputs, found.loops):
        if one.word == "regulated":
            return (f"cannot be identified: the loop was closed and nothing moved it from outside (input {name!r} is "
                    f"the controller's answer to output {one.output!r}); move the set-point, or add a test signal to "
                    "the input")
    return ""


def _led(found: Informativity, signals: RecordSignals) -> str:
    """Say where an input is a set-point that acts through another one."""
    for c, (name, one) in enumerate(zip(found.inputs, found.loops)):
        if one.word == "closed" and (leader := setpoint(signals, c)) is not None:
            return (f"input {found.inputs[leader]!r} is the set-point: with output {one.output!r} it determines input "
                    f"{name!r}, so that the record cannot tell their effects apart; leave {found.inputs[leader]!r} out "
                    "of the inputs")
    return ""


def _ineffective(found: Informativity) -> str:
    if all(found.without_effect(c) for c in range(len(found.inputs))):
        names = ", ".join(map(repr, found.inputs))
        return (f"input{'s' * (len(found.inputs) > 1)} {names} {'have' if len(found.inputs) > 1 else 'has'} no visible "
                "effect on the output: check the column, or move the input further")
    return ""


def _findings(found: Informativity, data: Data, reason: str) -> list[str]:
    sentences = [reason] if reason else []
    for name, one in zip(found.inputs, found.loops):
        if one.word == "closed":
            seen = "by one law at most samples" if one.follows else p_equals(one.p_value, 1)
            sentences.append(
                f"closed loop: output {one.output!r} acts on input {name!r} ({seen}); use lags from 1 "
                "on and a noise model (bj.exact, armax.exact, or arx with many lags), and move the set-point")
    sentences += [one.finding for one in found.excitations if one.finding and not reason]
    if reason:
        return sentences
    for c, name in enumerate(found.inputs):
        if found.without_effect(c):
            sentences.append(f"input {name!r} has no visible effect on any output: leave it out")
    for process in found.processes:
        for c, name in enumerate(found.inputs):
            response = process.responses[c]
            if not found.acts(c, process.output):
                continue
            dead = max(response.nk - 1, 0)
            low, high = (max(lag - 1, 0) for lag in response.lag_interval)
            if dead:
                interval = f"; 95 %: {low} to {high}" if high > low else ""
                time = interval_text(dead * data.dt, data.time_unit)
                samples = plural(dead, "sample", "")
                # further poles than those found act like a dead time
                what = "dead time" if response.poles.size < 2 else "apparent dead time"
                size = f"{time} ({samples}{interval})" if data.time_unit else f"{samples}{interval}"
                sentences.append(f"{what} from {name!r} to {process.output!r}: {size}")
            if found.excitations[c].held and _follows(data, c, process, found.outputs.index(process.output)):
                sentences.append(f"output {process.output!r} settles at input {name!r}, as at the set-point of a loop: "
                                 "the model is then that of the closed loop")
            if response.integrates:
                sentences.append(f"output {process.output!r} integrates input {name!r}: it ramps while the input is "
                                 "held")
    return sentences


def _follows(data: Data, c: int, process: Process, o: int) -> bool:
    """Whether an output settles at the value of an input."""
    if not abs(process.responses[c].gain - 1) < SAME:
        return False
    raw = data.raw()
    u, y = np.concatenate([e.u[:, c] for e in raw.experiments]), np.concatenate([e.y[:, o] for e in raw.experiments])
    return bool(abs(np.nanmean(y) - np.nanmean(u)) < SAME * np.nanstd(u))
