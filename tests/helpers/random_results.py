"""Random fits of every formulation, and every use of a result: print, report, draw, save, load, pickle, export."""

import io
import pickle
import warnings
from contextlib import suppress
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
from random_calls import limited

import optid
from optid.errors import DataError, DataWarning, OptidError, StructureError
from optid.registry import FORMULATIONS, find_entry_points
from optid.show.documents import fit_document
from optid.show.page import render
from optid.show.sections import FAILED

NAMES = sorted(find_entry_points(FORMULATIONS))
SYSTEMS = ("plain", "white", "slow", "unstable", "no effect", "noise-free", "integrator", "feedback", "gaps", "huge",
           "tiny", "levels", "pulse", "constant end", "resonant")
BASES = ("polynomial:2", "polynomial:3", "triangular:4", "piecewiseconstant:3", "bspline:5", "trigonometric:2",
         "linear")
CONSTRAINTS = ("stable:0.95", "monotone:increasing", "gain:1.0", "stable", "saturation:-0.5:0.5", "odd")
PLOTS = (optid.plots.fit_over_time, optid.plots.certificate, optid.plots.residual_tests,
         optid.plots.poles_and_response)


def tank(v: Any) -> dict[str, Any]:
    """A leaking tank with a cubic leak."""
    return {"x": v["a"] * v["x"] - v["c"] * v["x"] ** 3 + v["b"] * v["u"], "y": v["x"] + v["d"]}


TANK = optid.Equations(tank, {"x": 0.1}, {"a": 0.5, "b": 0.8, "c": 0.1, "d": 0.1}, time="discrete")


def record(system: str, n: int, m: int, l: int, rng: np.random.Generator) -> optid.Data:  # noqa: E741
    """Return a record of n samples of a system."""
    u = rng.uniform(-1, 1, (n, m))
    if system == "levels":
        u = np.repeat(rng.choice([-1.0, 0.0, 1.0], (n, m)), 4, axis=0)[:n]
    elif system == "pulse":
        u = np.zeros((n, m))
        u[n // 4 : n // 3] = 1.0
    pole = {"slow": 0.99, "unstable": 1.03, "integrator": 1.0, "white": 0.0, "feedback": 1.5, "resonant": 0.3}.get(
        system, 0.6)
    y = np.zeros((n, l))
    for k in range(1, n):
        drive = 0.0 if system in ("white", "no effect") else u[k - 1] ** 3 @ np.ones((m, l)) * np.arange(1, l + 1)
        y[k] = pole * (np.tanh(y[k - 1]) if system == "feedback" else y[k - 1]) + drive
        if system == "resonant" and k > 1:
            y[k] -= 0.95 * y[k - 2]
        if system == "no effect":
            y[k] += rng.standard_normal(l)
    if system != "noise-free":
        y += (1.0 if system == "white" else 0.05) * rng.standard_normal((n, l))
    if system == "constant end":
        y[n // 2 :] = y[n // 2]
    if system == "gaps":
        y[rng.random((n, l)) < 0.1] = np.nan
    return optid.Data(u, y * {"huge": 1e100, "tiny": 1e-100}.get(system, 1.0), 0.5)


def draw(seed: int) -> tuple[str, optid.Data, str, dict[str, Any]]:
    """Return a system, its record, the name of a formulation, and its arguments."""
    rng = np.random.default_rng([seed, 41])
    name, system = NAMES[seed % len(NAMES)], str(rng.choice(SYSTEMS))
    known = signature(find_entry_points(FORMULATIONS)[name].load()).parameters
    m, l = (1 if name == "physical" or rng.random() < 0.7 else 2 for _ in range(2))  # noqa: E741
    several = "nx" in known or name.startswith(("arx", "hammerstein_arx"))
    usual = {"na": rng.integers(0, 4), "nb": rng.integers(1, 4), "nk": rng.integers(0, 3), "nc": rng.integers(1, 3),
             "nd": rng.integers(1, 3), "nx": rng.integers(1, 4), "basis": rng.choice(BASES), "weight": 0.1,
             "starts": 2, "iterations": 20, "tries": 1, "equations": TANK}
    given = {key: value.item() if isinstance(value, np.generic) else value
             for key, value in usual.items() if key in known}
    if name == "subspace.nuclear":
        del given["weight"]
    if "feedback_basis" in known and rng.random() < 0.4:
        given["feedback_basis"] = str(rng.choice(["polynomial:2", "polynomial:3", "triangular:4"]))
    if "criterion" in known and rng.random() < 0.4:
        given["criterion"] = "prediction"
    if rng.random() < 0.25:
        given["constraints"] = [str(rng.choice(CONSTRAINTS))]
    n = int(np.exp(rng.uniform(np.log(20), np.log(400))))
    return system, record(system, n, m, l if several else 1, rng), name, given


def uses(fit: Any, folder: Path, seed: int) -> dict[str, Any]:
    """Return what is done with a fit, by name; each returns what is wrong, nothing where all is well.

    What takes long alternates with the seed: figures, the advice of a page, and the text of an unpickled fit, whose
    programme is solved again.
    """
    model, data = fit.model, fit.data

    def text() -> str:
        return _failed(str(fit) + fit._repr_html_() + str(fit.params) + fit.params._repr_html_() + str(model))

    def page() -> str:
        test = data if seed % 2 else None
        if seed % 4 == 0:
            return _failed(fit.report(folder / "fit.html", test).read_text(encoding="utf-8"))
        return _failed(render(fit_document(fit, test, advise=False)))

    def figure() -> None:
        drawn = fit.plot() if seed % 2 else PLOTS[seed // 2 % 4](fit)
        drawn.savefig(io.BytesIO(), dpi=30)

    def load() -> str:
        again = optid.load(model.save(folder / "model.json"))
        return "other text" if str(again) != str(model) else _differ(model, again, data)

    def pickled() -> str:
        again, found = pickle.loads(pickle.dumps(fit)), pickle.loads(pickle.dumps(model))
        if seed % 5 == 0 and str(again) != str(fit):
            return "other text"
        return _differ(model, again.model, data) or _differ(model, found, data)

    def validation() -> str:
        if not isinstance(predictions := run(model, data)[0], str) and np.isfinite(predictions).any(axis=0).all():
            checked, compared = fit.validate(), optid.compare_models([model], data)
            checked.report(folder / "checked.html"), compared.report(folder / "compared.html")
            return _failed(str(checked) + checked._repr_html_() + str(compared) + compared._repr_html_())
        return ""  # of a model that predicts nothing `validate` says so

    def exported() -> None:
        if fit.formulation == "process.exact":  # in continuous time, where a dead time needs an approximation
            with suppress(StructureError):  # an integrator, a drift, inputs that go straight
                model.to_continuous(), model.to_fmu(folder / "model.fmu", binary=False)
                model.to_control(pade=2) if find_spec("control") else None
            return
        model.to_c(folder / "model.c"), model.to_st(folder / "model.st"), model.to_casadi()
        model.to_dlti(), model.to_control() if find_spec("control") else None
        str(model.pole_table), model.zeros
        with suppress(StructureError):  # a pole at 0, a negative real one, nonlinear feedback
            model.to_continuous()

    return {"text": text, "repr": lambda: repr(fit) + repr(model) and "", "page": page, "figure": figure, "load": load,
            "pickle": pickled, "validation": validation, "export": exported}


def run(model: Any, data: optid.Data) -> list[Any]:
    """Return the prediction and the simulation of a record, or why there is none."""
    found: list[Any] = []
    for simulator in (model.predict, model.simulate):
        try:
            found.append(simulator(data))
        except DataError as error:
            found.append(str(error))
    return found


def _differ(model: Any, other: Any, data: optid.Data) -> str:
    same = (one == two if isinstance(one, str) else np.array_equal(one, two, equal_nan=True)
            for one, two in zip(run(model, data), run(other, data)))
    return "" if all(same) else "other predictions"


def _failed(shown: str) -> str:
    return "a part failed" if FAILED in " ".join(shown.split()) else ""


def troubles(seed: int, folder: Path) -> list[str] | None:
    """Fit, and use the result in every way; return what fails, None where optid refuses the fit with a reason."""
    system, data, name, given = draw(seed)
    said = f"{seed}: {system} {data.n_samples}x{data.m}x{data.l} {name} {given}"
    with warnings.catch_warnings(action="ignore", category=DataWarning), limited(120):
        try:
            fit = optid.fit(data, name, **given)
        except OptidError:
            return None
        except Exception as error:  # noqa: BLE001
            return [f"{said}: fit: {type(error).__name__}: {error}"[:500]]
    found = []
    for what, use in uses(fit, folder, seed).items():
        with warnings.catch_warnings(action="ignore", category=DataWarning), limited(120):
            try:
                if wrong := use():
                    found.append(f"{said}: {what}: {wrong}")
            except Exception as error:  # noqa: BLE001
                found.append(f"{said}: {what}: {type(error).__name__}: {error}"[:500])
    return found
