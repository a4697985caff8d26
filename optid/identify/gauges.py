"""The scale between mu and b, which is not identifiable: how the formulations fix it."""

from collections.abc import Sequence

import numpy as np

from optid.models.gauges import GAUGES, gauge_factor
from optid.program.program import Program

FIXED = GAUGES[:-1]  # the gauges that fix the scale
TRIALS = 5  # random points at which constraints are compared with those of the opposite signs


def in_gauge(gauge: str, mu: np.ndarray, b: np.ndarray, a: np.ndarray, channel: str) -> tuple[np.ndarray, np.ndarray]:
    """Return mu (P,) and b (nb,) or (nb, l) of one input, the channel, scaled to satisfy a gauge of `FIXED`.

    The coefficients a of A are (na,) or (na, l, l). A quantity that is zero, and that the gauge sets to one, is a
    `StructureError`.
    """
    if gauge == "norm" and not np.any(b):  # an input without effect: any direction will do
        return np.zeros_like(mu), np.full(b.shape, 1 / np.sqrt(b.size))
    factor = gauge_factor(gauge, a, b, channel)
    return mu * factor, b / factor


def signs_are_fixed(program: Program, pairs: Sequence[tuple[str, str]]) -> bool:
    """Whether the user's constraints tell (mu, b) of some input from (-mu, -b), given the names of each pair.

    Those about ``mu bᵀ`` do not, nor do equations such as a symmetry of f; they are compared at random points. One that
    cannot be evaluated there counts as fixing them. The variables keep their values.
    """
    if not program.user_constraints:
        return False
    rng, kept = np.random.default_rng(0), {name: variable.value for name, variable in program.variables.items()}

    def violations(values: dict[str, np.ndarray]) -> np.ndarray:
        program.assign(values)
        return np.concatenate([np.ravel(member.violation()) for group in program.user_constraints.values()
                               for member in group])

    try:
        for _ in range(TRIALS):
            values = {name: rng.normal(size=shape) for name, shape in program.shapes.items()}
            here = violations(values)
            for mu, b in pairs:
                there = violations({**values, mu: -values[mu], b: -values[b]})
                if not np.allclose(here, there, rtol=1e-6, atol=1e-9 * np.max(here, initial=1.0)):
                    return True
        return False
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return True
    finally:
        for name, value in kept.items():
            program.variables[name].save_value(value)
