"""The headline of a verdict: what was compared, with how many problems, and which is the best of it."""

from collections import Counter

from optid.phrases import plural
from optid.studies.verdicts.averages import Paired
from optid.studies.verdicts.choice import CANNOT_TELL, DEPENDS, FIRST, NOBODY, ONLY_ONE, TIE
from optid.studies.verdicts.models import DataSet, Quality
from optid.studies.verdicts.outcomes import Results
from optid.studies.verdicts.standings import Standing, StandingsSection
from optid.studies.verdicts.statement import BAD, FAIR, GOOD, Statement, counting, join_names, of

RARE = 0.01  # share of refused problems, or of false claims, up to which a solver is recommended
LONGEST = 90  # characters of a headline
LISTED = 4  # data sets in a sentence


def headline(overall: StandingsSection, sections: tuple[StandingsSection, ...], models: Quality) -> Statement:
    """Return the verdict in one line, about what differs: the solvers, or else the formulations by their models."""
    problems, best = len(overall.found.data), overall.choice
    several = [section for section in sections if len(section.standings) > 1]
    if problems and overall.standings and not several:
        return model_statement(models) or solver_statement(overall)
    decided = [section for section in several if section.recommended]
    beaten = any(s.choice.decided and not {*best.leaders} <= {*s.choice.leaders} for s in several)
    everywhere = best.decided and overall.standing(best.first).solved >= 0.99 * problems and not beaten
    if len(sections) < 2 or everywhere or not decided:
        return solver_statement(overall)
    leaders, rest = dict[str, list[StandingsSection]](), decided
    while rest:  # few solvers that lead all of them, the one that leads most first
        leads = {s.solver: [one for one in rest if s.solver in one.choice.leaders] for s in overall.standings}
        name = max(leads, key=lambda solver: len(leads[solver]))
        leaders[name] = leads[name]
        rest = [one for one in rest if one not in leads[name]]
    word = "; ".join(f"{name} for {join_names([one.name for one in theirs])}" for name, theirs in leaders.items())
    if len(leaders) == 1 and len(decided) == len(sections):
        word = f"Use {next(iter(leaders))}"
    most = max(overall.standings, key=lambda s: (s.solved, s.solver))
    text = f"{describe_comparison(overall.found)}. {most.solver} solved most, {of(most.solved, problems)}."
    if undecided := len(several) - len(decided):
        text += f" For {undecided} of {plural(len(several), 'formulation')} the comparison cannot tell."
    if alone := len(sections) - len(several):
        text += f" {plural(alone, 'formulation')} had a single solver, so nothing to compare."
    tones = [_tone(one.standing(name), len(one.found.data)) for name, theirs in leaders.items() for one in theirs]
    tone = max(tones + [FAIR] * bool(undecided), key=(GOOD, FAIR, BAD).index)
    if len(word) > LONGEST:
        return Statement(tone, "It depends on the formulation", f"{word}. {text}")
    return Statement(tone, word, text)


def describe_comparison(found: Results) -> str:
    """State what was compared: "4 solvers on 24 problems (2 formulations, 1 data set) at an accuracy of 1e-08"."""
    parts = f"{plural(len(set(found.formulation)), 'formulation')}, {plural(len(set(found.data_set)), 'data set')}"
    return (f"{plural(len(found.solvers), 'solver')} on {plural(len(found.data), 'problem')} ({parts}) at an accuracy "
            f"of {found.accuracy:.0e} ({counting(found.accuracy)})")


# -- solvers -----------------------------------------------------------------------------------------------------------


def solver_statement(section: StandingsSection) -> Statement:
    """Recommend a solver for the problems of a section, or say why none can be recommended."""
    choice, n = section.choice, len(section.found.data)
    if not n:
        text = "Every problem is infeasible." if section.infeasible else "There is no run of a solver."
        return Statement(FAIR, "Nothing to compare", text)
    if not section.standings:
        warm = section.found.measure == "warm"
        return Statement(FAIR, "Cannot tell", "No run has a warm time: it needs a study with warm = true, and a "
                         "procedure of several programmes never has one." if warm else
                         f"Every solver ({join_names(section.idle)}) refuses every problem, or was not run.")
    text = f"{describe_comparison(section.found)}: "
    if choice.kind == NOBODY:
        failures = sum((Counter(standing.failures) for standing in section.standings), Counter())
        common = ", ".join(f"{word} {count:,}" for word, count in failures.most_common(4))
        return Statement(BAD, "No solver reached the accuracy", f"{text}{common}.")
    if not choice.first:
        return Statement(FAIR, "Cannot tell", f"{text}{evidence(section)}.")
    lead = section.standing(choice.first)
    text += f"{lead.solver} solved {of(lead.solved, n)}; {evidence(section)}."
    if lead.false_claims:
        text += f" Claims of {lead.solver} were false on {plural(lead.false_claims, 'problem')}."
    if choice.kind == CANNOT_TELL:
        return Statement(FAIR, "Cannot tell", text)
    if choice.kind == ONLY_ONE:
        return Statement(_tone(lead, n), "Only one solver", text)
    if not section.recommended:
        return Statement(BAD, "No solver can be recommended", text)
    word = f"A tie: {join_names(choice.leaders)}" if choice.kind == TIE else f"Use {lead.solver}"
    if choice.kind == FIRST and lead.refused > RARE * n:
        word += " where it runs"
    return Statement(_tone(lead, n), word, text)


def evidence(section: StandingsSection) -> str:
    """Give the evidence for a choice: the distance of the next from the first, or the missing data."""
    choice = section.choice
    if choice.kind == ONLY_ONE:
        return "there is nothing to compare it with"
    if not choice.decided:
        return f"the comparison {choice.missing}"
    if not choice.against:
        return "no other solved any problem"
    near = {name: pair.value for name, pair in choice.against.items() if name in (choice.tied or choice.candidates)}
    name = min(near, key=near.__getitem__) if near else max(choice.against, key=choice.solved.__getitem__)
    pair, said = choice.against[name], f"the next, {name}, solved {choice.solved[name]:,}"
    if choice.kind == TIE:
        said = f"{name} does not differ from {choice.first} beyond chance or 10 %: it solved {choice.solved[name]:,}"
    return f"{said} and takes {interval(pair, ' times the time')}" if pair.n else said


def interval(pair: Paired, unit: str = "", noun: str = "problem") -> str:
    """Write a paired comparison with its 95 % interval: "1.5 times the time (95 %: 1.2 to 1.9, 18 problems)"."""
    value, low, high = pair.texts
    return f"{value}{unit} (95 %: {low} to {high}, {plural(pair.n, noun)})" if pair.n > 1 else f"{value}{unit}"


def _tone(lead: Standing, n: int) -> str:
    if lead.solved >= 0.95 * n and lead.false_claims <= RARE * n:
        return GOOD
    return FAIR if lead.solved >= 0.5 * n else BAD


# -- formulations ------------------------------------------------------------------------------------------------------


def model_statement(models: Quality) -> Statement | None:
    """Recommend the formulation with the best models, or say why none is recommended; None for a single formulation."""
    choice, unknown = models.choice, "Models: cannot tell"
    if len(models.formulations) < 2 or not any(models.solved.values()):
        return None
    text = (f"Models of {plural(len(models.formulations), 'formulation')} on {plural(models.records, 'record')} "
            f"({plural(len(models.sets), 'data set')}) by their {models.measure.replace('_', ' ')}")
    if choice.kind == NOBODY:
        return Statement(FAIR, unknown, f"{text}: none has one. Keep a hold-out share, or simulate a known truth.")
    if choice.kind == DEPENDS:
        each = "; ".join(_best_of(one) for one in models.sets[:LISTED])
        return Statement(FAIR, "Models depend on the data", f"{text}: {each}.")
    if not choice.first:
        return Statement(FAIR, unknown, f"{text}: the comparison {choice.missing}.")
    text += f": {choice.first}"
    rivals = {name: choice.against[name] for name in (choice.tied or choice.candidates) if name in choice.against}
    if rivals:
        name, pair = min(rivals.items(), key=lambda rival: rival[1].value)
        text += f"; the next, {name}, " + (f"has {interval(pair, ' times the error', models.unit)}" if models.errors
                                           else f"is behind by {interval(pair, ' points', models.unit)}")
    if choice.kind == CANNOT_TELL:
        return Statement(FAIR, unknown, f"{text}; the comparison {choice.missing}.")
    if not rivals:
        return Statement(FAIR, unknown, f"{text}; no other has one on half as many records.")
    word = f"{'Equal' if choice.kind == TIE else 'Best'} models: {join_names(choice.leaders)}"
    return Statement(GOOD, word, f"{text}.")


def _best_of(one: DataSet) -> str:
    if not one.choice.first:
        return f"on {one.name} the comparison {one.choice.missing}"
    so_far = " so far" if one.choice.kind == CANNOT_TELL else ""
    best = join_names(one.choice.leaders) if one.choice.kind == TIE else one.choice.first
    return f"on {one.name} {best}{so_far} ({plural(one.records, 'record')})"
