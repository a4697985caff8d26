"""The columns of the structure test: functions of the inputs, through filters with the poles of a process."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.informativity.process import Process
from optid.identify.informativity.signals import delay, hold_last
from optid.identify.validation.score_tests import Regression
from optid.models.recursions import lfilter
from optid.models.roots import roots_of

DEGREE, HATS, SAMPLES = 3, 5, 250  # coarse: powers and hats (at most) of an input; samples per hat and input
FINE_DEGREE, SPLIT = 7, 4  # fine: powers; parts of every interval between the nodes of the coarse hats
PULSES = 8  # lags of an input beside its poles
LONGEST = 5  # time constant of a filter, at most, in lengths of the longest experiment
MOVE, MOVES = 0.1, 4  # share of its range that an input covers in a move; moves that can be compared
VISIBLE = 0.1  # share of the variance that a process must explain for its poles and lags to be those of the plant
HALF = 0.5  # the same where there are several inputs
PRESENT = 0.9  # share of the energy of the filters that must have passed after a missing input before rows count
EARLY, DECAYS = 4, 12  # an experiment gives up a 4th of its rows, at most, for its past, and a 12th for its decays
Poles = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Family:
    """Functions of one input: powers of the standardised input, and a hat for each inner node."""

    centre: float
    spread: float
    degree: int
    nodes: Array  # (k + 2,) quantiles, or all levels where they are few: the family then contains every function
    coarse: Array  # (size, p) combinations of them that are fewer powers and hats

    @classmethod
    def of(cls, data: Data, c: int) -> "Family":
        """Return the functions for input c, fewer than its levels; a constant input is a `RankError`."""
        samples = np.concatenate([e.u[:, c] for e in data.experiments])
        samples = samples[~np.isnan(samples)]
        levels = np.unique(samples)
        if levels.size < 2:
            raise RankError(f"input {data.inputs[c]!r} is constant")
        hats = int(np.clip(data.n_samples // data.m // SAMPLES, 0, HATS))
        nodes = np.unique(np.quantile(samples, np.linspace(0, 1, SPLIT * (hats + 1) + 1)))
        degree, coarse_nodes, grid = FINE_DEGREE, nodes[::SPLIT], np.quantile(samples, np.linspace(0, 1, 200))
        if levels.size <= degree + nodes.size - 1:
            degree, nodes, coarse_nodes, grid = 1, levels, levels[:0], levels
        found = cls(float(samples.mean()), float(samples.std()), degree, nodes, np.zeros((0, 0)))
        few = cls(found.centre, found.spread, min(DEGREE, levels.size - 1), coarse_nodes, found.coarse)
        whole = np.column_stack([np.ones(grid.size), found.values(grid)])
        coarse = np.linalg.lstsq(whole, few.values(grid), rcond=1e-12)[0][1:]
        return cls(found.centre, found.spread, degree, nodes, coarse)

    @property
    def size(self) -> int:
        """Number of functions."""
        return self.degree + max(self.nodes.size - 2, 0)

    def values(self, u: Array) -> Array:
        """Evaluate the functions of complete samples, (N, size)."""
        x = (u - self.centre) / self.spread
        powers = np.asarray(np.polynomial.hermite_e.hermevander(x, self.degree)[:, 1:], dtype=float)
        hats = [np.interp(u, self.nodes, one) for one in np.eye(self.nodes.size)[1:-1]]
        return np.column_stack([powers, *hats])


@dataclass(frozen=True, eq=False)
class Design:
    """One output, and the functions of all inputs through the filters of its process."""

    data: Data
    inputs: list[Array]  # (N, m) per experiment, complete
    output: Sequence[Array]  # (N,) per experiment, centred and over its spread, zero where missing
    centre: float  # of the output, like the spread
    spread: float
    families: tuple[Family, ...]  # functions by input
    poles: tuple[Poles, ...]  # of the filters, by input
    lags: tuple[int, ...]
    banks: list[list[Array]]  # by input, filters of its functions, (N, J, P) per experiment
    regression: Regression  # rows that count, level and decays

    @classmethod
    def of(cls, data: Data, o: int, process: Process) -> "Design":
        """Lay out the columns for output o; a record that moves too little for them is a `RankError`."""
        if data.m > 1 and process.explained < HALF:  # whose dynamics are wrong for one input at least
            raise RankError(f"the low-order dynamics found explain {100 * process.explained:.0f} % of output "
                            f"{data.outputs[o]!r}, too little to compare structures of several inputs")
        inputs = [hold_last(e.u) for e in data.experiments]
        families = tuple(Family.of(data, c) for c in range(data.m))
        _refuse_still_inputs(data, inputs)
        measured = [e.y[:, o] for e in data.experiments]
        whole = np.concatenate(measured)
        centre, spread = float(np.nanmean(whole)), float(np.nanstd(whole)) or 1.0
        longest = max(e.n_samples for e in data.experiments)
        known = process.explained > VISIBLE  # or else what the output does has the poles of its noise model
        poles = tuple(_within(r.poles if known else roots_of(process.noise[1:]), longest) for r in process.responses)
        # a lag too few costs a column, one too many is wrong
        lags = tuple(max(r.nk - 1, 0) if known else 0 for r in process.responses)
        banks = [[filter_rational(f.values(u[:, c]) - f.values(u[:1, c]), p, lag) for u in inputs]
                 for c, (f, p, lag) in enumerate(zip(families, poles, lags))]
        decays = [filter_rational(np.eye(longest, 1), p, 0, pulses=0)[:, :, 0] for p in poles]
        # until then an output answers to inputs from before its experiment, and afterwards it decays
        past = max(lag + bank[0].shape[1] for lag, bank in zip(lags, banks))
        present, nuisance = [], []
        for e, y in zip(data.experiments, measured):
            first = min(past, e.n_samples // EARLY)
            here = ~np.isnan(y) & (np.arange(len(y)) >= first)
            for c, (response, lag) in enumerate(zip(decays, lags)):
                here &= ~_touched(np.isnan(e.u[:, c]), response, lag + PULSES)
            columns = np.hstack(decays)[: len(y) - first, : max(len(y) // DECAYS, 1)]
            present.append(here)
            nuisance.append(np.column_stack([np.ones(len(y)), np.pad(columns, ((first, 0), (0, 0)))]))
        output = [np.nan_to_num((y - centre) / spread) for y in measured]
        return cls(data, inputs, output, centre, spread, families, poles, lags, banks,
                   Regression(tuple(present), tuple(nuisance), np.ones(1)))


def filter_rational(x: Array, poles: Poles, lag: int, pulses: int = PULSES, twice: bool = True) -> Array:
    """Filter the columns of x (N, P), zero before it begins, by J rational functions: (N, J, P).

    They span q^-lag B(q) / A(q)^2 for the given poles, 1 / A unless `twice`, with `pulses` more coefficients in B than
    poles in the denominator: B / A' for poles near the given ones is contained up to the square of their error. A chain
    of all-pass filters keeps them apart (Takenaka 1925, Malmquist 1925).
    """
    stage = np.column_stack([delay(column, lag) for column in x.T])
    found = []
    for _ in range(pulses):
        found.append(stage)
        stage = _later(stage)
    for a in denominators(poles) * (2 if twice else 1):
        state = lfilter([1.0], a, stage)
        found += [state, _later(state)][: a.size - 1]
        stage = lfilter(a[::-1], a, stage)
    return np.stack(found, axis=1) if found else np.zeros((len(x), 0, x.shape[1]))


def denominators(poles: Poles) -> list[Array]:
    """Return the real factors [1, a1, ...] of the polynomial with these poles, the slowest first."""
    upper = poles[poles.imag >= 0]
    return [np.real(np.poly([p] if p.imag == 0 else [p, p.conjugate()])) for p in upper[np.argsort(-np.abs(upper))]]


def _later(x: Array) -> Array:
    return np.concatenate([np.zeros((1, x.shape[1])), x[:-1]])


def _within(poles: Poles, samples: int) -> Poles:
    """Contract poles on and beyond the unit circle, to time constants of a few lengths of the record."""
    return poles * np.minimum(1.0, np.exp(-1 / (LONGEST * samples)) / np.maximum(np.abs(poles), 1e-300))


def _touched(lost: NDArray[np.bool_], response: Array, lag: int) -> NDArray[np.bool_]:
    """Mark the samples in which most of the effect of a missing input has not passed."""
    energy = np.cumsum(np.sum(response**2, axis=1))
    after = lag + int(np.searchsorted(energy, PRESENT * energy[-1]))
    return np.convolve(lost, np.ones(after + 1))[: lost.size] > 0.5


def _refuse_still_inputs(data: Data, inputs: Sequence[Array]) -> None:
    """Raise `RankError` if all inputs move too few times to compare the responses to their moves."""
    counts = count_moves(inputs)
    if max(counts) < MOVES:
        name, most = data.inputs[int(np.argmax(counts))], max(counts)
        raise RankError(f"input {name!r} moves {'once' if most == 1 else f'{most} times'} by more than "
                        f"{100 * MOVE:.0f} % of its range; at least {MOVES} moves are compared with each other")


def count_moves(inputs: Sequence[Array]) -> list[int]:
    """Count, up to `MOVES` an experiment, the moves of every input over `MOVE` of its range; NaN are left out."""
    signals = [[u[~np.isnan(u[:, c]), c] for u in inputs] for c in range(inputs[0].shape[1])]
    return [sum(_moves(u, MOVE * float(np.ptp(np.concatenate(own) if any(v.size for v in own) else 0.0)))
                for u in own if u.size) for own in signals]


def _moves(u: Array, size: float) -> int:
    """Count, up to `MOVES`, how often a signal has moved from where it was by more than a size."""
    count, first = 0, 0
    while count < MOVES and (away := np.flatnonzero(np.abs(u[first:] - u[first]) > size)).size:
        first += int(away[0])
        count += 1
    return count
