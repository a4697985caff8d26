"""Errors of a model against the true system of a simulated record, independent of the gauge of the model.

Scale and offset of a nonlinearity are not identifiable separately from the linear part and the constant of a model.
So every f of the model is first fitted to the true one by scale and offset; the residual is the error of the
nonlinearity. The linear part is divided by the same scale and compared by its impulse response.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.models.functions import has_feedback

GRID = 401  # points at which nonlinearities are compared


@dataclass(frozen=True, eq=False)
class Truth:
    """The system behind a simulated record."""

    f: tuple[Callable[[np.ndarray], np.ndarray], ...]  # one function per input
    ranges: tuple[tuple[float, float], ...]  # (low, high) of every input, where its function is compared
    response: np.ndarray | None = None  # (K, l, m) impulse response; None with nonlinear feedback

    def nonlinearity_error(self, model: Any) -> float:
        """Return the root mean square error of f over the standard deviation of the true f on the grid.

        Between 0 and 1; 1 is the error of a constant. The root mean square over the inputs; NaN for a model with other
        inputs or with several functions of one input.
        """
        matched = self._matched(model)
        return float("nan") if matched is None else float(np.sqrt(np.mean([error**2 for _, error in matched])))

    def parameter_error(self, model: Any) -> float:
        """Return the norm of the error of the impulse response over the norm of the true one.

        NaN if either has nonlinear feedback, for a model with other channels or with several functions of one input;
        infinite if f of the model is unrelated to the true one.
        """
        matched = self._matched(model)
        if matched is None or self.response is None or has_feedback(model):
            return float("nan")
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # an unstable model
            found = model.impulse_response(len(self.response)) / np.array([scale for scale, _ in matched])
            if found.shape != self.response.shape:
                return float("nan")
            error = float(np.linalg.norm(found - self.response) / np.linalg.norm(self.response))
        return error if np.isfinite(error) else float("inf")

    def _matched(self, model: Any) -> list[tuple[float, float]] | None:
        """(scale, error) of every input: scale times the model's f plus an offset is next to the true f."""
        functions = model.nonlinearities
        if len(functions) != len(self.f) or tuple(getattr(model, "input_of", range(len(functions)))) != tuple(
                range(len(functions))):
            return None
        found = []
        for f, truth, (low, high) in zip(functions, self.f, self.ranges):
            u = np.linspace(low, high, GRID)
            ours, theirs = f(u), truth(u)
            ours, theirs = ours - ours.mean(), theirs - theirs.mean()
            power = float(ours @ ours)
            scale = float(ours @ theirs) / power if power else 0.0
            found.append((scale, float(np.linalg.norm(scale * ours - theirs) / np.linalg.norm(theirs))))
        return found
