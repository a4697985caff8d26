"""What the tests of a record find on ordinary plant records, and whether the verdict on a model is true.

    python benchmarks/record_tests.py [--records 200] [--only feedback effect ...] [--kinds staircase ...] [--jobs 2]
                                      [--seed 0] [--failures FILE] [--write FILE]

Simulated records (`plant_records.py`), so many of every kind, are given to the tests; one line a kind is printed as
soon as it is known: share with its 95 % interval (Clopper and Pearson), median CPU seconds of a record. The table at
the end compares the groups of kinds with what is required of them; a group without a requirement is reported.
--kinds takes the kinds whose names contain one of these words, --failures writes the seeds that failed and what came
out, --write the models behind the verdicts with all figures, as CSV.
"""

import argparse
import csv
import os
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import model_verdicts
import numpy as np
import plant_records as kinds
from model_verdicts import orders
from montecarlo import share, worker_pool
from plant_records import PlantRecord, record
from simulated_plants import levels_of, step_response

import optid
from optid.errors import OptidError
from optid.identify.informativity import informativity, processes
from optid.identify.validation.structure import structure_test


@dataclass(frozen=True)
class Outcome:
    """What came out of a record: whether it is right, in words, figures by name, and CPU seconds of the tests."""

    right: bool
    said: str
    figures: dict[str, float]
    seconds: float


@dataclass(frozen=True)
class Group:
    """Kinds of records of which something is required together.

    Attributes:
        what: words of the final table.
        kinds: the kinds.
        least: smallest share of right outcomes; None: reported.
        figure: a figure of the outcomes whose median counts in place of the share.
        within: largest and smallest median that is met.
    """

    what: str
    kinds: tuple[str, ...]
    least: float | None = None
    figure: str = ""
    within: tuple[float, float] | None = None


@dataclass(frozen=True)
class Row:
    """A row of the table: how an outcome is judged, and the groups."""

    judge: Callable[[PlantRecord], Outcome]
    groups: tuple[Group, ...]


class Failures(list[str]):
    """Lines on the records that failed, written to a file, if there is one, as soon as they are known."""

    def __init__(self, file: str | None, title: str) -> None:
        self.file = file
        self += [title]

    def __iadd__(self, lines: Iterable[str]) -> "Failures":
        self.extend(lines)
        if self.file:
            Path(self.file).write_text("\n".join(self) + "\n")
        return self


def timed(test: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a test returns, or the refusal that it raises, and its CPU seconds."""
    clock = time.process_time()
    try:
        found = test()
    except OptidError as refusal:
        found = refusal
    return found, time.process_time() - clock


# -- one function a row ------------------------------------------------------------------------------------------------


def feedback(one: PlantRecord) -> Outcome:
    """Judge the word of the loop; a regulated record must have a reason why it cannot be identified."""
    found, seconds = timed(lambda: informativity(one.data))
    if isinstance(found, OptidError):
        return Outcome(False, repr(found), {}, seconds)
    said = found.loop.word + (f", reason: {found.reason}" if found.reason else "")
    right = found.loop.word == one.loop and (bool(found.reason) or one.loop != kinds.REGULATED)
    return Outcome(right, f"{said}; p = {found.loop.p_value:.2g}, outside {found.loop.outside:.2g}; N = "
                   f"{one.data.n_samples}, noise {one.noise:.3f}", {}, seconds)


def gain(one: PlantRecord) -> Outcome:
    """Compare static gains, over the true one: of the scan, and of prediction errors with a noise model."""
    plant, u = one.plants[0], one.data.experiments[0].u[:, 0]
    assert plant is not None
    low, high = levels_of(u)
    n = 10 * plant.memory
    truth = step_response(plant.respond, low, high, 1, n)[-1]
    found, seconds = timed(lambda: processes(one.data, least=1)[0].responses[0])
    figures = {"scan": found.gain * (high - low) / truth}
    form = orders(plant) | {"nk": found.nk}
    fits = {"armax": ("armax.exact", {"nc": form["na"]}), "bj": ("bj.exact", {"nc": 1, "nd": 1})}
    for name, (formulation, noise) in fits.items():
        model, _ = timed(lambda f=formulation, v=noise: optid.fit(one.data, f, prove=False, **form, **v).model)
        if isinstance(model, OptidError):
            figures[name] = np.nan
            continue
        simulate = partial(_run, model)
        figures[name] = float(step_response(simulate, low, high, 1, n)[-1] / truth)
    said = ", ".join(f"{name} {value:.3f}" for name, value in figures.items())
    return Outcome(abs(figures["scan"] - 1) < 0.1, f"{said}; nk {found.nk}, true {plant.linear.nk}; disturbance "
                   f"{one.noise:.3f}", figures, seconds)


def _run(model: Any, u: np.ndarray) -> np.ndarray:
    return np.ravel(np.asarray(model.simulate(u, x0="zero")))


def effect(one: PlantRecord) -> Outcome:
    """Judge whether inputs that act are kept and those that do not are named."""
    found, seconds = timed(lambda: informativity(one.data))
    if isinstance(found, OptidError):
        return Outcome(False, repr(found), {}, seconds)
    seen = [bool(found.effects) and not found.without_effect(c) for c in range(len(one.plants))]
    right = seen == [plant is not None for plant in one.plants]
    figures = {"p": max((each.p_value for each in found.effects), default=1.0)}
    return Outcome(right, f"visible: {seen}; N = {one.data.n_samples}; {'; '.join(found.findings)}", figures, seconds)


def dead_time(one: PlantRecord) -> Outcome:
    """Judge the dead time, to within a sample."""
    plant = one.plants[0]
    assert plant is not None
    found, seconds = timed(lambda: processes(one.data)[0].responses[0])
    if isinstance(found, OptidError):
        return Outcome(False, repr(found), {}, seconds)
    low, high = found.lag_interval
    right = abs(found.nk - plant.linear.nk) <= 1
    figures = {"in its interval": float(low <= plant.linear.nk <= high)}
    return Outcome(right, f"nk {found.nk} [{low}, {high}], order {len(found.poles)}; true {plant.linear.nk}, order "
                   f"{plant.linear.order}, N = {one.data.n_samples}, noise {one.noise:.3f}", figures, seconds)


def structure(one: PlantRecord) -> Outcome:
    """Judge the structure test: Hammerstein plants are kept, others rejected, loops not tested."""
    plant = one.plants[0]
    assert plant is not None
    told = informativity(one.data)
    if told.loop.word != kinds.OPEN:  # as the verdict does
        return Outcome(one.loop != kinds.OPEN, f"not tested: {told.loop.word}", {}, 0.0)
    found, seconds = timed(lambda: structure_test(one.data, found=told.processes))
    if isinstance(found, OptidError):  # the record does not determine it
        return Outcome(plant.is_hammerstein, repr(found)[:100], {}, seconds)
    said = f"{'kept' if found.passed else 'rejected'}: {found.alternative} (p = {found.p_value:.2g})"
    right = found.passed == plant.is_hammerstein and one.loop == kinds.OPEN
    return Outcome(right, said, {}, seconds)


def bad(one: PlantRecord) -> Outcome:
    """Judge records that no model can come from: a finding, a reason or a named error."""
    found, seconds = timed(lambda: informativity(one.data))
    said = repr(found) if isinstance(found, OptidError) else "; ".join([*found.findings, found.reason])
    return Outcome(bool(said.strip("; ")), said, {}, seconds)


def cpu(one: PlantRecord) -> Outcome:
    """Take the time of all tests of a record."""
    told, seconds = timed(lambda: informativity(one.data))
    _, structure_seconds = timed(lambda: structure_test(one.data, found=told.processes or None))
    both = seconds + structure_seconds
    return Outcome(both <= 1.5, f"{seconds:.2f} s and {structure_seconds:.2f} s", {"seconds": both}, both)


ROWS: dict[str, Row] = {
    "feedback": Row(feedback, (
        Group("feedback: open records called open", tuple(kinds.OPEN_KINDS), 0.98),
        Group("feedback: closed loops named", tuple(kinds.MOVED_KINDS), 0.95),
        Group("feedback: regulated loops, with the reason", tuple(kinds.REGULATED_KINDS), 0.95),
        Group("feedback: relays and inner loops at constant set-point", tuple(kinds.OUTSIDE_KINDS)),
        Group("feedback: regulated loops, logged in coarse steps", tuple(kinds.LOGGED_KINDS)))),
    "gain": Row(gain, tuple(
        Group(f"gain in informative loops, median, {name}",
              tuple(k for k in kinds.MOVED_KINDS if "integrating" not in k), figure=name, within=(0.98, 1.02))
        for name in ("scan", "armax", "bj"))),
    "effect": Row(effect, (
        Group("effect: idle inputs named", tuple(kinds.IDLE_KINDS), 0.98),
        Group("effect: weak inputs kept, white noise", tuple(k for k in kinds.WEAK_KINDS if "white" in k), 0.95),
        Group("effect: weak inputs kept, AR(.9)", tuple(k for k in kinds.WEAK_KINDS if "AR" in k)),
        Group("effect: one of two inputs is idle", tuple(kinds.TWO_KINDS)),
        Group("effect: inputs of short records kept, noise up to 10 %", tuple(kinds.SIZE_KINDS)),
        Group("effect: idle beside an oscillation or a random walk", tuple(kinds.HARD_IDLE_KINDS)))),
    "dead_time": Row(dead_time, (
        Group("dead time: staircases and PRBS", tuple(kinds.DEAD_KINDS), 0.98),
        Group("dead time: one step, first order", tuple(kinds.STEP_KINDS), 0.95),
        Group("dead time: other plants", tuple(kinds.HARD_DEAD_KINDS)))),
    "structure": Row(structure, (
        Group("structure: Hammerstein plants kept", tuple(kinds.SIZE_KINDS), 0.98),
        *(Group(k, (k,), 0.95) for k in kinds.POWER_KINDS),
        Group("structure: loops not tested", tuple(kinds.MOVED_KINDS)))),
    "bad": Row(bad, (Group("bad input: a finding or a named error", tuple(kinds.BAD_KINDS)),)),
    "cpu": Row(cpu, (Group("CPU s of all tests, N = 3,000", tuple(kinds.LONG_KINDS), figure="seconds",
                           within=(0.0, 1.5)),)),
}
VERDICT = "verdict"

# -- running -----------------------------------------------------------------------------------------------------------


def judge(row: str, kind: str, seed: int) -> Outcome:
    """Judge one record; what is not a refusal is a fault, named in the outcome."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return ROWS[row].judge(record(kind, seed))
        except Exception as fault:  # a benchmark goes on, and counts it
            return Outcome(False, f"FAULT {type(fault).__name__}: {fault}", {}, np.nan)


def chosen(names: Iterable[str], words: Sequence[str]) -> tuple[str, ...]:
    """Return the kinds whose names contain one of the words; all without words."""
    return tuple(name for name in names if not words or any(word in name for word in words))


def run_row(row: str, pool: Executor, seeds: Sequence[int], failures: Failures, words: Sequence[str] = ()
            ) -> list[tuple[str, str, str]]:
    """Judge the kinds of a row, print a line each, and return the lines of the final table."""
    groups = [replace(group, kinds=chosen(group.kinds, words)) for group in ROWS[row].groups]
    groups = [group for group in groups if group.kinds]
    found: dict[str, list[Outcome]] = {}
    for kind in dict.fromkeys(kind for group in groups for kind in group.kinds):
        found[kind] = list(pool.map(partial(judge, row, kind), seeds))
        wrong = [(seed, one.said) for seed, one in zip(seeds, found[kind]) if not one.right]
        if wrong:
            failures += [f"\n## {row}: {kind}: {len(wrong)} of {len(seeds)}",
                         *(f"- seed {seed}: {said}" for seed, said in wrong)]
        print(f"{row:<10}{kind:<46}{_told(found[kind])}", flush=True)
    return [_measured(group, [one for kind in group.kinds for one in found[kind]]) for group in groups]


def _told(outcomes: Sequence[Outcome]) -> str:
    names = sorted({name for one in outcomes for name in one.figures})
    medians = [f"{name} {_median(one.figures.get(name, np.nan) for one in outcomes):.3f}" for name in names]
    return "  ".join([share(sum(one.right for one in outcomes), len(outcomes)),
                      f"{_median(one.seconds for one in outcomes):.2f} s", *medians])


def _median(values: Iterable[float]) -> float:
    present = [value for value in values if np.isfinite(value)]
    return float(np.median(present)) if present else np.nan


def _measured(group: Group, outcomes: Sequence[Outcome]) -> tuple[str, str, str]:
    if group.within is not None:
        median = _median(one.figures.get(group.figure, np.nan) for one in outcomes)
        low, high = group.within
        return group.what, f"{median:.3f}", f"{low:g} to {high:g}: {'met' if low <= median <= high else 'missed'}"
    right = sum(one.right for one in outcomes)
    required = "reported" if group.least is None else (
        f"{100 * group.least:g} %: {'met' if right >= group.least * len(outcomes) else 'missed'}")
    return group.what, share(right, len(outcomes)), required


def run_verdicts(pool: Executor, seeds: Sequence[int], failures: Failures, file: str | None, words: Sequence[str] = ()
                 ) -> list[tuple[str, str, str]]:
    """Judge the verdicts on right and wrong models; print the models by word and error, for every kind."""
    rows: list[model_verdicts.Row] = []
    for kind in chosen(model_verdicts.KINDS, words):
        found = [one for several in pool.map(partial(model_verdicts.judge, kind), seeds) for one in several]
        rows += found
        print(f"\nverdict   {kind}, {_median(r.seconds for r in found):.2f} s\n{model_verdicts.table(found)}",
              flush=True)
        for name, wrong in (("wrong but good or fair", [r for r in found if r.is_false]),
                            ("right response but poor or useless", [r for r in found if r.is_missed])):
            if wrong:
                failures += [f"\n## verdict: {kind}: {name}: {len(wrong)} of {len(found)} models; by structure "
                             f"{dict(Counter(r.structure for r in wrong))}",
                             *(f"- seed {r.seed}, {r.structure}: {r.word}, response off by {100 * r.error:.3g} %, fit "
                               f"{r.score:.1f}; failed parts {[p[0] for p in r.parts if not p[2]]}" for r in wrong)]
        if file:
            write(rows, file)
    print(f"\nverdict   all kinds\n{model_verdicts.table(rows)}")
    praised = [r for r in rows if r.word in ("good", "fair")]
    right = [r for r in rows if r.word and r.is_right]
    other = [r for r in rows if r.word and r.error < model_verdicts.RIGHT and not r.is_right]
    lines = []
    for what, of, wrong, most in (
            ("verdict: good or fair, but the response off by more than 10 %", praised, [r.is_false for r in praised],
             0.02),
            ("verdict: right structure and response, but poor or useless", right, [r.is_missed for r in right], 0.05),
            ("verdict: other structure, right response, poor or useless", other, [r.is_missed for r in other], None)):
        required = "reported" if most is None else (
            f"at most {100 * most:g} %: {'met' if sum(wrong) <= most * len(of) else 'missed'}")
        lines.append((what, share(sum(wrong), len(of)) if of else "none", required))
    return lines


def write(rows: Sequence[model_verdicts.Row], file: str) -> None:
    """Write the models with every part of their verdicts, a column each for value and outcome."""
    names = list(dict.fromkeys(part[0] for row in rows for part in row.parts))
    with Path(file).open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["kind", "seed", "model", "word", "error", "score", "seconds", "reason",
                        *(f"{name}{end}" for name in names for end in ("", ": passed"))])
        for row in rows:
            parts = {name: (value, passed) for name, value, passed, _ in row.parts}
            table.writerow([row.kind, row.seed, row.structure, row.word, row.error, row.score, row.seconds, row.reason,
                            *(cell for name in names for cell in parts.get(name, ("", "")))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=200, help="of every kind")
    parser.add_argument("--only", nargs="+", choices=[*ROWS, VERDICT], default=[*ROWS, VERDICT])
    parser.add_argument("--kinds", nargs="+", default=[], help="words of the names of kinds")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--failures", help="file of the records that failed")
    parser.add_argument("--write", help="CSV file of the models behind the verdicts")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.records)
    lines: list[tuple[str, str, str]] = []
    failures = Failures(options.failures, f"# Failures, {options.records} records a kind from seed {options.seed}")
    with worker_pool(options.jobs) as pool:
        for row in options.only:
            lines += run_verdicts(pool, seeds, failures, options.write, options.kinds) if row == VERDICT else (
                run_row(row, pool, seeds, failures, options.kinds))
    print(f"\n{'what':<66}{'measured':<28}required")
    for what, measured, required in lines:
        print(f"{what:<66}{measured:<28}{required}")


if __name__ == "__main__":
    main()
