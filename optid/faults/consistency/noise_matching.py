"""Covariances of a window by lag, and their signatures of added noise."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, StructureError
from optid.faults.consistency.noise_changes import noise_places
from optid.faults.signatures import Dictionary
from optid.faults.whitening import Whitened, check_window

if TYPE_CHECKING:
    from optid.program.solution import Solution

NOTHING = 1e-4
"""Covariances, in standard deviations, below which the result of an interior-point method is zero."""


@dataclass(frozen=True, eq=False)
class CovarianceProblem:
    """Lagged covariances of a window less those of a healthy plant, in units of their standard deviations."""

    labels: tuple[str, ...]  # the C places
    target: Array  # (M,)
    signatures: Array  # (M, C) for unit variances
    by_process: Array  # (M, n n) for the entries of the covariance of added process noise, column by column
    by_sensor: Array  # (M, l l) the same for sensor noise
    nx: int  # number of states n
    l: int  # noqa: E741 - number of outputs
    state_units: Array  # (n,) variances of the process noise of the model, the units of Q
    output_units: Array  # (l,) variances of its sensor noise
    lags: int  # largest lag

    @property
    def units(self) -> list[Array]:
        """Units of the entries of Q and of R."""
        return [np.sqrt(np.outer(units, units)) for units in (self.state_units, self.output_units)]


@dataclass(frozen=True, eq=False)
class CovarianceMatch:
    """The variances or covariances that match those of a window."""

    labels: tuple[str, ...]  # the C places
    rho: Array  # (C,) variance of the added noise in every place; NaN with full covariances
    gains: Array  # (C,) size of the covariances explained, in standard deviations
    Q: Array | None  # (n, n) covariance of the added process noise; None with places
    R: Array | None  # (l, l) covariance of the added sensor noise; None with places
    objective: float  # half the squares left
    gap: float  # relative duality gap
    certified: bool  # whether it is proved optimal
    lags: int  # largest lag
    status: str = ""  # the reason where it is not certified

    @classmethod
    def of(cls, problem: CovarianceProblem, solution: "Solution") -> "CovarianceMatch":
        """Read the solution of either programme."""
        rho, gains, Q, R = np.full(len(problem.labels), np.nan), np.full(len(problem.labels), np.nan), None, None
        if solution.has_point and "scaled" in solution.values:
            scaled = np.asarray(solution.values["scaled"])
            gains = np.where(scaled > NOTHING, scaled, 0.0)
            rho = gains / np.linalg.norm(problem.signatures, axis=0)
        elif solution.has_point:
            Q, R = (np.asarray(solution.values[name]) * units for name, units in zip("QR", problem.units))
        return cls(problem.labels, rho, gains, Q, R, solution.objective, solution.gap, not solution.doubt, problem.lags,
                   solution.doubt)

    @property
    def best(self) -> str:
        """The place with the largest gain; `StructureError` with full covariances, which have no places."""
        if np.isnan(self.gains).all():
            raise StructureError("Full covariances have no place: match the candidates (form='places').")
        return self.labels[int(np.nanargmax(self.gains))]

    def __str__(self) -> str:
        """Print what was matched."""
        lines = [f"covariances up to lag {self.lags} matched; relative gap {self.gap:.1e}"]
        if self.Q is None:
            lines += [f"  {label[:32]:<34}std added {np.sqrt(rho):>9.3g}   explains {gain:>7.2f} sigma"
                      for label, rho, gain in zip(self.labels, self.rho, self.gains)]
        else:
            assert self.R is not None
            lines += [f"  added process noise, std along the states: {np.round(np.sqrt(np.diag(self.Q)), 4)}"[:80],
                      f"  added sensor noise, std: {np.round(np.sqrt(np.diag(self.R)), 4)}"[:80]]
        return "\n".join(lines if self.certified else [*lines, f"  not certified: {self.status}"[:80]])


def covariance_problem(found: Dictionary, whitened: Whitened, *, lags: int | None = None, onset: int = 0
                       ) -> CovarianceProblem:
    """Return the lagged covariances of a window and the signatures of noise.

    Pairs of samples with a missing reading are left out; signatures are those of a plant with all readings.

    Args:
        found: the candidates, as in `optid.faults.consistency.noise_changes.noise_search`.
        whitened: the window; one experiment.
        lags: largest lag; None for the settling of the predictor, at most a tenth of the window.
        onset: first sample that is used.

    Raises:
        DataError: fewer than ten complete samples for every lag, innovations that are not finite.
        StructureError: lags or an onset that do not fit the window, several experiments, no place.
    """
    check_window(found.model, whitened, "The match of covariances", onset)
    l, used = whitened.r.shape[1], len(whitened.r) - int(onset)  # noqa: E741
    if lags is None:
        lags = min(whitened.predictor.settling, max(1, used // 10))
    if lags != int(lags) or not 0 <= lags < used:
        raise StructureError(f"lags={lags!r} must be an integer from 0 to {used - 1}.")
    places = noise_places(found)
    if not places:
        raise StructureError("The dictionary has no place where noise may increase.")
    r, complete = whitened.r[onset:], np.asarray(whitened.present[onset:].all(axis=1))
    target, weights = [], []
    upper = np.triu_indices(l)
    for lag in range(int(lags) + 1):
        there = complete[lag:] & complete[: used - lag]
        pairs = int(there.sum())
        if pairs < 10:
            raise DataError(
                f"{pairs} pairs of complete samples at lag {lag} are too few: use a longer window or fewer lags.")
        S = r[lag:][there].T @ r[: used - lag][there] / pairs
        target.append(S.ravel() if lag else (S - np.eye(l))[upper])
        weights.append(np.full(target[-1].size, np.sqrt(pairs)))
    weights[0] /= np.sqrt(np.where(upper[0] == upper[1], 2.0, 1.0))  # a variance scatters twice as much
    weight = np.concatenate(weights)[:, None]
    n, steady, noise = found.model.nx, whitened.predictor, found.model.noise
    length, d = int(lags) + 2 * steady.settling + 2, n + l
    state, output = np.zeros((length, n, d)), np.zeros((length, l, d))
    state[0, :, :n], output[0, :, n:] = np.eye(n), np.eye(l)
    h = steady.whitened(steady.respond(state, output))
    blocks = [np.einsum("kia,kjb->ijab", h[lag:], h[: length - lag]) for lag in range(int(lags) + 1)]
    entries = np.concatenate([blocks[0][upper], *(block.reshape(l * l, d, d) for block in blocks[1:])])
    entries = weight[:, :, None] * entries  # of the entries of a covariance of noise in states and outputs
    columns = []
    for _, candidate in places:
        enters = np.vstack([candidate.into_state, candidate.into_output])
        columns.append(np.einsum("mab,ac,bc->m", entries, enters, enters))
    assert noise is not None
    units = [np.maximum(np.diag(c), 1e-6 * max(float(np.trace(c)), 1e-300)) for c in (noise.Q, noise.R)]
    return CovarianceProblem(
        tuple(label for label, _ in places), weight[:, 0] * np.concatenate(target), np.stack(columns, axis=1),
        entries[:, :n, :n].reshape(-1, n * n), entries[:, n:, n:].reshape(-1, l * l), n, l, units[0], units[1],
        int(lags))
