"""Recursive identification of Hammerstein-ARX models, sample by sample (Luo, Algorithm 3.2, indices corrected).

The recursion minimises, after every sample,

    sum_t lambda^(rows used after t) a(t) |y(t) - theta^T phi(t)|^2
        + lambda^(rows used) (theta - theta_0)^T P_0^-1 (theta - theta_0),

where phi(t) contains y(t-1), .. and eta(u(t - nk)), .., and the first row is the first one with all its lags. The
square-root information form (`optid.identify.recursive.kernel`) equals Algorithm 3.2 in exact arithmetic.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_integer, one_of
from optid.bases import fitted_bases, from_dict, parse
from optid.bases.basis import Basis
from optid.data.channels import as_name_list, channel_fields, sampling_time
from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import DataError, RankError, StructureError
from optid.identify.recursive.state import SavedState, as_block, forgetting_factor
from optid.models import HammersteinTF
from optid.models.layout import Layout
from optid.models.nonlinearity import Nonlinearity
from optid.statistics import Statistics
from optid.statistics.blocks import check_inside, row_weights, used_rows
from optid.statistics.factors import add_to_root, dependent_column
from optid.structures.lifted_regression import leading_pairs, lifted_problem, positions
from optid.structures.whitening import invert_triangular

CHUNK = 4096  # samples whose basis functions are evaluated at a time
SPLITS = ("whitened", "plain")

COUNTS = ("samples", "candidates", "rows", "since_restart")


@dataclass(frozen=True, eq=False)
class Trace:
    """The estimate over time: theta (K, n, l) after `samples` (K,), NaN while undetermined, and innovations (N, l).

    The rank-one factors are those of Luo, Algorithm 3.1 (Bai, Automatica 34, 1998).
    """

    layout: Layout
    samples: Any
    theta: Array
    innovations: Array

    @property
    def a(self) -> Array:
        """Coefficients of A over time: (K, na), or (K, na, l, l) for several outputs."""
        return _past_coefficients(self.theta, self.layout)

    def split(self, c: int = 0, beta: float = 1.0) -> tuple[Array, Array, Array]:
        """Split Theta of input c by the plain SVD in the gauge of Algorithm 3.1: mu = beta s_1 u_1, b = v_1 / beta.

        The first coefficient of b has the sign of beta. Returns mu (K, P), b (K, nb l) and s_2 / s_1 (K,).
        """
        if beta == 0:
            raise StructureError("beta=0: the gauge must not be zero.")
        known = np.asarray(np.isfinite(self.theta).all(axis=(1, 2)))
        left, size, right = np.linalg.svd(_theta_matrices(self.theta[known], self.layout)[c], full_matrices=False)
        sign = np.where(right[:, :1, 0] < 0, -1.0, 1.0)
        second = size[:, 1] if size.shape[1] > 1 else np.zeros(len(size))
        found = (beta * (sign * size[:, :1]) * left[:, :, 0], sign * right[:, 0] / beta,
                 second / np.where(size[:, 0] > 0, size[:, 0], 1.0))
        mu, b, ratio = (np.full((len(known), *part.shape[1:]), np.nan) for part in found)
        mu[known], b[known], ratio[known] = found
        return mu, b, ratio


class RecursiveARX(SavedState):
    """A Hammerstein-ARX model that is updated as samples arrive; `update` changes it.

    The estimate is over-parametrised, one matrix Theta_c per input; `model` splits off the rank-one factors. A row with
    a missing sample, or with weight zero, leaves the information unchanged.

    Attributes:
        layout: the columns of phi.
        samples: samples seen.
        candidates: rows without regard to missing samples.
        rows: rows used.
        root: (n + l, n + l) the information, upper triangular R of [Phi | Y]: P = (R^T R)^-1 of its first n columns.
        past_u: (reach, m) the last inputs, for the lags.
        past_y: (reach, l) the last outputs.
        since_restart: samples since `restart`.
    """

    kind, arrays = "recursion", ("root", "past_u", "past_y")
    settings = ("input_units", "output_units", "dt", "time_unit", "forgetting")

    def __init__(
        self, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str],
        nk: int | Sequence[int] = 0, inputs: str | Sequence[str] = "u", outputs: str | Sequence[str] = "y",
        dt: float = 1.0, forgetting: float = 1.0, theta0: ArrayLike = 0.0, P0: ArrayLike = np.inf,
        input_units: str | Sequence[str] | None = None, output_units: str | Sequence[str] | None = None,
        time_unit: str = "",
    ) -> None:
        """Start from a prior estimate.

        Args:
            na: number of past outputs.
            nb: number of coefficients of B, one per input or one for all.
            basis: basis of the nonlinearity, with its interval, one per input or one for all.
            nk: delay in samples, one per input or one for all.
            inputs: names of the inputs; their number is the number of inputs.
            outputs: names of the outputs.
            dt: sampling time.
            forgetting: lambda in (0, 1]; 1 forgets nothing, lambda remembers about 1 / (1 - lambda) rows.
            theta0: prior estimate: a number, (n,) or (n, l) in the order of `layout.names()`.
            P0: prior covariance over the noise variance: a number, (n,) diagonal or (n, n); infinity (no prior) gives
                the batch least squares.
            input_units: units of the inputs.
            output_units: units of the outputs.
            time_unit: unit of dt, "" where it is unknown.

        Raises:
            StructureError: invalid orders, a basis without interval, a forgetting factor outside (0, 1], a P0 that is
                not positive.
        """
        names_u, names_y = as_name_list(inputs) or [], as_name_list(outputs) or []
        m = len(names_u)
        bases = tuple(parse(b) if isinstance(b, str) else b for b in _each(basis, m))
        self.layout = Layout(na, _each(nb, m), _each(nk, m), bases, tuple(names_y), tuple(names_u))
        names = channel_fields(m, len(names_y), names_u, names_y, input_units, output_units)
        for channel, one in zip(names_u, bases):
            if one.interval is None and type(one).__name__ != "Linear":
                raise StructureError(
                    f"The basis of input {channel!r} has no interval, which a recursion needs: give it, as in "
                    f"{type(one).__name__}(..., interval=(lower, upper)).")
        self.forgetting = forgetting_factor(forgetting)
        self.dt, self.time_unit = sampling_time(dt), time_unit
        self.input_units, self.output_units = names["input_units"], names["output_units"]
        self.samples = self.candidates = self.rows = 0
        self.root = _prior_factor(theta0, P0, self.layout)
        self.restart()

    @classmethod
    def like(cls, data: Data | Stream, *, basis: Any, **settings: Any) -> "RecursiveARX":
        """Start with the channels, units and sampling time of a record, and the range of its inputs as intervals.

        The samples are not used otherwise (see `read`); detrended or scaled data are a `DataError`. The settings are
        na, nb and the other arguments of the class.
        """
        _check_raw(data)
        return cls(basis=fitted_bases(data, basis), inputs=data.inputs, outputs=data.outputs,
                   dt=data.dt, time_unit=data.time_unit, input_units=data.input_units,
                   output_units=data.output_units, **settings)

    def update(self, u: ArrayLike, y: ArrayLike, weights: ArrayLike = 1.0) -> Array:
        """Process the next sample or block, and return the innovations y(t) - theta(t-1)^T phi(t).

        They are (N, l), NaN where the row was not used or the prediction was not determined.

        Args:
            u: (N, m) inputs, or (N,) for one input; one sample as (m,), or a number for one input. NaN = missing.
            y: (N, l) outputs, in the same way.
            weights: a(t) >= 0, one number or (N,); 0 leaves a row out.

        Raises:
            DataError: wrong shape, infinite sample, a sample outside a basis with outside="error". The state is then
                unchanged.
        """
        return self._absorb(u, y, weights, 0)[0]

    def trace(self, u: ArrayLike, y: ArrayLike, every: int = 1, weights: ArrayLike = 1.0) -> Trace:
        """Process a block as `update` does, and record the estimate after every so many samples since the start.

        The other arguments are those of `update`.
        """
        first, every = self.samples, check_integer(every, "every")
        innovations, theta = self._absorb(u, y, weights, every)
        after = np.arange(first + 1, self.samples + 1)
        return Trace(self.layout, after[after % every == 0], theta, innovations)

    def read(self, data: Data | Stream) -> list[Array]:
        """Process a whole record, every experiment with its own lags; return the innovations of each.

        Other channels than the model's, and detrended or scaled data, are a `DataError`.
        """
        _check_raw(data)
        if data.inputs != self.layout.inputs or data.outputs != self.layout.outputs:
            raise DataError(f"The data have {_channels(data)}, the model {_channels(self.layout)}: use data.select.")
        innovations = []
        for chunks in [data] if isinstance(data, Stream) else [[(e.u, e.y)] for e in data.experiments]:
            self.restart()
            innovations.append(np.concatenate([self.update(u, y) for u, y in chunks]))
        return innovations

    def restart(self) -> None:
        """Forget the lagged samples, not the estimate: the next sample does not follow the last one."""
        reach = self.layout.first_row
        self.past_u, self.past_y = np.full((reach, self.layout.m), np.nan), np.full((reach, self.layout.l), np.nan)
        self.since_restart = 0

    def _absorb(self, u: ArrayLike, y: ArrayLike, weights: ArrayLike, every: int) -> tuple[Array, Array]:
        from optid.identify.recursive import kernel as recursion_kernel

        layout, reach = self.layout, self.layout.first_row
        u, y = as_block(u, layout.inputs, "u", self.samples), as_block(y, layout.outputs, "y", self.samples)
        if len(u) != len(y):
            raise DataError(f"u has {len(u)} samples and y has {len(y)}: give as many of each.")
        check_inside(u, layout, "", self.samples)
        weights = row_weights(weights, len(u))
        columns = recursion_kernel.LaggedColumns(*_columns(layout))
        after = np.arange(self.samples + 1, self.samples + len(u) + 1)
        marks = after % every == 0 if every else np.zeros(len(u), bool)
        innovations, traced = [np.empty((0, layout.l))], [np.empty((0, layout.n_columns, layout.l))]
        for start in range(0, len(u), CHUNK):
            part = slice(start, start + CHUNK)
            past_u, past_y = np.concatenate([self.past_u, u[part]]), np.concatenate([self.past_y, y[part]])
            count, used = len(past_y) - reach, np.where(used_rows(past_u, past_y, layout), weights[part], 0.0)
            signals = np.concatenate([-past_y, *(b.values(x) for b, x in zip(layout.bases, past_u.T))], axis=1)
            self.rows, errors, estimates = recursion_kernel.absorb(
                self.root, signals, columns, used, self.forgetting, self.rows, marks[part])
            innovations.append(errors)
            traced.append(estimates)
            complete = np.arange(self.since_restart, self.since_restart + count) >= reach
            self.candidates += int(np.count_nonzero(complete & (weights[part] > 0)))
            self.samples += count
            self.since_restart += count
            self.past_u, self.past_y = past_u[count:], past_y[count:]
        return np.concatenate(innovations), np.concatenate(traced)

    @property
    def statistics(self) -> Statistics:
        """The information of the rows, the prior included, as the batch statistics of the same layout."""
        root = self.root.copy()
        return Statistics(self.layout, root.T @ root, self.rows, self.candidates, root)

    @property
    def theta(self) -> Array:
        """The estimate (n, l), in the order of `layout.names()`; an undetermined column is a `RankError`."""
        from scipy.linalg import solve_triangular

        return solve_triangular(self._determined(), self.root[: self.layout.n_columns, self.layout.n_columns :])

    @property
    def P(self) -> Array:
        """The matrix P (n, n) of Algorithm 3.2; times the noise variance, the covariance of `theta`, and as that."""
        inverse = invert_triangular(self._determined(), lower=False)
        return inverse @ inverse.T

    def _determined(self) -> Array:
        """Return the factor R (n, n) of the information; a singular one is a `RankError`."""
        n = self.layout.n_columns
        column = dependent_column(self.root, n, "qr")
        if column is not None:
            raise RankError(
                f"The {self.rows} rows so far do not determine the coefficient of {self.layout.names()[column]}. Wait "
                "for samples that excite it, use fewer lags or basis functions, or give a finite P0.")
        return self.root[:n, :n]

    @property
    def matrices(self) -> tuple[Array, ...]:
        """Theta_c (P_c, nb_c l) of every input, lags inner, outputs outer, of rank one for a Hammerstein system."""
        return _theta_matrices(self.theta, self.layout)

    def model(self, split: Literal["whitened", "plain"] = "whitened", gauge: str = "norm") -> HammersteinTF:
        """Return the model of the present estimate by its rank-one factors; errors as `theta`.

        Args:
            split: "whitened" (SVD in the Kronecker metric of the Gram matrix, close to the least-squares optimum) or
                "plain" (SVD of Theta, as in the dissertation).
            gauge: "norm", "gain" or "b0", as in `HammersteinTF.regauge`.

        Raises:
            StructureError: unknown split or gauge.
        """
        one_of("split", split, SPLITS)
        layout, theta = self.layout, self.theta
        core = lifted_problem(self.statistics, positions(layout)).core
        pairs = leading_pairs(core, _theta_matrices(theta, layout), split == "whitened")
        return HammersteinTF(
            a=_past_coefficients(theta, layout),
            b=tuple(b if layout.l == 1 else b.reshape(-1, layout.l, order="F") for _, b in pairs),
            nonlinearities=tuple(Nonlinearity(basis, mu) for basis, (mu, _) in zip(layout.bases, pairs)),
            nk=layout.nk, offset=theta[layout.offset], dt=self.dt, time_unit=self.time_unit, inputs=layout.inputs,
            outputs=layout.outputs, input_units=self.input_units, output_units=self.output_units,
        ).regauge(gauge)

    def __repr__(self) -> str:
        return (f"RecursiveARX: {_channels(self.layout)}, na {self.layout.na}, nb {self.layout.nb}, "
                f"nk {self.layout.nk}, forgetting {self.forgetting:g}; {self.rows} rows of {self.samples} samples")

    def _head(self) -> dict[str, Any]:
        layout = self.layout
        orders = {"na": int(layout.na), "nb": [int(b) for b in layout.nb], "nk": [int(k) for k in layout.nk]}
        settings = super()._head()["settings"] | orders | {"inputs": layout.inputs, "outputs": layout.outputs}
        return {"settings": settings, "bases": [basis.to_dict() for basis in layout.bases],
                "counts": {name: getattr(self, name) for name in COUNTS}}

    @classmethod
    def _of_head(cls, head: dict[str, Any], functions: dict[str, Any] | None) -> "RecursiveARX":
        state = cls(basis=[from_dict(basis, functions) for basis in head["bases"]], **head["settings"])
        for name in COUNTS:
            setattr(state, name, int(head["counts"][name]))
        return state


def _each(value: Any, m: int) -> tuple[Any, ...]:
    """One entry per input; of a list, `Layout` refuses a wrong length."""
    return tuple(value) if isinstance(value, list | tuple) else (value,) * m


def _channels(of: Any) -> str:
    return f"{', '.join(of.inputs)} -> {', '.join(of.outputs)}"


def _check_raw(data: Data | Stream) -> None:
    if not data.transform.is_identity:
        raise DataError("The data were detrended or scaled; a recursion works in raw units: use data.raw().")


def _columns(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return which signal, [-y | eta_1 | eta_2 ..], and which lag every column of phi but the last takes."""
    start = layout.l
    source, lag = [np.tile(np.arange(start), layout.na)], [np.repeat(np.arange(layout.na) + 1, start)]
    for lags, basis in zip(layout.lags, layout.bases):
        source.append(np.tile(start + np.arange(basis.size), len(lags)))
        lag.append(np.repeat(np.array(lags), basis.size))
        start += basis.size
    return np.concatenate(source).astype(np.intp), np.concatenate(lag).astype(np.intp)


def _past_coefficients(theta: Array, layout: Layout) -> Array:
    """Return the coefficients of A, (..., na) or (..., na, l, l) for several outputs, from theta (..., n, l)."""
    na, l = layout.na, layout.l  # noqa: E741
    a = theta[..., : na * l, :].reshape(*theta.shape[:-2], na, l, l).swapaxes(-1, -2)
    return a[..., 0, 0] if l == 1 else a


def _theta_matrices(theta: Array, layout: Layout) -> tuple[Array, ...]:
    """Return Theta_c (..., P_c, nb_c l) from the coefficients (..., n, l)."""
    found, (*several, _, l) = [], theta.shape  # noqa: E741
    for c, (b, basis) in enumerate(zip(layout.nb, layout.bases)):
        block = theta[..., layout.block(c), :].reshape(*several, b, basis.size, l)
        found.append(np.moveaxis(block, -3, -1).reshape(*several, basis.size, l * b))
    return tuple(found)


def _prior_factor(theta0: Any, P0: Any, layout: Layout) -> Array:
    """Return the factor [R | R theta_0; 0 | 0] with R^T R = P_0^-1."""
    n, l = layout.n_columns, layout.l  # noqa: E741
    theta, covariance = np.asarray(theta0, dtype=float), np.asarray(P0, dtype=float)
    if theta.shape not in ((), (n,), (n, l)) or not np.all(np.isfinite(theta)):
        raise StructureError(f"theta0 has shape {theta.shape}: it must be a number, ({n},) or ({n}, {l}), all finite.")
    if covariance.shape not in ((), (n,), (n, n)):
        raise StructureError(f"P0 has shape {covariance.shape}: it must be a number, ({n},) or ({n}, {n}).")
    if covariance.ndim < 2:
        if not np.all(covariance > 0):
            raise StructureError("P0 must be positive: it is a covariance. Infinity means no prior.")
        factor = np.diag(np.broadcast_to(1 / np.sqrt(covariance), n))
    else:
        skew = np.abs(covariance - covariance.T).max() > 1e-10 * np.abs(covariance).max()
        if skew or not np.linalg.eigvalsh(covariance)[0] > 0:
            raise StructureError("P0 is not a symmetric positive definite matrix; give (n,) variances to use infinity.")
        factor = add_to_root(np.zeros((n, n)), invert_triangular(np.linalg.cholesky(covariance)))
    root = np.zeros((n + l, n + l))
    root[:n, :n] = factor
    root[:n, n:] = factor @ np.broadcast_to(theta[:, None] if theta.ndim == 1 else theta, (n, l))
    return root
