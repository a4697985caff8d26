"""The comparison of formulations by their models, in words."""

from optid.phrases import plural
from optid.studies.verdicts.averages import Paired
from optid.studies.verdicts.choice import CANNOT_TELL, DEPENDS, FIRST, NOBODY, TIE, Choice
from optid.studies.verdicts.quality import FEW, DataSet, Quality
from optid.studies.verdicts.statement import FAIR, GOOD, NO_DIFFERENCE, Statement, listed, of

UNDECIDED = "Models: cannot tell"
LISTED = 4  # data sets in a sentence


def choice_of_formulation(quality: Quality) -> Statement | None:
    """Recommend the formulation with the best models, or say why none is recommended; None for a single formulation."""
    choice, sets = quality.choice, len(quality.sets)
    if len(quality.formulations) < 2 or not any(quality.solved.values()):
        return None
    if choice.kind == NOBODY:
        text = "No model has a simulation fit on samples it has not seen (keep a hold-out share) or a known truth."
        return Statement(FAIR, UNDECIDED, text, "formulation")
    if choice.kind == DEPENDS:
        text = f"No formulation is the best on all of them: {_each(quality)}."
        return Statement(FAIR, "Models depend on the data", text, "formulation")
    if not choice.first:
        return Statement(FAIR, UNDECIDED, choice.shortfall, "formulation")
    if choice.kind == CANNOT_TELL:
        so_far = _each(quality) if sets > 1 else f"{choice.first} has {_figure(quality)}"
        return Statement(FAIR, f"{UNDECIDED} yet", f"{choice.shortfall} So far {so_far}.", "formulation")
    text, tone = f"{choice.first} has {_figure(quality)}", GOOD
    word = f"{'Equal' if choice.kind == TIE else 'Best'} models: {listed(choice.leaders)}"
    rivals = [name for name in choice.candidates if name != choice.first]
    if not rivals:
        tone, word = FAIR, UNDECIDED
        text += f"; no other has a {quality.measure.replace('_', ' ')} on half as many records."
    elif 1 < sets < FEW:
        text += f". The best, or tied for it, on each of {plural(sets, 'data set')}: {_each(quality)}."
    elif choice.kind == TIE:
        each = "; ".join(f"{name} {_behind(quality, choice.against[name])}" for name in choice.tied[:3])
        text += f". {NO_DIFFERENCE} {'10 %' if quality.errors else '0.1 points'}: {each}."
    else:
        name = min(rivals, key=lambda rival: choice.against[rival].value)
        text += f". The next, {name}, {_behind(quality, choice.against[name])}."
    others = [one.name for one in quality.sets if one.decided and choice.first not in one.choice.leaders]
    if sets >= FEW and others:
        text += f" On {listed(others)} another one is ahead."
    return Statement(tone, word, text, "formulation")


def model_evidence(quality: Quality, name: str) -> str:
    """State how far the models of a formulation are behind the best, by data set if there are few."""
    if 1 < len(quality.sets) < FEW:
        return "; ".join(f"{one.name}: {_place(quality, one.choice, name, 'record')}" for one in quality.sets)
    return _place(quality, quality.choice, name, quality.unit)


def _place(quality: Quality, choice: Choice, name: str, unit: str) -> str:
    if name == choice.first:
        return {FIRST: "best", TIE: "tied for the best"}.get(choice.kind, "best so far")
    pair = choice.against.get(name)
    if pair is None or not pair.n:
        return f"no {unit} in common with the best" if choice.first else choice.missing
    return ("tied: " if name in choice.tied and choice.kind == TIE else "") + _behind(quality, pair, unit)


def _figure(quality: Quality) -> str:
    first, several = quality.choice.first, len(quality.sets) > 1
    mean, total = quality.figures[quality.measure][first], of(quality.choice.solved[first], quality.records, "record")
    where = f"{plural(len(quality.sets), 'data set')} ({total})" if several else f"{total} of {quality.sets[0].name}"
    if quality.errors:
        return f"a mean parameter error of {100 * mean:.3g} % on {where}"
    return f"a mean simulation fit of {mean:.2f} % on unseen samples of {where}"


def _behind(quality: Quality, pair: Paired, unit: str = "") -> str:
    low, high, n = pair.low, pair.high, plural(pair.n, unit or quality.unit)
    if quality.errors:
        interval = f" (95 %: {low:.3g} to {high:.3g}, {n})" if pair.n > 1 else ""
        return f"has {pair.value:.3g} times the error{interval}"
    word, sign = ("stays", 1) if pair.value > -0.005 else ("is, where both were solved,", -1)
    low, high = sorted((sign * low, sign * high))
    interval = f" (95 %: {round(low, 2) + 0.0:.2f} to {round(high, 2) + 0.0:.2f}, {n})" if pair.n > 1 else ""
    return f"{word} {abs(pair.value):.2f} points {'behind' if sign > 0 else 'ahead'}{interval}"


def _each(quality: Quality) -> str:
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
    said = f"on {one.name} {choice.first}{so_far}, {shown}, {name} {_place(quality, choice, name, 'record')}"
    return said if said.endswith(f", {records})") else f"{said} ({records})"  # the interval says how many, too
