"""The unknowns of a state-space model: matrices, static functions and one initial state per experiment."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optid.arrays import Array
from optid.bases.basis import Basis
from optid.errors import StructureError
from optid.models.state_signals import Parts, Places
from optid.statistics.expansion import Expansion
from optid.statistics.unknowns import Unknowns

SIMULATORS = {"simulation": "free", "measured feedback": "measured_feedback", "prediction": "predict"}
"""Criterion -> simulator of a model whose errors it counts."""


@dataclass(frozen=True, eq=False)
class Latent:
    """A static function h of a latent signal z = Cz x + Dz u + constant, and what is unknown of it.

    Attributes:
        basis: its basis, with an interval.
        vectors: (P, r) h = basis @ vectors @ c, c unknown; see `beyond_affine`.
        feeds: whether Ez is unknown; zero where not.
        direct: whether Fz is unknown; where not, it is one at `output`.
        output: index of an output that h is added to as it is, and that alone; -1 for none.
        moved: whether the inputs act on z: Dz is unknown; zero where not.
        row: (n + m + 1,) known row [Cz, Dz, constant] of the argument, with coefficients one; None where both are
            unknown.
    """

    basis: Basis
    vectors: Array
    feeds: bool = True
    direct: bool = False
    output: int = -1
    moved: bool = True
    row: Array | None = None

    @property
    def size(self) -> int:
        """Number r of coefficients."""
        return self.vectors.shape[1]


def beyond_affine(basis: Basis, points: int = 64) -> Array:
    """Return orthonormal coordinates (P, r) of the functions of a basis without a part in the span of {1, z}.

    That part is carried by the matrices. Orthogonal with respect to the uniform distribution on the interval.

    Raises:
        StructureError: nothing is left.
    """
    low, high = basis.interval if basis.interval is not None else (-1.0, 1.0)
    nodes, weights = np.polynomial.legendre.leggauss(points)
    values = basis.values((low + high) / 2 + (high - low) / 2 * nodes)
    sizes, vectors = np.linalg.svd((np.column_stack([np.ones(points), nodes]).T * weights) @ values)[1:]
    found = vectors[int(np.sum(sizes > 1e-9 * sizes[0])) :].T
    if not found.size:
        raise StructureError(f"the basis {type(basis).__name__.lower()} of a latent function has no part that is not "
                             "affine, which the matrices carry: use more functions.")
    return found


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
        cs: (r_i,) one array per latent function.
        Ez: (n, k).
        Fz: (l, k).
        Cz: (k, n).
        Dz: (k, m).
        offset_z: (k,).
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
    cs: tuple[Array, ...]
    Ez: Array
    Fz: Array
    Cz: Array
    Dz: Array
    offset_z: Array


@dataclass(frozen=True, eq=False)
class StateUnknowns(Unknowns):
    """The unknowns as one vector; the initial states come last.

    Attributes:
        n: number of states.
        expansion: functions of the inputs and of the outputs fed back.
        experiments: number of experiments.
        feedthrough: one per input.
        criterion: whose errors are meant, one of `SIMULATORS`; K is unknown for "prediction", and zero otherwise.
        constant: whether the offset is unknown; where not, it is zero.
        latent: functions of latent signals.
        linear_output: whether C is unknown; where not, it is zero.
    """

    n: int
    expansion: Expansion
    experiments: int
    feedthrough: tuple[bool, ...]
    criterion: str = "simulation"
    constant: bool = True
    latent: tuple[Latent, ...] = ()
    linear_output: bool = True

    @property
    def innovations(self) -> bool:
        """Whether K is unknown."""
        return self.criterion == "prediction"

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
        """Shape of every part in order: "A", "C", "K", "offset", "mu0", "b0", ..., "nu0", "e0", ..., "c0", "g0", "z0".

        g = [Ez; Fz] and z = [Cz, Dz, constant] of a latent function, as far as they are unknown.
        """
        n, outputs = self.n, self.l
        found: dict[str, tuple[int, ...]] = {"A": (n, n)}
        if self.linear_output:
            found["C"] = (outputs, n)
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
        for i, one in enumerate(self.latent):
            if one.row is None:
                found |= {f"c{i}": (one.size,), f"z{i}": (n + self.expansion.m * one.moved + 1,)}
            if one.feeds or one.direct:
                found[f"g{i}"] = (n * one.feeds + outputs * one.direct,)
        return found

    def pack(self, point: StatePoint) -> Array:
        """Return the vector of a point."""
        columns = [np.concatenate([point.b[:, c], point.d[:, c][: self.l * direct]])
                   for c, direct in enumerate(self.feedthrough)]
        parts = {"A": point.A, "C": point.C, "K": point.K, "offset": point.offset,
                 **{f"mu{c}": mu for c, mu in enumerate(point.mus)}, **{f"b{c}": b for c, b in enumerate(columns)},
                 **{f"nu{f}": nu for f, nu in enumerate(point.nus)},
                 **{f"e{f}": point.e[:, f] for f in range(point.e.shape[1])}}
        for i, one in enumerate(self.latent):
            parts[f"c{i}"] = point.cs[i]
            parts[f"g{i}"] = np.concatenate([point.Ez[: self.n * one.feeds, i], point.Fz[: self.l * one.direct, i]])
            inputs = point.Dz[i, : self.expansion.m * one.moved]
            parts[f"z{i}"] = np.concatenate([point.Cz[i], inputs, point.offset_z[i : i + 1]])
        return np.concatenate([*(np.ravel(parts[name]) for name in self.slices), np.ravel(point.x0)]).astype(float)

    def unpack(self, x: Array) -> StatePoint:
        """Return the point of a vector."""
        part = self.parts(x)
        n, outputs, m, s = self.n, self.l, self.expansion.m, len(self.expansion.feedback)
        b, d, k = np.zeros((n, m)), np.zeros((outputs, m)), len(self.latent)
        for c, direct in enumerate(self.feedthrough):
            b[:, c] = part[f"b{c}"][:n]
            if direct:
                d[:, c] = part[f"b{c}"][n:]
        Ez, Fz, Cz, Dz, constants = np.zeros((n, k)), np.zeros((outputs, k)), np.zeros((k, n)), np.zeros((k, m)), []
        for i, one in enumerate(self.latent):
            row = part[f"z{i}"] if one.row is None else one.row
            Cz[i], Dz[i, : row.size - n - 1] = row[:n], row[n:-1]
            constants.append(row[-1])
            if one.feeds:
                Ez[:, i] = part[f"g{i}"][:n]
            if one.direct:
                Fz[:, i] = part[f"g{i}"][n * one.feeds :]
            elif one.output >= 0:
                Fz[one.output, i] = 1.0
        return StatePoint(
            part["A"], part.get("C", np.zeros((outputs, n))), part.get("K", np.zeros((n, outputs))),
            part.get("offset", np.zeros(outputs)), tuple(part.get(f"mu{c}", np.ones(1)) for c in range(m)), b, d,
            tuple(part.get(f"nu{f}", np.ones(1)) for f in range(s)),
            np.column_stack([part[f"e{f}"] for f in range(s)]) if s else np.zeros((n, 0)),
            x[self.shared :].reshape(self.experiments, n),
            tuple(part.get(f"c{i}", np.ones(one.size)) for i, one in enumerate(self.latent)), Ez, Fz, Cz, Dz,
            np.array(constants))

    def similarity(self, x: Array) -> Array:
        """Return orthonormal directions (n^2, shared) of theta that a change of the states moves it along."""
        point, n = self.unpack(x), self.n
        at, directions = self.slices, np.zeros((n * n, self.shared))
        for row, (i, j) in enumerate(np.ndindex(n, n)):
            one = np.zeros((n, n))
            one[i, j] = 1.0
            to = directions[row]
            to[at["A"]] = (one @ point.A - point.A @ one).ravel()
            if "C" in at:
                to[at["C"]] = -(point.C @ one).ravel()
            if "K" in at:
                to[at["K"]] = (one @ point.K).ravel()
            for c in range(point.b.shape[1]):
                to[at[f"b{c}"]][:n] = one @ point.b[:, c]
            for f in range(point.e.shape[1]):
                to[at[f"e{f}"]] = one @ point.e[:, f]
            for k, latent in enumerate(self.latent):
                if latent.row is None:
                    to[at[f"z{k}"]][:n] = -point.Cz[k] @ one
                if latent.feeds:
                    to[at[f"g{k}"]][:n] = one @ point.Ez[:, k]
        return directions

    def places(self, parts: Parts) -> Places:
        """Return where every part stands behind the n columns of the initial state; ``parts`` are those of a model."""
        n, m, x = self.n, self.expansion.m, self.expansion

        def first(name: str, shift: int = 0, here: bool = True) -> int:
            return n + self.slices[name].start + shift if here and name in self.slices else -1

        def listed(places: list[int]) -> np.ndarray:
            return np.array(places, dtype=np.int64)

        def ends(sizes: list[int]) -> np.ndarray:
            return np.cumsum([0, *sizes]).astype(np.int64)

        inputs, families = range(m), range(len(x.feedback))
        latent = list(enumerate(self.latent))
        return Places.none(parts)._replace(
            A=first("A"), C=first("C"), K=first("K"), offset=first("offset"),
            mu=listed([first(f"mu{c}") for c in inputs]), b=listed([first(f"b{c}") for c in inputs]),
            d=listed([first(f"b{c}", n, direct) for c, direct in enumerate(self.feedthrough)]),
            functions=ends([*x.input_sizes]), nu=listed([first(f"nu{f}") for f in families]),
            e=listed([first(f"e{f}") for f in families]), coordinates=ends([family.size for family in x.feedback]),
            c=listed([first(f"c{i}") for i, _ in latent]),
            ez=listed([first(f"g{i}", 0, one.feeds) for i, one in latent]),
            fz=listed([first(f"g{i}", n * one.feeds, one.direct) for i, one in latent]),
            cz=listed([first(f"z{i}") for i, _ in latent]),
            dz=listed([first(f"z{i}", n, one.moved) for i, one in latent]),
            oz=listed([first(f"z{i}", n + m * one.moved) for i, one in latent]),
            members=ends([one.size for _, one in latent]))
