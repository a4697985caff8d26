"""Fits of every formulation with outputs missing at random: simulation fit on a clean record, against complete data.

    python benchmarks/gaps.py [--seeds 3] [--samples 3000] [--shares 0.05 0.2 0.4] [--only hammerstein_ss]

Samples of every output are removed at random, each output with gaps of its own. Printed per formulation: the simulation
fit in % of the noise-free validation output (the worst output, the worst seed), for complete data and for every share
of missing samples; an error is named by its class. The last line tells the largest loss.
"""

import argparse
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.signal import lfilter

import optid
from optid.bases import Polynomial, Triangular
from optid.errors import OptidError
from optid.identify.validation import fit_percent
from optid.models import HammersteinSS, Nonlinearity

AR, B = np.array([1.0, -1.5, 0.7]), np.array([0.0, 0.8, 0.6])
ORDERS = {"na": 2, "nb": 2, "nk": 1}
CUBIC = {"basis": "polynomial:3"}
FEEDBACK = Triangular(9, interval=(-4.0, 4.0))
"""Of the first output; its values at the nodes are those of sin(2 y)."""

OBSERVER = optid.Equations(
    lambda v: {"x1": v["b1"] * v["u"] - v["a1"] * v["x1"] + v["x2"], "x2": v["b2"] * v["u"] - v["a2"] * v["x1"],
               "y": v["x1"]},
    states={"x1": 0.1, "x2": 0.1}, parameters={"a1": -1.0, "a2": 0.5, "b1": 1.0, "b2": 0.5}, time="discrete")
"""The linear system as equations of one's own."""


@dataclass(frozen=True)
class Cell:
    """A formulation on a system.

    Attributes:
        formulation: its name.
        system: "equation", "output" or "coloured" error of a transfer function, or "states".
        structure: its arguments.
        outputs: of the state-space system.
        curved: whether the inputs act through cubic functions.
        fed: whether an output is fed back.
        samples: at most, for methods for short records.
    """

    formulation: str
    system: str
    structure: Mapping[str, Any] = field(default_factory=dict)
    outputs: int = 1
    curved: bool = False
    fed: bool = False
    samples: int = 1_000_000

    def __str__(self) -> str:
        words = [word for word in ("criterion", "noise", "form") if word in self.structure]
        said = [self.formulation, *(str(self.structure[word]) for word in words), f"{self.outputs}y"]
        marks = {"cubic": self.curved, "feedback": self.fed, "auto": self.structure.get("nx") == "auto"}
        return " ".join([*said, *(word for word, applies in marks.items() if applies)])


def _states(name: str, structure: Mapping[str, Any] | None = None, outputs: tuple[int, ...] = (1, 2),
            **more: bool) -> list[Cell]:
    return [Cell(name, "states", {"nx": 2, **(structure or {})}, outputs=count, **more) for count in outputs]


FED = {"feedback_basis": [FEEDBACK, None], **CUBIC}
CELLS = [
    Cell("arx", "equation", ORDERS),
    Cell("fir", "output", {"nb": 40}),
    *(Cell(name, "equation", {**ORDERS, **CUBIC}, curved=True) for name in
      ("hammerstein_arx.exact", "hammerstein_arx.nuclear", "hammerstein_arx.overparametrised")),
    Cell("oe.exact", "output", ORDERS),
    Cell("hammerstein_oe.exact", "output", {**ORDERS, **CUBIC}, curved=True),
    Cell("hammerstein_oe.shooting", "output", {**ORDERS, **CUBIC}, curved=True),
    Cell("process.exact", "output", {"process": "P2ZU"}),
    Cell("armax.exact", "coloured", {**ORDERS, "nc": 1}),
    Cell("hammerstein_armax.exact", "coloured", {**ORDERS, "nc": 1, **CUBIC}, curved=True),
    Cell("bj.exact", "output", {**ORDERS, "nc": 1, "nd": 1}),
    Cell("hammerstein_bj.exact", "output", {**ORDERS, "nc": 1, "nd": 1, **CUBIC}, curved=True),
    *_states("hammerstein_ss.sid"),
    *_states("hammerstein_ss.sid", structure={"nx": "auto"}),
    *_states("hammerstein_ss.sid", structure=CUBIC, curved=True),
    *_states("hammerstein_ss.sivid", structure=CUBIC, curved=True),
    *_states("hammerstein_ss.asivid", structure=CUBIC, curved=True),
    *_states("hammerstein_ss.sivid", structure=FED, curved=True, fed=True, outputs=(2,)),
    *_states("hammerstein_ss.asivid", structure=FED, curved=True, fed=True, outputs=(2,)),
    *_states("ss.exact"),
    *_states("ss.exact", structure={"criterion": "prediction"}),
    *_states("ss.exact", structure={"nx": "auto"}, outputs=(2,)),
    *_states("hammerstein_ss.exact", structure=CUBIC, curved=True),
    *_states("hammerstein_ss.exact", structure={**FED, "criterion": "measured feedback"}, curved=True, fed=True,
             outputs=(2,)),
    *_states("hammerstein_ss.exact", structure={**FED, "criterion": "prediction"}, curved=True, fed=True, outputs=(2,)),
    *(cell for name in ("lfr.exact", "wiener_ss.exact", "hammerstein_wiener_ss.exact") for cell in _states(name)),
    Cell("ss.shooting", "states", {"nx": 2}, samples=600),
    Cell("hammerstein_ss.shooting", "states", {"nx": 2, **CUBIC}, curved=True, samples=600),
    Cell("lfr.shooting", "states", {"nx": 2}, samples=600),
    Cell("physical", "output", {"equations": OBSERVER}, samples=600),
    Cell("subspace.nuclear", "states", {"nx": 2, "block_rows": 5}, samples=300),
    Cell("subspace.nuclear", "states", {"nx": 2, "block_rows": 5, "weight": 1e3}, outputs=2, samples=200),
]


def plant(cell: Cell) -> HammersteinSS:
    """Return the state-space system of a cell."""
    cubic = Polynomial(3, interval=(-2.0, 2.0))
    straight, bent = np.array([1.0, 0.0, 0.0]), (np.array([1.0, 0.4, 0.3]), np.array([0.6, -0.5, 0.2]))
    functions = tuple(Nonlinearity(cubic, part if cell.curved else straight) for part in bent)
    sine = Nonlinearity(FEEDBACK, np.sin(2 * np.linspace(-4.0, 4.0, 9)))
    fed = {"E": [[0.1], [0.25]], "feedback": (sine,), "output_of": (0,)} if cell.fed else {}
    c, d = np.array([[1.0, 0.0], [0.2, 1.0]])[: cell.outputs], np.zeros((cell.outputs, 2))
    return HammersteinSS([[0.7, 0.35], [-0.35, 0.6]], [[0.3, 0.1], [0.0, 0.4]], c, d, nonlinearities=functions,
                         offset_y=np.array([0.3, -0.2])[: cell.outputs], **fed)


def record(cell: Cell, samples: int, seed: int, noisy: bool = True) -> optid.Data:
    """Simulate a record of the system of a cell; 10 % noise."""
    rng = np.random.default_rng([seed, noisy])
    count = min(samples, cell.samples)
    if cell.system == "states":
        model, u = plant(cell), rng.uniform(-1.8, 1.8, (count, 2))
        if not cell.fed:
            clean = np.asarray(model.simulate(u))
            return optid.Data(u, clean + noisy * 0.1 * clean.std(axis=0) * rng.normal(size=clean.shape))
        x, y = np.zeros(2), np.zeros((count, cell.outputs))
        f = model.expand_inputs(u)
        for k in range(count):  # what is fed back is measured, noise and all
            y[k] = model.C @ x + model.offset_y + noisy * 0.1 * rng.normal(size=cell.outputs)
            x = model.A @ x + model.B @ f[k] + model.E @ model.feedback[0](y[k, :1])
        return optid.Data(u, y)
    u = rng.uniform(-1.0, 1.0, count)
    w = u + 0.5 * u**2 - 0.4 * u**3 if cell.curved else u
    clean, e = lfilter(B, AR, w), rng.normal(size=count)
    filters = {"equation": ([1.0], AR), "output": ([1.0], [1.0]), "coloured": ([1.0, 0.5], AR)}
    v = lfilter(*filters[cell.system], e)
    return optid.Data(u, clean + noisy * 0.1 * clean.std() * v / v.std())


def punctured(data: optid.Data, share: float, seed: int) -> optid.Data:
    """Remove a share of the samples of every output at random."""
    rng, y = np.random.default_rng([seed, 7]), np.array(data.y)
    y[rng.random(y.shape) < share] = np.nan
    return optid.Data(data.u, y)


def score(cell: Cell, data: optid.Data, seed: int, samples: int) -> float:
    """Fit, and return the simulation fit in % of the worst output on a clean record."""
    fit = optid.fit(data, cell.formulation, **cell.structure)
    clean = record(cell, min(samples, 1000), seed + 1000, noisy=False)
    simulate = getattr(fit.model, "simulate_measured_feedback", None) if cell.fed else fit.model.simulate
    return float(np.min(fit_percent(clean.y, np.reshape(simulate(clean, x0="fit"), clean.y.shape))))


def main(argv=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--samples", type=int, default=3000)
    parser.add_argument("--shares", type=float, nargs="+", default=[0.05, 0.2, 0.4])
    parser.add_argument("--only", default="", help="part of the names of the formulations")
    options = parser.parse_args(argv)
    shares, figures = [0.0, *options.shares], {}
    print(f"{'':52}" + "".join(f"{100 * share:8.0f} %" for share in shares) + "   seconds")
    for cell in [cell for cell in CELLS if options.only in str(cell)]:
        found, words, clock = np.full((len(shares), options.seeds), np.nan), {}, time.process_time()
        for i, share in enumerate(shares):
            for seed in range(options.seeds):
                data = punctured(record(cell, options.samples, seed), share, seed)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    try:
                        found[i, seed] = score(cell, data, seed, options.samples)
                    except (OptidError, np.linalg.LinAlgError) as error:
                        words[i] = f"{type(error).__name__}: {error}"
        figures[str(cell)] = found
        texts = [type_of(words[i]) if i in words else f"{row.min():.2f}" for i, row in enumerate(found)]
        print(f"{cell!s:52}" + "".join(f"{text:>10}" for text in texts) + f"{time.process_time() - clock:10.1f}",
              flush=True)
        for word in dict.fromkeys(words.values()):
            print(f"    {word}")
    losses = {name: float(np.max(found[:1] - found[1:])) for name, found in figures.items()}
    worst = max(losses, key=lambda name: np.nan_to_num(losses[name], nan=np.inf))
    print(f"largest loss of fit, any share and seed: {losses[worst]:.2f} points ({worst})")
    return figures


def type_of(sentence: str) -> str:
    """Return the class of an error from its sentence."""
    return sentence.split(":")[0][:9]


if __name__ == "__main__":
    main()
