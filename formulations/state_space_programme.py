"""Programmes in the tangent of an iterate of a state-space fit, and what their values mean.

The names of the variables are told in `formulations.state_space_exact`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.equation_error import flat, tangent_product
from formulations.prediction_error import Posed
from formulations.state_error import StateError
from optid.data.channels import Transform
from optid.models import HammersteinSS
from optid.program.judging import measure_violation
from optid.program.program import Program, Values
from optid.program.units import outer_bases
from optid.program.view import View
from optid.statistics.linearised import Linearised

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Posing:
    """Writes programmes in the tangent of an iterate, and reads their values."""

    name: str
    criterion: StateError
    constraints: tuple[Any, ...]
    units: Transform | None = None

    def posed(self) -> Posed:
        """Return what the constrained iteration needs."""
        return Posed(self.criterion, self.pose, self.pack, self.model)

    @cached_property
    def places(self) -> dict[str, str]:
        """{variable: part of the vector}, in the order of the vector."""
        unknowns, found = self.criterion.unknowns, {}
        x = unknowns.expansion
        for part in unknowns.slices:
            kind, number = part.rstrip("0123456789"), part[len(part.rstrip("0123456789")) :]
            if kind in ("mu", "b"):
                found[kind if x.m == 1 else f"{kind}[{x.input_names[int(number)]}]"] = part
            elif kind in ("nu", "e"):
                word = {"nu": "mu feedback", "e": "b feedback"}[kind]
                output = x.output_names[x.feedback[int(number)].output]
                found[word if x.l == 1 else f"{word}[{output}]"] = part
            else:
                found[kind] = part
        return {**found, "x0": "x0"}

    def values(self, x: Array) -> dict[str, Array]:
        """Name the parts of a vector."""
        unknowns = self.criterion.unknowns
        found = {}
        for name, part in self.places.items():
            if part == "x0":
                states = x[unknowns.shared :].reshape(unknowns.experiments, unknowns.n).T
                found[name] = states if unknowns.experiments > 1 else states[:, 0]
            else:
                found[name] = x[unknowns.slices[part]].reshape(unknowns.shapes[part])
        return found

    def pack(self, values: Mapping[str, Array]) -> Array:
        """Return the vector of named values."""
        parts = [np.ravel(np.asarray(values[name]).T if part == "x0" else values[name])
                 for name, part in self.places.items()]
        return np.concatenate(parts).astype(float)

    def pose(self, x: Array, at: Linearised, damping: float) -> Program:
        """Write the programme of one step from x; the gauge is part of the least squares, see `StateError`."""
        values, unknowns = self.values(x), self.criterion.unknowns
        variables = {name: cp.Variable(value.shape, name=name) for name, value in values.items()}
        parts = [flat(v) if name == "x0" or v.ndim == 1 else cp.vec(v, order="C") for name, v in variables.items()]
        stacked = cp.hstack(parts)
        matrix, errors = at.whole
        residual = matrix @ (stacked - x) + errors
        r = cp.Variable(x.size, name="residual")
        objective = cp.sum_squares(r) + at.remainder
        if damping:
            weights = np.sqrt(damping) * np.linalg.norm(matrix, axis=0)
            objective = objective + cp.sum_squares(cp.multiply(weights, stacked - x))
        names, bases = unknowns.expansion.input_names, unknowns.expansion.inputs
        bases = bases if self.units is None else outer_bases(bases, self.units)
        view = View({**variables, **self._theta(variables, values), **self._static(variables, values)}, iterate=True,
                    channels=names, outputs=unknowns.expansion.output_names,
                    bases=dict(zip(names, bases)), gauge="norm", reference=values, units=self.units)
        program = Program(name=self.name, objective=cp.Minimize(objective), constraints={"residual": (r == residual,)},
                          variables={**variables, "residual": r}, start={**values, "residual": errors},
                          recover=self.recover, view=view, structural=frozenset({"residual"}),
                          derived={"residual": residual}, scale=self.criterion.energy)
        return program.subject_to(*self.constraints)

    def _theta(self, variables: Mapping[str, cp.Variable], values: Mapping[str, Array]) -> dict[str, cp.Expression]:
        """Every mu bᵀ to first order, (P, n + l)."""
        names, found = self.criterion.unknowns.expansion.input_names, {}
        for name in names:
            tail = f"[{name}]" if len(names) > 1 else ""
            mu, b = f"mu{tail}", f"b{tail}"
            if mu in variables:
                found[f"Theta{tail}"] = tangent_product(variables[mu], variables[b], values[mu], values[b])
            else:
                found[f"Theta{tail}"] = cp.reshape(variables[b], (1, variables[b].size), order="F")
        return found

    def _static(self, variables: Mapping[str, cp.Variable], values: Mapping[str, Array]) -> dict[str, cp.Expression]:
        """Coefficients (P, l) of the static curves ``mu (C (I - A)^-1 B + D)ᵀ`` to first order; none with feedback."""
        expansion, found = self.criterion.unknowns.expansion, {}
        n = self.criterion.unknowns.n
        left = np.eye(n) - values["A"]
        if expansion.feedback or np.linalg.cond(left) > 1e12:
            return found
        to_state = np.linalg.inv(left)
        seen = values["C"] @ to_state
        for name in expansion.input_names:
            tail = f"[{name}]" if len(expansion.input_names) > 1 else ""
            mu, b = f"mu{tail}", f"b{tail}"
            rest = to_state @ values[b][:n]
            gain = seen @ variables[b][:n] + (variables["C"] - values["C"]) @ rest + (
                seen @ (variables["A"] - values["A"]) @ rest)
            at = seen @ values[b][:n]
            if values[b].size > n:
                gain, at = gain + variables[b][n:], at + values[b][n:]
            if mu in variables:
                found[f"static{tail}"] = tangent_product(variables[mu], gain, values[mu], at)
            else:
                found[f"static{tail}"] = cp.reshape(gain, (1, at.size), order="F")
        return found

    def signed(self, x: Array) -> Array:
        """Turn the sign of every (mu, b) to where the constraints are violated least."""
        x = self.criterion.normalised(x)
        at = self.criterion.unknowns.slices
        for part in [part for part in at if part.startswith("mu")]:
            if not self.constraints:
                break
            turned = np.array(x)
            turned[at[part]] *= -1.0
            turned[at["b" + part[2:]]] *= -1.0
            here = self.criterion.linearise(x)
            sizes = []
            for one in (x, turned):
                program = self.pose(one, here, 0.0)
                program.assign(program.start)
                sizes.append(measure_violation(program)[0])
            x = turned if sizes[1] < sizes[0] else x
        return x

    def model(self, x: Array) -> HammersteinSS:
        """Build the model of a vector."""
        found = self.criterion.at(self.criterion.unknowns.unpack(x))
        return found.regauge("norm") if any(self.criterion.unknowns.free) and not self.constraints else found

    def recover(self, values: Values) -> HammersteinSS:
        """Build the model of the programme's values."""
        return self.model(self.pack(values))
