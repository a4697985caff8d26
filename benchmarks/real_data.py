"""Real records: fit, proof and hold-out figures of constrained Hammerstein-ARX against linear ARX of the same orders.

    OPTID_DATA=folder python benchmarks/real_data.py [--reports FOLDER]

Records: stretch reflex (first 5000 samples for the estimate, the rest for validation), hydraulic actuator (512/512),
lamp heating (561/240; nine steps between six levels only, which draws a warning).
"""

import argparse
import os
import time
import warnings
from pathlib import Path

import optid
from optid.errors import DataWarning


def cases(folder: Path):
    reflex = optid.read(folder / "nlid_reflex.csv", dt=0.005)
    actuator = optid.read(folder / "lab_hydraulic_actuator.csv", inputs="u_valve", outputs="y_pressure", dt=1.0)
    heating = optid.read(folder / "daisy_heating.csv", dt=2.0)
    yield "stretch reflex", reflex, 5000, {"na": 4, "nb": 4, "basis": "triangular:8"}, ["monotone:increasing"]
    yield "hydraulic actuator", actuator, 512, {"na": 4, "nb": 4, "basis": "triangular:6"}, ["monotone:decreasing"]
    yield "lamp heating", heating, 561, {"na": 2, "nb": 2, "basis": "triangular:3"}, ["monotone:increasing"]


def study(name, data, count, structure, constraints, reports: Path | None):
    train, test = data.split(count)
    rows, findings = [], []
    orders = {key: structure[key] for key in ("na", "nb")}
    variants = [("linear ARX", "arx", orders, []), ("Hammerstein", "hammerstein_arx.exact", structure, []),
                ("  monotone", "hammerstein_arx.exact", structure, constraints)]
    for label, formulation, arguments, limits in variants:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            started = time.perf_counter()
            fit = optid.fit(train, formulation, constraints=limits, **arguments)
            seconds = time.perf_counter() - started
            check = optid.validate(fit.model, test)
        findings += [str(w.message) for w in caught if issubclass(w.category, DataWarning)]
        rows.append((label, fit, float(fit.one_step_fit[0]), next(iter(check.one_step.values())).fit,
                     next(iter(check.simulation.values())).fit, seconds))
        if reports is not None:
            from optid import report

            report.write(fit, reports / f"{name} {label.strip()}.html".replace(" ", "_"), test=test)
    return rows, sorted(set(findings))


def main(argv=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default=os.environ.get("OPTID_DATA"))
    parser.add_argument("--reports", type=Path)
    options = parser.parse_args(argv)
    if not options.data:
        parser.error("name the folder of the records with --data or OPTID_DATA")
    if options.reports:
        options.reports.mkdir(parents=True, exist_ok=True)
    figures = {}
    for name, data, count, structure, constraints in cases(Path(options.data)):
        rows, findings = study(name, data, count, structure, constraints, options.reports)
        print(f"\n{name}: {count} samples for the estimate, {data.n_samples - count} for validation, {structure}")
        print(f"{'':14}{'one-step %':>11}{'one-step %':>12}{'simulation %':>14}   status            proof     gap   ms")
        print(f"{'':14}{'estimate':>11}{'validation':>12}{'validation':>14}")
        for label, fit, inside, outside, simulated, seconds in rows:
            solution = fit.solution
            print(f"{label:14}{inside:11.2f}{outside:12.2f}{simulated:14.2f}   {solution.status!s:16}"
                  f"{'proved' if solution.proof else 'no':>8}{solution.gap:9.0e}{1e3 * seconds:6.0f}")
        for sentence in findings:
            print(f"  note: {sentence}")
        figures[name] = rows, findings
    return figures


if __name__ == "__main__":
    main()
