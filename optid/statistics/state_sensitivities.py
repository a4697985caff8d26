"""Errors of a state-space model and their sensitivities, compressed chunk by chunk.

The unknowns are theta = [A; C; K; offset; mu_c, b_c, d_c of every input; nu_f, e_f of every family of feedback
functions] and one initial state per experiment. The derivatives of the state follow the same recursion as the state
(`optid.statistics.state_sensitivity_kernel`); what leaves a chunk is a factor of [sensitivities | errors].
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.errors import DataError
from optid.models import state_simulation
from optid.statistics.expansion import Expansion
from optid.statistics.linearised import Linearised, linearised
from optid.statistics.unknowns import Unknowns

if TYPE_CHECKING:
    from optid.data.record import Data

NUMBERS = 1_000_000
"""Entries of the sensitivities formed at a time."""


@dataclass(frozen=True, eq=False)
class StatePoint:
    """Values of the unknowns.

    Attributes:
        A: (n, n).
        C: (l, n).
        K: (n, l); zero where it is not unknown.
        offset: (l,).
        mus: (P_c,) one array per input.
        b: (n, m).
        d: (l, m); zero where an input has no feedthrough.
        nus: (Q_f,) one array per family of feedback functions.
        e: (n, s).
        x0: (E, n).
    """

    A: Array
    C: Array
    K: Array
    offset: Array
    mus: tuple[Array, ...]
    b: Array
    d: Array
    nus: tuple[Array, ...]
    e: Array
    x0: Array


@dataclass(frozen=True, eq=False)
class StateUnknowns(Unknowns):
    """The unknowns as one vector; the initial states come last.

    Attributes:
        n: number of states.
        expansion: functions of the inputs and of the outputs fed back.
        experiments: number of experiments.
        feedthrough: one per input.
        innovations: whether K is unknown; where not, it is zero.
        constant: whether the offset is unknown; where not, it is zero.
    """

    n: int
    expansion: Expansion
    experiments: int
    feedthrough: tuple[bool, ...]
    innovations: bool
    constant: bool = True

    @property
    def l(self) -> int:  # noqa: E743 - the field's letter
        """Number of outputs."""
        return self.expansion.l

    @property
    def memory(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Size of an initial state."""
        return self.n

    @cached_property
    def free(self) -> tuple[bool, ...]:
        """Whether mu of every input is unknown: it is one where the basis has a single function."""
        return tuple(size > 1 for size in self.expansion.input_sizes)

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Shape of every part in the order of the vector: "A", "C", "K", "offset", "mu0", "b0", ..., "nu0", "e0"."""
        n, outputs = self.n, self.l
        found: dict[str, tuple[int, ...]] = {"A": (n, n), "C": (outputs, n)}
        if self.innovations:
            found["K"] = (n, outputs)
        if self.constant:
            found["offset"] = (outputs,)
        for c, (size, direct) in enumerate(zip(self.expansion.input_sizes, self.feedthrough)):
            if self.free[c]:
                found[f"mu{c}"] = (size,)
            found[f"b{c}"] = (n + outputs,) if direct else (n,)
        for f, family in enumerate(self.expansion.feedback):
            if family.size > 1:
                found[f"nu{f}"] = (family.size,)
            found[f"e{f}"] = (n,)
        return found

    def pack(self, point: StatePoint) -> Array:
        """Return the vector of a point."""
        columns = [np.concatenate([point.b[:, c], point.d[:, c][: self.l * direct]])
                   for c, direct in enumerate(self.feedthrough)]
        parts = {"A": point.A, "C": point.C, "K": point.K, "offset": point.offset,
                 **{f"mu{c}": mu for c, mu in enumerate(point.mus)}, **{f"b{c}": b for c, b in enumerate(columns)},
                 **{f"nu{f}": nu for f, nu in enumerate(point.nus)},
                 **{f"e{f}": point.e[:, f] for f in range(point.e.shape[1])}}
        return np.concatenate([*(np.ravel(parts[name]) for name in self.slices), np.ravel(point.x0)]).astype(float)

    def unpack(self, x: Array) -> StatePoint:
        """Return the point of a vector."""
        part = self.parts(x)
        n, outputs, m, s = self.n, self.l, self.expansion.m, len(self.expansion.feedback)
        b, d = np.zeros((n, m)), np.zeros((outputs, m))
        for c, direct in enumerate(self.feedthrough):
            b[:, c] = part[f"b{c}"][:n]
            if direct:
                d[:, c] = part[f"b{c}"][n:]
        return StatePoint(
            part["A"], part["C"], part.get("K", np.zeros((n, outputs))), part.get("offset", np.zeros(outputs)),
            tuple(part.get(f"mu{c}", np.ones(1)) for c in range(m)), b, d,
            tuple(part.get(f"nu{f}", np.ones(1)) for f in range(s)),
            np.column_stack([part[f"e{f}"] for f in range(s)]) if s else np.zeros((n, 0)),
            x[self.shared :].reshape(self.experiments, n))

    def similarity(self, x: Array) -> Array:
        """Return orthonormal directions (n^2, shared) of theta that a change of the states moves it along."""
        point, n = self.unpack(x), self.n
        at, directions = self.slices, np.zeros((n * n, self.shared))
        for row, (i, j) in enumerate(np.ndindex(n, n)):
            one = np.zeros((n, n))
            one[i, j] = 1.0
            to = directions[row]
            to[at["A"]] = (one @ point.A - point.A @ one).ravel()
            to[at["C"]] = -(point.C @ one).ravel()
            if "K" in at:
                to[at["K"]] = (one @ point.K).ravel()
            for c in range(point.b.shape[1]):
                to[at[f"b{c}"]][:n] = one @ point.b[:, c]
            for f in range(point.e.shape[1]):
                to[at[f"e{f}"]] = one @ point.e[:, f]
        return directions


class Matrices(NamedTuple):
    """The point as the kernel reads it."""

    A: Array
    C: Array
    K: Array
    b: Array
    d: Array
    e: Array


class Places(NamedTuple):
    """First column of every part, the initial state being in the first n columns; -1 where it is not unknown."""

    A: int
    C: int
    K: int
    offset: int
    mu: Any
    b: Any
    d: Any
    functions: Any
    nu: Any
    e: Any
    coordinates: Any


class Signals(NamedTuple):
    """What drives a stretch of T samples.

    Attributes:
        drive: (T, n) what inputs and feedback add to the next state.
        direct: (T, l) what they add to the output.
        y: (T, l) measured outputs, NaN = missing.
        f: (T, m) values of the nonlinearities.
        eta: (T, P) values of the functions of the inputs.
        g: (T, s) values of the feedback nonlinearities.
        zeta: (T, Q) values of the feedback functions.
        closed: (T,) row of `slopes` where the model's own output is fed back, -1 elsewhere.
        slopes: (M, n, l) derivative of the feedback with respect to those outputs.
    """

    drive: Array
    direct: Array
    y: Array
    f: Array
    eta: Array
    g: Array
    zeta: Array
    closed: Any
    slopes: Array


def linearise_states(data: "Data", unknowns: StateUnknowns, x: Array, weight: Array, model: Any,
                     gauge: Array | None = None, chunk: int = 0) -> Linearised:
    """Run a model over all experiments and compress its errors (model less record) with their sensitivities.

    Where an output is missing its error is left out, nothing is corrected by it, and the model's own output is fed
    back.

    Args:
        data: the record; every input present.
        unknowns: their order.
        x: the unknowns; the matrix that carries the state must be stable.
        weight: (l, l) positive definite: the errors count as e^T weight e; where outputs are missing, with the inverse
            of the block of its inverse.
        model: (point) -> `HammersteinSS` with K = 0, for the feedback of missing outputs.
        gauge: (rows, shared) directions that change no output; they get weight in the factor, not in the errors.
        chunk: samples at a time; chosen by their size where 0.

    Returns:
        The errors near x; of infinite value where they leave the range of numbers.
    """
    chunk = chunk or max(32, NUMBERS // ((unknowns.n + unknowns.shared + 1) * unknowns.l))
    try:
        return linearised(lambda i: _blocks(data, unknowns, x, i, weight, model, chunk), unknowns.experiments,
                          unknowns.n, unknowns.shared, gauge)
    except FloatingPointError:
        return _infinite(unknowns)


def residuals(data: "Data", unknowns: StateUnknowns, x: Array, model: Any) -> list[Array]:
    """Return the errors (N, l) (model less record) of every experiment, NaN where the output is missing."""
    point = unknowns.unpack(x)
    found = model(point)
    return [_simulated(unknowns, found, e, x0, None) - e.y for e, x0 in zip(data.experiments, point.x0)]


def _simulated(unknowns: StateUnknowns, model: Any, e: Any, x0: Array, limits: Any) -> Array:
    """Run a model over an experiment, with corrections where K is unknown, without them where it is not, (N, l)."""
    simulator = "predict" if unknowns.innovations else "measured_feedback"
    return state_simulation.run(state_simulation.prepared(model, simulator, e.u, e.y, limits, ""), x0)


def _infinite(unknowns: StateUnknowns) -> Linearised:
    n, p = unknowns.n, unknowns.shared
    nothing = (np.eye(n), np.zeros((n, p)), np.zeros(n))
    return Linearised(np.eye(p), np.zeros(p), (nothing,) * unknowns.experiments, np.inf, 0, 1.0, "gram")


def _blocks(data: "Data", unknowns: StateUnknowns, x: Array, index: int, weight: Array, model: Any, chunk: int
            ) -> Iterator[tuple[Array, int]]:
    """Yield weighted rows [x0 | shared | error], zero where the output is missing, and their number."""
    record, covariance = data.experiments[index].y, np.linalg.inv(weight)
    first = 0
    for outputs, jacobian in _runs(data, unknowns, unknowns.unpack(x), index, model, chunk):
        error = outputs - record[first : first + len(outputs)]
        first += len(outputs)
        if not np.all(np.isfinite(outputs)) or not np.all(np.isfinite(jacobian)):
            raise FloatingPointError
        block = np.concatenate([jacobian, error[:, :, None]], axis=2)
        missing = np.isnan(error)
        block[missing] = 0.0
        for pattern in np.unique(missing, axis=0):
            rows = (missing == pattern).all(axis=1)
            block[rows] = np.einsum("op,kpq->koq", _root(covariance, pattern), block[rows])
        yield block.reshape(-1, block.shape[2]), int(np.count_nonzero(~missing))


def _root(covariance: Array, missing: Any) -> Array:
    """Return the square root R of the weight of the outputs present, with e^T R^T R e the weighted square."""
    here, root = np.flatnonzero(~missing), np.zeros((missing.size, missing.size))
    if here.size:
        root[np.ix_(here, here)] = np.linalg.cholesky(np.linalg.inv(covariance[np.ix_(here, here)])).T
    return root


def _runs(data: "Data", unknowns: StateUnknowns, point: StatePoint, index: int, model: Any, chunk: int
          ) -> Iterator[tuple[Array, Array]]:
    """Yield outputs (T, l) and sensitivities (T, l, n + shared) chunk by chunk."""
    from optid.statistics.state_sensitivity_kernel import sensitivities

    e, n = data.experiments[index], unknowns.n
    places = _places(unknowns)
    matrices = Matrices(*(np.ascontiguousarray(part) for part in (
        point.A, point.C, point.K, point.b, point.d, point.e)))
    state = np.array(point.x0[index], dtype=float)
    turn = np.zeros((n, n + unknowns.shared))
    turn[:, :n] = np.eye(n)
    fed = _fed_back(data, unknowns, point, index, model)
    for first in range(0, len(e.u), chunk):
        last = min(first + chunk, len(e.u))
        signals = _signals(unknowns, point, e.u[first:last], e.y[first:last], fed[first:last])
        outputs = np.empty((last - first, unknowns.l))
        jacobian = np.empty((last - first, unknowns.l, turn.shape[1]))
        sensitivities(matrices, places, signals, state, turn, outputs, jacobian)
        yield outputs, jacobian


def _fed_back(data: "Data", unknowns: StateUnknowns, point: StatePoint, index: int, model: Any) -> Array:
    """Return the outputs (N, l) the feedback sees: measured, and the model's own where one is missing."""
    e = data.experiments[index]
    missing = np.isnan(e.y)
    if not unknowns.expansion.feedback or not missing.any():
        return e.y
    limits = None if unknowns.innovations else state_simulation.allowed_range([e.y])
    try:
        simulated = _simulated(unknowns, model(point), e, point.x0[index], limits)
    except DataError:
        raise FloatingPointError from None
    return np.where(missing, simulated, e.y)


def _signals(unknowns: StateUnknowns, point: StatePoint, u: Array, y: Array, fed: Array) -> Signals:
    x = unknowns.expansion
    eta = [basis.values(u[:, c]) for c, basis in enumerate(x.inputs)]
    f = np.column_stack([part @ mu for part, mu in zip(eta, point.mus)])
    s = len(x.feedback)
    zeta = [family.values(fed) for family in x.feedback]
    g = np.column_stack([part @ nu for part, nu in zip(zeta, point.nus)]) if s else np.zeros((len(u), 0))
    closed, slopes = np.full(len(u), -1, dtype=np.int64), np.zeros((0, unknowns.n, unknowns.l))
    missing = np.isnan(y)
    if s and missing.any():
        rows = np.flatnonzero(missing.any(axis=1))
        closed[rows] = np.arange(rows.size)
        slopes = np.zeros((rows.size, unknowns.n, unknowns.l))
        for family, nu, e in zip(x.feedback, point.nus, point.e.T):
            own = family.basis.slopes(fed[rows, family.output]) @ (family.vectors @ nu)
            change = np.tile(-(nu @ family.slope), (rows.size, 1))
            change[:, family.output] += own
            slopes += e[None, :, None] * (change * missing[rows])[:, None, :]
    return Signals(np.ascontiguousarray(f @ point.b.T + g @ point.e.T),
                   np.ascontiguousarray(f @ point.d.T + point.offset), np.ascontiguousarray(y),
                   np.ascontiguousarray(f), np.ascontiguousarray(np.hstack(eta)), np.ascontiguousarray(g),
                   np.ascontiguousarray(np.hstack(zeta)) if s else np.zeros((len(u), 0)), closed, slopes)


def _places(unknowns: StateUnknowns) -> Places:
    n, x, at = unknowns.n, unknowns.expansion, unknowns.slices

    def first(name: str) -> int:
        return n + at[name].start if name in at else -1

    inputs, families = range(x.m), range(len(x.feedback))

    def listed(names: Any) -> Any:
        return np.array([first(name) for name in names], dtype=np.int64)

    d = [first(f"b{c}") + n if direct else -1 for c, direct in enumerate(unknowns.feedthrough)]
    return Places(first("A"), first("C"), first("K"), first("offset"), listed(f"mu{c}" for c in inputs),
                  listed(f"b{c}" for c in inputs), np.array(d, dtype=np.int64), np.cumsum([0, *x.input_sizes]),
                  listed(f"nu{f}" for f in families), listed(f"e{f}" for f in families),
                  np.cumsum([0, *(family.size for family in x.feedback)]))
