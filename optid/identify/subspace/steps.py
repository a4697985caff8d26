"""The steps of the formulations that begin with subspace fits, declared for the choice of solvers."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from optid.bases import has_products
from optid.solving.steps import steps

MATRICES = {"shift": "SDP", "shift with fixed P": "SDP", "centre": "SDP"}
"""Those that bring poles to where the constraints want them, or an unstable A into the unit disc."""


def subspace_steps(own: Mapping[str, str] | None = None, tangent: str = "") -> Callable[[Callable], Callable]:
    """Declare "split", which chooses B, D and E, and the steps that move poles, behind those of a formulation.

    Args:
        own: its own steps.
        tangent: the step whose programmes hold all constraints, in the tangent of a state-space model.
    """
    def declare(given: Mapping[str, Any]) -> dict[str, str]:
        rules = given["constraints"]
        inner = _about_coefficients(rules) if "split" in given else []  # starts obey rules about poles alone
        products = has_products([given.get("basis", "linear"), given.get("feedback_basis")])
        split = "NLP rank-one" if products and given.get("split", "exact") == "exact" else (
            _convex(inner) if inner else "QP linear")
        whole = {tangent: _convex(rules) if rules else "QP linear"} if tangent else {}
        return {**(own or {}), **whole, "split": split, **MATRICES}
    return steps(declare)


def _about_coefficients(rules: Sequence[Any]) -> list[Any]:
    """Return the constraints about coefficients; a function of the user is one."""
    return [rule for rule in rules if "coefficients" in getattr(rule, "about", {"coefficients"})]


def _convex(rules: Sequence[Any]) -> str:
    """Return the class of a least-squares programme under constraints of a state-space model."""
    return "SDP" if any(getattr(rule, "matrix", False) for rule in rules) else "QP"
