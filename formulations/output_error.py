"""The sum of squared simulation errors of a Hammerstein or linear model as a function of its unknowns."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from optid.data.channels import Transform
from optid.data.record import Data
from optid.models import HammersteinARX, roots
from optid.models.gauges import gauge_factor
from optid.models.hammerstein_tf import HammersteinTF
from optid.program.program import Values
from optid.statistics.linearised import Linearised
from optid.statistics.sensitivities import Unknowns, expanded, linearise

Array = np.ndarray

STABLE = 1 - 1e-9
"""Radius inside which every pole of an iterate, or zero of C, lies."""


@dataclass(frozen=True, eq=False)
class OutputError:
    """Simulation errors as a function of the unknowns; a `formulations.prediction_error.Criterion`.

    Attributes:
        data: the record.
        unknowns: their order.
        gauge: how the scale between mu and b is fixed; "none" for a linear model.
        units: from those of the record above (`optid.program.units`) to those of the model.
    """

    data: Data
    unknowns: Unknowns
    gauge: str
    units: Transform = field(default_factory=lambda: Transform.identity(1, 1))

    def __post_init__(self) -> None:
        if len(self.units.u_scale) != self.data.m:
            object.__setattr__(self, "units", Transform.identity(self.data.m, 1))

    @property
    def errors(self) -> str:
        """What they are called."""
        return "simulation errors"

    @cached_property
    def functions(self) -> tuple[Array, ...] | None:
        """Values of the basis functions, where they are few enough to be kept."""
        return expanded(self.data, self.unknowns.layout)

    @cached_property
    def energy(self) -> float:
        """Sum of squares of the output about its mean."""
        y = np.concatenate([e.y[:, 0] for e in self.data.experiments])
        return float(np.nansum((y - np.nanmean(y)) ** 2))

    def linearise(self, x: Array) -> Linearised:
        """Return the errors near x."""
        return linearise(self.data, self.unknowns, self.unknowns.unpack(x), gauge=self.gauge_rows(x),
                         functions=self.functions)

    def admissible(self, x: Array) -> bool:
        """Whether all poles lie inside the unit circle."""
        a = x[self.unknowns.slices["a"]]
        return bool(np.all(np.isfinite(x))) and roots.radius(a) < STABLE

    def normalised(self, x: Array) -> Array:
        """Return the same model in the gauge."""
        x, at = np.array(x), self.unknowns.slices
        for c, free in enumerate(self.unknowns.free):
            if free:
                mu, b = x[at[f"mu{c}"]], x[at[f"b{c}"]]
                factor = 1.0
                if self.gauge == "norm":
                    factor = float(np.linalg.norm(b))
                elif self.gauge != "none":
                    factor = gauge_factor(self.gauge, x[at["a"]], b, self.unknowns.layout.inputs[c])
                if not factor:  # an input without effect: any direction will do
                    x[at[f"mu{c}"]], x[at[f"b{c}"]] = 0.0, 1 / np.sqrt(b.size)
                    continue
                x[at[f"mu{c}"]], x[at[f"b{c}"]] = mu * factor, b / factor
        return x

    def with_noise(self, plant: HammersteinARX, values: Values) -> HammersteinTF:
        """Give a plant the noise model of the programme's values: none."""
        return replace(plant, d=())

    def gauge_rows(self, x: Array) -> Array:
        """Gradients (inputs, p) of the gauge: directions that a step does not take."""
        at, rows = self.unknowns.slices, []
        for c, free in enumerate(self.unknowns.free):
            if free:
                row = np.zeros(self.unknowns.shared)
                if self.gauge == "b0":
                    row[at[f"b{c}"].start] = 1.0
                elif self.gauge == "gain":
                    row[at[f"b{c}"]], row[at["a"]] = 1.0, -1.0
                else:
                    row[at[f"b{c}"]] = x[at[f"b{c}"]]
                rows.append(row)
        return np.array(rows).reshape(-1, self.unknowns.shared)
