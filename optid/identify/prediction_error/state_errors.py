"""The error of a state-space model as a function of its unknowns: simulation (K = 0) or innovation form.

Unknowns live in the full matrices; the directions along which a change of states moves them, and the scale between mu
and b, are projected out at every iterate (data-driven local coordinates, McKelvey, Helmersson and Ribarits 2004).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from optid.arrays import Array
from optid.bases import Linear
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.prediction_error.descent import Criterion
from optid.identify.subspace.realisation import state_model
from optid.models import HammersteinSS, Nonlinearity
from optid.models.roots import spectral_radius
from optid.models.state_simulation import allowed_range, prepared, visited
from optid.statistics.linearised import Linearised, Method
from optid.statistics.state_sensitivities import StatePredictor
from optid.statistics.state_unknowns import SIMULATORS, StatePoint, StateUnknowns

STABLE = 1 - 1e-9
WILD = 10.0  # times the range of the record that the run of an iterate must not leave
FLOOR = 1e-7  # smallest standard deviation of an error that weights may rest on, as a share of that of its output


@dataclass(frozen=True, eq=False)
class StateErrors(Criterion):
    """The weighted sum of squared errors of all outputs."""

    data: Data  # the record
    unknowns: StateUnknowns  # their order, and whose errors are meant
    weight: Array  # (l, l) weight of the errors
    limit: float = STABLE  # modulus below which the poles that carry the state must stay
    # constraints on poles that every iterate obeys: model -> what is wrong, "" where nothing is
    checks: tuple[Callable[[Any], str], ...] = ()
    gauge: ClassVar[str] = "norm"

    def key(self, name: str, number: int) -> str:
        """Name a quantity of an input, or of a family of feedback functions."""
        x = self.unknowns.expansion
        if name in ("c", "g", "z"):
            word = {"c": "mu latent", "g": "b latent", "z": "z"}[name]
            return word if len(self.unknowns.latent) == 1 else f"{word}[{number + 1}]"
        if name in ("nu", "e"):
            word = {"nu": "mu feedback", "e": "b feedback"}[name]
            return word if x.l == 1 else f"{word}[{x.output_names[x.feedback[number].output]}]"
        return name if x.m == 1 else f"{name}[{x.input_names[number]}]"

    @property
    def bends(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether outputs or latent signals of a run act on its states."""
        return self.limits is not None

    @cached_property
    def limits(self) -> tuple[Any, ...] | None:
        """Ranges that runs must not leave, where outputs act on states, or latent signals do."""
        unknowns = self.unknowns
        if unknowns.innovations or not (unknowns.expansion.feedback or unknowns.latent):
            return None
        return tuple(allowed_range([e.y], WILD) for e in self.data.experiments)

    @cached_property
    def _predictor(self) -> StatePredictor:
        return StatePredictor(self.data, self.unknowns, self.at, self.weight, self.limits)

    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x."""
        return self._predictor.compress(x, self.gauge_rows(x), method)

    def blocks(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return what yields the weighted rows [sensitivities | errors] of an experiment."""
        return self._predictor.blocks(x)

    def admissible(self, x: Array) -> bool:
        """Whether the matrix that carries the state is stable enough, and the constraints on poles hold."""
        if not np.all(np.isfinite(x)):
            return False
        point = self.unknowns.unpack(x)
        if spectral_radius(point.A - point.K @ point.C) >= self.limit:
            return False
        return not self.checks or not any(check(self.at(point)) for check in self.checks)

    def gauge_rows(self, x: Array) -> Array:
        """Orthonormal directions (rows, shared) of theta that a step does not take, since they change no output."""
        at, rows = self.unknowns.slices, list(self.unknowns.similarity(x))
        for mu, b in self.unknowns.products:
            row = np.zeros(self.unknowns.shared)
            row[at[mu]], row[at[b]] = x[at[mu]], -x[at[b]]
            rows.append(row)
        if not rows:
            return np.zeros((0, self.unknowns.shared))
        values, vectors = np.linalg.svd(np.array(rows), full_matrices=False)[1:]
        return vectors[values > 1e-12 * values[0]]

    def value(self, x: Array) -> float:
        """Return the weighted sum of squared errors."""
        return self._predictor.squares(x)

    def residuals(self, x: Array) -> list[Array]:
        """Return the errors (N, l) of every experiment."""
        return self._predictor.residuals(x)

    def visited(self, point: StatePoint) -> list[Array]:
        """Return the states (N, n) of the run of every experiment."""
        model, word = self.at(point), SIMULATORS[self.unknowns.criterion]
        return [visited(prepared(model, word, e.u, e.y, None, ""), x0)
                for e, x0 in zip(self.data.experiments, point.x0)]

    def reweighted(self, x: Array, full: bool) -> "StateErrors":
        """Return the criterion weighted by the inverse (co)variance of the errors at x.

        A fixed point of this iteration is stationary for the determinant of the covariance (``full``), or the product
        of the variances, of the errors.
        """
        errors = np.vstack(self.residuals(x))
        floor = FLOOR * np.nanstd(np.vstack([e.y for e in self.data.experiments]), axis=0)
        complete = errors[~np.isnan(errors).any(axis=1)]
        variances = np.maximum(np.nanmean(errors**2, axis=0), floor**2)
        covariance = np.diag(variances)
        if full and len(complete) > 10 * errors.shape[1]:
            covariance = complete.T @ complete / len(complete) + np.diag(floor**2)
        return replace(self, weight=np.linalg.inv(covariance))

    def level(self, x: Array, full: bool = False) -> float:
        """Return the logarithm of the size of the errors, by which points of different weights are compared.

        It is that of the product of the variances, or, ``full``, of the determinant of the covariance, which
        `reweighted` lowers.
        """
        return -float(np.linalg.slogdet(self.reweighted(x, full).weight)[1])

    def at(self, point: StatePoint) -> HammersteinSS:
        """Build the model of a point."""
        matrices = point.A, point.b, point.C, point.d
        plain = state_model(self.unknowns.expansion, self.data, matrices, point.mus, point.nus, point.e, K=point.K,
                            offset=point.offset)
        if not self.unknowns.latent:
            return plain
        functions = [Nonlinearity(one.basis, one.vectors @ c) for one, c in zip(self.unknowns.latent, point.cs)]
        return replace(plain, latent=tuple(functions), Ez=point.Ez, Fz=point.Fz, Cz=point.Cz, Dz=point.Dz,
                       offset_z=point.offset_z)

    def point_of(self, model: HammersteinSS) -> StatePoint:
        """Return the point of a model of the same structure, its initial states zero.

        Raises:
            StructureError: another number of states, or functions other than the criterion's.
        """
        unknowns, x = self.unknowns, self.unknowns.expansion
        if model.nx != unknowns.n or model.m != x.m or model.l != x.l or len(model.nonlinearities) != x.m:
            raise StructureError(f"a start has {model.nx} states, {model.m} inputs and {model.l} outputs; "
                                 f"{unknowns.n}, {x.m} and {x.l} are needed")
        pairs = [(f.basis, basis) for f, basis in zip(model.nonlinearities, x.inputs)]
        pairs += [(g.basis, family.basis) for g, family in zip(model.feedback, x.feedback)]
        same = [one.to_dict() == other.to_dict() or isinstance(one, Linear) and isinstance(other, Linear)
                for one, other in pairs]
        if not all(same) or len(model.feedback) > len(x.feedback):
            raise StructureError("a start has other basis functions than the fit: give it the same bases")
        mus = [np.ones(1) if not free else f.mu for f, free in zip(model.nonlinearities, unknowns.free)]
        scale = [1.0 if free else float(f.mu[0]) for f, free in zip(model.nonlinearities, unknowns.free)]
        nus: list[Any] = [np.ones(family.size) for family in x.feedback]
        columns = np.zeros((unknowns.n, len(x.feedback)))
        constant, injection = np.array(model.offset_x), np.array(model.L)
        for f, (g, family) in enumerate(zip(model.feedback, x.feedback)):
            nu = np.linalg.lstsq(family.vectors, g.mu)[0]
            constant += model.E[:, f] * (nu @ family.intercept)
            injection += np.outer(model.E[:, f], nu @ family.slope)
            nus[f], columns[:, f] = (nu, model.E[:, f]) if family.size > 1 else (np.ones(1), model.E[:, f] * nu[0])
        # what is left of L goes into A; the constant of the state into that of the output
        A, b = model.A + injection @ model.C, (model.B + injection @ model.D) * scale
        constant = constant + injection @ model.offset_y
        shift = np.linalg.lstsq(np.eye(unknowns.n) - A, constant)[0]
        gain = model.K + injection if unknowns.innovations else np.zeros_like(model.K)
        d = model.D * scale * np.array(unknowns.feedthrough)
        offset = model.offset_y + model.C @ shift if unknowns.constant else np.zeros(unknowns.l)
        x0 = np.zeros((unknowns.experiments, unknowns.n))
        cs = tuple(np.linalg.lstsq(one.vectors, h.mu)[0] for one, h in zip(unknowns.latent, model.latent))
        return StatePoint(A, np.array(model.C), gain, offset, tuple(mus), b, d, tuple(nus), columns, x0, cs,
                          model.Ez + injection @ model.Fz, model.Fz, model.Cz, model.Dz, model.offset_z)
