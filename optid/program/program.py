"""A programme: the identification problem written once, in CVXPY, with everything in it named."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint
from cvxpy.constraints.second_order import SOC
from cvxpy.lin_ops.lin_utils import ID_COUNTER, get_id

from optid.errors import StructureError, nearest
from optid.program.compressed import Compressed
from optid.program.limits import Limit
from optid.program.solution import Bound
from optid.program.structure import GAUGE, Structure
from optid.program.view import Values, View

AFFINE = ("zero", "below")  # cones of constraints of the core whose rows have sizes
STATED = ("objective", "constraints", "variables", "view", "derived", "limits")  # of the statement in CVXPY
FOLLOWS = ("problem", "kind", "usual_sizes")  # what is kept of a programme and follows from its statement


def named(built: Any, default: str) -> dict[str, tuple[Limit, ...]]:
    """Bring what a builder returned, CVXPY constraints or `Limit` objects, into the form {name: (limit, ...)}.

    It returns one of them, a list, or a dictionary of either; the default is the name where it gave none.

    Raises:
        StructureError: when something in it is not a CVXPY constraint.
    """
    if isinstance(built, Mapping):
        groups = {str(name): item for name, item in built.items()}
    elif isinstance(built, list | tuple):
        groups = {default if len(built) == 1 else f"{default}[{i}]": item for i, item in enumerate(built)}
    else:
        groups = {default: built}
    return {name: tuple(_limit(name, one) for one in (item if isinstance(item, list | tuple) else [item]))
            for name, item in groups.items()}


def _limit(name: str, member: Any) -> Limit:
    if not isinstance(member, Constraint | Limit):
        raise StructureError(
            f"constraint {name!r} is a {type(member).__name__}, not a CVXPY constraint such as v['a'][0] <= -1")
    if isinstance(member, SOC):  # in rows, with one multiplier each
        member = cp.norm(member.args[1], 2, axis=None if member.args[1].ndim < 2 else member.axis) <= member.args[0]
    return member if isinstance(member, Limit) else Limit.of(member)


@dataclass(frozen=True)
class Program:
    """One optimisation problem with named parts, independent of who solves it.

    Attributes:
        name: name of the formulation.
        objective: CVXPY objective, in units of the data (residuals as variables, see ``constraints``).
        constraints: {name: constraints}; the names in ``structural`` belong to the formulation, the others to the user.
        variables: {name: CVXPY variable}.
        start: {name: array}: a point to start from; never zero for a bilinear programme, where zero is a saddle.
        recover: values -> model.
        view: the expressions that constraints may use.
        structural: names of constraints that belong to the formulation.
        parameters: {name: CVXPY parameter} that may change between solves without recompiling.
        derived: {name: expression}: variables that the others determine exactly, such as residuals passed as
            variables; they are recomputed at every point before it is judged.
        structure: what special methods, judging and proofs may use of it, or None.
        certify: (program, values, duals) -> (Bound, better start or None), or None where no certificate exists.
        scale: objective of the zero model, the yardstick of gaps.
        note: why there can be no proof, where that is known beforehand.
        compressed: the compressed data the programme was built from, for prices, intervals and figures.
        unit: what one unit of the objective is in units of the record; solutions report their values in the latter.
        settled: whether the start is close to an optimum, from which a solver should not wander.
        step: whether a procedure goes on from its answer and has evidence of its own: no bound is asked for.
        courses: variables besides the derived ones that the structural constraints determine from the others.
        limits: {name of a user constraint: what its members say, before their rows were divided by their size}.
        core: the problem of the core that it states, None where there is none.
    """

    name: str
    objective: cp.Minimize
    constraints: Mapping[str, tuple[Constraint, ...]]
    variables: Mapping[str, cp.Variable]
    start: Values
    recover: Callable[[Values], Any]
    view: View
    structural: frozenset[str] = frozenset()
    parameters: Mapping[str, cp.Parameter] = field(default_factory=dict)
    derived: Mapping[str, cp.Expression] = field(default_factory=dict)
    structure: Structure | None = None
    certify: Callable[["Program", Values, Values], tuple[Bound, Values | None]] | None = None
    scale: float = 1.0
    note: str = ""
    compressed: Compressed | None = field(default=None, repr=False)
    unit: float = 1.0
    limits: Mapping[str, tuple[Limit, ...]] = field(default_factory=dict, repr=False)
    courses: frozenset[str] = frozenset()
    settled: bool = False
    step: bool = False
    core: Any = field(default=None, repr=False)

    @classmethod
    def deferred(cls, name: str, statement: Callable[[], Mapping[str, Any]], *, start: Values,
                 structure: Structure, **known: Any) -> "Program":
        """Return a programme that is stated in CVXPY only when the statement is first used.

        Back ends and judgement for its structure do not use it; constraints of the user do at once, unless a problem
        of the core reads them.

        Args:
            name: of the formulation.
            statement: returns objective, constraints, variables, view and derived.
            start: values of all variables that are not derived.
            structure: which measures a point by itself (`Structure.complete`).
            known: the other attributes.
        """
        made = cls(name, *[None] * 3, start=start, structure=structure, view=None, **known)  # type: ignore[arg-type]
        for part in STATED:
            del vars(made)[part]
        vars(made)["_statement"], vars(made)["_held"] = statement, {}
        return made

    def __getattr__(self, name: str) -> Any:
        if name not in STATED or "_statement" not in vars(self):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        stated = vars(self)["_statement"]()
        del vars(self)["_statement"]
        vars(self).update({"limits": {}, **stated})
        if held := vars(self).pop("_held"):
            with suppress(ValueError):  # CVXPY takes no derived value that overflowed; the judgement has said so
                self.assign(held)
        return vars(self)[name]

    def __getstate__(self) -> dict[str, Any]:
        stated = object.__new__(type(self))  # what this one need not be
        vars(stated).update(vars(self))
        _ = stated.objective  # which also assigns the values that are held for it
        return {**{name: value for name, value in vars(stated).items() if name != "problem"},  # solvers keep more there
                "_last_id": get_id()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ID_COUNTER.count = max(ID_COUNTER.count, state.pop("_last_id"))  # CVXPY's next objects must have other ids
        vars(self).update(state)

    @property
    def is_stated(self) -> bool:
        """Whether the programme is stated in CVXPY; one that is `deferred` is not until its statement is needed."""
        return "_statement" not in vars(self)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the variables that are not derived."""
        if not self.is_stated:
            return {name: np.shape(value) for name, value in self.start.items()}
        return {name: variable.shape for name, variable in self.variables.items() if name not in self.derived}

    @property
    def implied(self) -> frozenset[str]:
        """Variables that the others determine."""
        return self.courses | self.derived.keys()

    @cached_property
    def problem(self) -> cp.Problem:
        """The CVXPY problem; compiled once and re-used when parameters change."""
        return cp.Problem(self.objective, [c for group in self.constraints.values() for c in group])

    @cached_property
    def kind(self) -> str:
        """The class of the programme: "LP", "QP", "SOCP", "SDP", "conic" or "NLP".

        Raises:
            StructureError: naming the part that is neither convex nor smooth.
        """
        cones = set() if self.core is None else {one.cone for one in self.core.constraints()}
        if self.structure is not None and self.structure.kind and not self.is_stated:
            if cones <= set(AFFINE):
                return self.structure.kind
            if self.structure.kind == "QP" and cones <= {*AFFINE, "psd"}:
                return "SDP"
        if self.problem.is_dcp():
            return _convex_class(self.problem)
        for name, part in self._parts():
            if not getattr(part, "is_dnlp", bool)():  # cones have no such method
                raise StructureError(
                    f"{name} of {self.name!r} is neither convex nor a smooth expression that an NLP solver accepts: "
                    f"{part}")
        return "NLP"

    @property
    def user_constraints(self) -> dict[str, tuple[Constraint, ...]]:
        """The constraints that are not part of the formulation itself; names alone until they are stated."""
        if not self.is_stated:
            return {} if self.core is None else dict.fromkeys(self.core.constraint_names, ())
        return {name: group for name, group in self.constraints.items() if name not in self.structural}

    @property
    def is_restricted(self) -> bool:
        """Whether anything but gauges restricts the unknowns, which methods for its structure alone do not know."""
        of_problem = () if self.core is None else self.core.constraints()
        return bool(self.user_constraints) or any(one.name != GAUGE for one in of_problem)

    def nonconvex_parts(self) -> list[str]:
        """Names of the parts that break convexity."""
        return [name for name, part in self._parts() if not part.is_dcp()]

    def _parts(self) -> Iterable[tuple[str, Any]]:
        yield "the objective", self.objective
        for name, group in self.constraints.items():
            for member in group:
                yield f"constraint {name!r}", member

    def subject_to(self, *builders: Any, convex: bool | None = None, core: Any = None) -> "Program":
        """Return the programme with further constraints.

        Args:
            builders: callables of the `View` (such as those of ``formulations.constraints`` or a lambda that returns a
                dictionary of CVXPY constraints), or such dictionaries.
            convex: True refuses constraints that are not convex; default: True when the programme is convex.
            core: the problem of the core that has read them; by default that of this programme reads them.

        Raises:
            StructureError: unknown variable, name used twice, or a nonconvex constraint in a convex formulation.
        """
        if not builders:
            return self
        if not self.is_stated and self.core is not None:
            return self.under(self.core.subject_to(*builders))
        convex_only = self.problem.is_dcp() if convex is None else convex
        known = set(self.variables.values())
        constraints, variables, limits = dict(self.constraints), dict(self.variables), dict(self.limits)
        usual, sizes = self.usual_sizes, {}
        if core is None and self.core is not None:
            core = self.core.subject_to(*builders)
        if core is not None:
            sizes = {(one.name, one.position): one.sizes for one in core.constraints()}
        for position, builder in enumerate(builders):
            default = getattr(builder, "name", None) or f"constraint {position + 1}"
            built = builder(self.view) if callable(builder) else builder
            for name, group in named(built, default).items():
                group = tuple(limit for limit in group if limit.member.size)  # a straight line has no curvature
                if not group:
                    continue
                if name in constraints:
                    raise StructureError(f"there are two constraints named {name!r}; give each its own name")
                for member in (limit.member for limit in group):
                    foreign = set(member.variables()) - known
                    own = {v for v in foreign if self.view.owns(v)}
                    for variable in sorted(own, key=lambda v: v.id):
                        numbered = (f"{variable.name()} {k}" for k in range(2, len(variables) + 3))
                        free = (one for one in (variable.name(), *numbered) if one not in variables)
                        variables[next(free)] = variable
                    known |= own
                    if foreign := foreign - own:
                        raise StructureError(
                            f"constraint {name!r} uses {', '.join(sorted(v.name() for v in foreign))}, "
                            f"which is not a variable of {self.name!r} ({', '.join(self.variables)})"
                        )
                    if convex_only and not member.is_dcp():
                        raise StructureError(
                            f"constraint {name!r} is not convex, and {self.name!r} is a convex formulation: {member}. "
                            "State it in the named variables of the relaxation or use an exact formulation."
                        )
                if self.view.units is not None or core is not None:
                    constraints[name], limits[name] = zip(*(limit.posed(usual, sizes.get((name, k)))
                                                            for k, limit in enumerate(group)))
                else:
                    constraints[name], limits[name] = tuple(limit.member for limit in group), group
        return replace(self, constraints=constraints, variables=variables, limits=limits, core=core)

    def stating(self, core: Any, convex: bool | None) -> "Program":
        """Return the programme with the restrictions of a problem of the core, and the constraints of its user."""
        return self.subject_to(*core.restrictions, convex=False, core=core).subject_to(
            *core.builders, convex=convex, core=core)

    def under(self, core: Any) -> "Program":
        """Return a deferred programme under the constraints that a problem of the core has read.

        What is wrong with them is said now, as a `StructureError`.
        """
        if taken := self.structural & set(core.constraint_names):
            raise StructureError(f"there are two constraints named {min(taken)!r}; give each its own name")

        def statement() -> dict[str, Any]:
            _ = self.objective
            whole = self.stating(core, None)
            return {part: getattr(whole, part) for part in STATED}

        return self._copied(core=core, _statement=statement, _held={})

    def _copied(self, **known: Any) -> "Program":
        """Return a copy with some attributes changed, that is stated only if this one is."""
        made = object.__new__(type(self))
        vars(made).update({name: value for name, value in vars(self).items() if name not in FOLLOWS} | known)
        return made

    def beginning(self, start: Values, recover: Callable[[Values], Any]) -> "Program":
        """Return the programme with another start and another model of its values, stated no earlier than this one."""
        return self._copied(start=start, recover=recover)

    @cached_property
    def usual_sizes(self) -> dict[int, float]:
        """The largest entry of every variable at the start, by id; variables that vanish there are left out."""
        sizes = {self.variables[name].id: float(np.max(np.abs(value), initial=0.0))
                 for name, value in self.start.items() if name in self.variables}
        return {key: size for key, size in sizes.items() if size > 0}

    def freeze(self, **values: Any) -> "Program":
        """Return the programme with some variables held at values, as parameters that may be changed later.

        Freezing ``b`` (or ``mu``) of a bilinear programme leaves a convex one. Structural constraints in which
        nothing is left to choose are dropped. Names with brackets are passed as ``**{"mu[u1]": value}``.

        Raises:
            StructureError: unknown name or wrong shape.
        """
        swap: dict[int, Any] = {}
        parameters = dict(self.parameters)
        for name, value in values.items():
            if name not in self.variables:
                raise StructureError(f"cannot freeze {name!r}. {nearest(name, self.variables)}")
            variable = self.variables[name]
            array = np.asarray(value, dtype=float)
            if array.shape != variable.shape:
                raise StructureError(f"{name!r} has shape {variable.shape}, the value given has {array.shape}")
            parameters[name] = swap[id(variable)] = cp.Parameter(variable.shape, name=name, value=array)
        constraints = {}
        for name, group in self.constraints.items():
            kept = tuple(c.tree_copy(swap) for c in group)
            if name in self.structural and not any(c.variables() for c in kept):
                continue
            constraints[name] = kept
        view = replace(self.view, inner={name: inner.tree_copy(swap) for name, inner in self.view.inner.items()})
        limits = {name: tuple(limit.substituted(swap) for limit in group) for name, group in self.limits.items()}
        left = {name: v for name, v in self.variables.items() if name not in values}

        def recover(found: Values) -> Any:
            return self.recover({**found, **{name: np.asarray(parameters[name].value) for name in values}})

        return replace(self, objective=self.objective.tree_copy(swap), constraints=constraints, variables=left,
                       parameters=parameters, view=view, recover=recover, limits=limits,
                       structure=None, certify=None, core=None,
                       derived={name: e.tree_copy(swap) for name, e in self.derived.items()},
                       start={name: v for name, v in self.start.items() if name in left})

    def without(self, *names: str) -> "Program":
        """Return the programme without the named constraints."""
        return replace(self, constraints={k: g for k, g in self.constraints.items() if k not in names}, core=None)

    def assign(self, values: Values) -> None:
        """Write values into the CVXPY variables and recompute the derived ones."""
        if not self.is_stated:
            vars(self)["_held"].update({name: np.asarray(values[name], dtype=float).reshape(shape, order="F")
                                        for name, shape in self.shapes.items() if name in values})
            return
        for name, value in values.items():
            variable = self.variables[name]
            array = np.asarray(value, dtype=float).reshape(variable.shape, order="F")
            if variable.attributes["sparsity"] or variable.attributes["diag"]:
                variable.value = array
            else:  # a point just outside the variable's own bounds is to be judged, not refused
                variable.save_value(array)
        for name, expression in self.derived.items():
            self.variables[name].value = np.asarray(expression.value)

    def values(self) -> dict[str, np.ndarray]:
        """Return a copy of what the CVXPY variables hold, without variables that hold nothing."""
        return {name: np.array(v.value, dtype=float) for name, v in self.variables.items() if v.value is not None}

    def duals(self) -> dict[str, np.ndarray]:
        """Return the multipliers the constraints hold: {name: flat array over the members of the group}.

        Names whose constraints hold no multiplier are absent.
        """
        found = {}
        for name, group in self.constraints.items():
            parts = [d.value for member in group for d in member.dual_variables]
            if parts and all(part is not None for part in parts):
                found[name] = np.concatenate([np.ravel(np.asarray(part, dtype=float), order="F") for part in parts])
        return found

    def clear_duals(self) -> None:
        """Forget the multipliers of an earlier solve, so that they cannot be mistaken for new ones."""
        for group in self.constraints.values() if self.is_stated else ():
            for member in group:
                for dual in member.dual_variables:
                    dual.value = None

    @property
    def size(self) -> int:
        """Number of scalar unknowns."""
        if self.structure is not None and not self.is_stated:
            return sum(np.size(value) for value in self.structure.complete(self, self.start)[0].values())
        return sum(v.size for v in self.variables.values())


_MATRIX_ATOMS = {"normNuc", "lambda_max", "sigma_max", "lambda_sum_largest", "MatrixFrac", "matrix_frac", "tr_inv"}
_EXPONENTIAL_ATOMS = {"exp", "log", "log1p", "log_sum_exp", "logistic", "entr", "kl_div", "rel_entr", "xexp", "log_det",
                      "Power", "GeoMean", "Pnorm"}  # the last three are power cones; their approximations are not


def _convex_class(problem: cp.Problem) -> str:
    if problem.is_lp():
        return "LP"
    if problem.is_qp():
        return "QP"
    atoms = {atom.__name__ for atom in problem.atoms()}  # CVXPY lists the types
    cones = {type(c).__name__ for c in problem.constraints}
    if cones & {"ExpCone", "PowCone3D", "PowConeND"} or atoms & _EXPONENTIAL_ATOMS:
        return "conic"
    if cones & {"PSD"} or atoms & _MATRIX_ATOMS or any(
        v.attributes["PSD"] or v.attributes["NSD"] for v in problem.variables()
    ):
        return "SDP"
    return "SOCP"
