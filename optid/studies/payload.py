"""The verdict and its rows as compact JSON values for the scripts of a study page."""

from typing import Any

import numpy as np

from optid.program.solution import GRADIENT
from optid.studies.storage.rows import BY_NAME, COLUMNS
from optid.studies.verdicts.advice import carries_over, choice_of_solver
from optid.studies.verdicts.averages import PerformanceProfile
from optid.studies.verdicts.outcomes import TIMES, Table, seconds_of, states_of_rows, worst_residual
from optid.studies.verdicts.standings import Standing, StandingsSection
from optid.studies.verdicts.verdict import StudyVerdict

TEXT_BUDGET = 1_500_000  # characters of different texts that a column may bring to the page
POINTS = 400  # steps of a profile on the page
DIGITS = {"objective": 10, "bound": 10, "scale": 8}


def page_payload(verdict: StudyVerdict) -> dict[str, Any]:
    """Return everything the scripts need as plain values for JSON, without numbers that are not finite.

    Texts keep their full length up to `TEXT_BUDGET` characters per column, beyond that their beginnings.
    """
    agreement, states = verdict.agreement, states_of_rows(verdict.table, verdict.found)
    return {
        "solvers": [s.solver for s in verdict.overall.standings] + list(verdict.overall.idle),
        "tolerance": verdict.found.tolerance,
        "time": verdict.found.measure,
        "sections": [_section(section) for section in (verdict.overall, *verdict.sections)],
        "agreement": {
            "solvers": list(agreement.solvers),
            **{name: getattr(agreement, name).tolist() for name in ("common", "objective", "compared", "model")},
            **{name: [_numbers(row, 2) for row in getattr(agreement, name)]
               for name in ("worst_objective", "worst_model")},
        },
        "failures": [[f.solver, f.state, f.reason[:400], f.count] for f in verdict.failures],
        "columns": [column for column in _columns(verdict.table, states, verdict.found.measure) if column is not None],
        "count": len(states),
    }


def _number(value: float, digits: int = 5) -> float | None:
    """Round to significant digits; None where there is no finite number."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None


def _numbers(values: Any, digits: int = 5) -> list[float | None]:
    return [_number(value, digits) for value in values]


def _section(section: StandingsSection) -> dict[str, Any]:
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
            "names": list(ranking.names), "ranks": _numbers(ranking.ranks), "n": ranking.n,
            "missing": ranking.missing, "left_out": list(ranking.left_out), "behind": list(ranking.behind),
        },
    }


def _standing(s: Standing, section: StandingsSection) -> dict[str, Any]:
    ranking, pair, growth = section.ranking, section.choice.against.get(s.solver), s.growth
    rank = ranking.ranks[ranking.names.index(s.solver)] if s.solver in ranking.names else np.nan
    return {
        "solver": s.solver, "problems": s.problems, "solved": s.solved, "share": _number(s.share), "refused": s.refused,
        "false": s.false_claims, "fastest": s.fastest, "time": _number(s.time), "fit": _number(s.fit),
        "proved": s.proved, "penalised": _number(s.penalised),
        "residual": _number(s.residual, 3), "rank": _number(rank), "failures": s.failures,
        "against": None if pair is None else _numbers((pair.value, pair.low, pair.high, pair.n)),
        "growth": {"slope": _number(growth.slope), "low": _number(growth.low), "high": _number(growth.high),
                   "missing": growth.missing, "n": _numbers(growth.lengths), "t": _numbers(growth.times)},
    }


def _profile(profile: PerformanceProfile) -> list[list[float | None]]:
    """Return the steps of a profile; of many, `POINTS` of them with the first and the last."""
    most = len(profile.factors)
    at = np.unique(np.rint(np.linspace(0, most - 1, POINTS)).astype(int)) if most > POINTS else np.arange(most)
    return [_numbers(profile.factors[at]), _numbers(profile.shares[at])]


def _columns(table: Table, states: np.ndarray, time: str) -> list[dict[str, Any] | None]:
    made = [
        _texts("state", "solved, or the reason why it does not count", states),
        _figures("time_s", "compared time: " + " + ".join(TIMES[time]), "s", seconds_of(table, time), 5),
        _figures("residual", f"largest of violation, complementarity and stationarity / {GRADIENT:g}", "",
                 worst_residual(table), 3),
    ]
    for column in COLUMNS:
        values = table[column.name]
        if column.kind in ("number", "integer"):
            digits = 12 if column.kind == "integer" else DIGITS.get(column.name, 5)
            made.append(_figures(column.name, column.meaning, column.unit, values, digits))
        else:
            words = np.where(values, "yes", "no") if column.kind == "flag" else values
            made.append(_texts(column.name, column.meaning, words))
    return made


def _figures(name: str, meaning: str, unit: str, values: np.ndarray, digits: int) -> dict[str, Any] | None:
    if not np.isfinite(values).any() and name in BY_NAME:
        return None
    shorter = [int(v) if v is not None and v == int(v) and abs(v) < 1e15 else v for v in _numbers(values, digits)]
    return {"name": name, "kind": "number", "meaning": meaning, "unit": unit, "values": shorter}


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
