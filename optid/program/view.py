"""What a constraint may speak about: the named expressions of a programme, in the units of the record."""

from collections.abc import Mapping
from typing import Any

import cvxpy as cp
import numpy as np

from optid.data.channels import Transform
from optid.errors import StructureError, nearest
from optid.program.units import outward

Values = Mapping[str, np.ndarray]
"""Values of variables by name."""


class View(Mapping[str, cp.Expression]):
    """The named expressions that a constraint may speak about, and the structure it may need.

    Attributes:
        kind: "exact" (variables a, b, mu, offset), "relaxed" (a, Theta, offset), "linear" (a, b, offset), "tangent"
            (a step of an output-error fit), "shift" (P and Q = A P) or "realisation" (Theta_c = functions x [B; D] of
            input c, and offset, with A and C held).
        channels: names of the inputs; with one input the plain names ``b``, ``mu``, ``Theta`` stand for it,
            with several they carry the input, as in ``mu[valve]``.
        bases: the fitted basis of every channel.
        gauge: how the scale between ``mu`` and ``b`` is fixed ("norm", "gain", "b0"), "" where nothing needs fixing.
        reference: values of the unconstrained least-squares estimate, for constraints that need a centre; in a
            "realisation" step the matrices ``A`` and ``C`` that are held.
        outputs: names of the outputs, where constraints may have to choose one.
        units: from the units of the programme to those of the record, in which the expressions are; None where they
            are the same.
        inner: the expressions in the units of the programme.
    """

    def __init__(self, expressions: Mapping[str, cp.Expression], *, kind: str, channels: tuple[str, ...] = (),
                 bases: Mapping[str, Any] | None = None, gauge: str = "", reference: Values | None = None,
                 outputs: tuple[str, ...] = (), units: Transform | None = None) -> None:
        self.inner = dict(expressions)
        self.units = units
        self._expressions = self.inner if units is None else outward(self.inner, kind, units, channels)
        self._auxiliaries: dict[int, cp.Variable] = {}
        self.outputs = tuple(outputs)
        self.kind = kind
        self.channels = channels
        self.bases = dict(bases or {})
        self.gauge = gauge
        self.reference = dict(reference or {})

    def __getitem__(self, name: str) -> cp.Expression:
        try:
            return self._expressions[name]
        except KeyError:
            raise StructureError(
                f"a constraint asks for {name!r}, which this formulation does not have. {nearest(name, self)}"
            ) from None

    def __contains__(self, name: object) -> bool:
        return name in self._expressions

    def __iter__(self):
        return iter(self._expressions)

    def __len__(self) -> int:
        return len(self._expressions)

    def auxiliary(self, name: str, shape: tuple[int, ...] = (), **attributes: Any) -> cp.Variable:
        """Return a new variable that a constraint needs for itself, such as the matrix of a Lyapunov inequality.

        It becomes a variable of every programme in which the constraint stands.

        Args:
            name: its name.
            shape: its shape.
            attributes: CVXPY attributes, such as ``symmetric=True``.
        """
        variable = cp.Variable(shape, name=name, **attributes)
        self._auxiliaries[variable.id] = variable
        return variable

    def owns(self, variable: cp.Variable) -> bool:
        """Whether a variable came from `auxiliary`."""
        return variable.id in self._auxiliaries

    def key(self, name: str, channel: str | None = None) -> str:
        """Return the key of a per-channel quantity: ``mu`` with one input, ``mu[channel]`` with several."""
        if len(self.channels) <= 1:
            return name
        if channel is None:
            raise StructureError(f"{name!r} needs a channel: there are several inputs ({', '.join(self.channels)})")
        return f"{name}[{channel}]"
