"""Constraints on gain, time constants, damping, zero and dead time of processes, in the units of the record.

They apply to `formulations.process` alone; another formulation refuses them by name. The unknowns are the logarithms of
time constants, in which bounds on them stay bounds: a price is per unit of the bound as it was written. ``channel`` is
the name of an input, ``output`` that of an output, needed where there are several.
"""

from collections.abc import Sequence

import numpy as np

from formulations.constraints.rule import Rule, check_bounds, label, record_arguments
from optid.errors import StructureError
from optid.program.limits import Limit
from optid.program.view import View

__all__ = ["K", "T", "dead_time", "overdamped", "tau", "tau_zero", "zeta"]


Pair = tuple[str | None, str | None]  # names of input and output


@record_arguments
def tau(value: float | None = None, low: float | None = None, high: float | None = None, number: float | None = None,
        channel: str | None = None, output: str | None = None) -> Rule:
    """The time constants equal ``value`` or lie in [low, high], in units of time; all, or the one of a number from 1.

    The first is the largest one: larger ones obey a lower bound as well, and smaller ones an upper bound.

    Raises:
        StructureError: no bound, crossing ones, one that is not positive, or no such number.
    """
    names = ("log tau", "log tau1", "log tau2", "log tau3")
    if number is None:
        return _bounded("tau", names, value, low, high, (channel, output))
    if number not in (1, 2, 3):
        raise StructureError(f"tau: number={number!r} must be 1, 2 or 3; the first time constant is the largest one")
    own, pair = int(number), (channel, output)
    parts = [(names[own : own + 1] + names[:1] * (own == 1), value, low, high)]
    least, most = (low, high) if value is None else (value, value)
    parts += [(names[1:own], None, least, None)] * (least is not None and own > 1)
    parts += [(names[own + 1 :], None, None, most)] * (most is not None and own < 3)
    first, *others = (_bounded("tau", *part, pair) for part in parts)

    def build(view: View) -> list[Limit]:
        limits = first.build(view)  # which refuses an input that is missing
        there = [any(view.key(name, channel) in view for name in those) for those, *_ in parts[1:]]
        return limits + [limit for rule, has in zip(others, there) if has for limit in rule.build(view)]

    return Rule(label(f"tau{own}", *pair), build)


@record_arguments
def T(value: float | None = None, low: float | None = None, high: float | None = None,  # noqa: N802
      channel: str | None = None, output: str | None = None) -> Rule:
    """The time constant of the second-order factor equals ``value`` or lies in [low, high]; errors as of `tau`."""
    return _bounded("T", ("log T",), value, low, high, (channel, output))


@record_arguments
def zeta(value: float | None = None, low: float | None = None, high: float | None = None, channel: str | None = None,
         output: str | None = None) -> Rule:
    """The damping of the second-order factor equals ``value`` or lies in [low, high]; errors as of `tau`."""
    return _bounded("zeta", ("log zeta",), value, low, high, (channel, output))


@record_arguments
def overdamped(channel: str | None = None, output: str | None = None) -> Rule:
    """The damping of the second-order factor is at least one: its poles are real."""
    return _bounded("overdamped", ("log zeta",), None, 1.0, None, (channel, output))


@record_arguments
def tau_zero(value: float | None = None, low: float | None = None, high: float | None = None,
             channel: str | None = None, output: str | None = None) -> Rule:
    """The time constant of the zero equals ``value`` or lies in [low, high]; negative with an inverse response.

    Raises:
        StructureError: no bound, or crossing ones.
    """
    return _bounded("tau_zero", ("tau_zero",), value, low, high, (channel, output))


@record_arguments
def dead_time(value: float | None = None, low: float | None = None, high: float | None = None,
              channel: str | None = None, output: str | None = None) -> Rule:
    """The dead time equals ``value`` or lies in [low, high], in units of time.

    Raises:
        StructureError: no bound, crossing ones, or a negative one.
    """
    _refuse_below("dead_time", 0.0, value, low, high)
    return _bounded("dead_time", ("dead_time",), value, low, high, (channel, output))


@record_arguments
def K(value: float | None = None, low: float | None = None, high: float | None = None,  # noqa: N802
      channel: str | None = None, output: str | None = None) -> Rule:
    """The gain equals ``value`` or lies in [low, high]; with an integrator, the slope of the output.

    Raises:
        StructureError: no bound, crossing ones, or a static curve, whose gain has the word "gain".
    """
    return _bounded("K", ("K",), value, low, high, (channel, output))


def _bounded(word: str, names: Sequence[str], value: float | None, low: float | None, high: float | None,
             pair: Pair) -> Rule:
    """Return bounds on parameters, on logarithms of positive ones; those that the process has are meant."""
    check_bounds(word, low if value is None else value, high if value is None else value)
    logarithmic = names[0].startswith("log ")
    if logarithmic:
        _refuse_below(word, np.finfo(float).tiny, value, low, high)
    bounds = {"value": value} if value is not None else {"low": low, "high": high}
    given = {kind: bound for kind, bound in bounds.items() if bound is not None}

    def build(view: View) -> list[Limit]:
        one, found = _input(view, word, names, pair), []
        entries = [view[view.key(name, one)] for name in names if view.key(name, one) in view]
        for kind, bound in given.items():
            for entry in entries:
                end, unit = (np.log(bound), 1 / bound) if logarithmic else (bound, 1.0)
                member = entry == end if kind == "value" else entry >= end if kind == "low" else entry <= end
                found.append(Limit(member, unit, kind))
        return found

    return Rule(label(word, *pair), build)


def _input(view: View, word: str, names: Sequence[str], pair: Pair) -> str | None:
    """Return the input that is meant; refuse other formulations, and processes without such a parameter."""
    if not any(name.startswith("dynamics") for name in view):
        raise StructureError(f"constraint {word!r} is about a process in continuous time: use the formulation "
                             "'process.exact'; elsewhere 'stable', 'damped' or 'strip' restrict the poles")
    channel, output = pair
    one = None if len(view.channels) == 1 and channel is None else view.channel(channel)
    if output is not None:
        view.output(output)
    if not any(view.key(name, one) in view for name in names):
        plain = names[0].removeprefix("log ")
        remedy = {"K": "the static curve has the word 'gain'", "dead_time": "choose a type with D, such as 'P1D'",
                  "zeta": "choose a type with U, such as 'P2DU'"}.get(plain, "choose another type of process")
        raise StructureError(f"constraint {word!r}: this process has no {plain}; {remedy}")
    return one


def _refuse_below(word: str, least: float, *bounds: float | None) -> None:
    wrong = [bound for bound in bounds if bound is not None and not bound >= least]
    if wrong:
        raise StructureError(f"{word} needs {'positive bounds' if least else 'bounds that are not negative'}; got "
                             f"{wrong[0]:g}")
