"""The verdict in words: recommendations with the numbers they rest on, warnings, and what cannot be told."""

from collections import Counter

from optid.show.wording import seconds
from optid.studies.verdicts.averages import Paired, paired
from optid.studies.verdicts.choice import CANNOT_TELL, NOBODY, ONLY_ONE, TIE
from optid.studies.verdicts.model_advice import choice_of_formulation
from optid.studies.verdicts.quality import Quality
from optid.studies.verdicts.ranks import Ranking
from optid.studies.verdicts.standings import Section, Standing
from optid.studies.verdicts.statement import BAD, FAIR, GOOD, Statement, counting, listed, of, plural

RARE = 0.01  # share of the problems that a solver may refuse, or lie on, and still be called the one to use
LONGEST = 90  # characters of a headline
NO_SOLVER = "No solver can be recommended"


def choice_of_solver(section: Section) -> Statement:
    """Say which solver to use on the problems of a section, or why that cannot be told."""
    choice, n, at = section.choice, len(section.found.data), section.found.accuracy
    if not n:
        text = no_solution(section) if section.infeasible else "There is no run of a solver."
        return Statement(FAIR, "Nothing to compare", text, "solver")
    if not section.standings and section.found.measure == "warm":
        text = "No run has a warm time to compare: it needs a study with warm = true, and a procedure of several "
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
        return Statement(FAIR, "Cannot tell", f"It {choice.missing}.", "solver")
    lead = section.standing(choice.first)
    average = f", in {seconds(lead.time)} on average" if lead.time == lead.time else ""
    solved = f"{lead.solver} reached the accuracy of {at:.0e} on {of(lead.solved, n)}{average} ({counting(at)})"
    if choice.kind == ONLY_ONE:
        return Statement(_tone(lead, n), "Only one solver", f"{solved}. There is nothing to compare it with.", "solver")
    if choice.kind == CANNOT_TELL:
        return Statement(FAIR, "Cannot tell yet", f"The comparison {choice.missing}. So far {solved}.", "solver")
    if choice.kind == TIE:
        each = "; ".join(f"{name} {_count(section, name)}{_against(section, name)}" for name in choice.tied[:3])
        text = f"{solved}. No difference in time beyond chance or 10 %: {each}."
        word = f"A tie: {listed(choice.leaders)}"
    else:
        refusals = f" (it does not take {lead.refused:,} of the others)" if lead.refused else ""
        text = f"{solved}{refusals}. {_runner_up(section)}{_proofs(section)}{_quicker(section)}"
        word = f"Use {lead.solver}"
        if lead.refused > RARE * n:
            most = lead.solved == max(choice.solved.values())
            word = f"Solves most: {lead.solver}" if most else f"{word} where it runs"
    for name in choice.leaders:
        if k := section.standing(name).false_claims:
            text += f" Mind that {k:,} claim{'s' if k > 1 else ''} of {name} {'were' if k > 1 else 'was'} false."
    return Statement(_tone(lead, n), word if section.recommended else NO_SOLVER, text.rstrip(), "solver")


def no_solution(section: Section) -> str:
    """Say how many problems have no solution, and who says so."""
    k, (said, asked) = section.infeasible, section.deniers
    return (f"{plural(k, 'problem')} {'has' if k == 1 else 'have'} no solution: {said} of {asked} solvers say so, and "
            "none found one. That counts neither for nor against them.")


def evidence(section: Section) -> str:
    """Say in a few words what the choice rests on: the distance to the next."""
    choice = section.choice
    if not choice.decided:
        return choice.missing or ("nothing to compare with" if choice.kind == ONLY_ONE else "")
    if choice.kind == TIE:
        pairs = [f"{name} {_times(choice.against[name])}" for name in choice.tied[:2]]
        return "no difference beyond chance or 10 %: " + ", ".join(pairs)
    after = _next(section)
    if after is None:
        return "nobody else solved any"
    fewer = "" if after.solved == section.standing(choice.first).solved else f" solved {after.solved:,},"
    ratio, whole = choice.against.get(after.solver), _whole_fit(section, after.solver)
    if ratio is None or not ratio.enough:
        return f"next: {after.solver}{fewer}".rstrip(",")
    rest = f", {whole.value:.3g} × for the whole fit" if whole else ""
    return f"next: {after.solver}{fewer} {_times(ratio)}{rest}.{_proofs(section)}".rstrip(".")


def _next(section: Section) -> Standing | None:
    """The candidate closest to the first, or where there is none who solved most after it; None where nobody did."""
    choice = section.choice
    rivals = [name for name in choice.candidates if name != choice.first]
    if rivals:
        return section.standing(min(rivals, key=lambda rival: choice.against[rival].value))
    others = [s for s in section.standings if s.solver != choice.first and s.solved]
    return max(others, key=lambda s: s.solved, default=None)


def _times(pair: Paired) -> str:
    return f"{pair.value:.3g} × the time ({pair.low:.3g} to {pair.high:.3g})"


def _tone(lead: Standing, n: int) -> str:
    if lead.solved >= 0.95 * n and lead.false_claims <= RARE * n:
        return GOOD
    return FAIR if lead.solved >= 0.5 * n else BAD


def _times_as(value: float) -> str:
    """Write a ratio of times in words."""
    if 0.995 <= value <= 1.005:
        return "the same time"
    return f"{value:.3g} times the time" if value < 10 else f"{value:.0f} times the time"


def _against(section: Section, name: str) -> str:
    pair = section.choice.against[name]
    return f"takes {_times_as(pair.value)} (95 %: {pair.low:.3g} to {pair.high:.3g}, {pair.n:,} problems)"


def _count(section: Section, name: str) -> str:
    """Say how many problems a candidate solved where it is not as many as the first."""
    solved = section.choice.solved
    if solved[name] == solved[section.choice.first]:
        return ""
    return f"solved {solved[name]:,}, no difference beyond chance or 1 %, and "


def _runner_up(section: Section) -> str:
    """Compare with the next candidate, or with the one that solved most after the first."""
    choice, after = section.choice, _next(section)
    if after is None:
        return f"Nobody else solved any: {listed([s.solver for s in section.standings if s.solver != choice.first])}."
    name = after.solver
    if name not in choice.candidates:
        pair = choice.against.get(name)
        speed = f", in {_times(pair)} where both work" if pair is not None and pair.enough else ""
        return f"The next, {name}, solved only {after.solved:,}{speed}."
    fewer, most = _count(section, name), max(choice.candidates, key=lambda one: choice.solved[one])
    text = f"The next{'' if fewer else ' as reliable'}, {name}, {fewer}{_against(section, name)}"
    whole = _whole_fit(section, name)
    text += f"; for the whole fit {_times_as(whole.value)}." if whole else "."
    if choice.solved[most] > max(choice.solved[choice.first], choice.solved[name]):
        text += f" {most} {_count(section, most)}{_against(section, most)}."
    return text


def _whole_fit(section: Section, name: str) -> Paired | None:
    """What is left of the ratio of times in the whole fit, where the solver's share of it is compared."""
    found = section.found
    pair = paired(found.fit[:, found.solvers.index(name)], found.fit[:, found.solvers.index(section.choice.first)])
    return pair if pair.enough and found.measure == "solve" else None


def _proofs(section: Section) -> str:
    """Say how many answers are proved, of the first and the next, where that is not all of one of them."""
    after = _next(section)
    named = [section.standing(section.choice.first), *([after] if after else [])]
    if all(one.proved == one.solved for one in named) or not any(one.proved for one in named):
        return ""
    shown = ", ".join(f"{one.solver} {one.proved:,} of {one.solved:,}" for one in named)
    return f" Proved globally optimal: {shown}."


def _quicker(section: Section) -> str:
    """Name a solver that is faster where it works but solves less."""
    choice, n = section.choice, len(section.found.data)
    fast = [(pair.value, name) for name, pair in choice.against.items() if name not in choice.candidates and pair.ahead]
    if not fast:
        return ""
    value, name = min(fast)
    others = [solved for solver, solved in choice.solved.items() if solver != choice.first]
    if len(choice.candidates) == 1 and choice.solved[name] == max(others):
        return ""  # named already
    return f" {name} is {1 / value:.3g} times faster where both work, but solved only {of(choice.solved[name], n)}."


def carries_over(ranking: Ranking, noun: str = "solver") -> Statement:
    """Say whether an order carries over to other data sets; the noun is what is ranked."""
    if not ranking.told:
        text = f"Whether the order holds on other data sets cannot be told: the test {ranking.missing}."
        return Statement(FAIR, "Other data: cannot tell", text, "data sets")
    p = "below 0.001" if ranking.probability < 0.001 else f"{ranking.probability:.2g}"
    shown = f"{ranking.test}, {ranking.n} data sets, probability {p}"
    if ranking.probability >= ranking.level:
        text = f"Over the data sets the ranks of the {noun}s do not differ beyond chance ({shown})."
        return Statement(FAIR, "Other data: no difference", text, "data sets")
    best = ranking.names[0]
    same = [name for name in ranking.names[1:] if not ranking.differ(best, name)]
    text = f"{best} has the best mean rank, {ranking.ranks[0]:.2f} ({shown})"
    if len(same) == len(ranking.names) - 1:
        text += f"; the ranks differ as a whole, but no other {noun} is behind it beyond chance."
        return Statement(FAIR, "Other data: a tie", text, "data sets")
    text += f"; {listed(same)} cannot be told apart from it." if same else "; all others are behind beyond chance."
    word = f"Other data: {listed([best, *same])} {'lead' if same else 'leads'}"
    return Statement(GOOD, word, text, "data sets")


def headline(overall: Section, sections: tuple[Section, ...], quality: Quality) -> Statement:
    """Say the verdict in one line: one solver for everything, or that it depends on the formulation.

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
    at, used = overall.found.accuracy, _used(overall, decided)
    main, *others = used
    counted, all_told = f"an accuracy of {at:.0e} ({counting(at)})", len(decided) == count
    if not others and all_told:
        lead = overall.standing(main)
        text = f"{main} comes first, or ties for it, in {of(count, count, 'formulation')}, and "
        text += f"reached {counted} on {of(lead.solved, n)}."
        return Statement(_tone(lead, n), f"Use {main}", text, "solver")
    if all_told and len(used[main]) > 1:
        best = "; ".join([f"Use {main}", *(f"for {listed([s.name for s in used[name]])} {name}" for name in others)])
    else:
        best = "; ".join(f"{name} for {listed([s.name for s in theirs])}" for name, theirs in used.items())
    most = max(overall.standings, key=lambda s: (s.solved, -s.penalised))
    text = f"{most.solver} solved most, {of(most.solved, n)} at {counted}."
    if most.solved < 0.99 * n:
        text = f"No solver does everything: {text}"
    if len(used[main]) > 1:
        text += f" {main} comes first, or ties for it, in {len(used[main]):,} of {count:,} formulations."
    if not all_told:
        text += f" For {count - len(decided)} of {count} formulations it cannot be told."
    tones = [_tone(one.standing(name), len(one.found.data)) for name, theirs in used.items() for one in theirs]
    tone = max(tones if all_told else [*tones, FAIR], key=(GOOD, FAIR, BAD).index)
    if len(best) <= LONGEST:
        return Statement(tone, best, f"It depends on the formulation. {text}", "solver")
    return Statement(tone, "It depends on the formulation", f"{best}. {text}", "solver")


def _used(overall: Section, decided: list[Section]) -> dict[str, list[Section]]:
    """Few solvers that come first, or tie for it, in all these sections: {solver: sections}, whoever covers most first.

    Of solvers that cover as many, the one that stands better on all problems.
    """
    order, left, used = [s.solver for s in overall.standings], list(decided), {}
    while left:
        leads = {name: [one for one in left if name in one.choice.leaders] for name in order}
        name = max(leads, key=lambda solver: len(leads[solver]))
        used[name] = leads[name]
        left = [one for one in left if one not in leads[name]]
    return used
