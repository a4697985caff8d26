"""The unknowns of a fit as one vector: parts that all experiments share, then an initial state per experiment."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from optid.arrays import Array
from optid.models.layout import Layout


class Unknowns:
    """The places of the parts of the vector x; a subclass names the parts."""

    n: int  # number of states
    experiments: int  # number of experiments
    innovations: bool  # whether the errors are those of predictions rather than of simulations
    shapes: dict[str, tuple[int, ...]]  # shape of every shared part in the order of x

    @property
    def memory(self) -> int:
        """Size of an initial state among the unknowns."""
        return self.n

    @cached_property
    def slices(self) -> dict[str, slice]:
        """The place of every shared part in x; matrices row by row."""
        found, position = {}, 0
        for name, shape in self.shapes.items():
            found[name] = slice(position, position + int(np.prod(shape)))
            position = found[name].stop
        return found

    @cached_property
    def shared(self) -> int:
        """Number of unknowns that all experiments share: the first entries of x."""
        return max((at.stop for at in self.slices.values()), default=0)

    @cached_property
    def products(self) -> tuple[tuple[str, str], ...]:
        """Parts of which the output shows the product alone: (mu, b), (nu, e) of feedback, (c, g) of latent ones."""
        partner, found = {"mu": "b", "nu": "e", "c": "g"}, []
        for part, at in self.slices.items():
            kind = part.rstrip("0123456789")
            other = partner.get(kind, "") + part[len(kind) :]
            if kind in partner and part != kind and at.stop > at.start and other in self.slices:
                found.append((part, other))
        return tuple(found)

    def parts(self, x: Array) -> dict[str, Array]:
        """Return the shared parts of x in their shapes."""
        return {name: x[at].reshape(self.shapes[name]) for name, at in self.slices.items()}

    @property
    def size(self) -> int:
        """Length of x."""
        return self.shared + self.experiments * self.memory


@dataclass(frozen=True, eq=False)
class TransferPoint:
    """Values of the unknowns of a transfer-function model."""

    a: Array  # (na,) coefficients of A
    mus: tuple[Array, ...]  # (P_c,) coefficients of f_c, one array per input
    bs: tuple[Array, ...]  # (nb_c,) coefficients of B_c, one array per input
    offset: float  # constant of the equation
    # (E, n) what the past of every experiment adds to its first n equations; last, where each has one, its constant
    x0: Array
    c: Array = field(default_factory=lambda: np.zeros(0))  # (nc,) coefficients of C
    d: Array = field(default_factory=lambda: np.zeros(0))  # (nd,) coefficients of D; A where D is A


@dataclass(frozen=True)
class TransferUnknowns(Unknowns):
    """The unknowns of ``A x = sum_c B_c f_c(u_c) + d, y = x + (C/D) e``: [a; mu0; b0; mu1; ...; offset; c; d; x0]."""

    layout: Layout  # orders and bases of the plant; one output
    experiments: int  # number of experiments
    # whether the coefficients of every nonlinearity are unknown; where not, mu is one (`Linear`)
    free: tuple[bool, ...]
    constant: bool = True  # whether the offset is unknown; where not, it is zero
    nc: int = 0  # order of C
    # order of D; None where D is A (ARX, ARMAX). Then there are no initial states among the unknowns
    nd: int | None = 0
    # whether every experiment has its own constant, in place of the offset: a state that does not change
    levels: bool = False

    @property
    def apart(self) -> bool:
        """Whether the poles of the noise, if any, differ from those of the plant."""
        return self.nd is not None

    @property
    def innovations(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether there is a noise filter: C and D are not both one."""
        return (self.nc, self.nd) != (0, 0)

    @property
    def memory(self) -> int:
        """Size n of an initial state among the unknowns, the constant of an experiment included."""
        return self.fading + self.levels

    @property
    def fading(self) -> int:
        """Size of what is forgotten of an initial state among the unknowns."""
        return self.layout.first_row if self.apart else 0

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Sizes of "a", "mu0", "b0", "mu1", ..., "offset", "c" and "d"; zero where a part is not unknown."""
        parts = {"a": self.layout.na}
        for c, (basis, nb) in enumerate(zip(self.layout.bases, self.layout.nb)):
            parts |= {f"mu{c}": basis.size if self.free[c] else 0, f"b{c}": nb}
        parts |= {"offset": int(self.constant), "c": self.nc, "d": self.nd or 0}
        return {name: (size,) for name, size in parts.items()}

    def pack(self, point: TransferPoint) -> Array:
        """Return x of a point."""
        parts = {"a": point.a, "offset": np.full(1, point.offset), "c": point.c, "d": point.d,
                 **{f"mu{c}": mu for c, mu in enumerate(point.mus)}, **{f"b{c}": b for c, b in enumerate(point.bs)}}
        shared = [parts[name][: shape[0]] for name, shape in self.shapes.items()]
        return np.concatenate([*shared, point.x0.ravel()[: self.experiments * self.memory]]).astype(float)

    def unpack(self, x: Array) -> TransferPoint:
        """Return the point of x."""
        part, inputs = self.parts(x), range(self.layout.m)
        return TransferPoint(
            part["a"], tuple(part[f"mu{c}"] if self.free[c] else np.ones(1) for c in inputs),
            tuple(part[f"b{c}"] for c in inputs), float(np.sum(part["offset"])),
            x[self.shared :].reshape(self.experiments, self.memory), part["c"], part["d"] if self.apart else part["a"])
