"""Choose the weight of a penalty: along a path, or by hold-out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.equation_error import EquationError
from optid.identify.fitting import Fit, fit, resolve
from optid.identify.validation.predictions import prediction_fit
from optid.progress import track

PENALTIES = ("ridge", "curvature", "weight")


@dataclass(frozen=True)
class Path:
    """Fits along a grid of penalty weights.

    Attributes:
        penalty: name of the argument that was varied.
        weights: (k,) the grid, increasing.
        fits: one per weight.
        scores: (k,) mean one-step fit in % on the hold-out part; NaN where there was none.
    """

    penalty: str
    weights: np.ndarray
    fits: tuple[Fit, ...]
    scores: np.ndarray

    @property
    def best(self) -> int:
        """Index of the largest weight whose score is within 0.02 points of the best: the simplest of equals."""
        close = np.flatnonzero(self.scores >= np.nanmax(self.scores) - 0.02)
        return int(close[-1])

    def __str__(self) -> str:
        lines = [f"{self.penalty:>12}   objective   hold-out one-step fit (%)   singular values 2/1"]
        for i, (weight, one, score) in enumerate(zip(self.weights, self.fits, self.scores)):
            mark = " <" if np.isfinite(score) and i == self.best else ""
            lines.append(f"{weight:12.4g}   {one.solution.objective:9.4g}   {score:25.3f}   {_ratio(one):19.2e}{mark}")
        return "\n".join(lines)


def path(data: Data, formulation: str, *, penalty: str, weights: Sequence[float] | None = None,
         holdout: float = 0.3, **arguments: Any) -> Path:
    """Fit along a grid of weights of one penalty.

    A penalty that is a weight of the problem (the nuclear norm) is solved again from the solution before, without
    compressing the record twice.

    Args:
        data: the record.
        formulation: name of the formulation.
        penalty: "ridge", "curvature" or "weight" (of the nuclear norm).
        weights: grid; default 13 values over six decades below the energy of the record.
        holdout: share of every experiment, from its end, that is kept for the score; 0 means no score.
        arguments: as for `optid.fit`.

    Raises:
        StructureError: unknown penalty or an impossible share.
    """
    if penalty not in PENALTIES:
        raise StructureError(f"penalty is one of {', '.join(PENALTIES)}; got {penalty!r}")
    if not 0 <= holdout < 1:
        raise StructureError(f"holdout must be a share from 0 to below 1; got {holdout!r}")
    train, test = data.split(1 - holdout) if holdout else (data, None)
    grid = default_weights(train) if weights is None else np.sort(np.asarray(weights, dtype=float))
    fits, scores = [], []
    for weight in track(grid, f"path of {penalty}", len(grid)):
        if fits and penalty in fits[-1].problem.weights:
            one = resolve(fits[-1], {penalty: float(weight)}, solver=arguments.get("solver", "auto"))
        else:
            one = fit(train, formulation, **{**arguments, penalty: float(weight)})
        fits.append(one)
        scores.append(np.nan if test is None else float(np.nanmean(prediction_fit(one.model, test))))
    return Path(penalty, grid, tuple(fits), np.array(scores))


def fit_by_holdout(data: Data, formulation: str, *, penalty: str, weights: Sequence[float] | None = None,
                   holdout: float = 0.3, **arguments: Any) -> Fit:
    """Choose the weight of a penalty by hold-out and fit the whole record with it; arguments as in `path`.

    The chosen weight is in ``fit.arguments[penalty]``; the findings name it with its score.
    """
    if not holdout > 0:
        raise StructureError("hold-out needs a share above 0")
    found = path(data, formulation, penalty=penalty, weights=weights, holdout=holdout, **arguments)
    weight = float(found.weights[found.best])
    final = fit(data, formulation, **{**arguments, penalty: weight})
    sentence = (f"{penalty} = {weight:.4g} chosen by hold-out ({100 * holdout:.0f} % of the record): one-step fit "
                f"{found.scores[found.best]:.2f} % there")
    return replace(final, findings=(*final.findings, sentence))


def default_weights(data: Data) -> np.ndarray:
    """Return 13 weights over six decades, the largest a hundredth of the energy of the outputs about their mean."""
    energy = sum(float(np.nansum((e.y - np.nanmean(e.y, axis=0)) ** 2)) for e in data.experiments)
    return 0.01 * energy * np.logspace(-6, 0, 13)


def _ratio(one: Fit) -> float:
    """Largest ratio of the second to the first singular value over the channels."""
    compressed = one.problem.compressed
    thetas = compressed.matrices(one.solution.values) if isinstance(compressed, EquationError) else ()
    values = [np.linalg.svd(theta, compute_uv=False) for theta in thetas]
    return max([0.0, *(float(v[1] / v[0]) for v in values if v.size > 1 and v[0] > 0)])
