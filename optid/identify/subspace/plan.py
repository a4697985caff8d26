"""The request to a subspace method, on a record in its own units."""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from optid.arrays import Array, check_integer, one_of
from optid.bases import Linear, UserFunctions, feedback_bases, fitted_bases
from optid.data.channels import Transform
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.identify.arguments import check_offset
from optid.identify.subspace.projection import WEIGHTINGS
from optid.program.units import in_units, inner_bases, own_units
from optid.solving.solve import Evidence, Procedure
from optid.statistics.expansion import Expansion, expand

BEST = "best"  # word for the weighting that fits the record best
WORDS = {"observer": ("auto", "none", "kalman"), "split": ("exact", "lumped"), "stability": ("auto", "free"),
         "weighting": (*WEIGHTINGS, BEST)}


@dataclass(frozen=True, eq=False)
class Plan:
    """The request to a method; see `make_plan`. Attributes mean what the arguments of `hammerstein_ss.sid` do."""

    name: str
    data: Data
    nx: int | str
    block_rows: int | None
    basis: Any
    feedback_basis: Any
    instruments: str
    form: str = "projection"
    tolerance: float | None = None
    iterations: int = 0
    weighting: str = "moesp"
    offset: bool = True
    feedthrough: Any = True
    observer: str = "auto"
    split: str = "exact"
    stability: str = "auto"
    constraints: tuple[Any, ...] = ()
    imputes: bool = False  # whether missing outputs may be estimated although ``block_rows`` is given
    # from those of the data above to those of the record; the identity where not given
    units: Transform = Transform((), (), (), ())

    def __post_init__(self) -> None:
        for name, known in WORDS.items():
            one_of(name, getattr(self, name), known)
        if self.tolerance is not None and not 0 <= self.tolerance < 1:
            raise StructureError(f"tolerance={self.tolerance!r}: it must be a number in [0, 1).")
        check_integer(self.iterations, "iterations", 0)
        if self.nx not in ("auto", "gap"):
            check_integer(self.nx, "nx, unless 'auto' or 'gap',")
        if not self.units.y_scale:
            object.__setattr__(self, "units", Transform.identity(self.data.m, self.data.l))

    @cached_property
    def records(self) -> list[Array]:
        """Raw channels [u | y], (N, m + l), one array per experiment."""
        return self.data.records

    @property
    def order(self) -> int | None:
        """The given order; None where it is to be estimated."""
        return None if isinstance(self.nx, str) else int(self.nx)

    def expansion(self) -> Expansion:
        """Return the signals of the record, expanded in its bases."""
        return expand(self.data, self.basis, self.feedback_basis)

    def about(self, what: str) -> tuple[Any, ...]:
        """Constraints about "poles" or about "coefficients"."""
        return tuple(rule for rule in self.constraints if what in getattr(rule, "about", frozenset({"coefficients"})))

    def direct(self) -> tuple[bool, ...]:
        """Feedthrough of every input."""
        m = self.data.m
        given = [self.feedthrough] * m if isinstance(self.feedthrough, bool) else list(self.feedthrough)
        if len(given) != m or not all(isinstance(one, bool | np.bool_) for one in given):
            raise StructureError(f"feedthrough={self.feedthrough!r}: True or False, or one of them per input "
                                 f"({', '.join(self.data.inputs)}).")
        return tuple(bool(one) for one in given)


def make_plan(name: str, data: Data, *, basis: Any, feedback_basis: Any = None, offset: bool = True, **settings: Any
            ) -> Plan:
    """Plan a method on a record in memory, in its own units (`optid.program.units`); the settings are further fields.

    Without an offset nothing is centred.
    """
    if not isinstance(data, Data):
        raise DataError(f"{name} needs records in memory (optid.Data), not a {type(data).__name__}.")
    if check_offset(offset, data) == "each":
        raise StructureError(f"{name} has one constant for all experiments: use 'ss.exact' or 'hammerstein_ss.exact' "
                             "with offset='each'")
    inputs, outputs = fitted_bases(data, basis), feedback_bases(data, feedback_basis)
    units = own_units(data, [isinstance(one, Linear) for one in inputs], bool(offset))
    if any(isinstance(one, UserFunctions) for one in outputs):  # known in the units of the record only
        units = Transform.identity(data.m, data.l)
    inner = [one and one.in_units(1 / scale, -level / scale)[0]
             for one, scale, level in zip(outputs, units.y_scale, units.y_offset)]
    return Plan(name, in_units(data, units), basis=inner_bases(inputs, units), offset=bool(offset), units=units,
                feedback_basis=inner if any(inner) else None, **settings)


def in_record_units(procedure: Procedure, plan: Plan) -> Procedure:
    """Run a procedure and return its model in the units of the record that was planned for."""
    evidence = yield from procedure
    if evidence is None or evidence.model is None:
        return evidence
    extend = evidence.extend and partial(_extended, evidence, plan.units)
    return replace(evidence, model=evidence.model.with_transform(plan.units), extend=extend)


def _extended(evidence: Evidence, units: Transform) -> tuple[Any, dict[str, Any]]:
    model, figures = evidence.run_extension()
    return model.with_transform(units), figures
