"""The unknowns of a state-space model: matrices, static functions and one initial state per experiment."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases.basis import Basis
from optid.errors import StructureError
from optid.models.state_signals import Direct
from optid.statistics.expansion import Expansion
from optid.statistics.unknowns import Unknowns

# criterion -> simulator of a model whose errors it counts
SIMULATORS = {"simulation": "free", "measured feedback": "measured_feedback", "prediction": "predict"}


@dataclass(frozen=True, eq=False)
class Latent:
    """A static function h of a latent signal z = Cz x + Dz u + constant, and what is unknown of it."""

    basis: Basis  # its basis, with an interval
    vectors: Array  # (P, r) h = basis @ vectors @ c, c unknown; see `beyond_affine`
    feeds: bool = True  # whether Ez is unknown; zero where not
    direct: bool = False  # whether Fz is unknown; where not, it is one at `output`
    output: int = -1  # index of an output that h is added to as it is, and that alone; -1 for none
    moved: bool = True  # whether the inputs act on z: Dz is unknown; zero where not
    # (n + m + 1,) known row [Cz, Dz, constant] of the argument, with coefficients one; None where both are unknown
    row: Array | None = None

    @property
    def size(self) -> int:
        """Number r of coefficients."""
        return self.vectors.shape[1]


def beyond_affine(basis: Basis) -> Array:
    """Return orthonormal coordinates (P, r) of the functions of a basis that do not correlate with z.

    What is linear in z is carried by the matrices, constants by the offsets. The distribution of z is taken as uniform
    on the interval. Functions that go on straight beyond it meet its ends without curvature (natural splines) where
    enough of them can: an end of few samples then bends no tail. Where nothing is left a `StructureError` is raised.
    """
    low, high = basis.interval if basis.interval is not None else (-1.0, 1.0)
    nodes, weights = np.polynomial.legendre.leggauss(64)
    family = _straight_at_ends(basis)
    values = basis.values((low + high) / 2 + (high - low) / 2 * nodes) @ family
    sizes, vectors = np.linalg.svd(((weights * nodes) @ values)[None])[1:]
    found = family @ vectors[int(np.sum(sizes > 1e-9 * np.linalg.norm(values))) :].T
    if not found.size:
        raise StructureError(f"the basis {type(basis).__name__.lower()} of a latent function has no part that is not "
                             "affine, which the matrices carry: use more functions.")
    return found


# shapes of the arrays of a point: n states, l outputs, m inputs, s feedback and k latent functions, E experiments, N
# entries of an initial state
SHAPES = {
    "A": "nn", "C": "ln", "K": "nl", "offset": "l", "b": "nm", "d": "lm", "e": "ns", "x0": "EN", "Ez": "nk", "Fz": "lk",
    "Cz": "kn", "Dz": "km", "offset_z": "k"}


def _straight_at_ends(basis: Basis) -> Array:
    """Return orthonormal coordinates (P, r) of natural splines where tails are straight; else of all functions."""
    if basis.outside != "linear" or getattr(basis, "degree", 0) < 2:
        return np.eye(basis.size)
    vectors, sizes, _ = np.linalg.svd(basis.curvature()[[0, -1]].T)
    left = vectors[:, int(np.sum(sizes > 1e-9 * sizes[0])) :]
    return left if left.shape[1] > 1 else np.eye(basis.size)  # more than the straight line


@dataclass(frozen=True, eq=False)
class StatePoint:
    """Values of the unknowns."""

    A: Array  # (n, n)
    C: Array  # (l, n)
    K: Array  # (n, l); zero where it is not unknown
    offset: Array  # (l,)
    mus: tuple[Array, ...]  # (P_c,) one array per input
    b: Array  # (n, m)
    d: Array  # (l, m); zero where an input has no feedthrough
    nus: tuple[Array, ...]  # (Q_f,) one array per family of feedback functions
    e: Array  # (n, s)
    x0: Array  # (E, n), or (E, n + l) with the constants of the outputs of every experiment last
    cs: tuple[Array, ...]  # (r_i,) one array per latent function
    Ez: Array  # (n, k)
    Fz: Array  # (l, k)
    Cz: Array  # (k, n)
    Dz: Array  # (k, m)
    offset_z: Array  # (k,)


@dataclass(frozen=True, eq=False)
class StateUnknowns(Unknowns):
    """The unknowns as one vector; the initial states come last."""

    n: int  # number of states
    expansion: Expansion  # functions of the inputs and of the outputs fed back
    experiments: int  # number of experiments
    feedthrough: tuple[bool, ...]  # one per input
    # whose errors are meant, one of `SIMULATORS`; K is unknown for "prediction", and zero otherwise
    criterion: str = "simulation"
    constant: bool = True  # whether the offset is unknown; where not, it is zero
    latent: tuple[Latent, ...] = ()  # functions of latent signals
    linear_output: bool = True  # whether C is unknown; where not, it is zero
    # whether every experiment has constants of its own, in place of the offset: l states that do not change
    levels: bool = False

    l: int = field(init=False)  # noqa: E741 - number of outputs, the field's letter
    innovations: bool = field(init=False)  # whether K is unknown
    # whether mu of every input is unknown: it is one where the basis has a single function
    free: tuple[bool, ...] = field(init=False)

    def __post_init__(self) -> None:
        found = {"l": self.expansion.l, "innovations": self.criterion == "prediction",
                 "free": tuple(size > 1 for size in self.expansion.input_sizes)}
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @property
    def memory(self) -> int:
        """Size of an initial state among the unknowns, the constants of an experiment included."""
        return self.n + self.l * self.levels

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Shape of every part in order: "A", "C", "K", "offset", "mu0", "b0", ..., "nu0", "e0", ..., "c0", "z0", "g0".

        g = [Ez; Fz] and z = [Cz, Dz, constant] of a latent function, as far as they are unknown.
        """
        views = self._views(self._known())
        return {name: of[0].shape if len(of) == 1 else (sum(one.size for one in of),) for name, of in views.items()}

    def _known(self) -> StatePoint:
        """Return a point that holds what is known; what is unknown is zero."""
        size = {"n": self.n, "l": self.l, "m": self.expansion.m, "s": len(self.expansion.feedback),
                "k": len(self.latent), "E": self.experiments, "N": self.memory}
        found = {name: np.zeros([size[letter] for letter in letters]) for name, letters in SHAPES.items()}
        for i, one in enumerate(self.latent):
            if one.row is not None:
                found["Cz"][i], found["Dz"][i] = one.row[: self.n], one.row[self.n : -1]
                found["offset_z"][i] = one.row[-1]
            if one.output >= 0 and not one.direct:
                found["Fz"][one.output, i] = 1.0
        mus, nus = ([np.full(one.size, float(one.size == 1)) for one in functions]
                    for functions in (self.expansion.inputs, self.expansion.feedback))
        cs = [np.full(one.size, float(one.row is not None)) for one in self.latent]
        return StatePoint(mus=tuple(mus), nus=tuple(nus), cs=tuple(cs), **found)

    def _views(self, point: StatePoint) -> dict[str, list[Array]]:
        """Return what is unknown of a point, by part and in the order of x, as views of its arrays."""
        found = {"A": [point.A]}
        if self.linear_output:
            found["C"] = [point.C]
        if self.innovations:
            found["K"] = [point.K]
        if self.constant:
            found["offset"] = [point.offset]
        for c, direct in enumerate(self.feedthrough):
            if self.free[c]:
                found[f"mu{c}"] = [point.mus[c]]
            found[f"b{c}"] = [point.b[:, c], point.d[:, c]][: 1 + direct]
        for f, family in enumerate(self.expansion.feedback):
            if family.size > 1:
                found[f"nu{f}"] = [point.nus[f]]
            found[f"e{f}"] = [point.e[:, f]]
        for i, one in enumerate(self.latent):
            if one.row is None:
                found[f"c{i}"] = [point.cs[i]]
                found[f"z{i}"] = [point.Cz[i], *[point.Dz[i]] * one.moved, point.offset_z[i : i + 1]]
            if one.feeds or one.direct:
                found[f"g{i}"] = [*[point.Ez[:, i]] * one.feeds, *[point.Fz[:, i]] * one.direct]
        return found

    def pack(self, point: StatePoint) -> Array:
        """Return the vector of a point."""
        parts = [view.ravel() for views in self._views(point).values() for view in views]
        return np.concatenate([*parts, point.x0.ravel()]).astype(float)

    def unpack(self, x: Array) -> StatePoint:
        """Return the point of a vector."""
        return self._filled(self._known(), x)

    def _filled(self, point: StatePoint, x: Array) -> StatePoint:
        """Write a vector into a point."""
        at = 0
        for view in (view for views in self._views(point).values() for view in views):
            view[...] = x[at : at + view.size].reshape(view.shape)
            at += view.size
        point.x0[...] = x[at:].reshape(point.x0.shape)
        return point

    def similarity(self, x: Array) -> Array:
        """Return directions (n^2, shared) of theta that a change of the states moves it along."""
        point, one = self.unpack(x), np.eye(self.n**2).reshape(self.n**2, self.n, self.n)
        moved = {"A": one @ point.A - point.A @ one, "C": -point.C @ one, "K": one @ point.K, "b": one @ point.b,
                 "e": one @ point.e, "Ez": one @ point.Ez, "Cz": -point.Cz @ one}
        found = np.zeros((self.n**2, self.shared))
        for name, change in moved.items():
            columns = getattr(self._columns, name)
            found[:, columns[columns >= 0].astype(int) - self.memory] = change[:, columns >= 0]
        return found

    @cached_property
    def signals(self) -> dict[str, NDArray[np.intp]]:
        """Columns of the signals that multiply unknowns, by name and in order.

        They are the states "x", the innovations "e", the values "f", "g" and "w" of the functions of inputs, of outputs
        and of latent signals, the constant "1", their basis functions "eta", "zeta" and "phi", and the arguments
        [x, u, 1] of every latent function times its slope.
        """
        x, k = self.expansion, len(self.latent)
        sizes = {"x": self.n, "e": self.l, "f": x.m, "g": len(x.feedback), "w": k, "1": 1, "eta": x.p, "zeta": x.q,
                 "phi": sum(one.size for one in self.latent), "arguments": k * (self.n + x.m + 1)}
        ends = np.cumsum(list(sizes.values()))
        return {name: np.arange(end - size, end) for (name, size), end in zip(sizes.items(), ends)}

    @cached_property
    def _columns(self) -> StatePoint:
        """Index of each unknown among the columns after the initial states; negative if its value is fixed."""
        numbers = self._known()
        for value in vars(numbers).values():
            for array in value if isinstance(value, tuple) else (value,):
                array[...] = -np.inf
        return self._filled(numbers, np.arange(self.memory, self.memory + self.size, dtype=float))

    def direct(self, point: StatePoint) -> Direct:
        """Return what every unknown changes directly; the columns of the initial state come first."""
        gains = np.concatenate([np.ones(1), point.d.ravel(), point.b.ravel(), point.e.ravel()])
        return self._direct._replace(gain=gains[self._direct.gain.astype(int)])

    @cached_property
    def _direct(self) -> Direct:
        """As `direct`, with the index of each gain in [1, d, b, e] in place of its value at a point."""
        at, signals = self._columns, self.signals
        states, outputs, latent = (np.arange(count)[:, None] for count in (self.n, self.l, len(self.latent)))
        mu, nu, c = (np.concatenate([np.zeros(0), *of]) for of in (at.mus, at.nus, at.cs))
        d, b, e = at.d.size, at.b.size, at.e.size

        def gains_of(*names: str) -> Any:
            return np.concatenate([signals[name] for name in names])

        def repeat(gains: Any, of: Sequence[Array]) -> Any:
            return np.repeat(gains, [one.size for one in of], axis=1)

        rows = np.hstack([at.Cz, at.Dz, at.offset_z[:, None]])
        return Direct.of(
            [(latent, rows, signals["arguments"].reshape(rows.shape), 0),
             (repeat(latent.T, at.cs), c, signals["phi"], 0)],
            [(outputs, np.hstack([at.C, at.d, at.Fz, at.offset[:, None]]), gains_of("x", "f", "w", "1"), 0),
             (outputs, mu, signals["eta"], repeat(1 + np.arange(d).reshape(at.d.shape), at.mus))],
            [(states, np.hstack([at.A, at.K, at.b, at.e, at.Ez]), gains_of("x", "e", "f", "g", "w"), 0),
             (states, mu, signals["eta"], repeat(1 + d + np.arange(b).reshape(at.b.shape), at.mus)),
             (states, nu, signals["zeta"], repeat(1 + d + b + np.arange(e).reshape(at.e.shape), at.nus))])
