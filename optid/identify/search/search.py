"""From a record to a model: structures of every class are compared by cross-validation, and the choice is explained."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optid.arrays import LARGEST, check_integer, is_number, one_of, short_repr
from optid.backends.back_end import Settings
from optid.data.record import Data, not_a_record
from optid.data.reduction import available_cores
from optid.errors import DataError, OptidError, RankError, SolverFailed, StructureError
from optid.identify.blocks import Blocks, stretches
from optid.identify.fitting import Fit, fit
from optid.identify.search.determined import binary
from optid.identify.search.effort import effort_of, units
from optid.identify.search.kept import KeptTrials
from optid.identify.search.ladder import RUNGS, Ladder
from optid.identify.search.pool import TrialPool
from optid.identify.search.trial import (
    ASKED,
    CLEAR,
    EQUAL,
    FEEDBACK,
    INPUTS,
    KINDS,
    LATENT,
    LINEAR,
    OUT_OF_TIME,
    StructureCandidate,
    Trial,
    cheap_settings,
    continue_fit,
    leaves,
    run_trial,
)
from optid.identify.verdict import Verdict
from optid.packing import Unsendable, pack
from optid.progress import Meter, log
from optid.registry import Rendered, read_constraints
from optid.threads import one_thread

BUDGET, INTERRUPT = "the budget", "an interrupt"
Runs = Callable[[Sequence[StructureCandidate], Trial | None], list[Trial | None]]
# samples of a long record on which structures are compared, and up to which a record is not long: stretches cut out of
# it lose their beginnings, and with them more than a shorter trial saves
COMPARED, LONG = 5_000, 8_000
FIRST = 0.15  # share of the effort that linear models have before the others begin
MANY = 3.0  # effort for latent signals, of which there are most structures, over that of another class
LEADING = 2.0  # the same for the class of the best model so far
TURN = 0.05  # share of the effort that a class has at a time
LARGEST_SHARE = 0.4  # of the effort that one trial may take, after the first


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Rendered):
    """What `identify` found; `print` it.

    Attributes:
        fit: the chosen structure, fitted to the whole record.
        chosen: its trial.
        best: the best trial of every class that had one, by class.
        trials: all of them, in the order in which they were made.
        reasons: why this one, a sentence each.
        horizon, blocks: as in `identify`.
        stopped: what ended the search early, or "".
        units: effort that was spent.
        seconds: wall time.
    """

    fit: Fit
    chosen: Trial
    best: Mapping[str, Trial] = field(repr=False)
    trials: tuple[Trial, ...] = field(repr=False)
    reasons: tuple[str, ...] = field(repr=False)
    horizon: int | None
    blocks: int
    stopped: str
    units: float
    seconds: float

    @property
    def model(self) -> Any:
        """The model, in raw units."""
        return self.fit.model

    @property
    def ended(self) -> str:
        """What ended the search early, and how it goes on; "" where every class came to its end."""
        return self.stopped and (
            f"the search was ended by {self.stopped} after {len(self.trials)} trials: more effort may find a better "
            "structure (--effort large; from a file of --trials it goes on where it was)")

    @property
    def verdict(self) -> Verdict:
        """The quality of the model on the record, by cross-validation; that of the fit."""
        return self.fit.verdict


@one_thread
def identify(data: Data, *, effort: str | float = "normal", budget: float | None = None, horizon: int | None = None,
             blocks: int = 4, classes: Sequence[str] = KINDS, constraints: Sequence[Any] = (), solver: Any = "auto",
             accuracy: float = 1e-8, workers: int | None = None, trials: str | Path | None = None,
             progress: Callable[[str], None] | None = None) -> Identification:
    """Find a structure for a record by blocked cross-validation, and fit it to the whole record.

    Every structure is fitted to the record without one block at a time and simulated over the block left out; the
    initial state is estimated from the block and as many samples around it. Classes of models are tried
    from the simple to the rich; a richer one is chosen only where the pooled fit improves and the median over the
    blocks of the log ratio of error energies exceeds 0.2. A model whose simulation diverges in a block is never chosen,
    nor one with feedback or functions of latent signals that leaves the range of the outputs by half of it when the
    inputs come in other orders. The trials, and with them the model, depend on the record and the arguments alone, not
    on the machine or the number of processes. An interrupt (Ctrl-C) ends the search with the best so far.
    At irregular times processes in continuous time are all that is tried.

    Args:
        data: the record.
        effort: "small", "normal", "large", or a number of units, of which each is about a CPU second; every trial has a
            declared price in them (`optid.identify.search.effort`).
        budget: CPU seconds after which the search ends wherever it is; None for no such stop.
        horizon: compare predictions so many samples ahead; None compares free runs.
        blocks: number of contiguous blocks.
        classes: of "linear", "input functions", "feedback", "latent signals", those to be tried.
        constraints: as in `optid.fit`; every candidate satisfies them.
        solver: name of the back end, for every programme.
        accuracy: as in `optid.fit`.
        workers: number of processes; constraints must then be importable. None for one per available processor, or one
            alone if something cannot be sent to others (see ``reasons``).
        trials: file in which finished trials are kept; a search that was stopped goes on from there.
        progress: called with a sentence after every trial; default a progress bar on a terminal, and a line for every
            class in the log "optid" (every trial at level DEBUG).

    Raises:
        DataError: the record is not in memory; the file of `trials` belongs to another search.
        RankError: the record is too short for the blocks.
        StructureError: invalid arguments, or constraints that cannot be sent to `workers`.
        SolverFailed: no structure could be fitted; with the most frequent reason.
    """
    clock = time.monotonic()
    if not isinstance(data, Data):
        raise DataError(f"{not_a_record(data, 'identify')} A search fits a record many times, in memory.")
    most = effort_of(effort)
    if budget is not None and (not is_number(budget) or not budget > 0 or LARGEST < budget < np.inf):
        raise StructureError(f"budget must be a positive number of seconds; got {short_repr(budget)}")
    Settings(accuracy)  # every trial would refuse it
    for word in classes:
        one_of("classes", word, KINDS)
    if horizon is not None:
        check_integer(horizon, "horizon")
    rules = read_constraints(constraints)
    compared = data if data.n_samples <= LONG else stretches(data, COMPARED)
    cut = Blocks.of(compared, blocks)
    ladder, stopped = Ladder.of(cut, data.n_experiments > 1), ""
    unfinished: Sequence[str] = ()
    limits = dict(_limits(ladder))
    possible = [kind for kind in KINDS if kind in classes and kind not in limits]
    if not possible:
        raise StructureError(f"{next(limits[kind] for kind in classes)}: add 'linear' to the classes")
    if horizon is None and not ladder.open:
        horizon = 1  # a free run says nothing about the plant where the input answers the noise
    kept = KeptTrials(trials, data, {"blocks": blocks, "horizon": horizon, "constraints": [
        getattr(rule, "name", rule) for rule in rules], "solver": solver, "accuracy": accuracy})
    pool = TrialPool(partial(_attempt, cut, {"solver": solver, "accuracy": accuracy}, rules, horizon),
                     available_cores(workers, "workers"))
    alone = pool.reason and (_unsendable(rules, solver) or pool.reason)
    if alone and workers is not None:
        raise StructureError(f"workers={workers!r}: {alone}, or use workers=1")
    begun = time.process_time()

    def seconds_left() -> float:
        if budget is None or ladder.choice() is None:  # a model is worth more than the budget
            return np.inf
        elsewhere = sum(trial.seconds for trial in ladder.trials.values()) if pool.apart else 0.0
        return budget - (time.process_time() - begun) - elsewhere

    meter = Meter("search", most, lambda: sum(ladder.spent.values()))
    with meter if progress is None else nullcontext(progress) as told:
        try:
            run = partial(_run, pool, kept, seconds_left, partial(_told, ladder, told, most))
            stopped, unfinished = _climb(ladder, possible, run, most, seconds_left)
            for kind in possible:
                log.info("search: %s", _summary(ladder, kind))
            if stopped == BUDGET:
                stopped = f"the budget of {budget:g} CPU s"
        except KeyboardInterrupt:
            stopped = INTERRUPT
        finally:
            pool.close()
    best = {kind: trial for kind in KINDS if (trial := ladder.best(kind)) is not None}
    chosen = ladder.choice()
    if chosen is None:
        raise _nothing(list(ladder.trials.values()))
    found = _refitted(chosen, data, cut, horizon, {"solver": solver, "accuracy": accuracy, "constraints": rules})
    found = replace(found, cross_validated=(tuple(chosen.by_block.tolist()), chosen.score))
    why = reasons(ladder, best, unfinished)
    if compared is not data:
        why.append(f"structures were compared on {compared.n_samples} of {data.n_samples} samples, in "
                   f"{compared.n_experiments} stretches; the one that was chosen is fitted to all")
    if ladder.levels is not None:
        why.append(str(ladder.levels))
    why += dict.fromkeys(limits[kind] for kind in classes if kind in limits)
    if alone:
        why.append(f"the search worked in one process: {alone}")
    return Identification(found, chosen, best, tuple(ladder.trials.values()), tuple(why), horizon, blocks,
                          stopped, sum(ladder.spent.values()), time.monotonic() - clock)


def _limits(ladder: Ladder) -> Iterator[tuple[str, str]]:
    """Yield the classes that the record cannot tell from others, with the reason."""
    kinds, reason = KINDS[1:], ""
    if not ladder.data.is_regular:
        kinds = kinds if ladder.few_moves else (FEEDBACK, LATENT)
        reason = ("samples at irregular times: only processes in continuous time were compared (where rows were lost, "
                  "read the record with --gaps missing)")
    elif ladder.told.reason:
        reason = "nothing can be identified from this record: only the simplest model was fitted"
    elif ladder.few_moves:
        moves = ladder.told.moves
        reason = (f"an input moves {'once' if moves == 1 else f'{moves} times'}: only linear models can be "
                  "distinguished, order and dead time were chosen by the Bayesian information criterion")
    elif not ladder.open:
        kinds = (FEEDBACK, LATENT)
        reason = "closed loop: only models with a noise model were compared, one sample ahead"
    if reason:
        yield from ((kind, reason) for kind in kinds)
    if not (reason and INPUTS in kinds) and binary(ladder.data):
        yield INPUTS, "no input has more than two levels: static functions of the inputs are straight lines"


def _climb(ladder: Ladder, kinds: Sequence[str], run: Runs, most: float, left: Callable[[], float]
           ) -> tuple[str, tuple[str, ...]]:
    """Try structures until no class has more, the effort is spent, or no CPU second is left.

    Return what ended the search early, or "", and the classes that had more.

    The low orders found in the record come first, without and with functions of the inputs; then linear models, for a
    share of the effort; then the class that has had the least for its kind. Of a batch, as much is tried at a time as
    costs a small share of the effort, so that no class waits for expensive structures of another.
    """
    early = [kind for kind in (LINEAR, INPUTS) if kind in kinds and ladder.told.processes and ladder.data.l == 1]
    rungs = {kind: RUNGS[kind](ladder) for kind in kinds}
    batches: dict[str, list[StructureCandidate]] = {}
    waiting: dict[str, list[StructureCandidate]] = {}  # of the batch of a class, those that are not tried yet
    spent = ladder.spent
    while rungs:
        if not early and ladder.choice() is not None and sum(spent.values()) >= most:
            return f"its effort of {most:g} units", tuple(rungs)
        if left() <= 0:
            return BUDGET, tuple(rungs)
        kind = early[0] if early else (
            LINEAR if LINEAR in rungs and spent[LINEAR] < FIRST * most
            else min(rungs, key=lambda one: spent[one] / _share(ladder, one)))
        try:
            if kind not in batches:
                batches[kind] = _different(ladder, next(rungs[kind]))
                waiting[kind] = [c for c in batches[kind] if c.key not in ladder.trials]
            prices = np.cumsum([units(c, ladder.data, 1 + ladder.folds) for c in waiting[kind]])
            count = max(int(np.sum(prices <= TURN * most)), 1)
            _tried(ladder, kind, waiting[kind][:count], run, most)
            waiting[kind] = waiting[kind][count:]
            if not waiting[kind]:
                early = [one for one in early if one != kind]
                batches[kind] = _different(ladder, rungs[kind].send([ladder.trials[c.key] for c in batches[kind]]))
                waiting[kind] = [c for c in batches[kind] if c.key not in ladder.trials]
        except StopIteration:
            early = [one for one in early if one != kind]
            del rungs[kind]
    return "", ()


def _share(ladder: Ladder, kind: str) -> float:
    """Return the effort that a class may have, over that of others."""
    chosen = ladder.choice()
    leads = chosen is not None and chosen.candidate.kind == kind
    return (MANY if kind == LATENT else 1.0) * (LEADING if leads else 1.0)


def _different(ladder: Ladder, batch: Sequence[StructureCandidate]) -> list[StructureCandidate]:
    """Return the candidates of a batch, each once."""
    return list({c.key: c for c in map(ladder.with_levels, batch)}.values())


def _tried(ladder: Ladder, kind: str, batch: Sequence[StructureCandidate], run: Runs, most: float) -> None:
    """Try candidates of a class against its best so far, and put their trials down in the order of the batch."""
    rival, tasks = ladder.rival(kind), []
    for candidate in batch:
        price = units(candidate, ladder.data, 1 + ladder.folds)
        if rival is not None and price > LARGEST_SHARE * most:
            ladder.trials[candidate.key] = Trial(candidate, reason=f"it costs {price:.0f} units, more than "
                                                                   f"{100 * LARGEST_SHARE:.0f} % of the effort")
        else:
            tasks.append(candidate)
    for candidate, trial in zip(tasks, run(tasks, rival)):
        ladder.trials.pop(candidate.key, None)
        ladder.trials[candidate.key] = trial or Trial(candidate, reason=OUT_OF_TIME)
        ladder.spent[kind] += units(candidate, ladder.data, trial.fits, trial.searches) if trial else 0.0


def _run(pool: TrialPool, kept: KeptTrials, left: Callable[[], float], told: Callable[[Trial], None],
         batch: Sequence[StructureCandidate], rival: Trial | None) -> list[Trial | None]:
    """Return the trials of candidates against a rival, kept ones or new; None where no time was left."""
    known = [kept.find_trial(candidate, rival) for candidate in batch]
    new = pool.run([(candidate, rival) for candidate, trial in zip(batch, known) if trial is None], left, told)
    kept.keep([trial for trial in new if trial is not None], rival)
    rest = iter(new)
    return [next(rest) if trial is None else trial for trial in known]


@one_thread
def _attempt(blocks: Blocks, settings: Mapping[str, Any], rules: Sequence[Any], horizon: int | None,
             task: tuple[StructureCandidate, Trial | None], seconds: float) -> Trial:
    """Try a candidate against a rival, for so many CPU seconds at most."""
    candidate, rival = task
    return run_trial(candidate, blocks, rival, settings, rules, horizon, seconds)


def _unsendable(rules: Sequence[Any], solver: Any) -> str:
    """Return which constraint or solver cannot be sent to another process, and the remedy; "" if all can."""
    for what, one in (*(("constraint", rule) for rule in rules), ("solver", solver)):
        try:
            pack(one)
        except Unsendable as refusal:
            return f"{what} {getattr(one, 'name', getattr(one, '__name__', repr(one)))!r}: {refusal}"
    return ""


def reasons(ladder: Ladder, best: Mapping[str, Trial], open_kinds: Sequence[str] = ()) -> list[str]:
    """Say of every class what it gained over the one chosen before, how sure that is, and what was not reached."""
    found: list[str] = []
    current: Trial | None = None
    for kind, trial in best.items():
        if current is None:
            found.append(f"{kind}: {trial.score:.1f} % by cross-validation")
            current = trial
            continue
        sentence = f"{kind}: {trial.score:.1f} % against {current.score:.1f} %, with {_saved(current, trial)}"
        if trial.score > current.score and current.gain(trial) > CLEAR:
            found.append(f"{sentence}: selected")
            current = trial
        elif trial.score > current.score and current.gain(trial) > 0:
            found.append(f"{sentence}; at least {ASKED} less is asked for: not selected")
        else:
            found.append(f"{sentence}: not selected")
    tried_of = {kind: [t for t in ladder.trials.values() if t.candidate.kind == kind] for kind in KINDS}
    for kind, several in tried_of.items():
        if kind not in best and several:
            nearest = max(several, key=lambda t: t.estimation)
            found.append(f"{kind}: none of {len(several)} structures could be better than the chosen one; of the one "
                         f"that fits best, {nearest.candidate.formulation} {nearest.candidate.words}: {nearest.reason}")
    if open_kinds:
        parts = [f"{kind} {f'ended after {len(tried_of[kind])} structures' if tried_of[kind] else 'not reached'}"
                 for kind in KINDS if kind in open_kinds]
        found.append(f"{', '.join(parts)}: a larger effort goes on")
    return found


def _saved(plain: Trial, rich: Trial) -> str:
    """Say how much less error energy a richer structure leaves in the median block, and how sure that is."""
    gains = plain.gains(rich)
    saved = float(np.median(gains)) if gains.size else -np.inf
    share = 100 * (1 - np.exp(-saved)) if saved >= 0 else 100 * (np.exp(min(-saved, 100.0)) - 1)
    words = f"{share:.0f} % {'less' if saved >= 0 else 'more'} error energy in the median block"
    spread = float(np.std(gains, ddof=1)) if gains.size > 1 else 0.0
    return words + (f" ({abs(float(np.mean(gains))) / spread:.1f} times the spread over the blocks)" if spread else "")


def _refitted(chosen: Trial, data: Data, blocks: Blocks, horizon: int | None, settings: dict[str, Any]) -> Fit:
    """Fit a structure to the whole record with all its starts; as on trial where that follows the record better."""
    candidate = chosen.candidate
    arguments = candidate.under(settings.pop("constraints"))
    with suppress(OptidError):  # its starts may all leave their range, where the fewer ones of the trial did not
        found = fit(data, candidate.formulation, **settings, **arguments)
        as_good = 100 - blocks.fit(found.model, horizon) <= (1 + EQUAL) * (100 - chosen.estimation)
        if as_good and not leaves(candidate, found.model, blocks, horizon):
            return found

    def as_tried(record: Data, **more: Any) -> Fit:
        return fit(record, candidate.formulation, **settings, **{**cheap_settings(candidate), **arguments, **more})

    if chosen.restarted is None:
        return as_tried(data)
    return continue_fit(candidate, as_tried, data, as_tried(blocks.without(chosen.restarted)).model)


def _told(ladder: Ladder, progress: Callable[[str], None], most: float, trial: Trial) -> None:
    ladder.trials[trial.candidate.key] = trial  # also what an interrupt leaves
    outcome = f"{trial.score:.1f} %" if np.isfinite(trial.score) else trial.reason
    progress(f"{sum(ladder.spent.values()):.0f} of {most:g} units, {trial.candidate.kind}: "
             f"{trial.candidate.formulation} {trial.candidate.words}: {outcome}")


def _summary(ladder: Ladder, kind: str) -> str:
    """Say how many structures of a class were tried, how good the best was and what all cost."""
    count, best = sum(t.candidate.kind == kind for t in ladder.trials.values()), ladder.best(kind)
    reached = f"best {best.score:.1f} %" if best is not None else "none could be better"
    return f"{kind}: {count} structures, {reached}, {ladder.spent[kind]:.1f} units"


def _nothing(trials: Sequence[Trial]) -> Exception:
    if not trials:
        return RankError("no structure was tried: the budget ended before the first one was fitted")
    words = [t.reason for t in trials]
    common = max(set(words), key=words.count)
    return SolverFailed(f"none of {len(trials)} structures could be fitted and cross-validated; most often: {common}")
