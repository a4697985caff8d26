"""Nuclear-norm subspace identification of the CD player arm: speed of our own ADMM, and fit on validation data.

Prints, for the protocols of Liu and Vandenberghe (2009) and of Liu, Hansson and Vandenberghe (2013):

* N1: 100 samples for the estimate, 400 after them shown; weight from the noise level 0.27, order from the singular
  values above a thousandth of the largest (at most 10), projection on the complement of the inputs.
* N2: 200 samples for the estimate, the next 400 for validation; weights of the instrumental-variable method, twenty
  values of lambda over six decades chosen on the validation data, and the order with it; against N4SID, here the
  subspace method `sid` with the better of its two weightings at every order and several numbers of block rows, chosen
  on the same data. The other two forms beside it.
* the same convex programme by our own ADMM and as an SDP through the back ends named: CPU seconds of the solve, from
  compiled data for the SDP (compilation by CVXPY is shown apart) and with its decompositions for the ADMM, objectives,
  and dual bounds.

Goals: ADMM at least 20 times faster than the SDP at the same objective to 1e-4; validation fit at least that of the
best N4SID order.

    python benchmarks/nuclear_subspace.py --data /folder/with/daisy_cdplayer.csv
"""

import argparse
import os
import time
import warnings
from pathlib import Path

import numpy as np

import optid
from formulations.nuclear_subspace import low_rank
from optid.backends import Settings, find
from optid.core.low_rank import LowRankForm
from optid.core.statement import for_solvers, statement_of
from optid.identify.subspace.low_rank import held_out_fit, order_scores, structure
from optid.identify.subspace.plan import Plan
from optid.solving.solve import solve


def record(folder: str) -> optid.Data:
    path = Path(folder) / "daisy_cdplayer.csv"
    return optid.read(path, inputs=["u1", "u2"], outputs=["y1", "y2"])


def part(data: optid.Data, start: int, stop: int) -> optid.Data:
    e = data.experiments[0]
    return optid.Data(u=e.u[start:stop], y=e.y[start:stop], dt=data.dt, inputs=data.inputs, outputs=data.outputs)


def n4sid_scores(train: optid.Data, test: optid.Data, rows: list[int], largest: int) -> dict[tuple, float]:
    """Validation fit of the subspace method over block rows, orders, weightings and instruments."""
    found = {}
    for alpha in rows:
        for n in range(1, min(largest, alpha - 1) + 1):
            for weighting in ("moesp", "cva"):
                try:
                    fit = optid.fit(train, "hammerstein_ss.sid", nx=n, block_rows=alpha, weighting=weighting)
                except optid.errors.OptidError:
                    continue
                found[alpha, n, weighting] = held_out_fit(fit.model, test)
    return found


def nuclear_scores(train: optid.Data, test: optid.Data, form: str, rows: int, weights: np.ndarray,
                   nx: int | str = "auto") -> tuple[dict[tuple[float, int], float], float]:
    """Validation fit over weights and orders, and the CPU seconds of all programmes of the path."""
    plan = Plan("subspace.nuclear", train, nx, rows, "linear", None, form)
    clock = time.process_time()
    structured = structure(plan)
    problem = low_rank(structured, 1.0)
    found, seconds = {}, time.process_time() - clock
    for weight in weights:
        clock = time.process_time()
        solution = solve(problem.under_weights(weight=structured.penalty(weight)), "admm", accuracy=1e-7)
        seconds += time.process_time() - clock
        for n, score in order_scores(structured, solution.values, test).items():
            found[float(weight), n] = score
    return found, seconds


def race(structured, weight: float, solvers: list[str], accuracy: float, repeats: int) -> None:
    """Solve one programme by the ADMM and as an SDP."""
    program = for_solvers(low_rank(structured, structured.penalty(weight)))
    times = []
    for _ in range(repeats):
        fresh = for_solvers(low_rank(structured, structured.penalty(weight)))
        # the Gram matrix is decomposed anew: it belongs to the time of one solve
        numbers = LowRankForm.of(fresh).problem
        for name in ("gram", "groups", "index", "known", "data"):
            numbers.__dict__.pop(name, None)
        if numbers.predictor is not None:
            for name in ("stacked", "gram", "inverse", "places"):
                numbers.predictor.__dict__.pop(name, None)
        clock = time.process_time()
        answer = find("admm").run(fresh, Settings(accuracy=accuracy))
        times.append(time.process_time() - clock)
    own = solve(program, "admm", accuracy=accuracy)
    print(f"    matrix {structured.problem.shape}, {structured.problem.y.size} outputs, weight {weight:g}")
    print(f"    {'admm':10s} {min(times):9.4f} s  objective {own.objective:.8g}  bound {own.bound.value:.8g}  "
          f"{answer.iterations} iterations, {own.status}")
    for solver in solvers:
        fresh = for_solvers(low_rank(structured, structured.penalty(weight)))
        clock = time.process_time()
        statement_of(fresh).problem.get_problem_data(solver.upper())
        compiled = time.process_time() - clock
        clock = time.process_time()
        claim = find(solver).run(fresh, Settings(accuracy=accuracy))
        alone = time.process_time() - clock
        other = solve(fresh, lambda program, settings, claim=claim: claim, accuracy=accuracy)
        ratio = alone / min(times)
        difference = abs(other.objective - own.objective) / own.objective
        print(f"    {solver:10s} {alone:9.4f} s  objective {other.objective:.8g}  difference "
              f"{difference:.1e}  compiled in {compiled:.2f} s, {other.status}"
              f"  ADMM {ratio:.0f} times faster (goal 20)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default=os.environ.get("OPTID_DATA", "."), help="folder of daisy_cdplayer.csv")
    parser.add_argument("--solvers", nargs="*", default=["clarabel", "scs"], help="SDP back ends of the race")
    parser.add_argument("--accuracy", type=float, default=1e-6, help="accuracy asked of all solvers")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--forms", nargs="*", default=["instruments"], help="forms of N2 to race; the SDP of the "
                        "others has cones of some 200 rows, which takes an interior-point method minutes")
    parser.add_argument("--rows", type=int, default=15, help="block rows of the race")
    parser.add_argument("--no-fits", action="store_true", help="race only")
    parser.add_argument("--no-race", action="store_true", help="fits only")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    data = record(arguments.data)

    print("N1: 100 samples, noise 0.27, projection")
    train, shown = part(data, 0, 100), part(data, 0, 400)
    rows = int(min(30 // data.l, 101 // (data.l + data.m + 1) + 1))
    if not arguments.no_fits:
        fit = optid.fit(train, "subspace.nuclear", form="projection", noise=0.27, block_rows=rows)
        after = part(data, 100, 400)
        print(f"    {rows} block rows, order {fit.model.nx}, fit on the 300 samples after: "
              f"{held_out_fit(fit.model, after):.2f} %, on all 400: {held_out_fit(fit.model, shown):.2f} %")
        best = n4sid_scores(train, after, [rows // 2, rows * 2 // 3, rows], 10)
        where = max(best, key=best.get)
        print(f"    best N4SID (block rows, order, weighting) {where}: {best[where]:.2f} %")
    if not arguments.no_race:
        plan = Plan("subspace.nuclear", train, "auto", rows, "linear", None, "projection")
        structured = structure(plan)
        race(structured, float(np.mean(structured.scale)) ** 2 / 0.27**2, arguments.solvers, arguments.accuracy,
             arguments.repeats)

    print("N2: 200 samples, validation on the next 400, lambda chosen there")
    train, test = part(data, 0, 200), part(data, 200, 600)
    if not arguments.no_fits:
        best = n4sid_scores(train, test, [8, 10, 12, 15, 20], 12)
        where = max(best, key=best.get)
        print(f"    best N4SID (block rows, order, weighting) {where}: {best[where]:.2f} %")
        weights = 10.0 * np.logspace(-3, 3, 20)
        for form in ("instruments", "projection", "predictor"):
            for rows in (10, 15):
                found, seconds = nuclear_scores(train, test, form, rows, weights)
                top = max(found, key=found.get)
                print(f"    {form}, {rows} block rows: weight {top[0]:.3g}, order {top[1]}: {found[top]:.2f} % "
                      f"(goal {best[where]:.2f}); path of 20 programmes {seconds:.2f} s")
    if not arguments.no_race:
        for form in arguments.forms:
            plan = Plan("subspace.nuclear", train, "auto", arguments.rows, "linear", None, form)
            structured = structure(plan)
            print(f"  race, {form}")
            race(structured, 30.0, arguments.solvers, arguments.accuracy, arguments.repeats)


if __name__ == "__main__":
    main()
