"""What the scripts share: for chapter 3 the two bases, the gauge and the error E_N; subspace fits, tables and files.

Source: D. Luo, System Identification and Fault Detection of Complex Systems, PhD dissertation, University of Central
Florida, 2005. Where its numbers are lost, the systems of `optid.examples` and `optid.plants` replace its own.
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import optid
from optid.identify.design.rules import check_lines
from optid.show.panels import with_style as with_style
from optid.statistics.expansion import expand

SERIES = {"basis": "polynomial:4", "feedback_basis": "polynomial:4"}
BASES = {"LSID": {"basis": "linear"}, "SIVID": SERIES, "ASIVID": SERIES}
"""Functions of the pendulum's methods."""

BETA = 0.75
"""Gauge of the dissertation: b = v_1 / beta, so that b has norm 4/3."""


def bases(low: float, high: float) -> dict[str, Any]:
    """The two bases of the chapter on an interval; the half range 1.25 keeps the ends of an odd f apart."""
    return {
        "triangular": optid.Triangular(10, (low, high)),
        "trigonometric": optid.Trigonometric(5, half_range=1.25, interval=(low, high)),
    }


def recursion(data: optid.Data, basis: Any, nb: int = 2) -> optid.RecursiveARX:
    """Algorithm 3.2 as the chapter runs it: theta(0) = 0, P(-1) = 1000 I, a(t) = 1, n_a = 2."""
    return optid.RecursiveARX.like(data, na=2, nb=nb, basis=basis, theta0=0.0, P0=1e3)


def last_error(y: np.ndarray, predicted: np.ndarray, n: int = 200) -> float:
    """E_N of the last n samples as printed in the dissertation: the mean square, without a root."""
    return float(np.mean((y[-n:] - predicted[-n:]) ** 2))


def table(title: str, rows: Sequence[tuple[str, Any, str]]) -> None:
    """Print (quantity, value found, reference) lines."""
    print(f"\n{title}\n{'':<46}{'here':>22}  reference")
    for name, value, reference in rows:
        text = np.array2string(np.asarray(value, dtype=float), precision=4, suppress_small=True)
        print(f"{name:<46}{text:>22}  {reference}")


def panels(rows: int, columns: int, size: tuple[float, float] = (4.2, 2.7), **settings: Any) -> tuple[Figure, Any]:
    """A figure with rows x columns panels of a size in inches."""
    figure = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **settings)


def save(figure: Figure, folder: Path, name: str) -> None:
    """Save a figure in the folder, which is made when it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / name, dpi=150)
    print(f"saved {folder / name}")


def run(main: Callable[[Path], Any]) -> None:
    """Run a script with the folder for its figures from the command line; default: figures."""
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "figures"))


def feedback_error(model: Any, data: optid.Data) -> Any:
    """Error of the simulation with measured feedback (P2), % of the root mean square of each output."""
    simulated = model.simulate_measured_feedback(data, x0="fit")
    return 100 * np.sqrt(np.sum((data.y - simulated) ** 2, axis=0) / np.sum(data.y**2, axis=0))


def subspace(data: optid.Data, method: str, quiet: bool = True, **settings: Any) -> optid.Fit:
    """Fit of a subspace method: "sid" (linear unless a basis is given), "sivid" or "asivid"; without the proof."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if quiet else "default", optid.errors.DataWarning)
        return optid.fit(data, f"hammerstein_ss.{method}", prove=False, **settings)


def pendulum_fit(kind: str, method: str, train: optid.Data, nx: int) -> optid.Fit:
    """Fit of the pendulum by LSID, SIVID or ASIVID, without feedthrough: the command acts on the next sample.

    Of a sinusoid LSID and SIVID leave singular directions out, and ASIVID has the fewest block rows there can be.
    """
    rows = nx + 1 if (kind, method) == ("sinusoid", "ASIVID") else 10
    settings: dict[str, Any] = {"nx": nx, "block_rows": rows, "feedthrough": False, **BASES[method]}
    if method == "SIVID" or (kind, method) == ("sinusoid", "LSID"):
        return subspace(train, "sivid", instruments="inputs+past", tolerance=0.1, **settings)
    weighting = {"LSID": "moesp", "ASIVID": "cva"}[method]
    return subspace(train, "sid" if method == "LSID" else "asivid", noise="white", weighting=weighting, **settings)


def rank(method: str, train: optid.Data, nx: int) -> tuple[float, int]:
    """Return how many numbers the lines of a sinusoid give a method, and how many it asks for.

    Through functions with L spectral lines it excites 2 L + 1 regressors; amplitudes and phases of the l outputs are
    2 L l numbers. ASIVID needs every regressor: functions times block rows. LSID and SIVID do without, but solve
    for the response of every state to every function before they split it into B and f.
    """
    basis = expand(train, BASES[method]["basis"]).inputs[0]
    excited = check_lines("command", [train.u[:, 0]], basis, 10).number
    if method == "ASIVID":
        return excited, (nx + 1) * basis.size
    return train.l * (excited - 1), nx * basis.size


def judged(kind: str, method: str, train: optid.Data, test: optid.Data, nx: int) -> tuple[Any, np.ndarray, str]:
    """Return the fit of the pendulum, its errors of angle and speed in %, and the two as text.

    Where the sinusoid does not determine the model: None, inf and the `rank`.
    """
    try:
        fit = pendulum_fit(kind, method, train, nx)
    except optid.errors.DataError:
        given, asked = rank(method, train, nx)
        if given >= asked:  # another reason
            raise
        return None, np.full(2, np.inf), f"rank {given:g} of {asked}"
    error = feedback_error(fit.model, test)
    return fit, error, f"{error[0]:.3g}/{error[1]:.3g}"
