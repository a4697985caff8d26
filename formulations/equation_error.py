"""The compressed equation-error least squares that the ARX-type formulations share.

``A(q) y = sum_c B_c(q) f_c(u_c) + d + e`` is linear in ``z = [vec a; offset; vec Theta_1; ...]`` with
``Theta_c = mu_c vec(b_c)ᵀ``; one pass over the record leaves a triangular system of the size of z.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_triangular

from formulations.arguments import per_channel, whole_number
from optid.bases import Linear, fitted_bases
from optid.bases.basis import Basis
from optid.data.channels import Transform
from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import StructureError
from optid.models import HammersteinARX, Nonlinearity
from optid.models.gauges import leading_sign
from optid.program.program import Program
from optid.program.units import energy_unit, in_units, inner_bases, own_units
from optid.program.view import View
from optid.statistics import Layout, Statistics, collect
from optid.structures.rank_one import RankOne


class Compressed(Protocol):
    """A record compressed to least squares in rank-one blocks."""

    @property
    def problem(self) -> RankOne: ...  # noqa: D102
    @property
    def unit(self) -> float: ...  # noqa: D102


@dataclass(frozen=True)
class EquationError:
    """Least squares in z with the names needed to read it.

    Attributes:
        statistics: what one pass over the record left.
        problem: ``‖R z - s‖² + remainder`` with one rank-one block per input.
        meta: dt, names and units for the model.
        units: from those of the problem (`optid.program.units`) to those of the record.
        bases: one per input, in the units of the record.
        unit: what one unit of the objective is in units of the record.
        unweighted: statistics of the same rows without weights, where ``statistics`` has weights.
    """

    statistics: Statistics
    problem: RankOne
    meta: Mapping[str, Any]
    units: Transform
    bases: tuple[Basis, ...]
    unit: float = 1.0
    unweighted: Statistics | None = None

    @property
    def layout(self) -> Layout:
        """Column layout of the regressor."""
        return self.statistics.layout

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.layout.inputs

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return len(self.layout.outputs)

    def key(self, name: str, channel: int) -> str:
        """Name of a per-channel variable: plain with one input, ``name[input]`` with several."""
        return name if len(self.channels) == 1 else f"{name}[{self.channels[channel]}]"

    def linear_variables(self) -> dict[str, cp.Variable]:
        """Return new CVXPY variables ``a`` ((na,) or (l, na l) = [A_1 .. A_na]) and ``offset`` (l,)."""
        ny, na = self.outputs, self.layout.na
        found = {}
        if na:
            found["a"] = cp.Variable(na if ny == 1 else (ny, na * ny), name="a")
        found["offset"] = cp.Variable(ny, name="offset")
        return found

    def b_shape(self, channel: int) -> tuple[int, ...]:
        """Shape of b: (nb,) with one output, (nb, l) with several."""
        nb = self.layout.nb[channel]
        return (nb,) if self.outputs == 1 else (nb, self.outputs)

    def residual(self, linear: Mapping[str, cp.Expression], thetas: Sequence[cp.Expression]) -> cp.Expression:
        """Return ``R z - s`` for given linear variables and matrices Theta_c (P_c, nb_c l)."""
        parts = [flat(linear[name]) for name in ("a", "offset") if name in linear] + [flat(t) for t in thetas]
        return self.problem.root @ cp.hstack(parts) - self.problem.target

    def view(self, expressions: Mapping[str, cp.Expression], gauge: str = "") -> View:
        """Return what constraints may speak about."""
        full = solve_triangular(self.problem.root, self.problem.target)
        return View(expressions, channels=self.channels, bases=dict(zip(self.channels, self.bases)),
                    gauge=gauge, reference=self.linear_part(full[: self.problem.linear]), units=self.units)

    def linear_part(self, w: np.ndarray) -> dict[str, np.ndarray]:
        """Split the linear part of z into values of ``a`` and ``offset``."""
        ny, na = self.outputs, self.layout.na
        found = {"offset": np.array(w[na * ny * ny :])}
        if na:
            found["a"] = np.array(w[:na]) if ny == 1 else np.reshape(w[: na * ny * ny], (ny, na * ny), order="F")
        return found

    def matrices(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Return Theta_c (P_c, nb_c l) of every input, whatever variables the formulation uses."""
        found = []
        for c, shape in enumerate(self.problem.blocks):
            theta, mu, b = (values.get(self.key(name, c)) for name in ("Theta", "mu", "b"))
            if theta is None:
                theta = np.outer(np.ones(1) if mu is None else mu, np.ravel(np.asarray(b), order="F"))
            found.append(np.reshape(theta, shape))
        return found

    def lifted(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return z of named values, whatever variables the formulation uses."""
        parts = [values[name] for name in ("a", "offset") if name in values]
        return np.concatenate([np.ravel(part, order="F") for part in [*parts, *self.matrices(values)]])

    def regression(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the coefficients (n_columns, l) of the regressor's columns in the order of the layout."""
        ny, na = self.outputs, self.layout.na
        theta = np.zeros((self.layout.n_columns, ny))
        if na:
            theta[: na * ny] = np.reshape(values["a"], (ny, na * ny), order="F" if ny > 1 else "C").T
        for c, matrix in enumerate(self.matrices(values)):
            theta[self.layout.block(c)] = matrix.reshape(-1, ny, order="F")
        theta[-1] = values["offset"]
        return theta

    @property
    def energy(self) -> np.ndarray:
        """Sum of squares of every output about its mean over the rows used, in the units of the problem.

        It is what a one-step fit of 0 % leaves.
        """
        statistics = self.unweighted or self.statistics
        n, root = self.layout.n_columns, statistics.root
        columns = root[:, n:]
        return np.sum(columns**2, axis=0) - (root[:n, n - 1] @ columns[:n]) ** 2 / statistics.rows

    def one_step_fit(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the one-step fit in % of every output over the rows used, from the statistics alone."""
        n, root = self.layout.n_columns, (self.unweighted or self.statistics).root
        rest = np.sum((root[:, :n] @ self.regression(values) - root[:, n:]) ** 2, axis=0)
        return np.where(self.energy > 0, 100.0 * (1.0 - np.sqrt(rest / np.maximum(self.energy, 1e-300))), np.nan)

    def model(self, values: Mapping[str, np.ndarray], mus: Sequence[np.ndarray], bs: Sequence[np.ndarray], *,
              gauge: str, flip: bool = True) -> HammersteinARX:
        """Build the model in the units of the record from one (mu, b) per input, b of shape `b_shape`.

        Args:
            values: holds ``a`` and ``offset``.
            mus: coefficients of the nonlinearities, one array per input.
            bs: numerator coefficients, one array per input.
            gauge: the gauge to report in.
            flip: make the first non-zero of every b positive.
        """
        ny, na = self.outputs, self.layout.na
        a = np.asarray(values.get("a", np.zeros(0)))
        if ny > 1:
            a = np.stack([a[:, i * ny : (i + 1) * ny] for i in range(na)]) if na else np.zeros((0, ny, ny))
        signs = [leading_sign(np.asarray(b)) if flip else 1.0 for b in bs]
        model = HammersteinARX(
            a=a, b=tuple(s * np.asarray(b) for s, b in zip(signs, bs)),
            nonlinearities=tuple(Nonlinearity(basis, s * np.asarray(mu), None)
                                 for s, basis, mu in zip(signs, self.layout.bases, mus)),
            nk=self.layout.nk, offset=np.asarray(values["offset"], dtype=float), gauge=gauge, **self.meta)
        return model.with_transform(self.units)


def flat(expression: cp.Expression) -> cp.Expression:
    """Stack the columns of an expression."""
    return expression if expression.ndim == 1 else cp.vec(expression, order="F")


def tangent_product(mu: cp.Expression, b: cp.Expression, mu0: np.ndarray, b0: np.ndarray) -> cp.Expression:
    """Return ``mu bᵀ`` to first order about (mu0, b0)."""
    return cp.outer(mu, b0) + cp.outer(mu0, b) - np.outer(mu0, b0)


def compress(data: Data | Stream, *, na: int, nb: int | Sequence[int], nk: int | Sequence[int],
             basis: Basis | str | Sequence[Basis | str], ridge: float = 0.0, curvature: float = 0.0,
             weights: Sequence[np.ndarray] | None = None, own: bool = True, degree: int = 2) -> EquationError:
    """Read the record once and return the compressed problem, posed in the record's own units (`optid.program.units`).

    Args:
        data: the record.
        na: order of A.
        nb: number of numerator coefficients, one per input or one for all.
        nk: delay in samples, one per input or one for all.
        basis: one basis for all inputs or one per input; a basis without interval takes the range of its input.
        ridge: weight of ``‖Theta‖²``.
        curvature: weight of the integral of ``f''²`` summed over the columns of Theta.
        weights: nonnegative row weights per experiment, or None.
        own: False for a record that is in its own units already.
        degree: of the loss in the residuals: 2 for squares, 1 for the sum of magnitudes.

    Raises:
        StructureError: impossible orders.
        RankError: the record does not determine the parameters.
    """
    inputs, outputs = data.inputs, data.outputs
    nbs = per_channel("nb", nb, inputs, low=1)
    nks = per_channel("nk", nk, inputs, low=0)
    order = whole_number("na", na, 0, "the number of past outputs")
    bases = fitted_bases(data, basis)
    units = Transform.identity(len(inputs), len(outputs))
    if own:
        units = own_units(data, [isinstance(one, Linear) for one in bases])
        data = in_units(data, units)
    layout = Layout(na=order, nb=nbs, nk=nks, bases=inner_bases(bases, units), outputs=tuple(outputs),
                    inputs=tuple(inputs))
    if ridge < 0 or curvature < 0:
        raise StructureError(f"penalty weights must not be negative: ridge={ridge}, curvature={curvature}")
    statistics = collect(data, layout, weights=weights)
    unit = units.y_scale[0] ** degree
    share = energy_unit(units) / unit
    problem = lifted_problem(statistics, share * ridge, share * curvature, units.u_scale)
    return EquationError(statistics, problem, model_meta(data), units, bases, unit)


def model_meta(data: Data | Stream) -> dict[str, Any]:
    """Names, units and sampling time that a model carries."""
    return {"dt": data.dt, "inputs": tuple(data.inputs), "outputs": tuple(data.outputs),
            "input_units": tuple(getattr(data, "input_units", None) or ("",) * len(data.inputs)),
            "output_units": tuple(getattr(data, "output_units", None) or ("",) * len(data.outputs))}


def lifted_problem(statistics: Statistics, ridge: float, curvature: float, scales: Sequence[float]) -> RankOne:
    """Order the triangular system of the statistics by z and add the quadratic penalties on Theta.

    Args:
        statistics: of the record.
        ridge: weight of ``‖Theta‖²``.
        curvature: weight of the integral of ``f''²``.
        scales: unit of every input: Theta in the units of the record is Theta / scale.
    """
    layout, ny = statistics.layout, len(statistics.layout.outputs)
    n, na = layout.n_columns, layout.na
    sizes = [b.size for b in layout.bases]
    blocks = tuple((p, q * ny) for p, q in zip(sizes, layout.nb))
    linear = na * ny * ny + ny
    total = linear + sum(p * q for p, q in zip(sizes, layout.nb)) * ny
    where = np.zeros((ny, n), dtype=int)
    for o in range(ny):
        where[o, : na * ny] = np.arange(na * ny) * ny + o
        where[o, n - 1] = na * ny * ny + o
        position = linear
        for c, (p, q) in enumerate(zip(sizes, layout.nb)):
            where[o, layout.block(c)] = position + o * p * q + np.arange(p * q)
            position += p * q * ny
    root = statistics.root
    system = np.zeros((ny * n + (total - linear if ridge else 0), total + 1))
    remainder = 0.0
    for o in range(ny):
        rows = slice(o * n, (o + 1) * n)
        system[rows, where[o]] = root[:n, :n]
        system[rows, -1] = root[:n, n + o]
        remainder += float(np.sum(root[n:, n + o] ** 2))
    if ridge:
        each = np.concatenate([np.full(p * q, 1 / scale) for (p, q), scale in zip(blocks, scales)])
        system[ny * n :, linear:-1] = np.sqrt(ridge) * np.diag(each)
    if curvature:
        extra = np.zeros((total - linear, total + 1))
        position = linear
        for (p, q), basis in zip(blocks, layout.bases):
            factor = _square_root(np.asarray(basis.penalty(2)))
            for _ in range(q):
                extra[position - linear : position - linear + p, position : position + p] = np.sqrt(curvature) * factor
                position += p
        system = np.vstack([system, extra])
    triangle = np.triu(np.linalg.qr(system, mode="r"))
    triangle = triangle * np.where(np.diag(triangle[:, : len(triangle)]) < 0, -1.0, 1.0)[:, None]  # one of many signs
    remainder += float(triangle[total, total] ** 2) if triangle.shape[0] > total else 0.0
    scale = float(sum(np.sum(root[:, n + o] ** 2) for o in range(ny)))
    return RankOne(root=triangle[:total, :total], target=triangle[:total, total], remainder=remainder, linear=linear,
                   blocks=blocks, scale=scale)


def _square_root(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def residual_programme(problem: Compressed, name: str, variables: dict[str, cp.Variable],
                       residual: cp.Expression, **parts: Any) -> Program:
    """Assemble a programme ``minimise ‖r‖² + remainder (+ penalty)`` with the residual passed as a variable.

    The remainder is kept in the objective, so that objectives and gaps are in units of the data.
    """
    r = cp.Variable(residual.size, name="residual")
    penalty = parts.pop("penalty", 0.0)
    constraints = {"residual": (r == residual,), **parts.pop("constraints", {})}
    objective = cp.Minimize(cp.sum_squares(r) + problem.problem.remainder + penalty)
    return Program(name=name, objective=objective, constraints=constraints, variables={**variables, "residual": r},
                   structural=frozenset(constraints), derived={"residual": residual}, scale=problem.problem.scale,
                   compressed=problem, unit=problem.unit, **parts)
