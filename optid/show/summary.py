"""Facts, tables and sentences about a fit, for the printed result and the HTML page."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from optid.core.least_squares import RankOneForm
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.identify.equation_error import EquationError
from optid.identify.fitting import Fit
from optid.identify.validation.predictions import predictors
from optid.identify.verdict import GOOD, GOOD_BLOCK, GOOD_FIT, Verdict
from optid.models.functions import has_feedback, runs_free, static_functions
from optid.models.kalman import NoiseCovariances
from optid.models.roots import in_words
from optid.phrases import and_joined, seconds
from optid.program.solution import Solution, Status
from optid.show.sections import Facts
from optid.show.wording import Table, gap_text, number, percent, with_unit

MOST = 12
"""Entries of an array among the figures that are printed."""

PRICE_NOTE = (
    "Multiplier: change of the objective per unit of the bound. Price: points of one-step fit gained when the bound "
    "is relaxed by 1 % of the range of f or, if the constraint is not on f, of the size of the bounded quantity."
)


def title(fit: Fit) -> str:
    """Name the kind of model, its outputs and its inputs."""
    model = fit.model
    return f"{model.title} of {and_joined(model.outputs)} from {and_joined(model.inputs)}"


def verdict(fit: Fit) -> tuple[str, str, str]:
    """Return a tone ("good", "fair", "bad"), the status in words, and one sentence that explains it."""
    solution = fit.solution
    bound, gap = solution.bound, solution.gap
    if solution.proof and solution.status is Status.OPTIMAL and bound is not None:
        which = "this structure that keeps the constraints" if fit.prices else "this structure"
        proof = f"{bound.method}, relative gap {gap_text(gap)}"
        sentence = f"No model of {which} has a smaller objective on this record: global optimality is proved ({proof})."
        return "good", "optimal (proved)", sentence
    word = f"{solution.status} (not proved)" if solution.has_point else str(solution.status)
    reason = (solution.reason or (bound.reason if bound is not None else "") or fit.problem.no_proof).rstrip(".")
    because = f": {reason}" if reason else ""
    if solution.status not in (Status.LOCAL, Status.OPTIMAL):
        return "bad", word, f"The solver stopped early{because}. The figures below may be far from optimal."
    if fit.outcome.evidence is not None and because:
        return "fair", word, f"Not proved to be the best model of this structure{because}."
    if gap < 1:
        most = f"{100 * gap:.2g} %"
        return "fair", word, f"A local optimum; no model of this structure can lower the objective by more than {most}."
    return "fair", word, f"A local optimum; whether a better one exists is not known{because}."


def judgement(found: Verdict) -> str:
    """Return the tests of a verdict that fail, or what a good model would show, in a sentence."""
    if found.failed:
        return f"FAIL: {'; '.join(f'{part.name} ({part.value})' for part in found.failed)}."
    more = f" A good model has a fit of at least {GOOD_FIT:g} %, and {GOOD_BLOCK:g} % in its worst block."
    return "All tests of the verdict pass." + more * (found.word != GOOD)


def verdict_table(found: Verdict) -> Table:
    """The tests behind the verdict on a model, each with its value and outcome."""
    cut = [(part, *part.value.partition(": ")[::2]) if part.outcome == "-" else (part, part.value, "")
           for part in found.parts]  # the reason why a test is not available is a sentence, and no cell
    note = "; ".join(f"{part.name}: {reason}" for part, _, reason in cut if reason)
    return Table("", ("test", "value", "outcome"), [(part.name, value, part.outcome) for part, value, _ in cut], note)


def fit_table(fit: Fit) -> Table:
    """Fit of every output on the estimation record, by every predictor that the model has."""
    columns = [np.atleast_1d(fit.one_step_fit)]
    if has_feedback(fit.model):
        columns.append(np.atleast_1d(fit.measured_feedback_fit))
    columns.append(simulation_fit(fit))
    rows = [(name, *map(percent, values)) for name, *values in zip(fit.model.outputs, *columns)]
    return Table("Fit on the estimation record", ("output", *predictors(fit.model)), rows)


def simulation_fit(fit: Fit) -> np.ndarray:
    """Simulation fit of every output in %; NaN where there is none: see `Fit.simulation_fit`, or an unstable model.

    With nonlinear feedback the poles of the linear part do not decide about stability; the simulation does.
    """
    if not runs_free(fit.model):
        return np.full(fit.model.l, np.nan)
    return np.atleast_1d(fit.simulation_fit)


def constraint_table(fit: Fit) -> Table:
    """Activity, slack and price of every user constraint."""
    rows = []
    for p in fit.prices:
        state = f"active ({p.active} of {p.rows})" if p.binding else "not active"
        priced = p.binding and not np.isnan(p.multiplier)
        rows.append((p.name, state, "-" if p.binding else number(p.slack, 3),
                     *(number(value, 3) if priced else "-" for value in (p.multiplier, p.points_per_step))))
    return Table("Constraints", ("constraint", "state", "slack", "multiplier", "price"), rows, PRICE_NOTE)


def certificate_facts(fit: Fit) -> Facts:
    """Status claimed by the solver, whether it returned a solution, the proof, and the residuals measured by optid."""
    s, r = fit.solution, fit.solution.residuals
    facts = [("Solver status", f"{s.solver}: {s.claimed}"), ("Solution returned", "yes" if s.has_point else "no")]
    if s.bound is None:
        facts.append(("Optimality proved", "no: " + (fit.problem.no_proof or "this programme has no certificate")))
    else:
        facts.append(("Optimality proved", f"{'yes' if s.proof else 'no'}: {s.bound.reason or s.bound.method}"))
        known = np.isfinite(s.bound.value)
        facts.append(("Bound", f"{number(s.bound.value, 10)} ({s.bound.method})" if known else "none"))
    facts.append(("Objective", number(s.objective, 10)))
    facts.append(("Relative gap", gap_text(s.gap)))
    if r is not None:
        worst = f" in {r.worst!r}" if r.violation > 0 and r.worst else ""
        facts.append(("Largest violation", f"{gap_text(r.violation)}{worst}"))
        facts += [(name, f"{value:.1e}" if np.isfinite(value) else "not measured") for name, value in (
            ("Stationarity", r.stationarity), ("Complementarity", r.complementarity))]
    return facts


def record_facts(fit: Fit) -> Facts:
    """Name, length, experiments, missing samples and rows used."""
    data, figures = fit.data, fit.figures
    count = data.n_samples
    facts = [
        ("Record", data.name or "unnamed"),
        ("Samples", (f"{count} every {data.interval}" if count else f"every {data.interval}"))]
    if isinstance(data, Data):
        facts.append(("Experiments", str(data.n_experiments)))
        if data.dated:
            first, last = data.timelines[0], data.timelines[-1]
            facts.append(("Time", f"{first.text(0)} to {last.text(data.experiments[-1].n_samples - 1)}"))
        missing = [f"{name} {share:.2%}" for name, share in data.missing.items() if share]
        facts.append(("Missing", ", ".join(missing) or "none"))
        if not data.transform.is_identity:
            facts.append(("Units", "detrended or scaled for the fit; everything here is in raw units"))
    if "rows" in figures:
        facts.append(("Rows used", f"{figures['rows']} of {figures['candidates']}"))
        method = "Gram matrix" if figures["method"] == "gram" else "streamed QR"
        facts.append(("Condition", f"{figures['condition']:.1e} ({method})"))
    return facts


def evidence_facts(fit: Fit) -> Facts:
    """Figures that a procedure of several steps reported, under its own names and in its order."""
    return [(name[:1].upper() + name[1:], _measured(value)) for name, value in fit.figures.items() if name not in _ROWS]


def spectra(fit: Fit) -> dict[str, np.ndarray]:
    """Return the singular values and other falling sequences among the figures of a procedure, by their names."""
    named = {name: value for name, value in fit.figures.items() if "singular" in name.lower()}
    lists = {name: value for name, value in named.items() if isinstance(value, np.ndarray | list | tuple)}
    found = {name: np.asarray(value, dtype=float) for name, value in lists.items()}
    return {name: values for name, values in found.items() if values.ndim == 1 and values.size > 1}


def theta_singular_values(fit: Fit) -> dict[str, np.ndarray]:
    """Return the singular values of Theta by input: of the relaxed programme, or of least squares without the rank.

    Inputs whose Theta is a vector are left out.
    """
    compressed, found = fit.problem.compressed, {}
    heights = fit.problem.facts.get("units")
    if not isinstance(compressed, EquationError) or not fit.solution.has_point:
        return found
    if RankOneForm.of(fit.problem) is not None:
        z, position = np.linalg.solve(compressed.problem.root, compressed.problem.target), compressed.problem.linear
        thetas = []
        for rows, columns in compressed.problem.blocks:
            thetas.append(z[position : position + rows * columns].reshape(rows, columns, order="F"))
            position += rows * columns
    else:
        thetas = compressed.matrices(fit.solution.values)
    unit = 1.0 if heights is None else heights.y_scale[0]  # of Theta in the units of the record
    for name, theta in zip(fit.model.inputs, thetas):
        if min(theta.shape) > 1:
            found[name] = unit * np.linalg.svd(theta, compute_uv=False)
    return found


def channel_table(data: Data) -> Table:
    """Range, mean, spread, levels and missing share of every channel."""
    rows = [
        (c.name, c.role, c.unit or "-", *(number(value, 4) for value in (c.low, c.high, c.mean, c.std)),
         str(c.levels) if c.levels <= 1000 else "many", f"{c.missing:.2%}")
        for c in data.raw().channels]
    return Table("Channels", ("channel", "role", "unit", "lowest", "highest", "mean", "std", "levels", "missing"), rows)


def solver_facts(fit: Fit) -> Facts:
    """The solver, why it was chosen, and the time of each part."""
    s = fit.solution
    descended = fit.figures.get("programmes") == 1 and not fit.problem.constraint_names
    facts = [("Solver", f"descent, {s.solver}" if descended else s.solver)]
    if s.chosen:
        facts.append(("Chosen because", s.chosen.partition(": ")[2] or s.chosen))
    if s.iterations >= 0:
        facts.append(("Iterations", str(s.iterations)))
    if len(fit.steps) > 1:
        facts.append(("Programmes solved", str(len(fit.steps))))
    times = [("Building", s.times.build), ("Solving", s.times.solve), ("Verifying", s.times.judge)]
    times += [("Proving", s.times.prove)] if s.times.prove else []
    return facts + [(name, seconds(spent)) for name, spent in [*times, ("Total", fit.total_seconds)]]


def steps_table(fit: Fit) -> Table | None:
    """Every step of a procedure: its programmes, their solvers, status and objective of the last; None for one step."""
    by_name: dict[str, list[Solution]] = {}
    for name, solution in fit.steps:
        by_name.setdefault(name, []).append(solution)
    if len(by_name) == 1:
        return None
    rows = [(name, str(len(several)), ", ".join(dict.fromkeys(s.solver for s in several)), str(several[-1].status),
             number(several[-1].objective)) for name, several in by_name.items()]
    return Table("Steps", ("step", "programmes", "solver", "last status", "objective"), rows,
                 f"The objective of the fit is that of the step '{fit.problem.name}'.")


def call(fit: Fit) -> str:
    """Write the Python call behind the fit; constraints by their names."""
    words = [f"{key}={value.tolist() if isinstance(value, np.ndarray) else value!r}"
             for key, value in fit.arguments.items() if key != "constraints"]
    if fit.arguments.get("constraints"):
        names = [getattr(constraint, "name", None) or "a user function" for constraint in fit.arguments["constraints"]]
        words.append(f"constraints=[{', '.join(names)}]")
    return f"optid.fit(data, {fit.formulation!r}, {', '.join(words)})"


def model_facts(fit: Fit) -> Facts:
    """Orders, poles, noise, gauge, extrapolation of f, and why its offset is not identifiable."""
    model = fit.model
    facts = [
        ("Orders", ", ".join(f"{name} {' '.join(map(str, np.atleast_1d(n)))}" for name, n in model.orders.items())),
        ("Poles", in_words(model.poles) or "none")]
    if isinstance(noise := getattr(model, "noise", None), str) and noise:
        facts.append(("Noise", noise))
    if model.levels is not None:
        shown = [" ".join(number(one, 4) for one in row) for row in model.levels[:MOST]]
        more = f" and {len(model.levels) - MOST} more" if len(model.levels) > MOST else ""
        facts.append(("Constants of the experiments", f"{', '.join(shown)}{more}; offset is their mean"))
    if gauge := _gauge(model):
        facts.append(("Gauge", gauge))
    functions = [function for function in static_functions(model) if not function.is_linear]
    outside = sorted({f"{function.nonlinearity.basis.outside}" for function in functions})
    if outside:
        facts.append(("Outside the range", ", ".join(outside)))
    if model.offset_note and functions:
        facts.append(("Offset", model.offset_note))
    return facts


def _gauge(model: Any) -> str:
    """Say how the scale between f and the linear part is fixed; "" without a gauge."""
    known = {
        "norm": "norm of b is one",
        "gain": "static gain of the linear part is one",
        "b0": "first coefficient of b is one",
        "none": ""}
    words = known.get(model.gauge, str(model.gauge))
    if model.gauge != "norm":
        return words
    functions = [function for function in static_functions(model) if function.family == "nonlinearities"]
    falls = [function.word for function, sign in zip(functions, model.gain_signs) if sign < 0]
    return f"{words}; the output {'falls' if falls else 'rises'} with {and_joined(falls) if falls else 'f'}"


def has_noise(model: Any) -> bool:
    """Whether a model has noise covariances."""
    return isinstance(getattr(model, "noise", None), NoiseCovariances)


def noise_table(fit: Fit) -> Table | None:
    """Innovations, noise at the outputs and its colour for a state-space model with noise covariances."""
    model = fit.model
    if not has_noise(model):
        return None
    from optid.identify.noise import colour, output_deviations

    tests: dict[str, Any] = {}
    if isinstance(fit.data, Data):
        with suppress(DataError, StructureError):  # a simulation that diverges, a marginal mode that no output sees
            tests = colour(model, fit.data)
    spread = output_deviations(model)
    own = np.sqrt(np.diag(model.noise.innovation))
    rows = []
    for name, unit, innovation, total in zip(model.outputs, model.output_units, own, spread):
        test = tests.get(name)
        word = "-" if test is None or np.isnan(test.p_value) else "white" if test.passed else "coloured"
        p_value = "-" if test is None else number(test.p_value, 2)
        rows.append((with_unit(name, unit), number(innovation, 4), number(total, 4), word, p_value))
    note = (
        "Standard deviations. Q, R and S (model.noise) are those of the innovation form; others with the same spectrum "
        "explain the record equally well.")
    return Table("Noise", ("output", "innovations", "noise at output", "colour", "p value"), rows, note)


_ROWS = ("rows", "candidates", "condition", "method")
"""Figures of the compressed statistics, which `record_facts` reports."""


def _measured(value: Any) -> str:
    """Write a figure of a procedure: a number, a text, or the first entries of an array."""
    if isinstance(value, bool | str) or value is None:
        return value if isinstance(value, str) else {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_measured(entry)}" for key, entry in value.items())
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        return str(value)
    if array.ndim == 0:
        return number(float(array), 5)
    shown = " ".join(number(float(entry), 4) for entry in array.ravel()[:MOST])
    return shown + (f" ... ({array.size} in all)" if array.size > MOST else "")
