"""Signals of a subspace fit: functions of the inputs, of the measured outputs and of simulated outputs.

Functions of an output enter orthogonalised against {1, y} on the record: the linear part of a feedback cannot be told
from an output injection (A - LC, B - LD), and a function nearly linear in y would make the regressors nearly singular.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases import Bases, FeedbackBases, feedback_bases, fitted_bases
from optid.bases.basis import Basis
from optid.data.record import Data
from optid.errors import DataError, DataWarning, RankError
from optid.statistics.factors import ROUNDING, root_of_rows
from optid.statistics.hankel import RegressionRows, hankel_statistics

# part of a function outside the span of {1, y} and of the other functions, relative to it, that is not rounding
SMALLEST = 1e-6
# part of the feedback functions outside {1, y}, relative to their spread, below which the user is warned
NEARLY_LINEAR = 0.05
LINEAR = 1e-3  # the same part below which the fit is refused


@dataclass(frozen=True, eq=False)
class Feedback:
    """The functions of one output that enter the state equation, in orthonormal coordinates on the record.

    zeta_r = V^T zeta(y_o) - intercept - slope y, of unit variance and uncorrelated with {1, y}.
    """

    output: int  # index o of the output
    basis: Basis  # its basis, with an interval
    vectors: Array  # (Q, r) V; r < Q where the basis contains functions that are linear on the record
    intercept: Array  # (r,)
    slope: Array  # (r, l)
    share: float  # spread left after the orthogonalisation, relative to the spread of the functions

    @property
    def size(self) -> int:
        """Number r of coordinates."""
        return self.vectors.shape[1]

    def values(self, y: Array) -> Array:
        """Evaluate zeta_r, (T, r), at outputs y (T, l)."""
        return self.basis.values(y[:, self.output]) @ self.vectors - self.intercept - y @ self.slope.T


@dataclass(frozen=True, eq=False)
class Expansion:
    """Turns raw channels [u | y (| simulated y)] into signals [eta | zeta_r | y (| zeta_r of the simulated y)]."""

    inputs: tuple[Basis, ...]  # one basis per input, with intervals
    feedback: tuple[Feedback, ...]  # feedback functions, at most one family per output
    input_names: tuple[str, ...]  # names of the m inputs
    output_names: tuple[str, ...]  # names of the l outputs
    simulated: bool = False  # whether simulated outputs follow the measured ones

    m: int = field(init=False)  # number of inputs
    l: int = field(init=False)  # noqa: E741 - number of outputs, the field's letter
    input_sizes: tuple[int, ...] = field(init=False)  # number of functions of every input
    p: int = field(init=False)  # number of functions of all inputs
    q: int = field(init=False)  # number of coordinates of all feedback functions
    eta: range = field(init=False)  # positions of the input functions among the signals
    zeta: range = field(init=False)  # those of the feedback functions of the measured outputs
    y: range = field(init=False)  # those of the outputs
    zeta_simulated: range = field(init=False)  # those of the feedback functions of the simulated outputs

    def __post_init__(self) -> None:
        sizes = tuple(basis.size for basis in self.inputs)
        p, q, l = sum(sizes), sum(family.size for family in self.feedback), len(self.output_names)  # noqa: E741
        end = p + q + l
        found = {"m": len(self.input_names), "l": l, "input_sizes": sizes, "p": p, "q": q, "eta": range(p),
                 "zeta": range(p, p + q), "y": range(p + q, end),
                 "zeta_simulated": range(end, end + q * self.simulated)}
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @property
    def names(self) -> tuple[str, ...]:
        """Name every signal, e.g. polynomial2(valve)."""
        names = [f"{_family(basis)}{j}({channel})" if basis.size > 1 else channel
                 for channel, basis in zip(self.input_names, self.inputs) for j in range(1, basis.size + 1)]
        zetas = [f"feedback function {j} of {self.output_names[family.output]}"
                 for family in self.feedback for j in range(1, family.size + 1)]
        return (*names, *zetas, *self.output_names, *(f"simulated {name}" for name in zetas * self.simulated))

    def __call__(self, raw: Array) -> Array:
        """Evaluate the signals of samples (T, m + l) or (T, m + 2 l)."""
        m, l = self.m, self.l  # noqa: E741
        y = raw[:, m : m + l]
        parts = [basis.values(raw[:, c]) for c, basis in enumerate(self.inputs)]
        parts += [family.values(y) for family in self.feedback]
        parts.append(y)
        if self.simulated:
            parts += [family.values(raw[:, m + l :]) for family in self.feedback]
        return np.concatenate(parts, axis=1)

    def positions(self, at: Callable[..., NDArray[np.intp]], instruments: str, alpha: int, offset: bool = True
                  ) -> RegressionRows:
        """Return the rows of instruments, regressors and outputs among the first 2 alpha samples of the windows.

        Past and future have alpha block rows each; the last one of the feedback functions never reaches the future
        outputs and is left out. ``at`` is that of `optid.statistics.hankel.HankelStatistics`. Instruments are "past"
        (inputs, feedback functions and outputs of the past), "inputs" (past and future inputs), "inputs+past",
        "simulated" (past and future inputs and functions of simulated outputs) or "simulated+past", and with an offset
        a constant.
        """
        past, future, both = range(alpha), range(alpha, 2 * alpha), range(2 * alpha)
        one = np.zeros(int(offset), dtype=np.intp)
        z = [one, at(self.eta, past if instruments == "past" else both)]
        if instruments.startswith("simulated"):
            z.append(at(self.zeta_simulated, both))
        if instruments.endswith("past"):
            z += [at(self.zeta, past), at(self.y, past)]
        phi = [one, at(self.eta, future), at(self.zeta, future[:-1])]
        return RegressionRows(np.concatenate(z), np.concatenate(phi), at(self.y, future))

    def block_rows(self, records: Sequence[Array], nx: int | None, *, spans: int = 2, per_row: float = 2.0,
                   least: int | None = None) -> int:
        """Return block rows that a record can carry: 10, or twice the order (None: not known), or fewer.

        A window has ``spans`` times as many; ``per_row`` windows are wanted per row of the Hankel matrix. There are at
        least ``least`` block rows, one more than the order by default.
        """
        width, count = self.p + 2 * self.q + self.l, sum(len(record) for record in records)
        affordable = int(count / (spans * (len(records) + per_row * width)))  # windows = count - experiments (rows - 1)
        shortest = min(len(record) for record in records) // spans
        return max(1 + (nx or 1) if least is None else least, min(max(10, 2 * (nx or 0)), affordable, shortest))

    def injection(self, e: Array) -> tuple[Array, Array]:
        """Return L (n, l) and the constant (n,) that E (n, q) adds to the state equation beside ``E V^T zeta(y)``."""
        slopes = np.concatenate([np.zeros((0, self.l)), *(family.slope for family in self.feedback)])
        intercepts = np.concatenate([np.zeros(0), *(family.intercept for family in self.feedback)])
        return -e @ slopes, -e @ intercepts

    def without_feedback(self) -> "Expansion":
        """Return the open-loop expansion."""
        return replace(self, feedback=(), simulated=False)


def expand(data: Data, basis: Bases, feedback_basis: FeedbackBases = None) -> Expansion:
    """Fit the bases of inputs and outputs to a record and return its expansion.

    Raises:
        StructureError: a wrong number of bases, or an entry that is not a basis.
        RankError: the feedback functions of an output are linear in y on this record.
        DataError: a constant channel, or no sample at which all outputs are present.

    Warns:
        DataWarning: they are nearly linear.
    """
    outputs = [e.y for e in data.experiments]
    families = [_orthogonalised(outputs, output, family, data.outputs)
                for output, family in enumerate(feedback_bases(data, feedback_basis)) if family is not None]
    return Expansion(fitted_bases(data, basis), tuple(families), data.inputs, data.outputs)


def _orthogonalised(outputs: Sequence[Array], output: int, basis: Basis, names: Sequence[str]) -> Feedback:
    l = len(names)  # noqa: E741
    if all(np.isnan(y).any(axis=1).all() for y in outputs):
        raise DataError("no sample has all outputs: the feedback functions cannot be formed.")
    statistics = hankel_statistics(outputs, 1, lambda y: np.hstack([y, basis.values(y[:, output])]), method="qr")
    root, count = statistics.root, statistics.windows
    slopes = np.linalg.lstsq(root[: 1 + l, : 1 + l], root[: 1 + l, 1 + l :], rcond=None)[0]  # (1 + l, Q)
    rest = root[:, 1 + l :] - root[:, : 1 + l] @ slopes
    spread = np.linalg.norm(root[1:, 1 + l :])
    share = float(np.linalg.norm(rest) / spread) if spread > 0 else 0.0
    if share < LINEAR:
        raise RankError(_nearly_linear(basis, names[output], share) + " Use more functions, or a record in which this "
                        "output moves further.")
    if share < NEARLY_LINEAR:
        warnings.warn(_nearly_linear(basis, names[output], share) + " What it adds will be uncertain.", DataWarning,
                      stacklevel=4)
    _, values, right = np.linalg.svd(rest)
    kept = values > SMALLEST * spread
    vectors = right[: values.size][kept].T / (values[kept] / np.sqrt(count))
    reduced = slopes @ vectors
    return Feedback(output, basis, vectors, reduced[0], reduced[1:].T, share)


def _nearly_linear(basis: Basis, name: str, share: float) -> str:
    degree = "" if share < LINEAR else "nearly "
    return (f"the {_family(basis)} feedback functions of output {name!r} are {degree}linear in the outputs on this "
            f"record: only {share:.1e} of their spread is not. A linear feedback cannot be distinguished from an "
            "output injection (A - LC, B - LD).")


def _family(basis: Basis) -> str:
    return type(basis).__name__.lower()


def check_channels(records: Sequence[Array], inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Refuse channels of records [u | y], (N, m + l), that are constant or sums of multiples of others.

    Raises:
        DataError: an output that never changes.
        RankError: an input that the other inputs and a constant give exactly, or an output that other outputs give.
    """
    m = len(inputs)
    for kind, names, columns in (("input", inputs, slice(0, m)), ("output", outputs, slice(m, None))):
        rows = np.ones((sum(map(len, records)), 1 + len(names)))
        np.concatenate([record[:, columns] for record in records], out=rows[:, 1:])
        present = ~np.isnan(rows @ np.ones(1 + len(names)))
        rows = rows if present.all() else rows[present]
        if len(rows) <= len(names) + 1:
            raise DataError(f"only {len(rows)} samples have all {kind}s at once: {len(names)} {kind}s cannot be "
                            "separated with so few.")
        root = root_of_rows(rows)
        for c, name in enumerate(names, start=1):
            if np.abs(root[c, c]) <= 10 * ROUNDING["qr"] * np.linalg.norm(root[:, c]):
                if np.linalg.norm(root[1 : c + 1, c]) <= 10 * ROUNDING["qr"] * np.linalg.norm(root[:, c]):
                    raise DataError(f"{kind} {name!r} is constant: leave the channel out, or use a record in which it "
                                    "moves.")
                shares = np.linalg.lstsq(root[:c, :c], root[:c, c], rcond=None)[0][1:]
                sizes = np.abs(shares) * np.linalg.norm(root[1:, 1:c], axis=0)
                partners = [str(names[j]) for j in np.argsort(-sizes) if sizes[j] > 1e-6 * sizes.max()]
                raise RankError(f"{kind} {name!r} is a sum of multiples of {', '.join(partners)} and a constant: their "
                                "effects cannot be separated. Leave one channel out.")
