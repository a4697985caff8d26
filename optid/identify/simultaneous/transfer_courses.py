"""The courses of output error: the noise-free output, whose past is the state, and the values of every function.

    x(k) + sum_i a_i x(k-i) = sum_c sum_j b_cj w_c(k - nk_c - j) + d,    w_c = eta_c mu_c

A row has at most na + m nb + 2 unknowns in products of no more than two. The first n outputs of an experiment, whose
lags reach before it, are free: they are its initial state. A is built up from reflection coefficients between -1 and 1,
``A_m(q) = A_(m-1)(q) + kappa_m q^-m A_(m-1)(q^-1)`` (Levinson 1947), which keeps the poles inside the unit circle
exactly; without that x could satisfy the equations backwards in time.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp

from optid.arrays import Array
from optid.core.leaves import GAUGE
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.arguments import check_offset
from optid.identify.prediction_error.search import arx_start, iterate_passes
from optid.identify.prediction_error.transfer_errors import TransferErrors, TransferOrders, transfer_errors
from optid.identify.simultaneous.courses import Courses, Expressions, Formula, Reading, check_size

REFLECTION = 1 - 1e-7  # largest modulus of a reflection coefficient
LIMIT = 20_000  # samples up to which the programme is built: beyond, factorisations and CVXPY's own work take minutes


@dataclass(frozen=True, eq=False)
class TransferCourses(Courses):
    """The courses ``x`` (N,) and, of every input, ``w`` (N,)."""

    criterion: TransferErrors
    determined: ClassVar[bool] = False  # the first outputs are free

    @classmethod
    def of(cls, data: Data, orders: tuple[Any, Any, Any], basis: Any, gauge: str, offset: Any) -> "TransferCourses":
        """Check the arguments of a fit; orders are na, nb and nk. Errors as of `transfer_errors`, a long record."""
        if check_offset(offset, data) == "each":
            raise StructureError("this programme has one constant for all experiments; 'hammerstein_oe.exact' takes "
                                 "offset='each'")
        errors = transfer_errors(data, TransferOrders(*orders), basis, gauge, offset)
        check_size(errors.data.n_samples, LIMIT, "'hammerstein_oe.exact', which has the same optima, or fewer samples")
        return cls(errors)

    def readings(self, i: int) -> Iterator[Reading]:
        """Yield the output."""
        y = self.criterion.data.experiments[i].y[:, 0]
        there = np.isfinite(y)
        yield Reading(f"x{self.criterion.labels[i]}", sp.eye_array(y.size).tocsr()[there], y[there])

    def following(self, i: int, v: Expressions) -> dict[str, list[Any]]:
        """Return ``A(q) x = sum_c B_c(q) w_c + offset`` from the first sample on whose lags are all in the record."""
        errors, layout, label = self.criterion, self.criterion.unknowns.layout, self.criterion.labels[i]
        n, count = layout.first_row, errors.data.experiments[i].n_samples
        x, right = v[f"x{label}"], v["offset"][0] if "offset" in v else 0.0
        left = x[n:]
        for lag in range(1, layout.na + 1):
            left = left + v["a"][lag - 1] * x[n - lag : count - lag]
        for c, lags in enumerate(layout.lags):
            w = v[f"{errors.key('w', c)}{label}"]
            for j, lag in enumerate(lags):
                right = right + v[errors.key("b", c)][j] * w[n - lag : count - lag]
        return {f"dynamics{label}": [left == right]}

    def formulas(self, i: int) -> dict[str, Formula]:
        """Return ``w = eta mu`` of every input."""
        errors = self.criterion
        return {f"{errors.key('w', c)}{errors.labels[i]}": partial(
            lambda eta, mu, v: eta @ v[mu], basis.values(errors.data.experiments[i].u[:, c]), errors.key("mu", c))
            for c, basis in enumerate(errors.unknowns.layout.bases)}

    def confining(self, v: Expressions) -> dict[str, Any]:
        """Return the gauge, and the constraints that build A up from reflection coefficients."""
        errors = self.criterion
        found = {GAUGE: [one.condition(v) for one in errors.factors(errors.gauge)]}
        if "kappa" not in v:
            return found
        kappa, below = v["kappa"], None
        stable: list[Any] = [kappa <= REFLECTION, kappa >= -REFLECTION]
        for m in range(1, kappa.size + 1):
            level = v["a" if m == kappa.size else f"a of order {m}"]
            stable.append(level[m - 1] == kappa[m - 1])
            if below is not None:
                stable += [level[i] == below[i] + kappa[m - 1] * below[m - 2 - i] for i in range(m - 1)]
            below = level
        return {"stability": stable, **found}

    def start(self) -> dict[str, Array]:
        """Return the best of equation error, Steiglitz-McBride and instruments, and its run: all equations hold."""
        errors, na = self.criterion, self.criterion.unknowns.layout.na
        found = arx_start(errors)
        others = [iterate_passes(errors, found.x, method) for method in ("Steiglitz-McBride", "instruments")]
        best = min([found, *(one for one in others if one is not None)], key=lambda one: one.value)
        x = errors.normalise(best.x)
        start = errors.variables.values(x)
        start.pop("x0", None)  # the first outputs are the initial state
        for c in range(errors.data.m):
            mu, b = errors.key("mu", c), errors.key("b", c)
            sign = errors.gain_sign(x, f"b{c}") if errors.gauge == "norm" else 1.0
            start |= {mu: sign * start[mu], b: sign * start[b]}
        start |= zip([f"x{label}" for label in errors.labels], errors.simulate(errors.unknowns.unpack(x)))
        level, kappa = start.get("a", np.zeros(0)), np.zeros(na)
        for m in range(na, 0, -1):  # the recursion backwards
            if m < na:
                start[f"a of order {m}"] = level
            kappa[m - 1] = level[-1]
            level = (level[:-1] - level[-1] * level[-2::-1]) / (1 - level[-1] ** 2)
        return self.complete({**start, "kappa": kappa} if na else start)
