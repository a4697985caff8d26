"""Formulations compared by their models, in words: which to use, on which data, and by how much."""

from optid.studies.verdicts.averages import Paired
from optid.studies.verdicts.choice import CANNOT_TELL, DEPENDS, FIRST, NOBODY, TIE, Choice, listed
from optid.studies.verdicts.quality import FEW, DataSet, Quality
from optid.studies.verdicts.statement import FAIR, GOOD, Statement, of, plural

UNDECIDED = "Models: cannot tell"
LISTED = 4  # data sets in a sentence


def choice_of_formulation(quality: Quality) -> Statement | None:
    """Say which formulation gives the best models, or why that cannot be told; None for a single formulation."""
    choice = quality.choice
    if len(quality.formulations) < 2 or not any(quality.solved.values()):
        return None
    if choice.kind == NOBODY:
        text = "No model has a simulation fit on samples it has not seen (keep a hold-out share) or a known truth."
        return Statement(FAIR, UNDECIDED, text, "formulation")
    if choice.kind == DEPENDS:
        text = f"No formulation is the best on all of them: {_each(quality)}."
        return Statement(FAIR, "Models depend on the data", text, "formulation")
    if not choice.first:
        return Statement(FAIR, UNDECIDED, f"The comparison {choice.missing}.", "formulation")
    if choice.kind == CANNOT_TELL:
        so_far = f"So far {_each(quality) if len(quality.sets) > 1 else f'{choice.first} has {_figure(quality)}'}"
        return Statement(FAIR, f"{UNDECIDED} yet", f"The comparison {choice.missing}. {so_far}.", "formulation")
    few = 1 < len(quality.sets) < FEW
    if choice.kind == TIE:
        each = "; ".join(f"{name} {_behind(quality, choice.against[name])}" for name in choice.tied[:3])
        text = f"{choice.first} has {_figure(quality)}. {_trifle(quality)}: {_each(quality) if few else each}"
        return Statement(GOOD, f"Equal models: {listed((choice.first, *choice.tied))}", f"{text}.", "formulation")
    rivals = [name for name in choice.candidates if name != choice.first]
    if not rivals:
        text = f"{choice.first} has {_figure(quality)}; no other has a {quality.measure.replace('_', ' ')} on half as "
        return Statement(FAIR, UNDECIDED, text + "many records.", "formulation")
    name = min(rivals, key=lambda rival: choice.against[rival].value)
    if few:
        text = f"The best, or tied for it, on each of {plural(len(quality.sets), 'data set')}: {_each(quality)}."
    else:
        text = f"It has {_figure(quality)}; the next, {name}, {_behind(quality, choice.against[name])}."
    return Statement(GOOD, f"Best models: {choice.first}", text + _exceptions(quality), "formulation")


def model_evidence(quality: Quality, name: str) -> str:
    """Say in a few words how far the models of a formulation stay behind the best, by data set where there are few."""
    if 1 < len(quality.sets) < FEW:
        said = [f"{one.name}: {_place(quality, one.choice, name, 'record')}" for one in quality.sets]
        return "; ".join(said)
    return _place(quality, quality.choice, name, quality.unit)


def _place(quality: Quality, choice: Choice, name: str, unit: str) -> str:
    """Where a formulation stands in one choice."""
    if name == choice.first:
        return {FIRST: "best", TIE: "tied for the best"}.get(choice.kind, "best so far")
    pair = choice.against.get(name)
    if pair is None or not pair.n:
        return f"no {unit} in common with the best" if choice.first else choice.missing
    tied = "tied: " if name in choice.tied and choice.kind == TIE else ""
    if quality.measure == "parameter_error":
        return f"{tied}{pair.value:.3g} × the error{_span(pair.low, pair.high, pair.n)}"
    ahead = pair.value <= -0.005
    value, low, high = (-pair.value, -pair.high, -pair.low) if ahead else (pair.value, pair.low, pair.high)
    where = "ahead where both were solved" if ahead else "behind"
    interval = f" ({_points(low)} to {_points(high)})" if pair.n > 1 else ""
    return f"{tied}{_points(value)} points{interval} {where}"


def _span(low: float, high: float, n: int) -> str:
    return f" ({low:.3g} to {high:.3g})" if n > 1 else ""


def _points(value: float) -> str:
    """Write points of fit with two decimals, zero without a sign."""
    return f"{round(value, 2) + 0.0:.2f}"


def _trifle(quality: Quality) -> str:
    return f"No difference beyond chance or {'10 %' if quality.measure == 'parameter_error' else '0.1 points'}"


def _figure(quality: Quality) -> str:
    """The mean figure of the first choice, and what it is a mean of."""
    first, several = quality.choice.first, len(quality.sets) > 1
    mean, solved = quality.figures[quality.measure][first].mean, quality.choice.solved[first]
    total = of(solved, quality.records, "record")
    where = f"{plural(len(quality.sets), 'data set')} ({total})" if several else f"{total} of {quality.sets[0].name}"
    if quality.measure == "parameter_error":
        return f"a mean parameter error of {100 * mean:.3g} % on {where}"
    return f"a mean simulation fit of {mean:.2f} % on unseen samples of {where}"


def _behind(quality: Quality, pair: Paired) -> str:
    n = plural(pair.n, quality.unit)
    if quality.measure == "parameter_error":
        return f"has {pair.value:.3g} times the error (95 %: {pair.low:.3g} to {pair.high:.3g}, {n})"
    return f"stays {_points(pair.value)} points behind (95 %: {_points(pair.low)} to {_points(pair.high)}, {n})"


def _each(quality: Quality) -> str:
    """The best on every data set, with the next."""
    said = [_one(quality, one) for one in quality.sets[:LISTED]]
    more = len(quality.sets) - LISTED
    return "; ".join(said + ([f"and {plural(more, 'data set')} more"] if more > 0 else []))


def _one(quality: Quality, one: DataSet) -> str:
    choice, records = one.choice, plural(one.records, "record")
    if not choice.first:
        return f"{one.name}: {choice.missing}"
    mean = one.figures[quality.measure][choice.first].mean
    shown = f"an error of {100 * mean:.3g} %" if quality.measure == "parameter_error" else f"a fit of {mean:.2f} %"
    rivals = [name for name in choice.candidates if name != choice.first]
    if not rivals:
        return f"on {one.name} {choice.first} alone, {shown} ({records})"
    name = min(rivals, key=lambda rival: choice.against[rival].value)
    leaders = listed((choice.first, *choice.tied)) if choice.kind == TIE else choice.first
    so_far = " so far" if choice.kind == CANNOT_TELL and quality.choice.kind != CANNOT_TELL else ""
    if choice.kind == TIE:
        return f"on {one.name} {leaders} tie, {shown} ({records})"
    return f"on {one.name} {leaders}{so_far}, {shown}, {name} {_place(quality, choice, name, 'record')} ({records})"


def _exceptions(quality: Quality) -> str:
    """Name the data sets of many on which another formulation is ahead."""
    others = [one.name for one in quality.sets if one.decided and quality.choice.first not in one.leaders]
    if len(quality.sets) < FEW or not others:
        return ""
    return f" On {listed(others)} another one is ahead."
