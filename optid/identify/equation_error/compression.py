"""The compressed equation-error least squares that the ARX-type formulations share.

``A(q) y = sum_c B_c(q) f_c(u_c) + d + e`` is linear in ``z = [vec a; offset; vec Theta_1; ...]`` with
``Theta_c = mu_c vec(b_c)ᵀ``; one pass over the record leaves a triangular system of the size of z.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import solve_triangular

from optid.arrays import check_integer, check_weight, one_of
from optid.bases import Linear, fitted_bases
from optid.bases.basis import Basis
from optid.data.channels import Transform, model_meta
from optid.data.levels import remove_levels
from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import StructureError
from optid.identify.arguments import Offset, check_offset, per_channel
from optid.models import HammersteinTF, Nonlinearity
from optid.models.gauges import Gauge, in_gauge
from optid.program.compressed import Spread, white_spread
from optid.program.units import energy_unit, in_units, inner_bases, own_units
from optid.statistics import ExperimentMeans, Layout, Statistics, accumulate, collect, collect_by_experiment
from optid.statistics.experiments import OF_EXPERIMENTS, UNEQUAL, by_experiment, equal_levels, rows_factor
from optid.structures.bilinear import starts
from optid.structures.lifted_regression import leading_pairs, lifted_problem, positions
from optid.structures.rank_one import RankOne


@dataclass(frozen=True)
class EquationError:
    """Least squares in z, ``‖R z - s‖² + remainder`` with one rank-one block per input, with the names of its parts."""

    statistics: Statistics  # of one pass over the record
    problem: RankOne
    columns: np.ndarray  # (n_columns, l) position in z of every coefficient of the regressor
    meta: Mapping[str, Any]  # dt, names and units for the model
    units: Transform  # from those of the problem (`optid.program.units`) to those of the record
    bases: tuple[Basis, ...]  # one per input, in the units of the record
    unit: float = 1.0  # size of one unit of the objective in units of the record
    unweighted: Statistics | None = None  # of the same rows without weights, where ``statistics`` has weights
    means: ExperimentMeans | None = None  # of the rows of every experiment, where each has its own constant
    shifts: np.ndarray | None = None  # (E, l) what `remove_levels` subtracted from the outputs
    between: np.ndarray | float = 0.0  # (l,) sum of squares of the mean outputs of the experiments about their mean
    # takes the statistics of every experiment, of a record of several without weights
    parts: Callable[[], list[Statistics]] | None = None
    outward: ClassVar[None] = None  # its models are those of the record

    @property
    def layout(self) -> Layout:
        """Column layout of the regressor."""
        return self.statistics.layout

    def keys(self, name: str) -> list[str]:
        """Names of a per-channel variable: plain with one input, ``name[input]`` with several."""
        return [name] if self.layout.m == 1 else [f"{name}[{channel}]" for channel in self.layout.inputs]

    def b_shape(self, channel: int) -> tuple[int, ...]:
        """Shape of b: (nb,) with one output, (nb, l) with several."""
        nb, ny = self.layout.nb[channel], self.layout.l
        return (nb,) if ny == 1 else (nb, ny)

    def facts(self, gauge: str = "") -> dict[str, Any]:
        """Return what constraints may ask besides named expressions: keyword arguments of a `View`."""
        full, inputs = solve_triangular(self.problem.root, self.problem.target), self.layout.inputs
        return {"channels": inputs, "bases": dict(zip(inputs, self.bases)), "gauge": gauge, "units": self.units,
                "heights": frozenset({"mu", "Theta", "offset"}),
                "reference": self.linear_part(full[: self.problem.linear]),
                "delays": dict(zip(inputs, self.layout.nk))}

    def common(self) -> dict[str, Any]:
        """Return what every `optid.core.problem.Problem` of the record has: scale, unit, energy, the record itself."""
        return {"scale": self.problem.scale, "unit": self.unit, "energy": self.unit * float(np.sum(self.energy)),
                "compressed": self}

    def linear_zeros(self) -> dict[str, np.ndarray]:
        """Return zeros in the shapes of ``a`` ((na,) or (l, na l) = [A_1 .. A_na]) and ``offset`` (l,), in order."""
        part = self.linear_part(np.zeros(self.problem.linear))
        return {name: part[name] for name in ("a", "offset") if name in part}

    def linear_part(self, w: np.ndarray) -> dict[str, np.ndarray]:
        """Split the linear part of z into values of ``a`` and ``offset``."""
        ny, na = self.layout.l, self.layout.na
        found = {"offset": np.array(w[na * ny * ny :])}
        if na:
            found["a"] = np.array(w[:na]) if ny == 1 else np.reshape(w[: na * ny * ny], (ny, na * ny), order="F")
        return found

    def matrices(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Return Theta_c (P_c, nb_c l) of every input, for any variables of a formulation."""
        found = []
        for shape, *keys in zip(self.problem.blocks, *map(self.keys, ("Theta", "mu", "b"))):
            theta, mu, b = (values.get(key) for key in keys)
            if theta is None:
                theta = np.outer(np.ones(1) if mu is None else mu, np.ravel(np.asarray(b), order="F"))
            found.append(np.reshape(theta, shape))
        return found

    def lift(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return z of named values, for any variables of a formulation."""
        parts = [values[name] for name in ("a", "offset") if name in values]
        return np.concatenate([np.ravel(part, order="F") for part in [*parts, *self.matrices(values)]])

    def regression(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the coefficients (n_columns, l) of the regressor's columns in the order of the layout."""
        return self.lift(values)[self.columns]

    @property
    def energy(self) -> np.ndarray:
        """Sum of squares (l,) of every output about its mean over the rows used, in the units of the problem."""
        statistics, n = self.unweighted or self.statistics, self.layout.n_columns
        columns = statistics.root[:, n:]
        ones = statistics.root[:n, n - 1]
        return np.sum(columns**2, axis=0) - (ones @ columns[:n]) ** 2 / (ones @ ones) + self.between

    def one_step_fit(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the one-step fit in % of every output over the rows used, from the statistics alone."""
        n, root = self.layout.n_columns, (self.unweighted or self.statistics).root
        rest = np.sum((root[:, :n] @ self.regression(values) - root[:, n:]) ** 2, axis=0)
        return np.where(self.energy > 0, 100.0 * (1.0 - np.sqrt(rest / np.maximum(self.energy, 1e-300))), np.nan)

    def spread(self, z: np.ndarray, moves: np.ndarray) -> Spread:
        """Return the scatter under white equation errors, of a level of their own in every experiment if that shows."""
        found = white_spread(self.statistics, self.columns, z, moves)
        if found.penalised or self.parts is None:
            return found
        (n, l), parts = self.columns.shape, self.parts()  # noqa: E741
        counts = np.array([part.rows for part in parts])
        if not counts.all():
            return found
        roots = [rows_factor(part, self.means is not None) for part in parts]
        left = [root @ np.vstack([z[self.columns], -np.eye(l)]) for root in roots]
        noises = [rest.T @ rest / count for rest, count in zip(left, counts)]
        squares = np.array([float(np.trace(np.linalg.solve(found.noise, noise))) for noise in noises])
        if equal_levels(counts * l, squares) > UNEQUAL:
            return found
        effects = [np.einsum("ij,jok->oik", root[:, :n], moves[self.columns]) for root in roots]
        covariance = sum(np.einsum("oij,op,pik->jk", s, noise, s) for s, noise in zip(effects, noises))
        return replace(found, covariance=counts.sum() / found.dof * covariance, words=(OF_EXPERIMENTS,))

    def model(self, values: Mapping[str, np.ndarray], mus: Sequence[np.ndarray], bs: Sequence[np.ndarray], *,
              gauge: str, flip: bool = True) -> HammersteinTF:
        """Build the model in the units of the record from one (mu, b) per input, b of shape `b_shape`.

        The values hold ``a`` and ``offset``; the gauge is the one to report in, and `flip` turns every f that does not
        rise where the output rises.
        """
        levels = None
        if self.means is not None:
            pairs = zip(self.keys("mu"), mus, self.keys("b"), bs)
            point = {key: value for mu, at_mu, b, at_b in pairs for key, value in ((mu, at_mu), (b, at_b))}
            linear = {name: values[name] for name in ("a", "offset") if name in values}
            levels = self.means.constants(self.regression({**linear, **point}))
        model = HammersteinTF(
            a=self.past(values), b=tuple(map(np.asarray, bs)),
            nonlinearities=tuple(map(Nonlinearity, self.layout.bases, mus)), nk=self.layout.nk,
            offset=np.asarray(values["offset"], dtype=float), levels=levels, gauge=gauge, **self.meta)
        model = model.with_signs(model.gain_signs) if flip else model
        if self.shifts is not None:
            model = model.with_output_levels(self.shifts)
        return model.with_transform(self.units)

    def rank_one_start(self, gauge: Gauge) -> dict[str, np.ndarray]:
        """Return ``a``, ``offset``, and ``mu`` and ``b`` of every input: the best start without constraints."""
        if gauge == "gain" and self.layout.l > 1:
            raise StructureError("gauge 'gain' is defined for one output; use 'norm' or 'b0'")
        core = self.problem.core
        point = core.point(*starts(core, count=1)[0])
        part = self.linear_part(point.w)
        start = {name: part[name] for name in self.linear_zeros()}
        pairs = self._in_gauge(gauge, zip(point.mus, point.bs), start)
        for mu, b, pair in zip(self.keys("mu"), self.keys("b"), pairs):
            start.update(zip((mu, b), pair))
        return start

    def factored_model(self, gauge: Gauge, values: Mapping[str, np.ndarray], *, signed: bool = False) -> HammersteinTF:
        """Return the model of ``mu`` and ``b``; `signed` keeps their signs, else f rises where the output rises."""
        return self.model(values, [values[name] for name in self.keys("mu")], [values[name] for name in self.keys("b")],
                          gauge=gauge, flip=gauge == "norm" and not signed)

    def nearest_model(self, gauge: Gauge, whitened: bool, values: Mapping[str, np.ndarray]) -> HammersteinTF:
        """Return the model of the leading singular pair of every Theta, in the metric of the errors or a plain one."""
        pairs = leading_pairs(self.problem.core, self.matrices(values), whitened)
        mus, bs = zip(*self._in_gauge(gauge, pairs, values))
        return self.model(values, mus, bs, gauge=gauge, flip=gauge == "norm")

    def _in_gauge(self, gauge: Gauge, pairs: Iterable[tuple[np.ndarray, np.ndarray]], values: Mapping[str, np.ndarray]
                  ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return mu and b, as flat as the factors of a matrix, in the gauge."""
        return [in_gauge(gauge, mu, b.reshape(self.b_shape(c), order="F"), self.past(values), channel)
                for c, ((mu, b), channel) in enumerate(zip(pairs, self.layout.inputs))]

    def past(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the coefficients of A as models have them, (na,) or (na, l, l), from the variable ``a``, if any."""
        ny, na = self.layout.l, self.layout.na
        a = np.asarray(values.get("a", np.zeros(0)))
        if ny == 1:
            return a
        return np.stack([a[:, i * ny : (i + 1) * ny] for i in range(na)]) if na else np.zeros((0, ny, ny))


@dataclass(frozen=True)
class EquationStructure:
    """What is regressed on what.

    Attributes:
        na: order of A.
        nb: number of numerator coefficients, one per input or one for all.
        nk: delay in samples, likewise.
        basis: likewise; a basis without interval takes the range of its input.
        ridge: weight of ``‖Theta‖²``.
        curvature: weight of the integral of ``f''²`` summed over the columns of Theta.
        prior: of the impulse responses, "none", "tc", "dc" or "ss", see `optid.identify.equation_error.priors`.
        offset: True for one constant, "each" for one for every experiment.
        degree: of the loss in the residuals: 2 for squares, 1 for the sum of magnitudes.
    """

    na: int
    nb: int | Sequence[int]
    nk: int | Sequence[int]
    basis: Basis | str | Sequence[Basis | str]
    ridge: float = 0.0
    curvature: float = 0.0
    prior: str = "none"
    offset: Offset = True
    degree: int = 2


def compress(data: Data | Stream, of: EquationStructure, *, weights: Sequence[np.ndarray] | None = None,
             own: bool = True) -> EquationError:
    """Read the record once and return the compressed problem in the record's own units (`optid.program.units`).

    Args:
        data: the record.
        of: the regression.
        weights: nonnegative row weights per experiment, or None.
        own: False for a record that is in its own units already.

    Raises:
        StructureError: impossible orders, another offset.
        RankError: the record does not determine the parameters.
    """
    inputs, outputs = data.inputs, data.outputs
    nbs = per_channel("nb", of.nb, inputs, low=1)
    nks = per_channel("nk", of.nk, inputs, low=0)
    order = check_integer(of.na, "na (the number of past outputs)", 0)
    constants = check_offset(of.offset, data)
    if not constants:
        raise StructureError("offset=False: equation-error fits estimate the constant; hold it by "
                             "formulations.constraints.shape.fixed('offset', 0), or centre the record and use "
                             "'oe.exact' or 'armax.exact'")
    shifts, means, between = None, None, 0.0
    if isinstance(data, Data) and constants == "each":
        data, shifts = remove_levels(data)
    bases, before = fitted_bases(data, of.basis), data
    units = Transform.identity(len(inputs), len(outputs))
    if own:
        units = own_units(data, [isinstance(one, Linear) for one in bases])
        data = in_units(data, units)
    one_of("prior", of.prior, ("none", "tc", "dc", "ss"))
    layout = Layout(na=order, nb=nbs, nk=nks, bases=inner_bases(bases, units), outputs=tuple(outputs),
                    inputs=tuple(inputs))
    check_weight(of.ridge, "ridge")
    check_weight(of.curvature, "curvature")
    if shifts is not None and isinstance(data, Data):
        shifts = shifts / np.array(units.y_scale)
        statistics, means = collect_by_experiment(data, layout, weights)
        between = means.energy(shifts)
    else:
        statistics = collect(data, layout, weights=weights)
    unit = units.y_scale[0] ** of.degree
    share = energy_unit(units) / unit
    columns = positions(layout)
    rows = None
    if of.prior != "none":
        from optid.identify.equation_error.priors import likeliest

        rows = likeliest(of.prior, statistics).rows(columns)
    parts = partial(_parts, before, units, layout) if isinstance(before, Data) and weights is None and (
        before.n_experiments > 1) else None
    problem = lifted_problem(statistics, columns, share * of.ridge, share * of.curvature, units.u_scale, prior=rows)
    return EquationError(statistics, problem, columns, model_meta(data), units, bases, unit, means=means, shifts=shifts,
                         between=between, parts=parts)


def _parts(data: Data, units: Transform, layout: Layout) -> list[Statistics]:
    return by_experiment(accumulate, in_units(data, units), layout)
