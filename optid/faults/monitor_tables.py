"""What the compiled steps of the monitor read and what they change, as named arrays."""

from typing import Any, NamedTuple

import numpy as np

from optid.bases.basis import Array
from optid.errors import StructureError
from optid.faults.signatures import Candidate, Dictionary, response
from optid.faults.sweeps import inverse_roots
from optid.faults.whitening import Predictor
from optid.models.feedback_tables import Tables as Functions

COURSES = {"bias": 0, "drift": 1, "jump": 2, "loss": 3, "stuck": 3}
"""The course of the columns of a kind; as in `optid.faults.monitor_kernels`."""

LENGTH = 4
"""The arrays over onsets are so many windows long, so that they are seldom moved."""

ROOM = 6
"""Directions of faults that are estimated at a time, beside the state."""


class Tables(NamedTuple):
    """What never changes; n states, l outputs, r functions, D columns of C candidates, M of them driven, window W.

    Attributes:
        A: (n, n).
        B: (n, r).
        C: (l, n).
        D: (l, r).
        E: (n, s).
        L: (n, l).
        K: (n, l).
        offset_x: (n,).
        offset_y: (l,).
        output_of: (s,).
        feedback: its functions.
        root: (l, l) whitening of a complete reading.
        covariance: (l, l) of the innovations.
        course: (D,) of `COURSES`.
        which: (D,) number among the driven columns.
        into_state: (n, D), zero for driven columns.
        into_output: (l, D), zero for driven columns.
        driven: (M,) columns that are driven by the input.
        drive_state: (M, n, r) what the functions of the sample before add to the state.
        drive_output: (M, l, r) what those of this sample add to the output.
        first: (C,) first column of a candidate.
        size: (C,) its columns.
        pair: (C,) first row of its products.
        place: (C,) first row of its inverse roots.
        least: (C,) samples without which its magnitudes are not determined.
        additive: (C,) whether its signature is known without the input.
        H: (l, n, W) what a jolt of the state leaves in the whitened innovation, the newest last.
        N: (l, l, W) what one of the output leaves.
        trace: (D, l, W) signatures by age, the youngest last.
        gram: (pairs, W) their products.
        roots: (sum of d^2, W) inverse roots of the products, row by row.
        q: (C,) thresholds.
        rules: numbers of the decisions.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    L: Array
    K: Array
    offset_x: Array
    offset_y: Array
    output_of: np.ndarray
    feedback: Functions
    root: Array
    covariance: Array
    course: np.ndarray
    which: np.ndarray
    into_state: Array
    into_output: Array
    driven: np.ndarray
    drive_state: Array
    drive_output: Array
    first: np.ndarray
    size: np.ndarray
    pair: np.ndarray
    place: np.ndarray
    least: np.ndarray
    additive: np.ndarray
    H: Array
    N: Array
    trace: Array
    gram: Array
    roots: Array
    q: Array
    rules: Array


class State(NamedTuple):
    """What every sample changes; `LASTING_PARTS` are what must be kept for the next sample, the rest is scratch."""

    counts: np.ndarray
    x: Array
    V: Array
    P: Array
    nu: Array
    grown: Array
    power: Array
    column: np.ndarray
    owner: np.ndarray
    held: Array
    slope: Array
    before: Array
    tested: np.ndarray
    b: Array
    G: Array
    beta: Array
    g: Array
    h: Array
    shown: np.ndarray
    energy: Array
    statistic: Array
    peak: np.ndarray
    r: Array
    S: Array
    H: Array
    N: Array
    S0: Array
    Z: Array
    raw: Array
    gain: Array
    turn: Array
    whitening: Array
    predicted: Array
    M: Array
    T: Array
    z: Array
    sizes: Array
    spread: Array
    taken: Array
    line: Array
    other: Array
    later: Array
    moved: Array
    now: Array
    reading: Array
    index: np.ndarray


LASTING_PARTS = State._fields[: State._fields.index("S")]
"""The names of what a file holds."""


def monitored(candidate: Candidate) -> bool:
    """Whether a candidate has a signature that a running search can look for."""
    return candidate.kind in COURSES


def tables(found: Dictionary, chosen: tuple[Candidate, ...], window: int, rules: Array) -> Tables:
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
    sizes = np.array([c.dimension for c in chosen], dtype=np.int64)
    first, columns = np.cumsum([0, *sizes])[:-1], int(sizes.sum())
    course, into_state, into_output = np.zeros(columns, dtype=np.int64), np.zeros((n, columns)), np.zeros((l, columns))
    trace, driven, drives = np.zeros((columns, l, window)), [], []
    for c, begin in zip(chosen, first):
        own = slice(begin, begin + c.dimension)
        course[own] = COURSES[c.kind]
        if c.columns:
            course[begin + 1 : own.stop] = COURSES["bias"]
            driven.append(begin)
            drives.append((_placed(-c.into_state, c.columns, r), _placed(-c.into_output, c.columns, r)))
            own = slice(begin + 1, own.stop)
            if c.kind == "loss":
                continue
        into_state[:, own], into_output[:, own] = c.into_state, c.into_output
        kind = Candidate(c.name, "bias" if c.columns else c.kind, c.into_state, c.into_output)
        trace[own] = np.moveaxis(response(steady, kind, window)[::-1], 0, 2).swapaxes(0, 1)
    which = np.zeros(columns, dtype=np.int64)
    which[driven] = np.arange(len(driven))
    pairs = sizes * (sizes + 1) // 2
    additive = np.array([c.additive for c in chosen])
    gram, roots = _products(trace, first, sizes, additive)
    return Tables(
        *(np.array(part, dtype=float, order="C") for part in (
            model.A, model.B, model.C, model.D, model.E, model.L, steady.K, model.offset_x, model.offset_y)),
        np.array(model.output_of, dtype=np.int64), model.parts.tables, np.array(steady.root, order="C"),
        np.array(steady.covariance, order="C"), course, which, into_state, into_output,
        np.array(driven, dtype=np.int64), *(np.array([d[i] for d in drives]).reshape(-1, rows, r)
                                            for i, rows in ((0, n), (1, l))),
        first, sizes, np.cumsum([0, *pairs])[:-1], np.cumsum([0, *sizes**2])[:-1], -(-sizes // l), additive,
        *_jolts(steady, window), trace, gram, roots, np.full(len(chosen), np.inf), rules,
    )


def blank(t: Tables) -> State:
    """Return the state before the first sample, that of the plant being zero."""
    (l, n), r, columns, window = t.C.shape, t.B.shape[1], t.course.size, t.H.shape[2]  # noqa: E741
    length, room, driven, widest = LENGTH * window, n + ROOM + int(t.size.max()), t.driven.size, int(t.size.max())
    square = max(widest, l)
    counts = np.zeros(12, dtype=np.int64)
    counts[[2, 5, 9]] = -window, -1, -1  # never a missing reading, nothing named, no onset
    shapes: dict[str, Any] = {
        "x": n, "V": (n, room), "P": (room, room), "nu": room, "grown": room, "power": room, "held": columns,
        "slope": columns, "before": r, "b": (columns, length), "G": (len(t.gram), length),
        "beta": (room, columns, length), "g": (driven, n, length), "h": (driven, l, length), "energy": length,
        "statistic": t.size.size, "r": l, "S": (columns, l, window), "H": (l, n, window), "N": (l, l, window),
        "S0": (l, room), "Z": (l, room), "raw": (l, room), "gain": (room, l), "turn": (l, l), "whitening": (l, l),
        "predicted": l, "M": (square, square), "T": (square, square), "z": square, "sizes": square,
        "spread": (square, square), "taken": (room, square), "line": window, "other": window, "later": n, "moved": n,
        "now": r, "reading": l,
    }
    whole = {"counts": counts, "column": np.full(room, -1), "owner": np.full(room, -1),
             "tested": np.ones(t.size.size, dtype=bool), "shown": np.zeros((l, length), dtype=bool),
             "peak": np.full(t.size.size, -1), "index": np.zeros(l, dtype=np.int64)}
    return State(**whole, **{name: np.zeros(shape) for name, shape in shapes.items()})


def _placed(part: Array, columns: tuple[int, ...], r: int) -> Array:
    result = np.zeros((len(part), r))
    result[:, list(columns)] = part
    return result


def _jolts(steady: Predictor, window: int) -> tuple[Array, Array]:
    n, l = steady.K.shape  # noqa: E741
    H, N = np.empty((l, n, window)), np.empty((l, l, window))
    now, direct = steady.root @ steady.C, steady.root
    for at in range(window - 1, -1, -1):
        H[:, :, at], N[:, :, at] = now, direct
        now, direct = now @ steady.F, -now @ steady.K
    return H, N


def _products(trace: Array, first: np.ndarray, sizes: np.ndarray, additive: np.ndarray) -> tuple[Array, Array]:
    """Products of every candidate's columns over the ages, and their inverse roots."""
    window = trace.shape[2]
    gram, roots = [np.zeros((0, window))], [np.zeros((0, window))]
    for begin, d, known in zip(first, sizes, additive):
        own = trace[begin : begin + d]
        whole = np.cumsum(np.einsum("ioa,joa->aij", own, own)[::-1], axis=0)[::-1]
        gram.append(np.stack([whole[:, i, j] for i in range(d) for j in range(i + 1)]))
        root = inverse_roots(whole, np.linalg.eigvalsh(whole)[:, -1]) if known else np.zeros((window, d, d))
        roots.append(np.moveaxis(root.reshape(window, -1), 0, 1))
    return np.vstack(gram), np.ascontiguousarray(np.vstack(roots))
