"""Recursive identification of Hammerstein-ARX models, sample by sample (Luo, Algorithm 3.2, indices corrected).

The recursion minimises, after every sample,

    sum_t lambda^(rows used after t) a(t) |y(t) - theta^T phi(t)|^2
        + lambda^(rows used) (theta - theta_0)^T P_0^-1 (theta - theta_0),

where phi(t) holds y(t-1), .. and eta(u(t - nk)), .. and meets y(t), and the first row is the first one with all its
lags. It is carried in square-root information form (`optid.recursion_kernel`), which is Algorithm 3.2 in exact
arithmetic and does not lose symmetry or definiteness in long runs.
"""

import json
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from optid.accumulate import rows_present
from optid.arrays import check_finite
from optid.bases import from_dict, parse
from optid.basis import Array, Basis
from optid.channels import channel_names, channel_units, listed, sampling_time
from optid.errors import DataError, ModelFileError, StructureError
from optid.factors import add_to_root
from optid.layout import Layout
from optid.models import HammersteinARX
from optid.nonlinearity import Nonlinearity
from optid.regressors import Statistics
from optid.whitening import invert_triangular, kronecker_factors

if TYPE_CHECKING:
    from optid.data import Data
    from optid.streams import Stream

CHUNK = 4096
"""Samples whose basis functions are evaluated at a time."""

VERSION = 1
"""Version of the state file."""

SPLITS = ("whitened", "plain")


class RecursiveARX:
    """A Hammerstein-ARX model that is updated as samples arrive.

    It is a state: `update` changes it. The estimate is over-parametrised, one matrix Theta_c per input; `model` splits
    off the rank-one factors whenever it is asked. Nothing is forgotten while nothing is learned: a row that touches a
    missing sample, or has weight zero, leaves the information as it is, while the lags move on.

    Attributes:
        layout: the columns of phi.
        forgetting: lambda in (0, 1]; 1 forgets nothing, lambda remembers about 1 / (1 - lambda) rows.
        dt: sampling time.
        samples: samples seen.
        candidates: rows there would have been, had no sample been missing.
        rows: rows used.
    """

    def __init__(
        self,
        *,
        na: int,
        nb: int | Sequence[int],
        basis: Basis | str | Sequence[Basis | str],
        nk: int | Sequence[int] = 0,
        inputs: str | Sequence[str] = "u",
        outputs: str | Sequence[str] = "y",
        dt: float = 1.0,
        forgetting: float = 1.0,
        theta0: ArrayLike = 0.0,
        P0: ArrayLike = np.inf,
        input_units: str | Sequence[str] | None = None,
        output_units: str | Sequence[str] | None = None,
    ) -> None:
        """Start from what is known before the first sample.

        Args:
            na: number of past outputs.
            nb: number of coefficients of B, one per input or one for all.
            basis: basis of the nonlinearity, with its interval, one per input or one for all.
            nk: delay in samples, one per input or one for all.
            inputs: names of the inputs; their number is the number of inputs.
            outputs: names of the outputs.
            dt: sampling time.
            forgetting: lambda in (0, 1].
            theta0: prior estimate: a number, (n,) or (n, l) in the order of `layout.names()`.
            P0: prior covariance over the noise variance: a number, (n,) diagonal or (n, n). Infinity is no prior at
                all, and then the estimate is that of the batch least squares.
            input_units: units of the inputs.
            output_units: units of the outputs.

        Raises:
            StructureError: impossible orders, a basis without interval, a forgetting factor outside (0, 1], a P0 that
                is not positive.
        """
        names_u, names_y = listed(inputs) or [], listed(outputs) or []
        m = len(names_u)
        bases = tuple(parse(b) if isinstance(b, str) else b for b in _each(basis, m))
        self.layout = Layout(na, _each(nb, m), _each(nk, m), bases, tuple(names_y), tuple(names_u))
        channel_names(names_u + names_y, "", m + len(names_y), "inputs and outputs")
        for channel, one in zip(names_u, bases):
            if one.interval is None and type(one).__name__ != "Linear":
                raise StructureError(
                    f"The basis of input {channel!r} has no interval: a recursion does not know the range of the input "
                    f"beforehand. Give it, as in {type(one).__name__}(..., interval=(lower, upper))."
                )
        if not 0 < forgetting <= 1:
            raise StructureError(f"forgetting={forgetting!r}: a factor above 0 and at most 1, such as 0.995.")
        self.forgetting = float(forgetting)
        self.dt = sampling_time(dt)
        self.input_units = channel_units(input_units, m, "input_units")
        self.output_units = channel_units(output_units, self.layout.l, "output_units")
        self.samples = self.candidates = self.rows = 0
        self._root = _prior(theta0, P0, self.layout)
        self.restart()

    @classmethod
    def like(cls, data: "Data | Stream", **settings: Any) -> "RecursiveARX":
        """Start with the channels, units and sampling time of a record, and the range of its inputs as intervals.

        Args:
            data: the record, in raw units; its samples are not used (see `read`).
            settings: na, nb, basis and the other arguments of the class.

        Raises:
            DataError: detrended or scaled data.
        """
        if not data.transform.is_identity:
            raise DataError("The data were detrended or scaled; a recursion works in raw units: use data.raw().")
        lo, hi = data.ranges() if not hasattr(data, "experiments") else _ranges(data)
        bases = [parse(b) if isinstance(b, str) else b for b in _each(settings.pop("basis"), data.m)]
        return cls(
            basis=[b.fitted(float(x), float(z)) for b, x, z in zip(bases, lo, hi)], inputs=data.inputs,
            outputs=data.outputs, dt=data.dt, input_units=data.input_units, output_units=data.output_units, **settings,
        )

    # -- samples ---------------------------------------------------------------------------------------------------

    def update(self, u: ArrayLike, y: ArrayLike, weights: ArrayLike = 1.0) -> Array:
        """Take in the next sample, or the next block of them.

        Args:
            u: (N, m) inputs, or (N,) for one input; one sample as (m,), or a number for one input. NaN = missing.
            y: (N, l) outputs, in the same way.
            weights: a(t) >= 0, one number or (N,); 0 leaves a row out.

        Returns:
            (N, l) innovations y(t) - theta(t-1)^T phi(t); NaN where the row was not used and where the past did not
            determine the prediction.

        Raises:
            DataError: wrong shape, infinite sample, a sample outside a basis with outside="error". The state is then
                unchanged.
        """
        return self._absorb(u, y, weights, 0)[0]

    def trace(self, u: ArrayLike, y: ArrayLike, every: int = 1, weights: ArrayLike = 1.0) -> "Trace":
        """Take in a block as `update` does and record the estimate on the way.

        Args:
            u: as in `update`.
            y: as in `update`.
            every: the estimate is recorded after every so many samples, counted from the first one seen.
            weights: as in `update`.
        """
        if isinstance(every, bool) or not isinstance(every, int | np.integer) or every < 1:
            raise StructureError(f"every={every!r}: record after every so many samples, a whole number from 1.")
        first = self.samples
        innovations, theta = self._absorb(u, y, weights, int(every))
        after = np.arange(first + 1, self.samples + 1)
        return Trace(self.layout, after[after % every == 0], theta, innovations)

    def read(self, data: "Data | Stream") -> list[Array]:
        """Take in a whole record, every experiment with lags of its own; returns the innovations of each."""
        innovations = []
        if hasattr(data, "experiments"):
            for experiment in data.experiments:
                self.restart()
                innovations.append(self.update(experiment.u, experiment.y))
            return innovations
        self.restart()
        return [np.concatenate([self.update(u, y) for u, y in data])]

    def restart(self) -> None:
        """Forget the lagged samples, not the estimate: the next sample does not follow the last one."""
        reach = self.layout.first_row
        self._past_u, self._past_y = np.full((reach, self.layout.m), np.nan), np.full((reach, self.layout.l), np.nan)
        self._since_restart = 0

    def _absorb(self, u: ArrayLike, y: ArrayLike, weights: ArrayLike, every: int) -> tuple[Array, Array]:
        from optid import recursion_kernel

        layout, reach = self.layout, self.layout.first_row
        u, y = _block(u, layout.inputs, "u", self.samples), _block(y, layout.outputs, "y", self.samples)
        if len(u) != len(y):
            raise DataError(f"u has {len(u)} samples and y has {len(y)}: give as many of each.")
        self._check_inside(u)
        weights = _row_weights(weights, len(u))
        source, lag = _columns(layout)
        innovations = np.full(y.shape, np.nan)
        marks = np.zeros(len(u), bool)
        if every:
            marks[(np.arange(self.samples, self.samples + len(u)) + 1) % every == 0] = True
        traced, recorded = np.empty((int(marks.sum()), layout.n_columns, layout.l)), 0
        for start in range(0, len(u), CHUNK):
            part = slice(start, start + CHUNK)
            past_u, past_y = np.concatenate([self._past_u, u[part]]), np.concatenate([self._past_y, y[part]])
            count, marked = len(past_y) - reach, int(marks[part].sum())
            used = rows_present(past_u, past_y, layout) & (weights[part] > 0)
            signals = np.concatenate([-past_y, *(b.values(x) for b, x in zip(layout.bases, past_u.T))], axis=1)
            self.rows = recursion_kernel.absorb(
                self._root, signals, past_y, source, lag, used, weights[part], self.forgetting, self.rows,
                innovations[part], marks[part], traced[recorded : recorded + marked],
            )
            recorded += marked
            complete = np.arange(self._since_restart, self._since_restart + count) >= reach
            self.candidates += int(np.count_nonzero(complete & (weights[part] > 0)))
            self.samples += count
            self._since_restart += count
            self._past_u, self._past_y = past_u[count:], past_y[count:]
        return innovations, traced

    def _check_inside(self, u: Array) -> None:
        for channel, basis, x in zip(self.layout.inputs, self.layout.bases, u.T):
            if basis.outside == "error" and basis.n_outside(x):
                k = next(k for k in range(len(x)) if basis.n_outside(x[k : k + 1]))
                raise DataError(
                    f"input {channel!r}, sample {self.samples + k}: {x[k]:g} is outside the interval {basis.interval} of "
                    "the basis. Use data inside it, or outside='clamp' or 'extrapolate'."
                )

    # -- what is known now -------------------------------------------------------------------------------------------

    @property
    def statistics(self) -> Statistics:
        """Everything the rows say, the prior included, as the batch statistics of the same layout."""
        root = self._root.copy()
        return Statistics(self.layout, root.T @ root, self.rows, self.candidates, root)

    @property
    def theta(self) -> Array:
        """The estimate (n, l), in the order of `layout.names()`.

        Raises:
            RankError: the rows so far do not determine it; the message names the column.
        """
        from scipy.linalg import solve_triangular

        n, root = self.layout.n_columns, self.statistics.root
        return solve_triangular(root[:n, :n], root[:n, n:])

    @property
    def P(self) -> Array:
        """The matrix P (n, n) of Algorithm 3.2; times the noise variance, the covariance of the estimate.

        Raises:
            RankError: as `theta`.
        """
        inverse = invert_triangular(self.statistics.root[: self.layout.n_columns, : self.layout.n_columns], lower=False)
        return inverse @ inverse.T

    @property
    def matrices(self) -> tuple[Array, ...]:
        """Theta_c (P_c, nb_c l) of every input, lags inner, outputs outer.

        The ratio of its second to its first singular value tells how far the record is from a Hammerstein system.

        Raises:
            RankError: as `theta`.
        """
        return _matrices(self.theta, self.layout)

    def model(self, split: Literal["whitened", "plain"] = "whitened", gauge: str = "norm") -> HammersteinARX:
        """Split off the rank-one factors of the present estimate.

        Args:
            split: "whitened" (SVD in the Kronecker metric of the Gram matrix, close to the least-squares optimum) or
                "plain" (SVD of Theta, as in the dissertation).
            gauge: "norm", "gain" or "b0", as in `HammersteinARX.regauge`.

        Raises:
            RankError: as `theta`.
            StructureError: unknown split or gauge.
        """
        if split not in SPLITS:
            raise StructureError(f"split={split!r}: use one of {', '.join(map(repr, SPLITS))}.")
        layout, theta = self.layout, self.theta
        grams = _block_grams(self._root, layout) if split == "whitened" else [None] * layout.m
        pairs = [_leading_pair(matrix, gram, b, layout.l) for matrix, gram, b in zip(self.matrices, grams, layout.nb)]
        a = theta[: layout.na * layout.l].reshape(layout.na, layout.l, layout.l).transpose(0, 2, 1)
        return HammersteinARX(
            a=a[:, 0, 0] if layout.l == 1 else a,
            b=tuple(b if layout.l == 1 else b.reshape(-1, layout.l, order="F") for _, b in pairs),
            nonlinearities=tuple(Nonlinearity(basis, mu) for basis, (mu, _) in zip(layout.bases, pairs)),
            nk=layout.nk, offset=theta[layout.offset], dt=self.dt, inputs=layout.inputs, outputs=layout.outputs,
            input_units=self.input_units, output_units=self.output_units,
        ).regauge(gauge)

    def __repr__(self) -> str:
        return (
            f"RecursiveARX: {', '.join(self.layout.inputs)} -> {', '.join(self.layout.outputs)}, na {self.layout.na}, "
            f"nb {self.layout.nb}, nk {self.layout.nk}, forgetting {self.forgetting:g}; {self.rows} rows of "
            f"{self.samples} samples"
        )

    # -- files -------------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> Path:
        """Write the whole state to an npz file, from which `load` continues bit for bit.

        The file appears complete or not at all.
        """
        path, layout = Path(path), self.layout
        settings = {
            "na": int(layout.na), "nb": list(map(int, layout.nb)), "nk": list(map(int, layout.nk)),
            "inputs": layout.inputs, "outputs": layout.outputs, "input_units": self.input_units,
            "output_units": self.output_units, "dt": self.dt, "forgetting": self.forgetting,
        }
        counts = {"samples": self.samples, "candidates": self.candidates, "rows": self.rows,
                  "since_restart": self._since_restart}
        head = {"optid": "recursion", "version": VERSION, "settings": settings, "counts": counts,
                "bases": [basis.to_dict() for basis in layout.bases]}
        part = path.with_name(path.name + ".part")
        with part.open("wb") as file:
            np.savez(file, head=np.array(json.dumps(head)), root=self._root, past_u=self._past_u, past_y=self._past_y)
        os.replace(part, path)
        return path

    @classmethod
    def load(cls, path: str | Path, functions: dict[str, Any] | None = None) -> "RecursiveARX":
        """Restore a state.

        Args:
            path: file written by `save`.
            functions: the functions of UserFunctions bases by name, which a file does not hold.

        Raises:
            ModelFileError: truncated, of another version, or not a state of a recursion.
        """
        path = Path(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                head, arrays = json.loads(str(file["head"])), {k: file[k] for k in ("root", "past_u", "past_y")}
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ModelFileError(f"{path} is not a complete state of a recursion: {error}.") from error
        if not isinstance(head, dict) or head.get("optid") != "recursion" or head.get("version") != VERSION:
            raise ModelFileError(f"{path} is not a state of a recursion of version {VERSION}. Save it again with this optid.")
        try:
            state = cls(basis=[from_dict(basis, functions) for basis in head["bases"]], **head["settings"])
            shapes = {"root": state._root.shape, "past_u": state._past_u.shape, "past_y": state._past_y.shape}
            counts = {name: int(head["counts"][name]) for name in ("samples", "candidates", "rows", "since_restart")}
        except (KeyError, TypeError, AttributeError) as error:
            raise ModelFileError(f"{path}: the settings in the file cannot be read ({error}).") from error
        for name, array in arrays.items():
            if array.dtype != np.float64 or array.shape != shapes[name]:
                raise ModelFileError(f"{path}: {name} is {array.dtype} {array.shape}; float64 {shapes[name]} is needed.")
        state._root, state._past_u, state._past_y = arrays["root"], arrays["past_u"], arrays["past_y"]
        state.samples, state.candidates, state.rows = counts["samples"], counts["candidates"], counts["rows"]
        state._since_restart = counts["since_restart"]
        return state


@dataclass(frozen=True, eq=False)
class Trace:
    """The estimate over time.

    Attributes:
        layout: the columns of phi.
        samples: (K,) number of samples seen at each record.
        theta: (K, n, l) estimates; NaN while the rows so far do not determine them.
        innovations: (N, l) of every sample of the block.
    """

    layout: Layout
    samples: Array
    theta: Array
    innovations: Array

    @property
    def a(self) -> Array:
        """Coefficients of A over time: (K, na), or (K, na, l, l) for several outputs."""
        na, l = self.layout.na, self.layout.l  # noqa: E741
        a = self.theta[:, : na * l].reshape(-1, na, l, l).transpose(0, 1, 3, 2)
        return a[:, :, 0, 0] if l == 1 else a

    def split(self, c: int = 0, beta: float = 1.0) -> tuple[Array, Array, Array]:
        """Split Theta of input c by the plain SVD in the gauge of Algorithm 3.1: mu = beta s_1 u_1, b = v_1 / beta.

        Args:
            c: index of the input.
            beta: the gauge, not zero; the first coefficient of b has its sign.

        Returns:
            mu (K, P), b (K, nb l) and s_2 / s_1 (K,) (0 where there is one singular value).
        """
        if beta == 0:
            raise StructureError("beta=0: the gauge is a number other than zero.")
        known = np.isfinite(self.theta).all(axis=(1, 2))
        basis, cols = self.layout.bases[c], self.layout.nb[c] * self.layout.l
        mu, b, ratio = (np.full((len(known), *s), np.nan) for s in ((basis.size,), (cols,), ()))
        stack = [_matrices(theta, self.layout)[c] for theta in self.theta[known]]
        if stack:
            left, size, right = np.linalg.svd(np.stack(stack), full_matrices=False)
            sign = np.where(right[:, 0, 0] < 0, -1.0, 1.0)
            mu[known] = beta * (sign * size[:, 0])[:, None] * left[:, :, 0]
            b[known] = sign[:, None] * right[:, 0] / beta
            ratio[known] = size[:, 1] / size[:, 0] if size.shape[1] > 1 else 0.0
        return mu, b, ratio


def _each(value: Any, m: int) -> tuple[Any, ...]:
    """One entry per input; a list is taken as it is, and `Layout` refuses a wrong length."""
    return tuple(value) if isinstance(value, list | tuple) else (value,) * m


def _ranges(data: "Data") -> tuple[list[float], list[float]]:
    inputs = data.channels[: data.m]
    return [c.low for c in inputs], [c.high for c in inputs]


def _prior(theta0: ArrayLike, P0: ArrayLike, layout: Layout) -> Array:
    """Return the factor [R | R theta_0; 0 | 0] with R^T R = P_0^-1."""
    n, l = layout.n_columns, layout.l  # noqa: E741
    theta, covariance = np.asarray(theta0, dtype=float), np.asarray(P0, dtype=float)
    if theta.shape not in ((), (n,), (n, l)) or not np.all(np.isfinite(theta)):
        raise StructureError(f"theta0 has shape {theta.shape}: a number, ({n},) or ({n}, {l}), all finite, is needed.")
    start = np.broadcast_to(theta[:, None] if theta.ndim == 1 else theta, (n, l))
    if covariance.shape not in ((), (n,), (n, n)):
        raise StructureError(f"P0 has shape {covariance.shape}: a number, ({n},) or ({n}, {n}) is needed.")
    if covariance.ndim < 2:
        if not np.all(covariance > 0):
            raise StructureError("P0 must be positive: it is a covariance. Infinity means no prior.")
        factor = np.diag(np.broadcast_to(1 / np.sqrt(covariance), n))
    else:
        try:
            lower = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            lower = np.full((n, n), np.nan)
        if not np.all(np.isfinite(lower)) or not np.allclose(covariance, covariance.T, rtol=1e-10, atol=0):
            raise StructureError("P0 is not a symmetric positive definite matrix; give (n,) variances to use infinity.")
        factor = add_to_root(np.zeros((n, n)), invert_triangular(lower))
    root = np.zeros((n + l, n + l))
    root[:n, :n], root[:n, n:] = factor, factor @ start
    return root


def _block(values: ArrayLike, names: tuple[str, ...], what: str, seen: int) -> Array:
    """Return samples as (N, channels), finite or NaN, or refuse their shape."""
    samples, width = np.asarray(values, dtype=float), len(names)
    if samples.ndim == 0 and width == 1 or samples.ndim == 1 and width > 1 and samples.size == width:
        samples = samples.reshape(1, width)
    elif samples.ndim == 1 and width == 1:
        samples = samples[:, None]
    if samples.ndim != 2 or samples.shape[1] != width:
        raise DataError(
            f"{what} has shape {np.shape(values)}: a block (N, {width}) or one sample of {width} "
            f"channel{'s' if width > 1 else ''} ({', '.join(names)}) is needed."
        )
    check_finite(samples, [f"{what}, channel {name!r}" for name in names], seen)
    return samples


def _row_weights(weights: ArrayLike, count: int) -> Array:
    given = np.asarray(weights, dtype=float)
    if given.shape not in ((), (count,)):
        raise DataError(f"weights have shape {given.shape}: one number, or one for each of the {count} samples.")
    if not np.all(np.isfinite(given) & (given >= 0)):
        raise DataError("weights must be finite and not negative; 0 leaves a row out.")
    return np.array(np.broadcast_to(given, count))


def _columns(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return which signal, [-y | eta_1 | eta_2 ..], and which lag every column of phi but the last takes."""
    source, lag, start = [np.tile(np.arange(layout.l), layout.na)], [np.repeat(np.arange(layout.na) + 1, layout.l)], layout.l
    for lags, basis in zip(layout.lags, layout.bases):
        source.append(np.tile(start + np.arange(basis.size), len(lags)))
        lag.append(np.repeat(np.array(lags), basis.size))
        start += basis.size
    return np.concatenate(source).astype(np.intp), np.concatenate(lag).astype(np.intp)


def _matrices(theta: Array, layout: Layout) -> tuple[Array, ...]:
    """Return Theta_c (P_c, nb_c l) from the coefficients (n, l)."""
    found = []
    for c, (b, basis) in enumerate(zip(layout.nb, layout.bases)):
        block = theta[layout.block(c)].reshape(b, basis.size, layout.l)
        found.append(block.transpose(1, 2, 0).reshape(basis.size, layout.l * b))
    return tuple(found)


def _block_grams(root: Array, layout: Layout) -> list[Array]:
    """Gram matrices (P_c nb_c square) of the inputs' columns, what A and the constant explain removed."""
    n, past = layout.n_columns, layout.na * layout.l
    order = np.concatenate([np.arange(past), [layout.offset], np.arange(past, layout.offset)])
    rest = np.linalg.qr(root[:n, order], mode="r")[past + 1 :, past + 1 :]
    parts = [rest[:, layout.block(c).start - past : layout.block(c).stop - past] for c in range(layout.m)]
    return [part.T @ part for part in parts]


def _leading_pair(matrix: Array, gram: Array | None, lags: int, outputs: int) -> tuple[Array, Array]:
    """Return (mu, b) with mu b^T nearest to Theta, in the Frobenius norm or in the Kronecker metric of the Gram matrix."""
    if gram is None:
        left, size, right = np.linalg.svd(matrix, full_matrices=False)
        return size[0] * left[:, 0], right[0]
    factor_mu, factor_b = kronecker_factors(gram, (len(matrix), lags))
    factor_b = np.kron(np.eye(outputs), factor_b)  # every output has the same regressor
    left, size, right = np.linalg.svd(factor_mu.T @ matrix @ factor_b, full_matrices=False)
    return invert_triangular(factor_mu).T @ (size[0] * left[:, 0]), invert_triangular(factor_b).T @ right[0]
