"""The structures that a search tries, class by class, from the simple to the rich.

Every rung is a generator: it yields independent candidates together and receives their trials, so that it increases
orders only as long as the fit improves, and of nonlinear structures only where one may be chosen. Later rungs start
from the best structures of earlier ones.
"""

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.errors import OptidError, RankError
from optid.identify.blocks import Blocks
from optid.identify.informativity import Informativity, Process, informativity
from optid.identify.lag_sums import LagSums, scan
from optid.identify.levels import LevelEvidence, level_evidence
from optid.identify.process.order import best_basis, choose_types
from optid.identify.process.record import process_errors
from optid.identify.search.determined import determined_bases
from optid.identify.search.trial import CLEAR, FEEDBACK, INPUTS, KINDS, LATENT, LINEAR, StructureCandidate, Trial, near

Rung = Generator[list[StructureCandidate], list[Trial], None]

ONE_LEVEL = ("hammerstein_ss.sid",)  # formulations with one constant for all experiments, beside feedback and latent
PATIENCE = 2  # successive orders without improvement after which a rung ends
LARGEST, MOST_LATENT = 10, 8  # largest number of states, and that beside functions of latent signals
MOST_CHANNELS = 3  # latent signals
SAME_ORDER = 0.003  # relative difference of errors within which linear models say the same of the order
RISE = 0.95  # ratio of the errors on the record above which one more latent signal, or a richer class, has not helped
SMOOTH, FLEXIBLE, ENOUGH = "polynomial:3", "bspline:8", 1000
"""First basis of latent functions on short records, that on records of so many samples."""
FEW_MOVES = 8
"""Moves of an input below which order and dead time are chosen by the likelihood: blocks without moves say little."""
FINEST = 0.01  # share of the error (100 % less the cross-validated fit) that counts as an improvement


@dataclass
class Ladder:
    """The record, its delays, and all trials so far."""

    data: Data
    folds: int  # fits of a trial after the first
    told: Informativity  # what it can tell
    delays: list[tuple[int, ...]]  # combinations of delays of the inputs: none, and those found
    regressions: list[tuple[int, int, tuple[int, ...]]]  # orders (na, nb, nk) of the best autoregressions
    trials: dict[Any, Trial]  # all trials so far, by key
    levels: LevelEvidence | None = None  # the evidence for levels of the experiments; None for one experiment
    spent: dict[str, float] = field(default_factory=lambda: dict.fromkeys(KINDS, 0.0))  # units of effort, by class

    @classmethod
    def of(cls, blocks: Blocks, several: bool = False) -> "Ladder":
        """Look for delays and orders of autoregressions in the sums of the record, and for levels of several runs."""
        data, told = blocks.data, informativity(blocks.data)
        if not data.is_regular:  # no lags can be compared
            return cls(data, len(blocks.moving), told, [], [], {})
        sums = LagSums(blocks)
        delays = [(told.least,) * data.m]
        if told.processes:
            delays = list(dict.fromkeys([*delays, told.lags]))
        regressions = [one[1:] for delay in delays for one in scan(sums, [delay])[:1]]
        levels = None
        if several:
            with suppress(OptidError):  # too short for a regression: one level then
                levels = level_evidence(data, list(delays[-1]))
        return cls(data, len(blocks.moving), told, delays, regressions, {}, levels)

    def with_levels(self, candidate: StructureCandidate) -> StructureCandidate:
        """Return a candidate with a level for every experiment, where the record has them and the method knows them."""
        if not self.levels_differ or candidate.kind in (FEEDBACK, LATENT) or candidate.formulation in ONE_LEVEL:
            return candidate
        return replace(candidate, arguments={**candidate.arguments, "offset": "each"})

    @property
    def levels_differ(self) -> bool:
        """Whether every experiment has its own level."""
        return self.levels is not None and self.levels.offset == "each"

    def bases(self, word: str) -> Any:
        """Return a basis for all inputs, with as many functions as the samples of each determine."""
        return determined_bases(self.data, word, apart=self.levels_differ)

    @property
    def few_moves(self) -> bool:
        """Whether an input moves so rarely, or the record tells so little, that only low orders can be told apart."""
        told = bool(self.told.processes) or not self.data.is_regular
        return bool(self.told.reason) or (told and self.told.moves < FEW_MOVES)

    @property
    def open(self) -> bool:
        """Whether the outputs do not act on the inputs."""
        return self.told.loop.word == "open"

    def best(self, kind: str, *formulations: str) -> Trial | None:
        """Return the best complete trial of a class, or of some formulations of it."""
        found = [t for t in self.trials.values() if t.candidate.kind == kind and np.isfinite(t.score)
                 and (not formulations or t.candidate.formulation in formulations)]
        most = max((t.score for t in found), default=0.0)
        equal = [t for t in found if t.score >= most - near(most)]
        return min(equal, key=lambda t: (t.parameters, -t.score), default=None)

    def choice(self) -> Trial | None:
        """Return the choice so far: a richer class must be clearly better."""
        chosen = None
        for best in filter(None, map(self.best, KINDS)):
            if chosen is None or (best.score > chosen.score and chosen.gain(best) > CLEAR):
                chosen = best
        return chosen

    def rival(self, kind: str) -> Trial | None:
        """Return the trial to beat for a class; linear models are compared among themselves."""
        found = [self.best(kind), None if kind == LINEAR else self.choice()]
        return max(filter(None, found), key=lambda t: t.score, default=None)

    def leading(self, kind: str, *formulations: str) -> Trial | None:
        """Return the best trial of a class; where none is complete, the one that fits the record best."""
        found = [t for t in self.trials.values() if t.candidate.kind == kind and np.isfinite(t.estimation)
                 and (not formulations or t.candidate.formulation in formulations)]
        return self.best(kind, *formulations) or max(found, key=lambda t: t.estimation, default=None)

    def follows(self, kind: str, *formulations: str) -> bool:
        """Whether a structure of a class follows the record by much better than the choice does, or is the choice."""
        chosen, leading = self.choice(), self.leading(kind, *formulations)
        return chosen is None or chosen.candidate.kind == kind or (
            leading is not None and 100 - leading.estimation <= RISE * (100 - chosen.estimation))

    def arguments(self, kind: str, *formulations: str) -> Mapping[str, Any]:
        """Return the arguments of the leading structure of a class, or of formulations of it; none without any."""
        leading = self.leading(kind, *formulations)
        return {} if leading is None else leading.candidate.arguments

    def order(self) -> int:
        """Return the number of states of the best linear model: the smallest whose errors are hardly larger."""
        several = [t for t in self.trials.values() if t.candidate.kind == LINEAR and np.isfinite(t.score)
                   and t.candidate.formulation in ("ss.exact", "hammerstein_ss.sid")]
        several = [t for t in several if "criterion" not in t.candidate.arguments] or several  # states of the noise
        least = min((100 - t.score for t in several), default=0.0)
        return min((int(t.candidate.arguments["nx"]) for t in several if 100 - t.score <= (1 + SAME_ORDER) * least),
                   default=2)


def climb(candidates: Iterable[list[StructureCandidate]]) -> Rung:
    """Try one batch after another until two in a row bring no improvement: of the score, or without one of the fit."""
    best, failed = (False, -np.inf), 0
    for batch in candidates:
        found = yield batch
        reached = max(((t.complete, t.score if t.complete else t.estimation) for t in found), default=(False, -np.inf))
        least = (FINEST if reached[0] else 1 - RISE) * (100 - max(best[1], 0.0))
        rises = reached[0] > best[0] or reached > best and not reached[1] <= best[1] + least
        best, failed = max(best, reached), 0 if rises else failed + 1
        if failed >= PATIENCE:
            return


def linear_models(ladder: Ladder) -> Rung:
    """The low-order model found in the record, autoregressions, subspace and output-error models, and refinements."""
    model = partial(structure, LINEAR)
    if not ladder.data.is_regular:
        yield [processes_by_criterion(ladder, LINEAR)]
        return
    if ladder.data.l == 1 and ladder.told.processes:
        if ladder.few_moves and ladder.open:
            found = yield list(process_models(ladder))
            if any(trial.complete for trial in found):  # a finer dead time than a sample, in the terms of the plant
                return
        yield list(low_order(ladder))
        if ladder.few_moves:
            return
    yield [model("arx", na=na, nb=nb, nk=list(nk)) for na, nb, nk in ladder.regressions]
    if not ladder.open:  # others assume that the input does not depend on the noise
        yield from _in_a_loop(ladder)
        return
    yield from climb([model("hammerstein_ss.sid", nx=n, basis="linear")] for n in range(1, LARGEST + 1))
    if ladder.data.l > 1:
        n = int(ladder.arguments(LINEAR, "hammerstein_ss.sid").get("nx", 2))
        yield [model("ss.exact", nx=k) for k in dict.fromkeys([n, 2])]
        yield from climb([model("ss.exact", nx=k)] for k in range(n + 1, min(n + 3, LARGEST) + 1))
        # free runs leave coloured errors whose weight a noise model would lower
        yield from climb([model("ss.exact", nx=k, criterion="prediction")] for k in range(2, LARGEST + 1))
        return
    yield from climb([model("oe.exact", na=n, nb=n, nk=list(ladder.delays[-1]))] for n in range(1, 8))
    if a := ladder.arguments(LINEAR, "oe.exact"):  # fewer zeros, and other delays
        n = a["na"]
        yield [*(model("oe.exact", na=n, nb=nb, nk=list(a["nk"])) for nb in dict.fromkeys([1, max(n - 1, 1), n + 2])),
               *(model("oe.exact", na=n, nb=n + 1, nk=list(nk)) for nk in ladder.delays[:-1])]
    if a := ladder.arguments(LINEAR, "oe.exact"):
        yield [model("bj.exact", na=n, nb=a["nb"], nk=a["nk"], nc=1, nd=1)
               for n in dict.fromkeys([max(a["na"] - 1, 1), a["na"], a["na"] + 1])]


def processes_by_criterion(ladder: Ladder, kind: str, bases: Sequence[Any] = ("linear",)) -> StructureCandidate:
    """Return processes with the basis, and of the types for all pairs, that the Bayesian information criterion chooses.

    The errors raised are those of `choose_types`.
    """
    errors = [process_errors(ladder.data, "P1D", basis, initial="free") for basis in bases]
    place = best_basis(errors)
    words = [one.word for one in choose_types(errors[place])[0].unknowns.structures]
    curve = {} if bases[place] == "linear" else {"basis": bases[place]}
    return structure(kind, "process.exact", process=words, initial="free", **curve)


def process_models(ladder: Ladder) -> Iterator[StructureCandidate]:
    """Yield processes in continuous time with as many poles as were found, and with one less or more."""
    responses = ladder.told.processes[0].responses
    if any(r.nodes is not None for r in responses):  # a bent f is a matter of richer classes
        return
    for more in (0, -1, 1):
        words = []
        for response in responses:
            poles = response.poles[response.poles != 1]
            count = min(max(poles.size + more, int(not response.integrates)), 3)
            pair = count == 2 and bool(np.any(np.iscomplex(poles)))
            words.append(f"P{count}D{'I' * response.integrates}{'U' * pair}")
        yield structure(LINEAR, "process.exact", process=words, initial="free")


def low_order(ladder: Ladder) -> Iterator[StructureCandidate]:
    """Yield the model of the dead times and poles that were found in a record of one output."""
    process = ladder.told.processes[0]
    orders = _orders(process)
    if ladder.open:
        yield structure(LINEAR, "oe.exact", **orders)
        return
    nd = max(process.noise.size - 1, 1)
    for nc, d in dict.fromkeys([(0, nd), (0, 1), (1, 1)]):
        yield structure(LINEAR, "bj.exact", **orders, nc=nc, nd=d)


def _orders(process: Process) -> dict[str, Any]:
    """Return the arguments of a transfer function with the poles and lags of a process."""
    several = process.responses
    found: dict[str, Any] = {"na": max(r.poles.size for r in several), "nb": [r.b.size for r in several],
                             "nk": [r.nk for r in several]}
    if all(r.integrates for r in several):
        found["constraints"] = ("integrator",)
    return found


def _in_a_loop(ladder: Ladder) -> Rung:
    """Yield models with a noise model, whose inputs act one sample later at the earliest."""
    model = partial(structure, LINEAR)
    if ladder.data.l == 1:
        delay = list(ladder.delays[-1])
        yield from climb([model("bj.exact", na=n, nb=n, nk=delay, nc=1, nd=1),
                          model("armax.exact", na=n, nb=n, nk=delay, nc=n)] for n in range(1, 5))
    else:
        yield from climb([model("ss.exact", nx=n, criterion="prediction", feedthrough=False)]
                         for n in range(1, LARGEST + 1))


def input_functions(ladder: Ladder) -> Rung:
    """Static functions of the inputs before linear dynamics."""
    words = [ladder.bases(word) for word in ("polynomial:3", "triangular:6")]
    if not ladder.data.is_regular:
        more = [ladder.bases(word) for word in ("triangular:8", "triangular:10")]
        with suppress(RankError):  # too few samples for functions of the inputs: straight lines are left
            yield [processes_by_criterion(ladder, INPUTS, [*words, *more])]
        return
    if ladder.data.l > 1:
        yield from _of_several_outputs(ladder, words)
        return
    if not ladder.open:
        a = ladder.arguments(LINEAR, "bj.exact") or {"na": 2, "nb": 2, "nk": list(ladder.delays[-1]), "nc": 0, "nd": 1}
        yield [structure(INPUTS, "hammerstein_bj.exact", **a, basis=word) for word in words]
        return

    def model(n: int, nk: Sequence[int], basis: Any) -> StructureCandidate:
        return structure(INPUTS, "hammerstein_oe.exact", na=n, nb=n, nk=list(nk), basis=basis)

    for one in ladder.told.processes[:1]:
        yield [structure(INPUTS, "hammerstein_oe.exact", **_orders(one), basis=word) for word in words]
    a = ladder.arguments(LINEAR, "oe.exact") or {"na": 2, "nk": ladder.delays[-1]}
    delays = list(dict.fromkeys([tuple(a["nk"]), *ladder.delays]))
    yield [model(k, nk, word) for k in dict.fromkeys([min(int(a["na"]), 3), 2]) for nk in delays for word in words]
    if not (a := ladder.arguments(INPUTS)):
        return
    if ladder.best(INPUTS):
        yield from climb([model(k, a["nk"], a["basis"])] for k in range(a["na"] + 1, 7))
    a = ladder.arguments(INPUTS)
    yield [model(a["na"], a["nk"], ladder.bases(word))
           for word in ("polynomial:2", "polynomial:5", "triangular:4", "triangular:10")]
    a = ladder.arguments(INPUTS)
    near = [[max(k + step, 0) for k in a["nk"]] for step in (-1, 1)]
    low = [structure(INPUTS, "hammerstein_oe.exact", **_orders(p), basis=a["basis"]) for p in ladder.told.processes]
    yield [*low, *(model(a["na"], nk, a["basis"]) for nk in near if nk != a["nk"])]  # a better basis needs fewer lags
    if (a := ladder.arguments(INPUTS, "hammerstein_oe.exact")) and a["basis"] == ladder.bases("triangular:10"):
        yield [model(a["na"], a["nk"], ladder.bases(f"triangular:{count}")) for count in (7, 8)]  # a knee


def _of_several_outputs(ladder: Ladder, words: Sequence[Any]) -> Rung:
    """Subspace models tell functions and order, at a small part of the price of a descent, which follows."""
    subspace, states = (partial(structure, INPUTS, name) for name in ("hammerstein_ss.sid", "hammerstein_ss.exact"))
    order = ladder.order()
    yield [subspace(nx=order, basis=word) for word in words]
    a = ladder.arguments(INPUTS) or {"basis": words[0]}
    yield from climb([subspace(nx=k, basis=a["basis"])] for k in range(order + 1, LARGEST + 1))
    a = ladder.arguments(INPUTS) or {"nx": order, **a}
    yield [states(nx=k, basis=a["basis"]) for k in dict.fromkeys([a["nx"], order, 2])]
    if a := ladder.arguments(INPUTS, "hammerstein_ss.exact"):
        yield from climb([states(nx=k, basis=a["basis"])] for k in range(a["nx"] + 1, LARGEST + 1))
        linear = ladder.arguments(LINEAR)
        if linear.get("criterion") == "prediction":
            yield [states(nx=linear["nx"], basis=a["basis"], criterion="prediction")]


def feedback(ladder: Ladder) -> Rung:
    """Static feedback functions of the outputs, with or without functions of the inputs."""
    model = partial(structure, FEEDBACK, "hammerstein_ss.exact")
    yield [model(nx=n, basis=basis, feedback_basis="polynomial:3") for n in (2, 3) for basis in _inner(ladder)]
    if not (a := ladder.arguments(FEEDBACK)):
        return
    yield [model(nx=a["nx"], basis=a["basis"], feedback_basis=word)
           for word in ("polynomial:2", "polynomial:4", "triangular:6")]
    a = ladder.arguments(FEEDBACK)
    if ladder.best(FEEDBACK):
        yield from climb([model(nx=n, basis=a["basis"], feedback_basis=a["feedback_basis"])]
                         for n in range(a["nx"] + 1, 7))


def _inner(ladder: Ladder) -> list[Any]:
    """Return a straight line, and the basis of the inputs that was better, as bases inside of richer models."""
    best, plain = ladder.best(INPUTS), ladder.best(LINEAR)
    helped = best is not None and (plain is None or best.score > plain.score)
    return ["linear", *([best.candidate.arguments["basis"]] if helped and best else [])]


def latent_signals(ladder: Ladder) -> Rung:
    """Static functions of the outputs of linear or Hammerstein systems, and of combinations of states and inputs.

    Signals are added while the fit to the record rises; other families of functions are tried where the first help.
    """
    def model(n: int, channels: int, latent_basis: str, direct: bool, basis: Any = "linear") -> StructureCandidate:
        inner = {} if basis == "linear" else {"basis": basis}
        return structure(LATENT, "lfr.exact", nx=n, channels=channels, latent_basis=latent_basis, direct=direct,
                         **inner)

    order, inner = min(max(ladder.order(), 2), MOST_LATENT), _inner(ladder)
    orders = list(dict.fromkeys([2, 4, order]))  # functions hide the order from linear models
    output = [partial(structure, LATENT, "wiener_ss.exact"),
              *(partial(structure, LATENT, "hammerstein_wiener_ss.exact", basis=basis)
                for basis in inner[1:] or [ladder.bases("polynomial:3")])]
    first = SMOOTH if ladder.data.n_samples < ENOUGH else FLEXIBLE
    yield [one(nx=k, output_basis=first) for one in output for k in orders]
    yield [model(k, 1, first, direct) for k in orders for direct in (False, True)]
    yield from _output_functions(ladder)
    if not (a := ladder.arguments(LATENT, "lfr.exact")):
        return
    if ladder.follows(LATENT, "lfr.exact"):
        yield [model(k, 1, word, direct) for k in dict.fromkeys([2, int(a["nx"])])  # what suits may need fewer states
               for word in ("polynomial:5", FLEXIBLE) for direct in (False, True)]
    else:
        yield [model(a["nx"], 1, "polynomial:5" if first == FLEXIBLE else FLEXIBLE, a["direct"])]
    yield from _larger(ladder, model)
    if not ladder.follows(LATENT, "lfr.exact"):
        return
    a = ladder.arguments(LATENT, "lfr.exact")
    nx, channels, word, direct = a["nx"], a["channels"], a["latent_basis"], a["direct"]
    yield [*(model(nx, channels, other, direct) for other in (SMOOTH, "polynomial:5", "bspline:4")),
           model(nx, channels, word, not direct),
           *(model(nx, channels, word, direct, basis) for basis in inner[1:])]
    if ladder.best(LATENT, "lfr.exact"):
        yield [structure(LATENT, "lfr.exact", **ladder.arguments(LATENT, "lfr.exact"), tries=2)]


def _larger(ladder: Ladder, model: Callable[..., StructureCandidate]) -> Rung:
    """One more state, or one more latent signal, whatever the record is followed better with, while it is by much."""
    leading = ladder.leading(LATENT, "lfr.exact")
    while leading is not None:
        a = leading.candidate.arguments
        nx, channels, word, direct = a["nx"], a["channels"], a["latent_basis"], a["direct"]
        found = yield [*([model(nx + 1, channels, word, direct)] if nx < MOST_LATENT else []),
                       *([model(nx, channels + 1, word, direct)] if channels < MOST_CHANNELS else [])]
        best = max(found, key=lambda t: (t.score, t.estimation), default=None)
        if best is None or 100 - best.estimation > RISE * (100 - max(leading.estimation, 0.0)):
            return
        leading = best


def _output_functions(ladder: Ladder) -> Rung:
    """Other functions, of the outputs and then of the inputs, and then orders, of Wiener and Hammerstein-Wiener models.

    The better of the two is followed.
    """
    words = ("wiener_ss.exact", "hammerstein_wiener_ss.exact")
    if leading := ladder.leading(LATENT, *words):
        model = partial(structure, LATENT, leading.candidate.formulation)
        a = leading.candidate.arguments
        if ladder.follows(LATENT, *words):
            yield [model(**{**a, "output_basis": word}) for word in (SMOOTH, "polynomial:5", "bspline:4", FLEXIBLE)]
            a = ladder.arguments(LATENT, leading.candidate.formulation)
            inner = [ladder.bases(word) for word in (FLEXIBLE, "triangular:10", "polynomial:5")] if "basis" in a else []
            yield [model(**{**a, "basis": word}) for word in inner if word != a["basis"]]
        if ladder.best(LATENT, *words):
            a = ladder.arguments(LATENT, leading.candidate.formulation)
            yield from climb([model(**{**a, "nx": n})] for n in range(a["nx"] + 1, MOST_LATENT + 1))


RUNGS: dict[str, Callable[[Ladder], Rung]] = {
    LINEAR: linear_models, INPUTS: input_functions, FEEDBACK: feedback, LATENT: latent_signals}


def structure(kind: str, formulation: str, **arguments: Any) -> StructureCandidate:
    """Return a candidate of a class."""
    return StructureCandidate(kind, formulation, arguments)
