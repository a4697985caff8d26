"""Likelihood of an explanation when the signatures of an identified model are uncertain.

The errors of the parameters, of covariance P, also change the signature S(theta) nu of a fault of size nu, by J times
the errors with J its sensitivity. The residual then has the covariance I + J P J', which grows with the fault. With the
singular values and axes U of J P^(1/2) (whitened like the window), energies, magnitudes and their covariances at every
onset are those of generalised least squares, and the likelihood includes the determinant along U. Candidates whose
signatures differ by less than these errors are then about equally probable.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.faults.diagnosis.posterior import Explanation, bounded_shares, least_squares, marginal
from optid.faults.nuisance import ModelUncertainty, Nuisance
from optid.faults.places import place_of
from optid.faults.search.scanning import Scan
from optid.faults.signatures import Candidate

SMALL = 1e-3  # singular values below which an error of a signature is neglected


def with_model_uncertainty(found: Explanation, uncertainty: ModelUncertainty | None) -> Explanation:
    """Return an explanation by one candidate with the errors of its signature.

    Without uncertain parameters, or without a signature, it is returned unchanged.
    """
    scan = found.search
    if uncertainty is None or not uncertainty.root.shape[1] or len(found.candidates) != 1 or scan is None:
        return found
    candidate, best = found.candidates[0], found.best
    if candidate.schedule is not None:
        return found
    error = trace_error(scan, uncertainty, candidate, int(found.onsets[best, 0]), found.sizes[best])
    if not error.s.size:
        return found
    r = scan.whitened.r.ravel()
    drop = 1 - 1 / (1 + error.s**2)
    along = error.U.T @ r
    changed = -0.5 * float(np.sum(np.log1p(error.s**2))) + 0.5 * float(np.sum(drop * along**2))
    tested = int(np.sum(~np.isnan(scan.statistic[scan.index(candidate)])))
    traces = np.stack([scan.signature(candidate, int(k)).reshape(r.size, -1) for k in found.onsets[:, 0]])
    shared = np.einsum("nq,knd->kqd", error.U, traces, optimize=True)
    gram = np.einsum("knd,kne->kde", traces, traces, optimize=True)
    gram -= np.einsum("kqd,q,kqe->kde", shared, drop, shared, optimize=True)
    along_traces = np.einsum("knd,n->kd", traces, r) - shared.transpose(0, 2, 1) @ (drop * along)
    spread, nu, energy, _ = least_squares(gram, along_traces, 1e-9)
    logs = marginal(energy, candidate.dimension) - np.log(tested) + changed
    logs = logs + bounded_shares((candidate,), nu, spread)
    return found._replace(
        logs=logs, sizes=nu, covariances=spread, energies=energy + 2 * changed, error=error
    ).without_negligible_onsets()


def trace_error(scan: Scan, uncertainty: ModelUncertainty, candidate: Candidate, onset: int, size: Array) -> Nuisance:
    """Return the covariance of the signature of a fault of size (d,) due to the errors of the parameters."""
    white = scan.whitened

    def trace(changed: Any) -> Array:
        found = replace(scan.dictionary, model=changed)
        into_state, into_output = found.additions(moved(candidate, changed), len(white.r), onset, scan.u)
        steady = replace(white.predictor, A=changed.A, C=changed.C, L=changed.L, K=changed.K)
        return np.asarray(steady.respond(into_state @ size[:, None], into_output @ size[:, None], white.present))

    pairs = uncertainty.moves
    columns = np.empty((*white.r.shape, len(pairs)))
    for j, (plus, minus, factor) in enumerate(pairs):
        columns[:, :, j] = (trace(plus) - trace(minus))[:, :, 0] * factor
    flat = white.whiten_signature(columns).reshape(white.r.size, -1)
    U, s, _ = np.linalg.svd(flat, full_matrices=False)
    there = s > SMALL
    return Nuisance(U[:, there], s[there])


def moved(candidate: Candidate, model: Any) -> Candidate:
    """Return a candidate of another model: the columns of an actuator change, directions stay."""
    if not candidate.name.startswith("actuator"):
        return candidate
    into_state, into_output = place_of(model, candidate.name)
    same = into_state.shape == candidate.into_state.shape
    return replace(candidate, into_state=into_state, into_output=into_output) if same else candidate
