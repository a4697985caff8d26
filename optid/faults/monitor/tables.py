"""The tables and the first state of the monitor, from a dictionary."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.monitor import layout as at
from optid.faults.monitor.layout import State, Tables
from optid.faults.search.sweeps import inverse_roots
from optid.faults.signatures import Candidate, Dictionary, response
from optid.faults.whitening import Predictor

COURSES = {
    "bias": at.LASTING, "drift": at.DRIFT, "jump": at.JUMP, "spike": at.JUMP, "loss": at.DRIVEN, "stuck": at.DRIVEN,
}
"""The course of the (first) column of a kind."""

LONG = 8
"""The arrays over onsets are so many windows long, so that they are seldom moved."""

SPARE = 8
"""Directions of faults that are estimated at a time, beside the state and twice the widest candidate."""


def monitored(candidate: Candidate) -> bool:
    """Whether a candidate has a signature that a running search can look for."""
    return candidate.kind in COURSES


def tables(found: Dictionary, chosen: tuple[Candidate, ...], window: int, rules: Sequence[float]) -> Tables:
    """Tabulate a dictionary for a window; the thresholds are infinite until they are known.

    Args:
        found: the dictionary.
        chosen: those of its candidates that are looked for.
        window: samples W.
        rules: numbers of the decisions.

    Raises:
        StructureError: a feedback with functions of the user, which cannot be compiled.
    """
    model, steady = found.model, found.predictor
    if not model.parts.tables.compiled:
        raise StructureError(
            "The feedback has functions of the user, which cannot be compiled. Fit them by another basis first."
        )
    n, l, r = model.nx, model.l, model.B.shape[1]  # noqa: E741
    sizes = np.array([c.dimension for c in chosen])
    first, columns = np.cumsum([0, *sizes])[:-1], int(sizes.sum())
    course, into_state, into_output = np.zeros(columns, dtype=np.int64), np.zeros((n, columns)), np.zeros((l, columns))
    trace, driven, drives = np.zeros((columns, l, window)), [], []
    for c, start in zip(chosen, first):
        own = slice(start, start + c.dimension)
        course[own] = COURSES[c.kind]
        if c.columns:
            course[start + 1 : own.stop] = at.LASTING
            driven.append(int(start))
            drives.append([_placed(-part, c.columns, r) for part in (c.into_state, c.into_output)])
            own = slice(start + 1, own.stop)
            if c.kind == "loss":
                continue
        into_state[:, own], into_output[:, own] = c.into_state, c.into_output
        kind = Candidate(c.name, "bias" if c.columns else c.kind, c.into_state, c.into_output)
        trace[own] = np.moveaxis(response(steady, kind, window)[::-1], 0, 2).swapaxes(0, 1)
    which = np.zeros(columns, dtype=np.int64)
    which[driven] = np.arange(len(driven))
    additive = np.array([c.additive for c in chosen])
    gram, roots = _products(trace, first, sizes, additive)
    jolts = _jolts(steady, window)
    whole = np.vstack([*jolts, trace.reshape(-1, window), gram, roots])
    tabled = np.cumsum([len(part) for part in (*jolts, trace.reshape(-1, window), gram)])
    m, length, room = len(driven), LONG * window, n + SPARE + 2 * int(sizes.max())
    kept = np.cumsum([columns, len(gram), m * n, m * l, l, 1])
    scratch = np.cumsum([columns * l, l * n, l * l, 1])
    dim = [n, l, r, len(model.output_of), columns, len(chosen), m, window, length, room, *tabled, *kept, *scratch]
    matrices = [model.A, model.B, model.C, model.D, model.E, model.L, steady.K, steady.root, steady.covariance,
                into_state, into_output, *(d[0] for d in drives), *(d[1] for d in drives)]
    pairs = sizes * (sizes + 1) // 2
    numbers = [dim, model.output_of, course, which, driven, first, sizes, np.cumsum([0, *pairs])[:-1],
               np.cumsum([0, *sizes**2])[:-1], -(-sizes // l), additive]
    vectors = [model.offset_x, model.offset_y, np.full(len(chosen), np.inf), rules]
    return Tables(_stacked(matrices), _rows(vectors, float), _rows(numbers, np.int64), np.ascontiguousarray(whole))


def with_thresholds(t: Tables, q: Array) -> Tables:
    """Return tables with the thresholds (C,)."""
    vectors = t.v.copy()
    vectors[at.THRESHOLD, : len(q)] = q
    return t._replace(v=vectors)


def blank(t: Tables) -> State:
    """Return the state before the first sample, that of the plant being zero."""
    n, l, columns, candidates, window, length, room = (  # noqa: E741
        int(t.i[0, d]) for d in (at.NX, at.NY, at.COLUMNS, at.CANDIDATES, at.WINDOW, at.LENGTH, at.ROOM)
    )
    counts = np.zeros(12, dtype=np.int64)
    counts[[at.DIRTY, at.NAMED, at.PLACE]] = -window, at.NOTHING, -1
    square, wide = max(n, l, room), max(n, l, room, columns, candidates, int(t.i[0, at.NF]))
    whole = np.full((5, wide), -1, dtype=np.int64)
    whole[at.TESTED] = 1
    return State(
        counts, np.zeros((12, square, square)), np.zeros((17, wide)), whole,
        np.zeros((int(t.i[0, at.S_TAKEN]) + room * columns, length)), np.zeros((int(t.i[0, at.C_OTHER]) + 1, window)),
    )


def _stacked(matrices: list[Any]) -> Array:
    whole = np.zeros((len(matrices), *(max(np.shape(part)[axis] for part in matrices) for axis in (0, 1))))
    for number, part in enumerate(matrices):
        whole[number, : np.shape(part)[0], : np.shape(part)[1]] = part
    return whole


def _rows(vectors: list[Any], kind: Any) -> Any:
    whole = np.zeros((len(vectors), max(len(part) for part in vectors)), dtype=kind)
    for number, part in enumerate(vectors):
        whole[number, : len(part)] = part
    return whole


def _placed(part: Array, columns: tuple[int, ...], r: int) -> Array:
    result = np.zeros((len(part), r))
    result[:, list(columns)] = part
    return result


def _jolts(steady: Predictor, window: int) -> tuple[Array, Array]:
    """H (l n, W) and N (l l, W), the youngest last."""
    n, l = steady.K.shape  # noqa: E741
    jolts, directs = np.empty((l, n, window)), np.empty((l, l, window))
    jolt, direct = steady.root @ steady.C, steady.root
    for place in range(window - 1, -1, -1):
        jolts[:, :, place], directs[:, :, place] = jolt, direct
        jolt, direct = jolt @ steady.F, -jolt @ steady.K
    return jolts.reshape(-1, window), directs.reshape(-1, window)


def _products(trace: Array, first: np.ndarray, sizes: np.ndarray, additive: np.ndarray) -> tuple[Array, Array]:
    """Products of every candidate's columns by age, (pairs, W), and their inverse roots (sum of d^2, W)."""
    window = trace.shape[2]
    gram, roots = [], []
    for start, d, known in zip(first, sizes, additive):
        own = trace[start : start + d]
        whole = np.cumsum(np.einsum("ioa,joa->aij", own, own)[::-1], axis=0)[::-1]
        gram += [whole[:, i, j] for i in range(d) for j in range(i + 1)]
        root = inverse_roots(whole, np.linalg.eigvalsh(whole)[:, -1]) if known else np.zeros((window, d, d))
        roots.append(root.reshape(window, -1).T)
    return np.vstack(gram), np.vstack(roots)
