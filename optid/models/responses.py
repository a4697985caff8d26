"""Lengths and names of the responses of a model, as tables and figures show them."""

import numpy as np

from optid.models.functions import static_functions
from optid.models.model import Model

LONGEST_STEP, SETTLED = 400, 0.02


def step_length(model: Model) -> int:
    """Return the number of samples after which the step response of the linear part has settled within 2 %.

    At least 20 and at most 400, and 50 for an unstable model, whose response does not settle.
    """
    if not model.is_stable:
        return 50
    decay = 0 if model.radius == 0 else int(np.ceil(np.log(SETTLED) / np.log(model.radius)))
    return int(np.clip(1.5 * decay, 20, LONGEST_STEP))


def response_pairs(model: Model) -> list[tuple[str, str]]:
    """Return (input, output) of every column of a response of the linear part, in the order of its last two axes.

    Where an input has several static functions there is one column for each of them, by its word.
    """
    words = [function.word for function in static_functions(model) if not function.fed_back]
    sources = model.inputs if len(words) == model.m else words
    return [(source, output) for output in model.outputs for source in sources]
