"""What a trial costs, in units: about a second of one core, but declared, so that a search is the same everywhere.

The formula is from the time that fits of every formulation took on simulated records of 300 to 10,000 samples; most lie
within a factor of three of it. It decides in which order classes are tried and when a search ends, never how
long it takes: a slow machine makes the same trials as a fast one.
"""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from optid.arrays import LARGEST, is_number, short_repr
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.search.trial import StructureCandidate

EFFORTS = {"small": 15.0, "normal": 60.0, "large": 400.0}
"""Units of a search, by word."""
WARM = 0.25  # cost of a fit that goes on from another instead of searching for functions of latent signals
LEAST = 0.01  # units of the shortest fit
SAMPLES, EXPERIMENTS = 3000, 8  # of a record that costs twice as much as a short one
RATES = {"arx": (7e-5, 1.5), "armax": (1.3e-3, 1.5), "bj": (4e-3, 1.5), "oe": (6e-3, 1.5), "sid": (1.7e-3, 1.0),
         "ss": (5.3e-3, 1.2), "process": (6e-3, 1.5), "wiener": (4.7e-3, 1.2), "latent": (1.9e-2, 1.5)}
"""Units of a fit with one parameter to a short record, and the power of their number by which it becomes dearer."""


def effort_of(given: Any) -> float:
    """Return the units of a word of `EFFORTS`, or of a positive number or its text (`StructureError`)."""
    value = given
    if isinstance(given, str):
        with suppress(ValueError):
            value = EFFORTS[given] if given in EFFORTS else float(given)
    if not is_number(value) or not 0 < value <= LARGEST:
        raise StructureError(f"effort={short_repr(given)}: use one of {', '.join(EFFORTS)}, "
                             "or a number of units above 0")
    return float(value)


def units(candidate: StructureCandidate, data: Data, fits: int = 1, searches: int = 1) -> float:
    """Return what so many fits of a candidate to a record, or to the rest of it without a block, cost.

    Of functions of latent signals, so many fits search for them; the others go on from a model with them.
    """
    size, rate = parameters(candidate.arguments, data.m, data.l), _rate(candidate.formulation)
    factor, power = RATES[rate]
    length = 1 + data.n_samples / SAMPLES + (data.n_experiments - 1) / EXPERIMENTS
    one = LEAST + factor * size**power * length * int(candidate.arguments.get("tries", 1))
    return one * (searches + WARM * (fits - searches) if rate == "latent" and fits else fits)


def parameters(arguments: Mapping[str, Any], m: int, l: int) -> int:  # noqa: E741 - the field's letter for outputs
    """Return about how many parameters a structure with m inputs and l outputs has."""
    inner = _coefficients(arguments.get("basis", "linear"), m)
    if "process" in arguments:
        return sum(int(word[1]) + len(word) for word in arguments["process"]) + inner + l
    if "nx" not in arguments:
        numerators = int(np.sum(np.broadcast_to(arguments.get("nb", 1), m)))
        return int(arguments.get("na", 0)) * l + numerators + inner + sum(
            int(arguments.get(name, 0)) for name in ("nc", "nd")) + l
    nx, fed = int(arguments["nx"]), l if "feedback_basis" in arguments else 0
    latent = int(arguments.get("channels", l if "output_basis" in arguments else 0))
    return nx * (m + fed + l) + m * l + l + inner + 3 * fed + latent * (2 * nx + m + l + 2)


def _coefficients(basis: Any, m: int) -> int:
    """Return how many coefficients the functions of the inputs have beyond a straight line."""
    words = [basis] * m if isinstance(basis, str) else list(basis)
    return sum(int(word.partition(":")[2] or 1) - 1 for word in words if isinstance(word, str))


def _rate(formulation: str) -> str:
    name = formulation.partition(".")[0].removeprefix("hammerstein_")
    if formulation.endswith(".sid"):
        return "sid"
    return {"lfr": "latent", "wiener_ss": "wiener"}.get(name, name if name in RATES else "ss")
