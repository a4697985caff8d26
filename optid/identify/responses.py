"""What a model does, in the units of its outputs: where they come to rest, and how they answer a step of an input.

None of it depends on the scale between f and B. A model that integrates comes to rest nowhere: instead of its static
characteristic there is the rate at which its output moves.
"""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, DataWarning, OptidError, StructureError
from optid.identify.dynamics import Levels, integration, jumps, slope_samples
from optid.models.functions import has_feedback
from optid.models.roots import AT_ONE, poles_of

POINTS, SAMPLES = 41, 121
"""Points of a characteristic besides the nodes of f, and most places of a step response."""

SETTLED, SHORTEST, LONGEST = 0.02, 20, 2000
"""Share of a step response that is still to come at its end, and its fewest and most samples."""

Kind = Literal["static", "rate", "step"]


@dataclass(frozen=True, eq=False)
class Response:
    """A curve of an output: at rest, or how fast it moves, against an input, or after a step of an input."""

    # "static" (output at rest), "rate" (change of the output per unit of time, above that at the lower level), or
    # "step" (change of the output as the input goes from the lower level to the upper one)
    kind: Kind
    input: int  # index of the input
    output: int  # index of the output
    levels: tuple[float, float]  # (low, high) of the input
    at: Array  # (k,) inputs, or times after the step
    value: Array  # (k,)
    error: Array  # (k,) standard errors; NaN where there are none, like the ends of the intervals
    lower: Array  # (k,) ends of the pointwise intervals
    upper: Array

    @property
    def has_band(self) -> bool:
        """Whether there are intervals."""
        return bool(np.isfinite(self.lower).any())


def responses(model: Any, levels: Levels, known: Any = None, longest: int = LONGEST, count: int = 0
              ) -> tuple[list[Response], list[str]]:
    """Return the static characteristic (or the rate) and the step response of every output to every input.

    The functions of the other inputs are at zero in a static characteristic.

    Args:
        model: the model.
        levels: (low, high) of every input.
        known: its `Uncertainty`, for intervals; None for none.
        longest: most samples of a step response, such as the length of the record.
        count: samples of a step response; as many as it takes to settle where 0.

    Returns:
        The curves, and why some are missing, one sentence each.
    """
    found, reasons = [], []
    integrates = integration(model, known)
    if integrates:
        reasons.append(f"No static characteristic: {integrates[0].lower()}{integrates[1:]}.")
    count = count or step_samples(model, bool(integrates), longest)
    places = np.unique(np.round(np.linspace(0, count - 1, min(count, SAMPLES))).astype(int))
    for c, (low, high) in enumerate(levels):
        points = np.unique(np.concatenate([np.linspace(low, high, POINTS), _nodes(model, c, low, high)]))
        rest = _rate if integrates else _at_rest
        refused = _refusal(lambda c=c, points=points, rest=rest: rest(model, c, points))
        if refused:
            reasons.append(f"No static characteristic against {model.inputs[c]}: {refused}.")
        refused = _refusal(lambda c=c, low=low, high=high: _step(model, c, low, high, count))
        if refused:
            reasons.append(f"No response to a step of {model.inputs[c]}: {refused}.")

        def quantity(model: Any, c: int = c, points: Array = points, low: float = low, high: float = high,
                     rest: Callable[..., Array] = rest) -> Array:
            curves = [np.full((points.size, model.l), np.nan), np.full((places.size, model.l), np.nan)]
            with suppress(StructureError, DataError):
                curves[0] = rest(model, c, points)
            with suppress(StructureError, DataError):
                curves[1] = _step(model, c, low, high, count)[places]
            return np.vstack(curves)

        bands = _limits(quantity, model, known)
        parts: list[tuple[Kind, Array, slice]] = [
            ("rate" if integrates else "static", points, slice(0, points.size)),
            ("step", model.dt * places, slice(points.size, None))]
        found += [Response(kind, c, o, (low, high), at, *(band[part, o] for band in bands))
                  for o in range(model.l) for kind, at, part in parts if np.isfinite(bands[0][part, o]).any()]
    return found, list(dict.fromkeys(reasons))


def step_samples(model: Any, integrates: bool = False, longest: int = LONGEST) -> int:
    """Return after how many samples a step response has settled within 2 %, or an integrator's is a straight line."""
    sizes = np.abs(poles_of(model))
    moving = integrates or np.any(sizes >= 1 - AT_ONE)
    slowest = float(np.max(sizes[sizes < 1 - 1e-3] if moving else sizes, initial=0.0))
    decay = np.log(SETTLED) / np.log(slowest) if slowest > 0 else 0.0
    samples = (max(2.5 * decay, 50) if moving else 1.5 * decay) + int(getattr(model, "largest_lag", 0))
    return int(np.clip(np.ceil(samples), SHORTEST, max(min(longest, LONGEST), SHORTEST)))


def _limits(quantity: Callable[[Any], Array], model: Any, known: Any) -> Sequence[Array]:
    """Return value, error and ends of a quantity; NaN where there are none."""
    if known is not None:
        with suppress(OptidError):
            found = known.of(quantity)
            return found.value, found.error, found.lower, found.upper
    value = quantity(model)
    return value, *(np.full(value.shape, np.nan),) * 3


def _refusal(build: Callable[[], Any]) -> str:
    try:
        build()
    except (StructureError, DataError) as error:
        return str(error).rstrip(".")
    return ""


def _nodes(model: Any, c: int, low: float, high: float) -> Array:
    places = getattr(model, "input_of", range(model.m))
    nodes = [getattr(f.basis, "nodes", ()) for f, place in zip(model.nonlinearities, places) if place == c]
    found = np.concatenate([np.zeros(0), *map(np.asarray, nodes)])
    return found[(found >= low) & (found <= high)]


def _at_rest(model: Any, c: int, points: Array) -> Array:
    if not hasattr(model, "static_curve"):
        raise StructureError("the state equations of the user have none")
    return model.static_curve(c, points)


def _rate(model: Any, c: int, points: Array) -> Array:
    """Return how fast the outputs move (k, l) with the input held at points (k,), above that at the first one."""
    last = model.impulse_response(slope_samples(model))[-1].reshape(model.l, -1)
    return np.array([last @ jumps(model, c, points[0], point) for point in points]) / model.dt


def _step(model: Any, c: int, low: float, high: float, count: int) -> Array:
    """Return the change of the outputs (count, l) as input c goes from one level to another, at rest before."""
    if model.structure == "ss" and (has_feedback(model) or model.latent or np.any(model.L)):
        u = np.zeros(model.m)
        u[c] = low
        state, before = model.equilibrium(u)
        u[c] = high
        with warnings.catch_warnings(action="ignore", category=DataWarning):
            return model.simulate(np.tile(u, (count, 1)), x0=state).reshape(count, model.l) - before
    return model.step_response(count).reshape(count, model.l, -1) @ jumps(model, c, low, high)
