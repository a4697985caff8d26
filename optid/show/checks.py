"""Tables of validations and comparisons: errors, tests, and the fit against the horizon."""

from typing import TYPE_CHECKING, Any

import numpy as np

from optid.models.functions import static_functions
from optid.phrases import p_value, seconds
from optid.show.wording import Table, number, percent

if TYPE_CHECKING:
    from optid.identify.search import Identification
    from optid.identify.search.trial import Trial
    from optid.identify.validation import Comparison, HorizonCurve, Validation


def validation_tables(checked: "Validation") -> list[Table]:
    """Errors of prediction and simulation, by experiment where there are several, and the tests."""
    errors = [
        (f"{name}, {word}", f"{q.fit:.2f}", f"{q.vaf:.2f}", number(q.rmse, 4), number(q.e_n, 4), number(q.snr, 4),
         number(q.snr_amplitude, 3), str(q.samples))
        for name in checked.one_step
        for word, table in checked.predictors.items()
        for q in (table[name],)]
    tables = [Table("Errors", ("prediction", "fit %", "VAF %", "RMSE", "E_N", "SNR", "root SNR", "samples"), errors)]
    if checked.experiments:
        rows = [
            (f"{name}, experiment {k + 1}", *(percent(by[name][k].fit) for by in checked.experiments.values()))
            for name in checked.one_step
            for k in range(len(next(iter(checked.experiments.values()))[name]))]
        tables.append(Table("Fit by experiment", ("output", *checked.experiments), rows))
    return [*tables, _test_table(checked)]


def _test_table(checked: "Validation") -> Table:
    rows = []
    for t in checked.tests:
        outside = f"{t.outside} of {t.lags.size - (t.input is None)}"
        found = (t.outcome, p_value(t.p_value), outside) if np.isfinite(t.p_value) else (t.outcome, "-", "-")
        rows.append((f"{t.output}: {_verdict(t)}", *found))
    structure, note = checked.structure, ""
    if structure is not None:
        outcome = "PASS" if structure.passed else "FAIL"
        rows.append((f"structure: {structure.finding}", outcome, p_value(structure.p_value), "-"))
        ratios = ", ".join(f"{name} {ratio:.3g}" for name, ratio in structure.ratios.items())
        saved = 100 * max(structure.saving, 0)
        note = f"A less restrictive structure would reduce the residual variance by {saved:.2g} %; second over first "
        note += f"singular value of lags by functions: {ratios}."
    return Table("Tests", ("residual of", "outcome", "p value", "lags outside 99 %"), rows, note)


def _verdict(test: Any) -> str:
    """Say in words what a residual test found."""
    if np.isnan(test.p_value):
        return "not tested (constant or rounding error)"
    if test.input is None:
        return "not white" if test.significant else "white"
    return f"depends on {test.input}" if test.significant else f"independent of {test.input}"


def horizon_table(curve: "HorizonCurve") -> Table:
    """Fit of every output against the samples ahead; the simulation is the limit."""
    rows = [(str(h), *(f"{fit:.2f}" for fit in fits)) for h, fits in zip(curve.horizons, curve.fits)]
    if not np.isnan(curve.simulation).all():
        rows.append(("simulation", *(percent(fit).removesuffix(" %") for fit in curve.simulation)))
    return Table("Fit in % against the prediction horizon", ("samples ahead", *curve.outputs), rows)


def comparison_table(found: "Comparison") -> Table:
    """Fit of every output by every predictor, and the residual tests, one row per model and output."""
    rows = []
    for i, (name, checked) in enumerate(zip(found.names, found.validations)):
        for o, output in enumerate(found.data.outputs):
            own = [t for t in checked.cross_correlations.values() if t.output == output]
            fits = [percent(found.fits[word][i, o]) for word in found.fits]
            white = "PASS" if checked.autocorrelations[output].passed else "FAIL"
            label = name if len(found.data.outputs) == 1 else f"{name}: {output}"
            rows.append((label, *fits, white, "PASS" if all(t.passed for t in own) else "FAIL"))
    what = "model" if len(found.data.outputs) == 1 else "model: output"
    note = "Fits over the samples that all models predict."
    if len(found.names) > 1 and "simulation" in found.fits:
        note += f" Best simulation: {found.best()}."
    head = (what, *found.fits, "whiteness", "independence")
    return Table(f"Fit on {found.data.name or 'the record'}", head, rows, note)


def facts_table(found: "Comparison") -> Table:
    """Kind, orders, number of coefficients and largest pole of every model."""
    rows = [
        (name, model.title,
         str(len(model.coefficients()) + sum(f.nonlinearity.mu.size for f in static_functions(model))),
         number(float(np.max(np.abs(model.poles), initial=0.0)), 4))
        for name, model in zip(found.names, found.models)]
    return Table("Models", ("model", "kind", "coefficients", "largest pole"), rows)


def search_table(found: "Identification") -> Table:
    """Return the best structure of every class, and its runner-up."""
    rows = []
    for kind in found.best:
        several = sorted((t for t in found.trials if t.candidate.kind == kind and np.isfinite(t.score)),
                         key=lambda t: t.score, reverse=True)
        best = found.best[kind]
        others = [t for t in several if t is not best][:1]
        rows += [_row(kind, best, best is found.chosen), *(_row("  runner-up", t, False) for t in others)]
    what = "simulation" if found.horizon is None else f"{found.horizon} samples ahead"
    spent = sum(t.seconds for t in found.trials)
    return Table(f"Search over {len(found.trials)} structures ({what}, {found.blocks}-fold cross-validation, "
                 f"{seconds(spent)} CPU)", ("structure", "cv fit %", "worst block", "parameters"), rows)


def worst_block(trial: "Trial") -> str:
    """Return the fit of a trial in its worst block; "-" where no block could be left out."""
    return f"{trial.by_block.min():.1f}" if trial.by_block.size else "-"


def _row(word: str, trial: "Trial", chosen: bool) -> tuple[str, ...]:
    structure = f"{trial.candidate.formulation} {trial.candidate.words}"
    return (f"{'* ' * chosen}{word}: {structure}", f"{trial.score:.1f}", worst_block(trial), str(trial.parameters))
