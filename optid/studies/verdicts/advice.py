"""The verdict in words: recommendations with their evidence, warnings, and undecided questions."""

from collections import Counter

from optid.phrases import plural
from optid.show.wording import seconds
from optid.studies.verdicts.averages import paired
from optid.studies.verdicts.choice import CANNOT_TELL, FIRST, NOBODY, ONLY_ONE, TIE
from optid.studies.verdicts.model_advice import choice_of_formulation
from optid.studies.verdicts.quality import Quality
from optid.studies.verdicts.ranks import SolverRanking
from optid.studies.verdicts.standings import Standing, StandingsSection
from optid.studies.verdicts.statement import BAD, FAIR, GOOD, NO_DIFFERENCE, Statement, counting, listed, of

RARE = 0.01  # share of refused problems, or of false claims, up to which a solver is recommended
LONGEST = 90  # characters of a headline
NO_SOLVER = "No solver can be recommended"


def choice_of_solver(section: StandingsSection) -> Statement:
    """Recommend a solver for the problems of a section, or say why none can be recommended."""
    choice, n, at = section.choice, len(section.found.data), section.found.accuracy
    if not n:
        text = no_solution(section) if section.infeasible else "There is no run of a solver."
        return Statement(FAIR, "Nothing to compare", text, "solver")
    if not section.standings and section.found.measure == "warm":
        text = "No run has a warm time: it needs a study with warm = true, and a procedure of several "
        return Statement(FAIR, "Cannot tell", text + "programmes never has one.", "solver")
    if not section.standings:
        text = f"Every solver ({listed(section.idle)}) refuses every problem, or was not run."
        return Statement(FAIR, "Nothing was run", text, "solver")
    if choice.kind == NOBODY:
        failures = sum((Counter(standing.failures) for standing in section.standings), Counter())
        common = ", ".join(f"{word} {count:,}" for word, count in failures.most_common(4))
        where = "the only problem" if n == 1 else f"any of {n:,} problems"
        text = f"No solver reached the accuracy of {at:.0e} on {where} ({common}); {counting(at)}."
        return Statement(BAD, NO_SOLVER, text, "solver")
    if not choice.first:
        return Statement(FAIR, "Cannot tell", evidence(section), "solver")
    lead = section.standing(choice.first)
    average = f", in {seconds(lead.time)} on average" if lead.time == lead.time else ""
    solved = f"{lead.solver} reached the accuracy of {at:.0e} on {of(lead.solved, n)}{average} ({counting(at)})"
    if choice.kind == CANNOT_TELL:
        return Statement(FAIR, "Cannot tell yet", f"{evidence(section)} So far {solved}.", "solver")
    word, text = f"Use {lead.solver}", f"{solved}. {evidence(section)}"
    if choice.kind == ONLY_ONE:
        return Statement(_tone(lead, n), "Only one solver", text, "solver")
    if choice.kind == TIE:
        word = f"A tie: {listed(choice.leaders)}"
    elif lead.refused > RARE * n:
        text += f" It does not take {lead.refused:,} of the others."
        most = lead.solved == max(choice.solved.values())
        word = f"Solves most: {lead.solver}" if most else f"{word} where it runs"
    for name in choice.leaders:
        if k := section.standing(name).false_claims:
            text += f" Note that {k:,} claim{'s' if k > 1 else ''} of {name} {'were' if k > 1 else 'was'} false."
    return Statement(_tone(lead, n), word if section.recommended else NO_SOLVER, text, "solver")


def evidence(section: StandingsSection) -> str:
    """Give the evidence for the choice: the distance of the others from the first, or the missing data."""
    choice, first = section.choice, section.choice.first
    if choice.kind != FIRST:
        each = "; ".join(f"{name} {_count(section, name)}{_against(section, name)}" for name in choice.tied[:3])
        return choice.shortfall or f"{NO_DIFFERENCE} 10 % of the time: {each}."
    rivals = [name for name in choice.candidates if name != first]
    others = [s.solver for s in section.standings if s.solver != first]
    if rivals:
        name = min(rivals, key=lambda rival: choice.against[rival].value)
        text = f"The next, {name}, {_count(section, name)}{_against(section, name)}"
        found = section.found
        whole = paired(found.fit[:, found.solvers.index(name)], found.fit[:, found.solvers.index(first)])
        text += f"; for the whole fit {_times_as(whole.value)}." if whole.enough and found.measure == "solve" else "."
        most = max(rivals, key=lambda rival: choice.solved[rival])
        if choice.solved[most] > max(choice.solved[first], choice.solved[name]):
            text += f" {most} {_count(section, most)}{_against(section, most)}."
    elif not any(choice.solved[name] for name in others):
        return f"No other solver solved any problem: {listed(others)}."
    else:
        name = max(others, key=lambda other: choice.solved[other])
        pair = choice.against[name]
        speed = f", and where both work {_against(section, name)}" if pair.enough else ""
        text = f"The next, {name}, solved only {choice.solved[name]:,}{speed}."
    named = [section.standing(one) for one in (first, name)]
    if any(one.proved for one in named) and any(one.proved < one.solved for one in named):
        shown = ", ".join(f"{one.solver} {one.proved:,} of {one.solved:,}" for one in named)
        text += f" Proved globally optimal: {shown}."
    fast = [(pair.value, other) for other, pair in choice.against.items()
            if pair.ahead and other not in (name, *choice.candidates)]
    if fast:
        value, other = min(fast)
        text += (f" {other} is {1 / value:.3g} times faster where both work, but solved only "
                 f"{of(choice.solved[other], len(section.found.data))}.")
    return text


def no_solution(section: StandingsSection) -> str:
    """State how many problems are infeasible, and how many solvers agree."""
    k, (said, asked) = section.infeasible, section.deniers
    return (f"{plural(k, 'problem')} {'has' if k == 1 else 'have'} no solution according to {said} of {asked} solvers; "
            "none found one. This counts neither for nor against them.")


def _tone(lead: Standing, n: int) -> str:
    if lead.solved >= 0.95 * n and lead.false_claims <= RARE * n:
        return GOOD
    return FAIR if lead.solved >= 0.5 * n else BAD


def _times_as(value: float) -> str:
    if 0.995 <= value <= 1.005:
        return "the same time"
    return f"{value:.3g} times the time" if value < 10 else f"{value:.0f} times the time"


def _against(section: StandingsSection, name: str) -> str:
    pair = section.choice.against[name]
    return f"takes {_times_as(pair.value)} (95 %: {pair.low:.3g} to {pair.high:.3g}, {pair.n:,} problems)"


def _count(section: StandingsSection, name: str) -> str:
    """State how many problems a candidate solved where the first solved more."""
    solved = section.choice.solved
    if solved[name] == solved[section.choice.first]:
        return ""
    return f"solved {solved[name]:,}, no difference beyond chance or 1 %, and "


def carries_over(ranking: SolverRanking, noun: str = "solver") -> Statement:
    """State whether the order of solvers or formulations (the noun) holds on other data sets."""
    if ranking.missing:
        text = f"Whether the order holds on other data sets is unknown: the test {ranking.missing}."
        return Statement(FAIR, "Other data: cannot tell", text, "data sets")
    best, *others = ranking.names
    least = min(ranking.probabilities.values())
    p = "below 0.001" if least < 0.001 else f"{least:.2g}"
    text = f"{best} has the best mean rank, {ranking.ranks[0]:.2f} (sign tests, {ranking.n} data sets, probability {p})"
    if not ranking.behind:
        text += f"; no other {noun} is significantly behind it."
        return Statement(FAIR, "Other data: no difference", text, "data sets")
    same = [name for name in others if name not in ranking.behind]
    text += f"; {listed(same)} do not differ significantly." if same else "; all others are significantly behind."
    word = f"Other data: {listed([best, *same])} {'lead' if same else 'leads'}"
    return Statement(GOOD, word, text, "data sets")


def headline(overall: StandingsSection, sections: tuple[StandingsSection, ...], quality: Quality) -> Statement:
    """Return the verdict in one line: one solver for everything, or one per formulation.

    A study of a single solver is about the formulations by their models.
    """
    choice, n, count = overall.choice, len(overall.found.data), len(sections)
    if len(overall.standings) == 1:
        return choice_of_formulation(quality) or choice_of_solver(overall)
    beaten = any(s.choice.decided and not {*choice.leaders} <= {*s.choice.leaders} for s in sections)
    decided = [section for section in sections if section.recommended or section.choice.kind == ONLY_ONE]
    everywhere = choice.decided and overall.standing(choice.first).solved >= 0.99 * n and not beaten
    if count < 2 or not overall.standings or everywhere or not decided:
        return choice_of_solver(overall)
    at, used, all_told = overall.found.accuracy, _used(overall, decided), len(decided) == count
    main, *others = used
    where = {name: listed([section.name for section in theirs]) for name, theirs in used.items()}
    best = "; ".join(f"{name} for {where[name]}" for name in used)
    if all_told and (not others or len(used[main]) > 1):
        best = "; ".join([f"Use {main}", *(f"for {where[name]} {name}" for name in others)])
    most = max(overall.standings, key=lambda s: (s.solved, -s.penalised))
    text = f"{most.solver} solved most, {of(most.solved, n)} at an accuracy of {at:.0e} ({counting(at)})."
    if most.solved < 0.99 * n:
        text = f"No solver does everything: {text}"
    if len(used[main]) > 1:
        text += f" {main} comes first, or ties for it, in {of(len(used[main]), count, 'formulation')}."
    if not all_told:
        text += f" For {count - len(decided)} of {count} formulations it is undecided."
    tones = [_tone(one.standing(name), len(one.found.data)) for name, theirs in used.items() for one in theirs]
    tone = max(tones if all_told else [*tones, FAIR], key=(GOOD, FAIR, BAD).index)
    depends = "It depends on the formulation"
    if len(best) > LONGEST:
        return Statement(tone, depends, f"{best}. {text}", "solver")
    return Statement(tone, best, f"{depends}. {text}" if others or not all_told else text, "solver")


def _used(overall: StandingsSection, decided: list[StandingsSection]) -> dict[str, list[StandingsSection]]:
    """Return few solvers that lead all these sections: {solver: sections}, the one that leads most first.

    Of solvers that lead as many, the one with the better standing on all problems.
    """
    order, left, used = [s.solver for s in overall.standings], list(decided), {}
    while left:
        leads = {name: [one for one in left if name in one.choice.leaders] for name in order}
        name = max(leads, key=lambda solver: len(leads[solver]))
        used[name] = leads[name]
        left = [one for one in left if one not in leads[name]]
    return used
