"""The named expressions of a programme that constraints may use, in the units of the record."""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np

from optid.data.channels import Transform
from optid.errors import StructureError, nearest
from optid.program.units import outward

Values = Mapping[str, np.ndarray]  # values of variables by name


@dataclass(eq=False, repr=False)
class View(Mapping[str, cp.Expression]):
    """The named expressions that a constraint may use, and the structure it may need.

    A factored model has ``mu`` and ``b`` of an input, a relaxed one the product ``Theta``, a linear one ``b`` alone;
    the step that chooses the poles of a state-space model has ``P`` and ``Q`` = A P, the step that chooses B and D
    ``Theta`` = functions x [B; D] with A and C held.

    Attributes:
        inner: the expressions in the units of the programme.
        channels: names of the inputs; with one input the plain names ``b``, ``mu``, ``Theta`` stand for it,
            with several they carry the input, as in ``mu[valve]``.
        bases: the fitted basis of every channel, and of the latent signals "z1", "z2", ...
        spans: coordinates (P, r) of the functions of latent signals, orthonormal; those without z itself leave what is
            linear in z to the matrices.
        gauge: how the scale between ``mu`` and ``b`` is fixed ("norm", "gain", "b0"), "" where nothing needs fixing.
        reference: values of the unconstrained least-squares estimate, for constraints that need a centre; matrices
            ``A`` and ``C`` of a state-space model, held where they are no variables.
        outputs: names of the outputs, where constraints may have to choose one.
        units: from the units of the programme to those of the record, in which the expressions are; None where they
            are the same.
        heights: words of named quantities that are proportional to the unit of the outputs.
        courses: words of those that are courses of the outputs, with their levels.
        delays: of the inputs in samples, of a polynomial model.
        iterate: whether the reference is the point where a descent stands, which constraints must not cut off.
    """

    inner: Mapping[str, cp.Expression]
    _: KW_ONLY
    channels: tuple[str, ...] = ()
    bases: Mapping[str, Any] = field(default_factory=dict)
    spans: Mapping[str, np.ndarray] = field(default_factory=dict)
    gauge: str = ""
    reference: Values = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    units: Transform | None = None
    heights: frozenset[str] = frozenset()
    courses: frozenset[str] = frozenset()
    iterate: bool = False
    delays: Mapping[str, int] = field(default_factory=dict)
    _auxiliaries: set[int] = field(default_factory=set, init=False)
    _asked: set[str] = field(default_factory=set, init=False)

    @cached_property
    def _expressions(self) -> Mapping[str, cp.Expression]:
        if self.units is None:
            return self.inner
        return outward(self)

    def __getitem__(self, name: str) -> cp.Expression:
        self._asked.add(name)
        try:
            return self._expressions[name]
        except KeyError:
            raise StructureError(
                f"a constraint asks for {name!r}, which this formulation does not have. {nearest(name, self)}"
            ) from None

    def __contains__(self, name: object) -> bool:
        return name in self.inner

    def __iter__(self):
        return iter(self.inner)

    def __len__(self) -> int:
        return len(self.inner)

    def auxiliary(self, name: str, shape: tuple[int, ...] = (), **attributes: Any) -> Any:
        """Return a new variable that a constraint needs for itself, such as the matrix of a Lyapunov inequality.

        It becomes an unknown of every problem in which the constraint stands, where its name is its own; the attributes
        are CVXPY's.
        """
        if name in self.inner:
            return self.inner[name]
        variable = cp.Variable(shape, name=name, **attributes)
        self._auxiliaries.add(variable.id)
        return variable

    def part(self, inner: Mapping[str, cp.Expression], **facts: Any) -> "View":
        """Return a view of other expressions, whose auxiliary variables are those of this one."""
        made = View(inner, **facts)
        made._auxiliaries = self._auxiliaries
        return made

    def was_asked(self, names: frozenset[str]) -> bool:
        """Whether one of these expressions was looked at since the last such question."""
        found = not names.isdisjoint(self._asked)
        self._asked.clear()
        return found

    def owns(self, variable: cp.Variable) -> bool:
        """Whether a variable came from `auxiliary`."""
        return variable.id in self._auxiliaries

    def key(self, name: str, channel: str | None = None) -> str:
        """Return the key of a per-channel quantity: ``mu`` with one input, ``mu[channel]``, ``mu latent[z1]``."""
        if channel in self.bases and channel not in self.channels:
            return f"{name} latent[{channel}]"
        if len(self.channels) <= 1:
            return name
        if channel is None:
            raise StructureError(f"{name!r} needs a channel: there are several inputs ({', '.join(self.channels)})")
        return f"{name}[{channel}]"

    @property
    def poles(self) -> tuple[cp.Expression, cp.Expression] | cp.Expression | None:
        """What determines the poles: (P, Q = A P), or the coefficients a of a polynomial; None without poles."""
        if "P" in self and "Q" in self:
            return self["P"], self["Q"]
        return self["a"] if "a" in self else None

    @property
    def holds_matrices(self) -> bool:
        """Whether A and C are held, so that the responses of the model are linear in ``Theta``."""
        return "C" in self.reference and "C" not in self

    def basis(self, channel: str | None) -> Any:
        """Return the basis of an input, of the only one where none is named; raises as `channel`."""
        return self.bases[self.channel(channel)]

    def channel(self, channel: str | None) -> str:
        """Return the name of an input, of the only one where none is named.

        Raises:
            StructureError: several inputs and none named, or no such input.
        """
        if channel is None:
            if len(self.channels) != 1:
                raise StructureError(f"this constraint needs channel=, one of {', '.join(self.channels)}")
            return self.channels[0]
        if channel not in self.bases:
            raise StructureError(f"there is no input {channel!r}; the inputs are {', '.join(self.channels)}"
                                 + "".join(f", a latent signal is {one}" for one in [*self.bases][len(self.channels):]))
        return channel

    def output(self, output: str | None) -> int:
        """Return the position of an output of a state-space model; of the only one where none is named.

        Raises:
            StructureError: several outputs and none named, or no such output.
        """
        if output is None and len(self.outputs) == 1:
            return 0
        if output not in self.outputs:
            wrong = "needs output=" if output is None else f"names no output {output!r}"
            raise StructureError(f"this constraint {wrong}; the outputs are {', '.join(self.outputs)}")
        return self.outputs.index(output)

    def function(self, channel: str) -> cp.Expression:
        """Return the coefficients of f of an input up to factors: ``mu``, or the columns of ``Theta``."""
        mu = self.key("mu", channel)
        return self[mu] if mu in self else self[self.key("Theta", channel)]

    def direction(self, channel: str) -> cp.Expression | None:
        """Return what has the sign of the static gain over f of an input: the sum of ``b``, or through A, B, C and D.

        None where f is no factor, with several outputs, or where there is no static characteristic.
        """
        mu, b = self.key("mu", channel), self.key("b", channel)
        if mu not in self or b not in self or self[b].ndim != 1:
            return None
        if "C" not in self.reference:
            return np.ones(self[b].size) @ self[b]
        if len(self.outputs) > 1 or not (self.holds_matrices or self.key("static", channel) in self):
            return None
        if not self.holds_matrices:  # to first order, along the f where the descent stands
            return np.ravel(self.reference[mu]) @ self.static(channel)
        a, c = self.reference["A"], self.reference["C"]
        row = np.linalg.lstsq((np.eye(len(a)) - a).T, c[0])[0]
        return self.weights(channel, row, None) @ self[b]

    def curves(self, channel: str) -> list[cp.Expression]:
        """Return what the shape of f is stated in: ``mu``, or the static curve of every output."""
        mu = self.key("mu", channel)
        if mu in self:
            return [self[mu]]
        return [self.static(channel, output) for output in (self.outputs if self.holds_matrices else ()) or (None,)]

    def static(self, channel: str | None, output: str | None = None) -> Any:
        """Return the coefficients of the static curve of an input, times `static_scale`.

        ``Theta`` summed over the lags; of a state-space model through A, B, C and D.

        Raises:
            StructureError: there is no static curve, or it is not linear in the variables.
        """
        channel = self.channel(channel)
        if channel not in self.channels:
            raise StructureError(f"{channel} is a latent signal, which has no static characteristic: constrain the "
                                 "shape of its function")
        if self.holds_matrices:
            a, c = self.reference["A"], self.reference["C"]
            try:
                row = np.linalg.solve((np.eye(len(a)) - a).T, c[self.output(output)])
            except np.linalg.LinAlgError:
                raise StructureError(
                    "the model has a pole at 1, hence no static characteristic; add 'stable'") from None
            return self[self.key("Theta", channel)] @ self.weights(channel, row, output)
        if "C" in self.reference:  # to first order in A, B, C and D
            if self.key("static", channel) not in self:
                raise StructureError(
                    "nonlinear feedback: the static characteristic does not follow from the inputs alone")
            return self[self.key("static", channel)][:, self.output(output)]
        if self["offset"].size > 1:
            raise StructureError("constraints on the static characteristic are defined for one output")
        if self.key("Theta", channel) not in self and self.key("b", channel) not in self:
            raise StructureError(f"a process with an integrator has no static characteristic from {channel}: its "
                                 "output comes to rest at no level. The word K bounds its slope")
        if self.key("Theta", channel) not in self:  # a linear model has b alone
            return cp.hstack([cp.sum(self[self.key("b", channel)])])
        return cp.sum(self[self.key("Theta", channel)], axis=1)

    def static_offset(self, output: str | None = None) -> Any:
        """Return the constant of the static curve of an output, times `static_scale`."""
        if "C" not in self.reference:
            return self["offset"][0]
        level = self["offset"][self.output(output)] if "offset" in self else 0.0
        for channel, origin in zip(self.channels, self.units.u_offset if self.units else ()):
            if origin:  # the programme counts a linear input from its level
                level = level - origin * self.static(channel, output)[0]
        return level

    @property
    def static_scale(self) -> Any:
        """``1 + sum(a)``, one where there is no a."""
        return 1 + cp.sum(self["a"]) if "a" in self else 1.0

    def weights(self, channel: str | None, row: np.ndarray, output: str | None, direct: float = 1.0) -> np.ndarray:
        """Return w of one output with ``Theta w = (row B + direct D_output) of every function``, with A and C held.

        The row (n,) weighs the states. The Theta of an input without direct feedthrough is (functions, n).
        """
        a, c = self.reference["A"], self.reference["C"]
        found = np.concatenate([row, np.zeros(len(c))])
        found[len(a) + self.output(output)] = direct
        return found[: self[self.key("Theta", channel)].shape[1]]
