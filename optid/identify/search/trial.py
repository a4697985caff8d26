"""One structure on trial: fitted to the whole record, then to the record without every block, and judged there."""

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import OptidError
from optid.identify.fitting import fit
from optid.identify.search.blocks import Blocks, pooled_fit

WORSE = 1.3
"""A structure is given up when its errors on the first half of the blocks have so many times the energy of the best."""

STARTS = 2
"""Starts of output-error models on trial."""

STEPS = 30
"""Steps of the descents of state-space models on trial."""

Key = tuple[str, tuple[tuple[str, Any], ...]]


@dataclass(frozen=True)
class Candidate:
    """A structure: what `optid.fit` is to be called with.

    Attributes:
        kind: class of models, such as "linear".
        formulation: its name.
        arguments: of the formulation.
    """

    kind: str
    formulation: str
    arguments: Mapping[str, Any]

    @property
    def key(self) -> Key:
        """What tells it from others."""
        return self.formulation, tuple(sorted((name, str(value)) for name, value in self.arguments.items()))

    @property
    def words(self) -> str:
        """The arguments as one writes them on the command line."""
        return " ".join(f"--{name.replace('_', '-')} {_word(value)}" for name, value in self.arguments.items())


@dataclass(frozen=True, eq=False)
class Trial:
    """What became of a candidate.

    Attributes:
        candidate: the structure.
        estimation: fit in % of the free run on the record it was fitted to.
        energy: (b, l) energy of its errors on the blocks that were tried.
        measure: (b, l) what it is measured by, see `Blocks.errors`.
        order: the blocks, in the order of `energy`.
        parameters: number of parameters of the model.
        seconds: CPU time.
        status: of the solver on the whole record, or "refused".
        reason: why it was given up, "" where it was tried on every block.
    """

    candidate: Candidate
    estimation: float = -np.inf
    energy: Array = field(default_factory=lambda: np.zeros((0, 1)), repr=False)
    measure: Array = field(default_factory=lambda: np.zeros((0, 1)), repr=False)
    order: tuple[int, ...] = ()
    parameters: int = 0
    seconds: float = 0.0
    status: str = "refused"
    reason: str = ""

    @property
    def complete(self) -> bool:
        """Whether it was tried on every block, and its runs stayed finite."""
        return not self.reason

    @property
    def score(self) -> float:
        """Cross-validated fit in %, pooled over the blocks; minus infinity where it was given up."""
        return pooled_fit(self.energy, self.measure) if self.complete and len(self.energy) else -np.inf

    @property
    def by_block(self) -> Array:
        """Fit in % of the blocks (b,) in their order in the record, by the variance of the whole record."""
        fits = np.array([pooled_fit(e[None], m[None]) for e, m in zip(self.energy, self.measure)])
        return fits[np.argsort(self.order)]

    @property
    def losses(self) -> Array:
        """Relative energy of the errors on the blocks (b,), summed over the outputs, in their order in the record."""
        return np.sum(self.energy / np.maximum(self.measure, 1e-300), axis=1)[np.argsort(self.order)]


def tried(candidate: Candidate, blocks: Blocks, rival: Trial | None, settings: Mapping[str, Any],
          constraints: Sequence[Any], horizon: int | None, deadline: float) -> Trial:
    """Fit a candidate, leave out block after block, and stop early where it cannot win.

    Args:
        candidate: the structure.
        blocks: of the record.
        rival: what it has to beat, None for nothing.
        settings: solver and accuracy.
        constraints: of the user.
        horizon: samples ahead of the predictions that are compared; None for the free run.
        deadline: by `time.monotonic`.
    """
    clock = time.process_time()
    arguments = {**candidate.arguments, **({"constraints": tuple(constraints)} if constraints else {})}
    common: dict[str, Any] = {"candidate": candidate}

    def fitted(data: Any) -> Any:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return fit(data, candidate.formulation, prove=False, **settings, **spared(candidate), **arguments)

    def ended(reason: str = "", **found: Any) -> Trial:
        return Trial(**{**common, **found}, seconds=time.process_time() - clock, reason=reason)

    try:
        whole = fitted(blocks.data)
        model = whole.model
        energies, measures = zip(*(blocks.errors(model, b, horizon) for b in range(len(blocks))))
        common |= {"status": whole.solution.status.value, "parameters": free_parameters(model),
                   "estimation": pooled_fit(np.array(energies), np.array(measures))}
        if rival is not None and common["estimation"] < rival.score:
            return ended("fits the record itself less than its rival fits blocks left out")
        order, energy, measure = halves(len(blocks)), [], []
        for done, b in enumerate(order, start=1):
            if time.monotonic() > deadline:
                return ended("out of time")
            found = blocks.errors(fitted(blocks.without(b)).model, b, horizon)
            energy.append(found[0])
            measure.append(found[1])
            so_far = {"energy": np.array(energy), "measure": np.array(measure), "order": tuple(order[:done])}
            if not np.isfinite(found[0]).all():
                return ended(f"its run diverges in block {b + 1}", **so_far)
            if rival is not None and 2 * done == len(order) and _behind(so_far, rival):
                return ended("falls behind its rival on the first half of the blocks", **so_far)
        return ended(**so_far)
    except (OptidError, np.linalg.LinAlgError, ValueError) as error:
        return ended(f"{type(error).__name__}: {error}")


def spared(candidate: Candidate) -> dict[str, Any]:
    """Return the arguments that make a trial quicker than the fit of the structure that is chosen."""
    if candidate.formulation.endswith("oe.exact"):
        return {"starts": STARTS}
    if candidate.formulation in ("ss.exact", "hammerstein_ss.exact", "lfr.exact"):
        return {"iterations": STEPS, "block_rows": max(10, 2 * candidate.arguments["nx"] + 4)}
    return {}


def halves(count: int) -> tuple[int, ...]:
    """Return the blocks in the order they are tried: every other one first."""
    return (*range(0, count, 2), *range(1, count, 2))


def free_parameters(model: Any) -> int:
    """Return the number of parameters of a model, less those that repeat others (gauge)."""
    shapes = sum(f.basis.size - 1 for f in model.nonlinearities)
    if model.structure != "ss":
        return int(model.a.size + sum(b.size for b in model.b) + model.offset.size + shapes)
    n, signals = len(model.A), model.B.shape[1] + model.E.shape[1]
    direct = np.count_nonzero(np.any(np.c_[model.D, model.Fz] != 0, axis=0)) * model.l
    shapes += sum(f.basis.size - 1 for f in (*model.feedback, *model.latent))
    rows = sum(1 for f in model.latent) * (2 * n + 1)
    return int(n * (model.l + signals) + direct + model.l + shapes + rows)


def _behind(so_far: Mapping[str, Any], rival: Trial) -> bool:
    energy, measure = so_far["energy"], so_far["measure"]
    places = [rival.order.index(b) for b in so_far["order"]]
    ours, theirs = (float(np.sum(e.sum(axis=0) / np.maximum(m.sum(axis=0), 1e-300)))
                    for e, m in ((energy, measure), (rival.energy[places], rival.measure[places])))
    return ours > WORSE * theirs


def _word(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
