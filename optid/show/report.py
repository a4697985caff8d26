"""The report: one HTML page that carries its figures and its style with it."""

import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optid import __version__, plots
from optid.data.record import Data
from optid.errors import DataError, DataWarning
from optid.identify.validation import Validation, validate
from optid.lazy import public_names
from optid.models.functions import static_functions
from optid.show import checks, comparing, estimates, summary, wording
from optid.show.page import figure, template, versions
from optid.show.printing import describe

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.identify.validation.comparison import Comparison


def write(fit: "Fit", path: str | Path, test: Data | None = None, *, command: str = "") -> Path:
    """Write a self-contained HTML page: it opens offline and makes no request.

    Args:
        fit: the fit.
        path: the file, replaced when it exists.
        test: record the fit has not seen; adds its validation.
        command: the command line behind the fit, for the section that says how to reproduce it.

    Returns:
        The path.

    Raises:
        DataError: the fit has no model to report.
        OSError: the file cannot be written.
    """
    path = Path(path)
    path.write_text(render(fit, test, command=command), encoding="utf-8")
    return path


def render(fit: "Fit", test: Data | None = None, *, command: str = "") -> str:
    """Return the page that `write` writes."""
    if fit.model is None:
        raise DataError(f"there is no model to report: the fit ended with status '{fit.solution.status}'")
    return template("report.html.j2").render(_content(fit, test, command))


def write_comparison(found: "Comparison", path: str | Path, *, command: str = "") -> Path:
    """Write several models on one self-contained HTML page.

    Args:
        found: what `optid.compare_models` returned.
        path: the file, replaced when it exists.
        command: the command line behind it.

    Returns:
        The path.

    Raises:
        OSError: the file cannot be written.
    """
    path = Path(path)
    path.write_text(template("comparison.html.j2").render(_compared(found, command)), encoding="utf-8")
    return path


def _compared(found: "Comparison", command: str) -> dict[str, Any]:
    figures = []
    if any(found.simulated):
        caption = "Measured and simulated outputs; every simulation starts from the initial state that fits best."
        figures.append(figure("simulations", lambda: comparing.simulations(found), caption))
    caption = "Fit against how many samples ahead is predicted; dotted: the simulation, which knows no output."
    figures.append(figure("horizons", lambda: comparing.horizons(found), caption))
    figures.append(figure("poles", lambda: comparing.poles(found), "Poles of the linear parts."))
    several = len(found.names) > 1
    return {
        "version": __version__,
        "title": f"{len(found.names)} models on one record" if several else f"Validation of a {found.models[0].title}",
        "lead": " · ".join(part for part in (found.data.name, f"{found.data.n_samples} samples") if part),
        "fits": checks.comparison_table(found),
        "facts": checks.facts_table(found),
        "figures": figures,
        "validation": [
            {
                "title": name,
                "equation": [_breakable(line) for line in model.equation().splitlines()],
                "tables": checks.validation_tables(checked),
                "notes": checked.notes,
            }
            for name, model, checked in zip(found.names, found.models, found.validations)
        ],
        "call": command or f"optid.compare_models(models, data, horizon={found.horizon})",
        "versions": versions(),
        "text": str(found),
        "sections": [("fits", "Fits"), ("figures", "Figures"), ("validation", "Models"), ("reproduce", "Reproduce")],
    }


def _content(fit: "Fit", test: Data | None, command: str) -> dict[str, Any]:
    tone, word, sentence = summary.verdict(fit)
    checked = _checked(fit, test)
    tables = [*estimates.parameter_tables(fit), *estimates.nonlinearity_tables(fit), summary.fit_table(fit)]
    tables += [noise] if (noise := summary.noise_table(fit)) else []
    return {
        "version": __version__,
        "title": summary.title(fit),
        "lead": " · ".join(part for part in (fit.formulation, fit.data.name, _length(fit)) if part),
        "tone": tone,
        "word": word[:1].upper() + word[1:],
        "sentence": sentence,
        "judged": summary.verdict_table(fit.verdict) if fit.verdict is not None else None,
        "judged_tone": summary.TONES[fit.verdict.word] if fit.verdict is not None else "",
        "findings": fit.findings,
        "cards": _cards(fit, checked.get("test")),
        "equation": [_breakable(line) for line in fit.model.equation().splitlines()],
        "model_notes": [f"{name}: {value}" for name, value in summary.model_facts(fit)],
        "model_tables": tables,
        "evidence": summary.evidence_facts(fit),
        "coefficients": estimates.coefficient_table(fit),
        "figures": _figures(fit),
        "constraints": summary.constraint_table(fit) if fit.prices else None,
        "certificate": summary.certificate_facts(fit),
        "certificate_figure": figure(
            "certificate",
            lambda: plots.certificate(fit),
            "How far the proof of global optimality went, and the gap that is left.",
        ),
        "validation": [_validation(fit, name, test, found) for name, found in checked.items()],
        "record": summary.record_facts(fit),
        "channels": summary.channel_table(fit),
        "solver": summary.solver_facts(fit),
        "call": "\n".join(part for part in (command, summary.call(fit)) if part),
        "versions": versions(),
        "text": describe(fit),
        "sections": [
            (id, name)
            for id, name, present in (
                ("model", "Model", True),
                ("figures", "Figures", True),
                ("constraints", "Constraints", bool(fit.prices)),
                ("certificate", "Certificate", True),
                ("validation", "Validation", bool(checked)),
                ("data", "Data", True),
                ("solver", "Solver", True),
                ("reproduce", "Reproduce", True),
            )
            if present
        ],
    }


def _checked(fit: "Fit", test: Data | None) -> dict[str, Validation]:
    """Validate on the estimation record, unless it was a stream, and on the test record, where there is one."""
    records = {"est": fit.data, "test": test}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # they stand in the notes
        return {name: validate(fit.model, record) for name, record in records.items() if isinstance(record, Data)}


def _breakable(equation: str) -> str:
    """Leave line breaks to the places before a sign."""
    return re.sub(r" (?![+-] )", "\N{NO-BREAK SPACE}", equation)


def _length(fit: "Fit") -> str:
    return f"{fit.data.n_samples} samples" if fit.data.n_samples else ""


def _cards(fit: "Fit", tested: Validation | None) -> list[dict[str, str]]:
    """The figures of the first glance; of several outputs the lowest."""
    solution = fit.solution
    fits = [("one-step fit", fit.one_step_fit), ("simulation fit", summary.simulation_fit(fit))]
    if tested is not None:
        simulated = [q.fit for q in tested.simulation.values()]
        fits.append(("simulation fit, test record", np.array(simulated or np.nan)))
    which = ", lowest output" if fit.model.l > 1 else ""
    cards = [(label + which, wording.percent(np.min(values))) for label, values in fits]
    cards.append(("relative gap to the bound", "none" if solution.bound is None else wording.gap_text(solution.gap)))
    if fit.prices:
        cards.append(("constraints active", f"{sum(p.binding for p in fit.prices)} of {len(fit.prices)}"))
    cards.append(("time", wording.seconds(fit.seconds)))
    return [{"label": label, "value": value} for label, value in cards]


def _figures(fit: "Fit") -> list[dict[str, Any]]:
    found = []
    if isinstance(fit.data, Data):
        found.append(
            figure(
                "time",
                lambda: plots.fit_over_time(fit),
                "Measured, simulated and one-step predicted output on "
                "the estimation record; the simulation starts from the initial state that fits best.",
            )
        )
    if static_functions(fit.model):
        found.append(
            figure(
                "nonlinearity",
                lambda: plots.nonlinearity(fit),
                "Static nonlinearity, with its 95 % band where there is one. The bars show where the samples lie.",
            )
        )
    if plots.theta_singular_values(fit):
        found.append(
            figure(
                "theta",
                lambda: plots.singular_values(fit),
                "Singular values of the coefficient matrix before "
                "its rank is forced to one. A single one that stands out speaks for the Hammerstein structure.",
            )
        )
    if summary.spectra(fit):
        found.append(
            figure(
                "spectra",
                lambda: plots.spectra(fit),
                "Singular values from which the order is read, relative to the first; those kept in colour.",
            )
        )
    found.append(
        figure(
            "dynamics",
            lambda: plots.poles_and_response(fit),
            "Poles, frequency response (with 95 % bands where there are standard errors, up to the Nyquist frequency) "
            "and step response of the linear part.",
        )
    )
    if summary.has_noise(fit.model):
        found.append(
            figure(
                "noise",
                lambda: plots.noise(fit),
                "Spectral density of the noise at the outputs, process and measurement noise together. A flat line is "
                "white noise.",
            )
        )
    return found


TITLES = {"est": "Estimation record", "test": "Test record, not seen by the fit"}


def _validation(fit: "Fit", name: str, test: Data | None, checked: Validation) -> dict[str, Any]:
    record = test if name == "test" else None
    figures = [
        figure(
            f"{name}-residuals",
            lambda: plots.residual_tests(fit, record, checked),
            "Autocorrelation of the residuals and their cross-correlation with the inputs; shaded: 99 % bands.",
        )
    ]
    if record is not None:
        figures.insert(
            0,
            figure(
                f"{name}-time",
                lambda: plots.fit_over_time(fit, record),
                "Measured, simulated and one-step predicted output on the test record.",
            ),
        )
    tables = checks.validation_tables(checked)
    return {"title": TITLES[name], "tables": tables, "notes": checked.notes, "figures": figures}


__dir__ = public_names(__name__)
