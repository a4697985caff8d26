"""The static functions and the responses of a model, as tables and figures name them."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.models.model import Model
from optid.models.nonlinearity import Nonlinearity

LONGEST_STEP, SETTLED = 400, 0.02


@dataclass(frozen=True, eq=False)
class StaticFunction:
    """One static function of a model."""

    word: str  # its name in equations and tables: "f", "f_valve", "f2_valve", "g_level"
    nonlinearity: Nonlinearity  # the function
    channel: int  # index of its argument among the inputs, the outputs, or the latent signals
    name: str  # name of that channel
    unit: str  # its unit, "" where unknown
    family: str  # the attribute of the model that holds it: "nonlinearities", "feedback" or "latent"
    index: int  # its place there
    model: Any = field(repr=False)  # the model

    @property
    def is_linear(self) -> bool:
        """Whether there is nothing to draw."""
        return self.nonlinearity.is_linear

    @property
    def what(self) -> str:
        """What kind of function it is, as a title says it."""
        return {"feedback": "Feedback nonlinearity", "latent": "Latent nonlinearity"}.get(self.family, "Nonlinearity")

    def samples(self, data: Data) -> Array:
        """Samples (N,) of its argument in a record, all experiments; NaN = missing.

        Those of a latent signal are of the free run from the initial states that fit best; see `latent_run`.
        """
        if self.family == "latent":
            return np.concatenate([z[:, self.channel] for z in self.model.latent_run(data)])
        signals = [e.y if self.family == "feedback" else e.u for e in data.experiments]
        return np.concatenate([signal[:, self.channel] for signal in signals])


def static_functions(model: Any) -> list[StaticFunction]:
    """Return the functions of the inputs, of the outputs that are fed back, and of latent signals.

    With one input and one function of it the word is "f"; several functions of a channel are numbered: f1_valve.
    """
    shown = model.f if isinstance(model.f, tuple) else (model.f,)  # with its offset, where the model knows it
    places = tuple(getattr(model, "input_of", range(model.m)))
    groups = [("f", "nonlinearities", shown, places, model.inputs, model.input_units)]
    if has_feedback(model):
        groups.append(("g", "feedback", model.feedback, model.output_of, model.outputs, model.output_units))
    found = []
    for letter, family, functions, places, names, units in groups:
        for j, (f, c) in enumerate(zip(functions, places)):
            number = str(places[: j + 1].count(c)) if places.count(c) > 1 else ""
            word = letter + number + ("" if len(names) == 1 else f"_{names[c]}")
            found.append(StaticFunction(word, f, c, names[c], units[c], family, j, model))
    return found + [StaticFunction(word, h, i, name, "", "latent", i, model)
                    for i, (word, name, h) in enumerate(zip(*latent_names(model), getattr(model, "latent", ())))]


def latent_names(model: Any) -> tuple[list[str], list[str]]:
    """Words of the functions of latent signals and of the signals: h and z, numbered where there are several."""
    count = len(getattr(model, "latent", ()))
    numbers = [""] if count == 1 else [str(i + 1) for i in range(count)]
    return [f"h{number}" for number in numbers], [f"z{number}" for number in numbers]


def has_feedback(model: Any) -> bool:
    """Whether outputs are fed back through static functions, so that a simulation may take them from a record."""
    return bool(getattr(model, "feedback", ()))


def runs_free(model: Any) -> bool:
    """Whether a free run says something: stable, integrating, or with feedback, where poles do not decide."""
    return bool(model.is_stable or model.integrates or has_feedback(model))


def step_length(model: Model) -> int:
    """Return the number of samples after which the step response of the linear part has settled within 2 %.

    At least 20 and at most 400, and 50 for an unstable model, whose response does not settle.
    """
    if not model.is_stable:
        return 50
    decay = 0 if model.radius == 0 else int(np.ceil(np.log(SETTLED) / np.log(model.radius)))
    late = int(np.max(getattr(model, "dead_times", 0.0)) / model.dt)  # of a process in continuous time
    return int(np.clip(1.5 * decay + late, 20, LONGEST_STEP))


def response_pairs(model: Model) -> list[tuple[str, str]]:
    """Return (input, output) of every column of a response of the linear part, in the order of its last two axes.

    Where an input has several static functions there is one column for each of them, by its word; of processes one for
    each pair, of which the responses of other outputs are zero.
    """
    own: Any = getattr(model, "pairs", None)
    if own is not None:
        return [(model.inputs[c], output) for output in model.outputs for _, c in own]
    words = [function.word for function in static_functions(model) if function.family == "nonlinearities"]
    sources = words if len(words) > model.m else model.inputs
    return [(source, output) for output in model.outputs for source in sources]


def free_parameters(model: Any) -> int:
    """Return the number of parameters of a model, less those that repeat others (gauge)."""
    if hasattr(model, "parameters"):  # state equations of the user
        return len(model.parameters)
    if model.structure == "process":
        dynamics = sum(one.p.size for one in model.processes)
        levels = model.l if model.levels is None else model.levels.size
        drifts = np.count_nonzero(model.drift)
        return int(dynamics + sum(f.mu.size for f in model.nonlinearities) + levels + drifts)
    shapes = sum(f.basis.size - 1 for f in model.nonlinearities)
    constants = model.l if model.levels is None else model.levels.size
    if model.structure != "ss":
        return int(model.a.size + sum(b.size for b in model.b) + constants + shapes)
    n, signals = len(model.A), model.B.shape[1] + model.E.shape[1]
    direct = np.count_nonzero(np.any(np.c_[model.D, model.Fz] != 0, axis=0)) * model.l
    shapes += sum(f.basis.size - 1 for f in (*model.feedback, *model.latent))
    rows = sum(1 for f in model.latent) * (2 * n + 1)
    return int(n * (model.l + signals) + direct + constants + shapes + rows)
