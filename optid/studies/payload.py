"""What the scripts of a study page draw and list: the verdict and its rows as plain JSON values, kept small."""

from typing import Any

import numpy as np

from optid.program.solution import GRADIENT
from optid.studies.storage.rows import BY_NAME, COLUMNS
from optid.studies.verdicts.advice import carries_over, choice_of_solver
from optid.studies.verdicts.agreement import Agreement
from optid.studies.verdicts.averages import Profile
from optid.studies.verdicts.outcomes import TIMES, Table, seconds_of, states_of_rows, worst_residual
from optid.studies.verdicts.standings import Section, Standing
from optid.studies.verdicts.verdict import Verdict

TEXT_BUDGET = 1_500_000  # characters of different texts that a column may bring to the page
POINTS = 400  # steps of a profile that a screen can show
DIGITS = {"objective": 10, "bound": 10, "scale": 8}


def page_payload(verdict: Verdict) -> dict[str, Any]:
    """Return everything the scripts need.

    Args:
        verdict: the verdict.

    Returns:
        Plain values for JSON, without numbers that are not finite. Texts keep their full length up to `TEXT_BUDGET`
        characters per column, beyond that their beginnings.
    """
    states = states_of_rows(verdict.table, verdict.found)
    return {
        "solvers": [s.solver for s in verdict.overall.standings] + list(verdict.overall.idle),
        "tolerance": verdict.found.tolerance,
        "time": verdict.time,
        "sections": [section_payload(verdict.overall), *(section_payload(s) for s in verdict.sections)],
        "agreement": _agreement(verdict.agreement),
        "failures": [[f.solver, f.state, f.reason[:400], f.count] for f in verdict.failures],
        "columns": _columns(verdict.table, states, verdict.time),
        "count": len(states),
    }


def number(value: float, digits: int = 5) -> float | None:
    """Round to significant digits; None where there is no finite number."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None


def section_payload(section: Section) -> dict[str, Any]:
    """Return one section: standings, profiles, ranking."""
    ranking, said = section.ranking, [choice_of_solver(section)]
    if len(section.standings) > 1:
        said.append(carries_over(ranking))
    return {
        "name": section.name,
        "said": [[s.tone, s.word, s.text] for s in said],
        "problems": len(section.found.data),
        "idle": list(section.idle),
        "first": section.choice.first,
        "tied": list(section.choice.tied),
        "kind": section.choice.kind,
        "standings": [_standing(s, section) for s in section.standings],
        "profiles": {name: _profile(p) for name, p in section.profiles.items()},
        "ranking": {
            "names": list(ranking.names), "ranks": [number(r) for r in ranking.ranks], "n": ranking.n,
            "p": number(ranking.probability), "difference": number(ranking.difference), "test": ranking.test,
            "missing": ranking.missing, "left_out": list(ranking.left_out),
            "apart": bool(ranking.told and ranking.probability < ranking.level),
        },
    }


def _standing(s: Standing, section: Section) -> dict[str, Any]:
    ranking, pair, growth = section.ranking, s.against, s.growth
    rank = ranking.ranks[ranking.names.index(s.solver)] if s.solver in ranking.names else np.nan
    return {
        "solver": s.solver, "problems": s.problems, "solved": s.solved, "share": number(s.share), "refused": s.refused,
        "false": s.false_claims, "fastest": s.fastest, "time": number(s.time), "fit": number(s.fit),
        "proved": s.proved, "penalised": number(s.penalised),
        "residual": number(s.residual, 3), "rank": number(rank), "failures": s.failures,
        "against": None if pair is None else [number(v) for v in (pair.value, pair.low, pair.high, pair.n)],
        "growth": {"slope": number(growth.slope), "low": number(growth.low), "high": number(growth.high),
                   "missing": growth.missing, "n": [number(v) for v in growth.lengths],
                   "t": [number(v) for v in growth.times]},
    }


def _profile(profile: Profile) -> list[list[float | None]]:
    """Steps of a profile; of very many, those that stand far enough apart for a screen, the first and the last kept."""
    at = np.arange(len(profile.factors))
    if len(at) > POINTS:
        at = np.unique(np.rint(np.linspace(0, len(at) - 1, POINTS)).astype(int))
    return [[number(x) for x in profile.factors[at]], [number(y) for y in profile.shares[at]]]


def _agreement(agreement: Agreement) -> dict[str, Any]:
    return {
        "solvers": list(agreement.solvers),
        **{name: getattr(agreement, name).tolist() for name in ("common", "objective", "compared", "model")},
        **{name: [[number(v, 2) for v in row] for row in getattr(agreement, name)]
           for name in ("worst_objective", "worst_model")},
    }


def _columns(table: Table, states: np.ndarray, time: str) -> list[dict[str, Any]]:
    made = [
        _texts("state", "solved, or why it does not count", states),
        _numbers("time_s", "the time compared: " + " + ".join(TIMES[time]), "s", seconds_of(table, time), 5),
        _numbers("residual", f"largest of violation, complementarity and stationarity / {GRADIENT:g}", "",
                 worst_residual(table), 3),
    ]
    for column in COLUMNS:
        values = table[column.name]
        if column.kind in ("number", "integer"):
            digits = 12 if column.kind == "integer" else DIGITS.get(column.name, 5)
            made.append(_numbers(column.name, column.meaning, column.unit, values, digits))
        elif column.kind == "flag":
            made.append(_texts(column.name, column.meaning, np.where(values, "yes", "no")))
        else:
            made.append(_texts(column.name, column.meaning, values))
    return [column for column in made if column is not None]


def _numbers(name: str, meaning: str, unit: str, values: np.ndarray, digits: int) -> dict[str, Any] | None:
    if not np.isfinite(values).any() and BY_NAME.get(name):
        return None
    return {"name": name, "kind": "number", "meaning": meaning, "unit": unit,
            "values": [_whole(number(v, digits)) for v in values]}


def _whole(value: float | None) -> float | int | None:
    """Write 3 for 3.0: it is shorter."""
    return int(value) if value is not None and value == int(value) and abs(value) < 1e15 else value


def _texts(name: str, meaning: str, values: np.ndarray) -> dict[str, Any] | None:
    words = sorted(set(values))
    if words == [""]:
        return None
    long = sum(map(len, words)) > TEXT_BUDGET
    most = max(80, TEXT_BUDGET // len(words)) if long else None
    code = {word: k for k, word in enumerate(words)}
    shown = [w if most is None or len(w) <= most else f"{w[:most]}… ({len(w) - most:,} more characters)" for w in words]
    return {"name": name, "kind": "text", "meaning": meaning, "unit": "", "words": shown,
            "values": [code[value] for value in values]}
