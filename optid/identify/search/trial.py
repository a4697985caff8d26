"""The trial of one structure: a fit to the whole record, and cross-validation over the blocks."""

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.bases import feedback_bases, fitted_bases
from optid.data.record import Data
from optid.errors import DataError, OptidError, RankError
from optid.identify.blocks import Blocks, pooled_fit
from optid.identify.fitting import Fit, fit
from optid.identify.search.cpu_limit import OutOfTime, cpu_limit
from optid.models.functions import free_parameters

LINEAR, INPUTS, FEEDBACK, LATENT = KINDS = ("linear", "input functions", "feedback", "latent signals")
"""Classes of models, each richer than those before."""
CLEAR = 0.2  # median over the blocks of the log ratio of error energies that a richer class must save
ASKED = f"{100 * (1 - np.exp(-CLEAR)):.0f} %"  # the same as a share of the energy
EQUAL = 0.02
"""Relative difference of errors within which structures of a class count as equal: the smaller one is chosen."""
SMALL, SMALLER = 0.1, 0.2  # points of fit within which they do, too, where that is no larger share of the error
WORSE = 1.3
"""Ratio of its error energy on the first half of the blocks to that of the best, above which a structure is dropped."""
STARTS = 3  # starts of output-error models in a trial
OPTIONS = {"constraints": "constraint"}  # options of the command line by arguments with another name
LATENT_FITS = ("lfr.exact", "wiener_ss.exact", "hammerstein_wiener_ss.exact")
STATE_FITS = ("ss.exact", "hammerstein_ss.exact", *LATENT_FITS)  # formulations that can begin with a model
CONTINUED: dict[str, dict[str, Any]] = {  # what a fit that goes on from a model need not do
    "lfr.exact": {"tries": 0}, "ss.exact": {"block_rows": ()}, "hammerstein_ss.exact": {"block_rows": ()}}
SUSPECT = 4.0  # ratio of the errors on a block to those of the whole fit above which a fit without it is repeated
STEPS = 30  # iterations of state-space models in a trial
AWAY = 0.5  # ranges of an output by which a model may leave it when the inputs come in other orders
OUT_OF_TIME = "out of time"

Key = tuple[str, tuple[tuple[str, Any], ...]]


@dataclass(frozen=True)
class StructureCandidate:
    """A structure of a class of models, such as "linear": formulation and arguments for `optid.fit`."""

    kind: str
    formulation: str
    arguments: Mapping[str, Any]

    @property
    def key(self) -> Key:
        """Its identity; one value for all channels is the same as a list of equal ones."""
        return self.formulation, tuple(sorted((name, str(_shared(value))) for name, value in self.arguments.items()))

    @property
    def words(self) -> str:
        """The arguments as command-line options."""
        texts = {name: " ".join(map(str, value)) if isinstance(value, list | tuple) else value
                 for name, value in self.arguments.items()}
        return " ".join(f"--{OPTIONS.get(name, name.replace('_', '-'))} {text}" for name, text in texts.items())

    def under(self, constraints: Sequence[Any]) -> dict[str, Any]:
        """Return its arguments with further constraints."""
        whole = (*self.arguments.get("constraints", ()), *constraints)
        return {**self.arguments, **({"constraints": whole} if whole else {})}


def _shared(value: Any) -> Any:
    """Return the one value of a list of equal ones, anything else as it is."""
    return value[0] if isinstance(value, list | tuple) and value and all(one == value[0] for one in value) else value


@dataclass(frozen=True, eq=False)
class Trial:
    """The outcome of a candidate.

    Attributes:
        estimation: fit in % over the same blocks of the model of the whole record.
        energy: (b, l) energy of its errors on the blocks that were tried, in that order.
        measure: (b, l) what it is measured by, see `Blocks.errors`.
        parameters: number of parameters of the model.
        fits: number of fits that were made.
        searches: of them those that began without a model.
        seconds: CPU time.
        status: of the solver on the whole record, or "refused".
        restarted: block without which a better optimum was found, from which the fit to the whole record went on; None
            where there was none.
        reason: why it was dropped, "" where it was tried on every block.
    """

    candidate: StructureCandidate
    estimation: float = -np.inf
    energy: Array = field(default_factory=lambda: np.zeros((0, 1)), repr=False)
    measure: Array = field(default_factory=lambda: np.zeros((0, 1)), repr=False)
    order: tuple[int, ...] = ()
    parameters: int = 0
    fits: int = 0
    searches: int = 0
    seconds: float = 0.0
    status: str = "refused"
    restarted: int | None = None
    reason: str = ""

    @property
    def complete(self) -> bool:
        """Whether it was tried on every block without diverging."""
        return not self.reason

    @property
    def score(self) -> float:
        """Cross-validated fit in %, pooled over the blocks; minus infinity where it was dropped.

        It is at most the fit of the estimation data, which a poor local optimum of the whole record lowers.
        """
        if not self.complete:
            return -np.inf
        if not len(self.energy):  # no structure can be tried on a block of this record
            return self.estimation
        return min(pooled_fit(self.energy, self.measure), self.estimation)

    @property
    def by_block(self) -> Array:
        """Fit in % of the blocks (b,) in their order in the record, by the variance of the whole record."""
        fits = np.array([pooled_fit(e[None], m[None]) for e, m in zip(self.energy, self.measure)])
        return fits[np.argsort(self.order)]

    @property
    def losses(self) -> Array:
        """Relative energy of the errors on the blocks (b,), summed over the outputs, in their order in the record."""
        return np.sum(self.energy / np.maximum(self.measure, 1e-300), axis=1)[np.argsort(self.order)]

    def gains(self, rich: "Trial") -> Array:
        """Return the log ratio of error energies on the blocks of both (b,): what a richer structure saves."""
        common = sorted(set(self.order) & set(rich.order))
        mine, other = (np.array([trial.losses[sorted(trial.order).index(b)] for b in common]) for trial in (self, rich))
        return np.log(np.maximum(mine, 1e-300) / np.maximum(other, 1e-300))

    def gain(self, rich: "Trial") -> float:
        """Return the median of `gains`; minus infinity without any block."""
        gains = self.gains(rich)
        return float(np.median(gains)) if gains.size else -np.inf


def run_trial(candidate: StructureCandidate, blocks: Blocks, rival: Trial | None, settings: Mapping[str, Any],
              constraints: Sequence[Any], horizon: int | None, seconds: float = np.inf) -> Trial:
    """Fit a candidate, cross-validate it block by block, and stop early where it cannot beat its rival.

    The settings are solver and accuracy, the horizon is as in `Blocks.errors`. After so many CPU seconds the trial is
    given up.
    """
    clock, found, fits, searches = time.process_time(), Trial(candidate), 0, 0

    def fit_candidate(data: Any, **more: Any) -> Any:
        nonlocal fits, searches
        if time.process_time() - clock > seconds:  # where nothing interrupts a fit
            raise OutOfTime
        fits, searches = fits + 1, searches + ("initial" not in more)
        return fit(data, candidate.formulation, prove=False, **settings, **{**arguments, **more})

    try:
        with cpu_limit(seconds), warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # the fit that is chosen tells them
            arguments = {**cheap_settings(candidate), **candidate.under(constraints), **_bases(candidate, blocks.data)}
            for known in _steps(found, fit_candidate(blocks.data), fit_candidate, blocks, rival, horizon):
                found = known
                if known.reason:
                    break
    except OutOfTime:
        found = replace(found, reason=OUT_OF_TIME)
    except (OptidError, np.linalg.LinAlgError, ValueError) as error:
        found = replace(found, reason=f"{type(error).__name__}: {error}")
    return replace(found, fits=fits, searches=searches, seconds=time.process_time() - clock)


def _bases(candidate: StructureCandidate, data: Data) -> dict[str, Any]:
    """Return the bases of a candidate on the ranges of the whole record, which a block left out may narrow."""
    found: dict[str, Any] = {}
    if "basis" in candidate.arguments:
        found["basis"] = list(fitted_bases(data, candidate.arguments["basis"]))
    if "feedback_basis" in candidate.arguments:
        found["feedback_basis"] = feedback_bases(data, candidate.arguments["feedback_basis"])
    return found


def _steps(known: Trial, whole: Fit, fitted: Callable[..., Fit], blocks: Blocks, rival: Trial | None,
           horizon: int | None) -> Iterator[Trial]:
    """Yield what is known after the fit to the whole record, and after every block.

    Where a fit without a block finds a better optimum than that to the whole record had, this goes on from it, once,
    and all blocks are left out of the new one.
    """
    errors = [blocks.errors(whole.model, b, horizon) for b in range(len(blocks))]
    energies, measures = map(np.array, zip(*errors))
    known = replace(known, status=whole.solution.status.value, parameters=free_parameters(whole.model),
                    estimation=pooled_fit(energies, measures))
    if rival is not None and (refusal := _no_better(known.candidate, energies, measures, rival)):
        yield replace(known, reason=refusal)
    if leaves(known.candidate, whole.model, blocks, horizon):
        yield replace(known, reason="its free run leaves the range of the outputs when the inputs come otherwise")
    order, refusal = (*blocks.moving[::2], *blocks.moving[1::2]), None  # every other one first
    known = replace(known, energy=np.zeros((0, blocks.data.l)), measure=np.zeros((0, blocks.data.l)), order=())
    for done, b in enumerate(order, start=1):
        try:
            found, searched = _left_out(known.candidate, fitted, blocks, b, horizon, whole.model, energies[b])
            if searched and known.restarted is None:
                again = whole
                with suppress(OptidError):
                    again = continue_fit(known.candidate, fitted, blocks.data, found.model)
                if again.solution.objective < (1 - EQUAL) * whole.solution.objective:
                    yield from _steps(replace(known, restarted=b), again, fitted, blocks, rival, horizon)
                    return
            energy, measure = blocks.errors(found.model, b, horizon)
        except (RankError, DataError) as error:  # what is left of the record does not determine the structure
            refusal = error
            continue
        known = replace(known, energy=np.vstack([known.energy, energy]), measure=np.vstack([known.measure, measure]),
                        order=(*known.order, b))
        if not np.isfinite(energy).all():
            yield replace(known, reason=f"its simulation diverges in block {b + 1}")
        if rival is not None and 2 * done == len(order):
            both = [one for one in known.order if one in rival.order]
            if both and _on(known, both) > WORSE * _on(rival, both):
                yield replace(known, reason="worse than the best on the first half of the blocks")
    if refusal is not None and not known.order and rival is not None and rival.order:
        yield replace(known, reason=f"it cannot be cross-validated: {refusal}")
    yield known


def leaves(candidate: StructureCandidate, model: Any, blocks: Blocks, horizon: int | None) -> bool:
    """Whether free runs of a model with functions of outputs or latent signals leave what these were fitted to."""
    return horizon is None and candidate.kind in (FEEDBACK, LATENT) and blocks.excursion(model) > AWAY


def _no_better(candidate: StructureCandidate, energies: Array, measures: Array, rival: Trial) -> str:
    """Return why a model of the whole record, by its errors on the blocks (b, l), cannot replace a rival; "" if it can.

    The errors on a block are seldom smaller where the block is left out.
    """
    if pooled_fit(energies, measures) < rival.score - near(rival.score):
        return "its fit of the estimation data is below the cross-validated fit of the best"
    richer = KINDS.index(candidate.kind) > KINDS.index(rival.candidate.kind)
    here = list(rival.order)
    gain = rival.gain(Trial(candidate, energy=energies[here], measure=measures[here], order=rival.order))
    if richer and here and gain <= CLEAR:
        return (f"it follows the record with {100 * (1 - np.exp(-max(gain, 0.0))):.0f} % less error energy than the "
                f"best {rival.candidate.kind} model is predicted to, in the median block; {ASKED} is asked for")
    return ""


def continue_fit(candidate: StructureCandidate, fitted: Callable[..., Fit], data: Data, model: Any) -> Fit:
    """Return the fit of a candidate that goes on from a model of the same structure."""
    return fitted(data, initial=model, **CONTINUED.get(candidate.formulation, {}))


def _left_out(candidate: StructureCandidate, fitted: Callable[..., Fit], blocks: Blocks, block: int,
              horizon: int | None, whole: Any, reached: Array) -> tuple[Fit, bool]:
    """Return the fit to all other blocks, which descends from the model of the whole record.

    Functions of latent signals have many optima: where the block is much worse than in the fit to the whole record,
    they are searched for in the others alone, too, and the better fit to these counts. With it, whether it is that one.
    """
    data, latent = blocks.without(block), candidate.formulation in LATENT_FITS
    if candidate.formulation not in STATE_FITS:
        return fitted(data), False
    try:
        found = continue_fit(candidate, fitted, data, whole)
    except RankError:  # no run from it stays finite
        if not latent:
            raise
        return fitted(data), True
    if latent and not np.sum(blocks.errors(found.model, block, horizon)[0]) <= SUSPECT * np.sum(reached):
        again = fitted(data)
        if again.solution.objective < found.solution.objective:
            return again, True
    return found, False


def _on(trial: Trial, blocks: Sequence[int]) -> float:
    """Return the error energy of a trial on some blocks, over what it is measured by."""
    places = [trial.order.index(one) for one in blocks]
    energy, measure = trial.energy[places], trial.measure[places]
    return float(np.sum(energy.sum(axis=0) / np.maximum(measure.sum(axis=0), 1e-300)))


def near(score: float) -> float:
    """Return how far below a score in % another one counts as equal."""
    return max(EQUAL * (100 - score), min(SMALL, SMALLER * (100 - score)))


def cheap_settings(candidate: StructureCandidate) -> dict[str, Any]:
    """Return the arguments that make a trial faster than the final fit."""
    if candidate.formulation.endswith("oe.exact"):
        return {"starts": STARTS}
    if candidate.formulation in STATE_FITS:
        once: dict[str, Any] = {"tries": 1} if candidate.formulation == "lfr.exact" else {}
        if candidate.formulation in ("ss.exact", "hammerstein_ss.exact", "lfr.exact") and (
                candidate.arguments.get("criterion") != "prediction"):
            once["weighting"] = "scale"  # as the errors on the blocks are measured
        return {"iterations": STEPS, "block_rows": max(10, 2 * candidate.arguments["nx"] + 4), **once}
    return {}
