"""Back-end agreement. Every installed back end over every case of the zoo that it accepts.

    python benchmarks/backends.py [--cases qp] [--solvers clarabel ipopt] [--repeat 3] [--isolate]

Printed per run: what the solver claimed, what our residuals made of it, the objective relative to the best that any
back end reached and to the known value, the residuals, and the time of compiling and solving (best of the repeats;
with --isolate every run has a process of its own, whose start is in the time). At the end: the largest error behind
an "optimal", and every disagreement with how it was caught.
"""

import argparse

from optid.backends import back_ends
from optid.conformance.checks import SUCCESS, VALUE, Row, accepted_cases, run_case, value_error
from optid.conformance.zoo import SOLVED, cases
from optid.program.solution import Status

CLAIMS = {"optimal", "Solve_Succeeded", "success", "FEASIBLE_KKT_POINT", "stationary", "optimal_inaccurate"}
LIMIT = 60.0  # seconds per run


def main() -> None:
    """Run, print the table and the two statements of the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="", help="only cases whose name starts with this")
    parser.add_argument("--solvers", nargs="*", default=None)
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--isolate", action="store_true", help=f"own processes, stopped after {LIMIT:.0f} s")
    arguments = parser.parse_args()
    zoo = [case for case in cases() if case.name.startswith(arguments.cases)]
    installed = [b for name, b in sorted(back_ends().items()) if b.installed]
    chosen = [b for b in installed if arguments.solvers is None or b.name in arguments.solvers]
    limits = {"time_limit": LIMIT} if arguments.isolate else {}
    rows: dict[str, list[Row]] = {case.name: [] for case in zoo}
    for back_end in chosen:
        for case in accepted_cases(back_end, zoo):
            runs = [run_case(back_end, case, **limits) for _ in range(arguments.repeat)]
            rows[case.name].append(min(runs, key=lambda row: row.solution.times.solve))
    for case in zoo:
        print_case(case, rows[case.name])
    summarise([row for group in rows.values() for row in group])


def print_case(case, group: list[Row]) -> None:
    """Print one block of the table: one case, all back ends."""
    known = f"known value {case.value:.10g}" if case.outcome == SOLVED else f"known to be {case.outcome}"
    print(f"\n{case.name}: {known}{', hard' if case.hard else ''}")
    print(f"  {'solver':<13}{'claimed':<29}{'verified':<17}{'vs best':>9}{'vs known':>9}{'violation':>11}"
          f"{'station.':>10}{'complem.':>10}{'ms':>9}")
    good = [row.solution.objective for row in group if row.solution.status in SUCCESS]
    best = min(good, default=float("nan"))
    for row in group:
        s = row.solution
        text = f"  {row.solver:<13}{s.claimed[:27]:<29}{s.status!s:<17}"
        if s.residuals is not None and case.outcome == SOLVED:
            against = abs(s.objective - best) / max(abs(best), 1e-6 * s.scale)
            text += f"{against:>9.0e}{value_error(case, s):>9.0e}"
        else:
            text += f"{'-':>9}{'-':>9}"
        if s.residuals is not None:
            r = s.residuals
            text += f"{r.violation:>11.0e}{r.stationarity:>10.0e}{r.complementarity:>10.0e}"
        else:
            text += f"{'-':>11}{'-':>10}{'-':>10}"
        print(text + f"{1e3 * s.times.solve:>9.1f}")


def summarise(rows: list[Row]) -> None:
    """Print the statements of the figure and list every disagreement."""
    solved = [row for row in rows if row.case.outcome == SOLVED]
    optimal = [row for row in solved if row.solution.status is Status.OPTIMAL]
    success = [row for row in solved if row.solution.status in SUCCESS]
    solvers, names = {row.solver for row in rows}, {row.case.name for row in rows}
    print(f"\n{len(rows)} runs, {len(solvers)} back ends, {len(names)} cases")
    for word, group in (("optimal", optimal), ("optimal or locally optimal", success)):
        worst = max((value_error(row.case, row.solution) for row in group), default=0.0)
        inside = sum(value_error(row.case, row.solution) <= VALUE for row in group)
        print(f"'{word}': {inside} of {len(group)} within {VALUE:.0e} relative of the known value; worst {worst:.1e}")
    caught = [row for row in rows if row.solution.claimed in CLAIMS and row.solution.status not in SUCCESS]
    wrong = [row for row in rows if row.complaints]
    honest = [row for row in solved if row.solution.claimed not in CLAIMS and row.solution.status not in SUCCESS]
    print(f"claims of success that our residuals took back: {len(caught)}")
    for row in caught:
        print(f"  {row.solver} on {row.case.name}: {row.solution.status}: {row.solution.reason}")
    print(f"no claim, no solution: {len(honest)}")
    for row in honest:
        print(f"  {row.solver} on {row.case.name}: {row.solution.status}: {row.solution.reason[:100]}")
    print(f"disagreements with the known answer that were not caught: {len(wrong)}")
    for row in wrong:
        print(f"  {row.solver} on {row.case.name}: {'; '.join(row.complaints)}")


if __name__ == "__main__":
    main()
