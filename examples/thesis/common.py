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
from optid.show.panels import styled as styled

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


def panels(rows: int, columns: int, **settings: Any) -> tuple[Figure, Any]:
    """A figure with rows x columns panels."""
    figure = Figure(figsize=(4.2 * columns, 2.7 * rows), layout="constrained")
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


def subspace(data: optid.Data, method: str, quiet: bool = True, **settings: Any) -> Any:
    """Model of a subspace method: "sid" (linear unless a basis is given), "sivid" or "asivid"; without the proof."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if quiet else "default", optid.errors.DataWarning)
        return optid.fit(data, f"hammerstein_ss.{method}", prove=False, **settings).model
