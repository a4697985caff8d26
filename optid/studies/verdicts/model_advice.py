"""Formulations compared by their models, in words: which to use, on which data, and by how much."""

from optid.studies.verdicts.averages import Paired
from optid.studies.verdicts.choice import CANNOT_TELL, DEPENDS, FIRST, NOBODY, TIE, Choice
from optid.studies.verdicts.quality import FEW, DataSet, Quality
from optid.studies.verdicts.statement import FAIR, GOOD, Statement, listed, of, plural

UNDECIDED = "Models: cannot tell"
LISTED = 4  # data sets in a sentence


def choice_of_formulation(quality: Quality) -> Statement | None:
    """Say which formulation gives the best models, or why that cannot be told; None for a single formulation."""
    choice, sets = quality.choice, len(quality.sets)
    if len(quality.formulations) < 2 or not any(quality.solved.values()):
        return None
    rivals = [name for name in choice.candidates if name != choice.first]
    tone, word = FAIR, UNDECIDED
    if choice.kind == NOBODY:
        text = "No model has a simulation fit on samples it has not seen (keep a hold-out share) or a known truth."
    elif choice.kind == DEPENDS:
        word, text = "Models depend on the data", f"No formulation is the best on all of them: {_each(quality)}."
    elif not choice.first:
        text = f"The comparison {choice.missing}."
    elif choice.kind == CANNOT_TELL:
        so_far = _each(quality) if sets > 1 else f"{choice.first} has {_figure(quality)}"
        word, text = f"{UNDECIDED} yet", f"The comparison {choice.missing}. So far {so_far}."
    elif choice.kind == TIE:
        each = "; ".join(f"{name} {_behind(quality, choice.against[name])}" for name in choice.tied[:3])
        trifle = f"No difference beyond chance or {'10 %' if quality.errors else '0.1 points'}"
        text = f"{choice.first} has {_figure(quality)}. {trifle}: {_each(quality) if 1 < sets < FEW else each}."
        tone, word = GOOD, f"Equal models: {listed(choice.leaders)}"
    elif not rivals:
        text = f"{choice.first} has {_figure(quality)}; no other has a {quality.measure.replace('_', ' ')} on half as "
        text += "many records."
    else:
        tone, word = GOOD, f"Best models: {choice.first}"
        name = min(rivals, key=lambda rival: choice.against[rival].value)
        text = f"It has {_figure(quality)}; the next, {name}, {_behind(quality, choice.against[name])}."
        if 1 < sets < FEW:
            text = f"The best, or tied for it, on each of {plural(sets, 'data set')}: {_each(quality)}."
        others = [one.name for one in quality.sets if one.decided and choice.first not in one.choice.leaders]
        if sets >= FEW and others:
            text += f" On {listed(others)} another one is ahead."
    return Statement(tone, word, text, "formulation")


def model_evidence(quality: Quality, name: str) -> str:
    """Say in a few words how far the models of a formulation stay behind the best, by data set where there are few."""
    if 1 < len(quality.sets) < FEW:
        return "; ".join(f"{one.name}: {_place(quality, one.choice, name, 'record')}" for one in quality.sets)
    return _place(quality, quality.choice, name, quality.unit)


def _place(quality: Quality, choice: Choice, name: str, unit: str) -> str:
    """Where a formulation stands in one choice."""
    if name == choice.first:
        return {FIRST: "best", TIE: "tied for the best"}.get(choice.kind, "best so far")
    pair = choice.against.get(name)
    if pair is None or not pair.n:
        return f"no {unit} in common with the best" if choice.first else choice.missing
    tied = "tied: " if name in choice.tied and choice.kind == TIE else ""
    if quality.errors:
        span = f" ({pair.low:.3g} to {pair.high:.3g})" if pair.n > 1 else ""
        return f"{tied}{pair.value:.3g} × the error{span}"
    ahead = pair.value <= -0.005
    value, low, high = (-pair.value, -pair.high, -pair.low) if ahead else (pair.value, pair.low, pair.high)
    interval = f" ({_points(low)} to {_points(high)})" if pair.n > 1 else ""
    return f"{tied}{_points(value)} points{interval} {'ahead where both were solved' if ahead else 'behind'}"


def _points(value: float) -> str:
    """Write points of fit with two decimals, zero without a sign."""
    return f"{round(value, 2) + 0.0:.2f}"


def _figure(quality: Quality) -> str:
    """The mean figure of the first choice, and what it is a mean of."""
    first, several = quality.choice.first, len(quality.sets) > 1
    mean, total = quality.figures[quality.measure][first], of(quality.choice.solved[first], quality.records, "record")
    where = f"{plural(len(quality.sets), 'data set')} ({total})" if several else f"{total} of {quality.sets[0].name}"
    if quality.errors:
        return f"a mean parameter error of {100 * mean:.3g} % on {where}"
    return f"a mean simulation fit of {mean:.2f} % on unseen samples of {where}"


def _behind(quality: Quality, pair: Paired) -> str:
    n = plural(pair.n, quality.unit)
    if quality.errors:
        return f"has {pair.value:.3g} times the error (95 %: {pair.low:.3g} to {pair.high:.3g}, {n})"
    return f"stays {_points(pair.value)} points behind (95 %: {_points(pair.low)} to {_points(pair.high)}, {n})"


def _each(quality: Quality) -> str:
    """The best on every data set, with the next."""
    more = len(quality.sets) - LISTED
    said = [_one(quality, one) for one in quality.sets[:LISTED]]
    return "; ".join(said + ([f"and {plural(more, 'data set')} more"] if more > 0 else []))


def _one(quality: Quality, one: DataSet) -> str:
    choice, records = one.choice, plural(one.records, "record")
    if not choice.first:
        return f"{one.name}: {choice.missing}"
    mean = one.figures[quality.measure][choice.first]
    shown = f"an error of {100 * mean:.3g} %" if quality.errors else f"a fit of {mean:.2f} %"
    rivals = [name for name in choice.candidates if name != choice.first]
    if not rivals:
        return f"on {one.name} {choice.first} alone, {shown} ({records})"
    if choice.kind == TIE:
        return f"on {one.name} {listed(choice.leaders)} tie, {shown} ({records})"
    name = min(rivals, key=lambda rival: choice.against[rival].value)
    so_far = " so far" if choice.kind == CANNOT_TELL and quality.choice.kind != CANNOT_TELL else ""
    place = _place(quality, choice, name, "record")
    return f"on {one.name} {choice.first}{so_far}, {shown}, {name} {place} ({records})"
