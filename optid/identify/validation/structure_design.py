"""The columns of the structure test: functions of inputs through a few filters, stretch by stretch of a record."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import fdtrc

from optid.arrays import Array
from optid.data.record import Data
from optid.data.stretches import interpolated
from optid.errors import RankError
from optid.identify.order.ranks import rank_test
from optid.models.recursions import lfilter
from optid.statistics.expansion import Expansion
from optid.statistics.factors import ROUNDING
from optid.statistics.hankel import HankelStatistics, hankel_statistics
from optid.statistics.rq import rq

BLOCK_ROWS, FEWEST = 10, 3  # future and past block rows; the least where the record is short
EXPLAINED = ROUNDING["gram"] ** 2  # share of an energy below which the rest of a regression is rounding
LATEST = 30  # longest delay, in samples
LEVEL = 0.01
SPARE = 1  # poles beyond the order that noisy data show, which may still matter
FEW = 3  # functions per input with which the dynamics are estimated
RADIUS, SLOWEST = 0.98, 20  # poles beyond 0.98 or 1 - 20 / N are contracted: their responses must end within the record
SETTLED = 1e-3  # share of its largest value below which an impulse response has ended
DEGREE, HATS, SAMPLES = 3, 5, 250  # powers and hats (at most) of an input in every filter; samples per hat and input
FINE_DEGREE, FINE_HATS, FINE_SAMPLES = 7, 20, 40  # the same for the leading filter
EXTRA = 3  # pulses beyond the order of the filters
LONGEST = 600  # samples after which the filters are cut, at most
CHUNK = 16384
PRESENT = 0.9  # share of the energy of the filters that must have passed after an interpolated input before rows count


@dataclass(frozen=True, eq=False)
class Family:
    """Functions of one input: powers of the standardised input, and a hat for each inner node of (k + 2,) quantiles."""

    centre: float
    spread: float
    degree: int
    nodes: Array

    @classmethod
    def of(cls, data: Data, c: int, degree: int, hats: int) -> "Family":
        """Return the functions for input c, fewer than its levels; a constant input is a `RankError`."""
        samples = np.concatenate([e.u[:, c] for e in data.experiments])
        samples = samples[~np.isnan(samples)]
        levels = np.unique(samples).size
        if levels < 2:
            raise RankError(f"Input {data.inputs[c]!r} is constant.")
        degree = min(degree, levels - 1)
        room = max(0, min(hats, levels - 1 - degree))
        nodes = np.unique(np.quantile(samples, np.linspace(0, 1, room + 2))) if room else np.zeros(0)
        return cls(float(samples.mean()), float(samples.std()), degree, nodes)

    @property
    def size(self) -> int:
        """Number of functions."""
        return self.degree + max(self.nodes.size - 2, 0)

    def values(self, u: Array) -> Array:
        """Evaluate the functions of complete samples, (N, size)."""
        x = (u - self.centre) / self.spread
        powers = np.asarray(np.polynomial.hermite_e.hermevander(x, self.degree)[:, 1:], dtype=float)
        if self.nodes.size < 3:
            return powers
        hats = [np.interp(u, self.nodes, one) for one in np.eye(self.nodes.size)[1:-1]]
        return np.column_stack([powers, *hats])


def delay_of(data: Data) -> int:
    """Estimate the delay of a record: one less than the first lag with significant coefficients of three functions.

    Zero where the record is too short. A delay too short costs a few filters, one too long is wrong: the level is high.
    """
    records, signals = _signals(data, 0)
    p, shortest = signals.p, min(e.n_samples for e in data.experiments)
    lags = min(LATEST + 10, data.n_samples // (6 * p), shortest // 3)
    if lags < 3:
        return 0
    statistics = _statistics(records, signals, lags)
    past = np.concatenate([[0], *(statistics.at(signals.eta, [lags - 1 - lag]) for lag in range(lags))])
    spare = statistics.windows - past.size
    if spare < past.size:
        return 0
    now = statistics.at(signals.y, [lags - 1])
    gram = statistics.gram
    inverse = np.linalg.pinv(gram[np.ix_(past, past)], hermitian=True)
    theta = inverse @ gram[np.ix_(past, now)]
    whole = np.diag(gram)[now]
    rest = np.maximum(whole - np.einsum("ij,ij->j", theta, gram[np.ix_(past, now)]), EXPLAINED * whole + 1e-300)
    for lag in range(lags):
        block = slice(1 + lag * p, 1 + (lag + 1) * p)
        weight = np.linalg.pinv(inverse[block, block], hermitian=True)
        energy = np.einsum("io,ij,jo->o", theta[block], weight, theta[block])
        if (fdtrc(p, spare, (energy / p) / (rest / spare)) < LEVEL).any():
            return min(max(lag - 1, 0), LATEST)
    return 0


def poles_of(data: Data, delay: int = 0) -> NDArray[np.complex128]:
    """Estimate the poles (n,) between delayed inputs and outputs by a subspace method with inputs as instruments.

    The inputs enter through three functions each; the noise may have any colour; the order is that of `rank_test`. The
    poles are well within the unit circle, none for a static record. A record that is too short, or does not excite the
    functions, is a `RankError`.
    """
    records, signals = _signals(data, delay)
    alpha = int(np.clip(data.n_samples // (6 * len(signals.names)), FEWEST, BLOCK_ROWS))
    statistics, largest = _statistics(records, signals, 3 * alpha), (alpha - 1) * data.l
    z, phi, y = signals.positions(statistics.at, "inputs", alpha)
    ranks = rank_test(statistics, z, phi, y, rows=2 * alpha, largest=largest)
    if ranks.order == 0:
        return np.zeros(0, dtype=complex)
    order = ranks.order if ranks.exact else min(ranks.order + SPARE, largest)
    observability = rq(statistics, z, phi, y).decomposition[0][:, :order]
    a = np.linalg.lstsq(observability[: -data.l], observability[data.l :])[0]
    poles = np.asarray(np.linalg.eigvals(a), dtype=complex)
    radius = min(RADIUS, 1 - SLOWEST / data.n_samples)
    return poles * np.minimum(1.0, radius / np.maximum(np.abs(poles), 1e-300))


def orthonormal_filters(poles: NDArray[np.complex128], extra: int, delay: int, longest: int, squared: bool = True
                        ) -> Array:
    """Return impulse responses (T, J) that span q^-(delay + i) / A(q)^2, i = 0 ... 2n + extra, A with the given poles.

    With A^2 in the denominator (A where it is not squared) the span contains B / A' for poles near the given ones, up
    to the square of their error. The responses are cut after `longest` samples at the latest.
    """
    every = np.concatenate([poles, poles]) if squared else poles
    a = np.asarray(np.real(np.poly(every)), dtype=float) if len(poles) else np.ones(1)
    count = a.size + extra
    response = lfilter([1.0], a, np.eye(1, max(longest, count + 1))[0])
    large = np.flatnonzero(np.abs(response) > SETTLED * np.abs(response).max())
    length = min(response.size, int(large[-1]) + 1 + count)
    shifted = np.column_stack([np.concatenate([np.zeros(i), response[: length - i]]) for i in range(count)])
    orthonormal = np.asarray(np.linalg.qr(shifted)[0], dtype=float)
    return np.concatenate([np.zeros((delay, count)), orthonormal])


def convolved(values: Array, filters: Array) -> Array:
    """Filter every column of values (T, P) with every response of filters (L, J) where it fits: (T - L + 1, J, P)."""
    size = next_fast_len(len(values), real=True)
    spectra = np.asarray(rfft(values, size, axis=0))
    found = np.empty((len(values) - len(filters) + 1, filters.shape[1], values.shape[1]))
    for j, response in enumerate(filters.T):
        whole = np.asarray(irfft(spectra * np.asarray(rfft(response, size))[:, None], size, axis=0))
        found[:, j] = whole[len(filters) - 1 : len(values)]
    return found


def _signals(data: Data, delay: int) -> tuple[Sequence[Array], Expansion]:
    """Raw channels [u | y], the outputs that many samples earlier, and their expansion in a few functions."""
    # windows without a gap would be few; interpolation does not move the poles
    records = [interpolated(np.hstack([e.u[: e.n_samples - delay], e.y[delay:]])) for e in data.experiments]
    families: Any = tuple(Family.of(data, c, FEW, 0) for c in range(data.m))
    return records, Expansion(families, (), data.inputs, data.outputs)


def _statistics(records: Sequence[Array], signals: Expansion, rows: int) -> HankelStatistics:
    long = [record for record in records if len(record) >= rows]
    return hankel_statistics(long or records, rows, signals, names=signals.names, centre="mean")


@dataclass(frozen=True, eq=False)
class Design:
    """The signals and filters of the columns of all regressions."""

    data: Data
    u: tuple[Array, ...]  # inputs of the record, missing samples interpolated, one array per experiment
    families: tuple[Family, ...]  # functions of each input
    fine: tuple[Family, ...]  # more of them
    filters: Array  # (L, J) orthonormal impulse responses, of these poles, which begin after the delay
    heavy: int  # samples after a missing input until most of its effect has passed
    poles: NDArray[np.complex128]
    delay: int
    kept: tuple[int, ...]  # experiments of the given record that are long enough, those of `data`

    @classmethod
    def of(cls, data: Data) -> "Design":
        """Estimate delay and poles, and place the functions; a record without a long experiment is a `RankError`."""
        delay = delay_of(data)
        longest = int(np.clip(data.n_samples // 5, 20, LONGEST))
        poles = poles_of(data, delay)
        filters = orthonormal_filters(poles, EXTRA, delay, longest)
        kept = tuple(i for i, e in enumerate(data.experiments) if e.n_samples >= len(filters))
        if not kept:
            raise RankError(f"No experiment has {len(filters)} samples, which the responses last: use longer ones.")
        data = data.select(experiments=kept)
        energy = np.cumsum(np.sum(filters**2, axis=1))
        each = data.n_samples // data.m
        hats, fine = int(np.clip(each // SAMPLES, 0, HATS)), int(np.clip(each // FINE_SAMPLES, 2, FINE_HATS))
        return cls(
            data, tuple(interpolated(e.u) for e in data.experiments),
            families=tuple(Family.of(data, c, DEGREE, hats) for c in range(data.m)),
            fine=tuple(Family.of(data, c, FINE_DEGREE, fine) for c in range(data.m)),
            filters=filters, heavy=int(np.searchsorted(energy, PRESENT * energy[-1])) + 1, poles=poles,
            delay=delay, kept=kept)

    @property
    def blocks(self) -> tuple[tuple[int, int], ...]:
        """Functions and filters by input."""
        return tuple((family.size, self.filters.shape[1]) for family in self.families)

    @property
    def cut(self) -> float:
        """Share of the energy of the slowest response that lies behind the end of the filters."""
        slowest = float(np.max(np.abs(self.poles), initial=0.0))
        return slowest ** (2 * (len(self.filters) - self.delay))

    def stretches(self, o: int, before: int = 0
                  ) -> Iterator[tuple[int, slice, Array, Array, NDArray[np.bool_]]]:
        """Yield experiment, rows, inputs (L - 1 + T, m), output o (T,) and which of its samples count, (T,).

        The first `before` rows of every stretch are those before it, once more. Rows count from sample L - 1.
        """
        reach = len(self.filters) - 1
        for i, (e, u) in enumerate(zip(self.data.experiments, self.u)):
            lost = np.isnan(e.u).any(axis=1).astype(float)
            valid = (np.convolve(lost, np.ones(self.heavy))[: len(u)] < 0.5) & ~np.isnan(e.y[:, o])
            for start in range(reach + before, len(u), CHUNK):
                rows = slice(start - before, min(start + CHUNK, len(u)))
                counted = slice(rows.start - reach, rows.stop - reach)
                yield i, counted, u[rows.start - reach : rows.stop], e.y[rows, o], valid[rows]

    def additive(self, u: Array) -> Array:
        """Return [1, filters of functions], (T, 1 + sum P_c J); per input, filters outermost."""
        rows = len(u) - len(self.filters) + 1
        parts = [convolved(f.values(u[:, c]), self.filters).reshape(rows, -1) for c, f in enumerate(self.families)]
        return np.hstack([np.ones((rows, 1)), *parts])

    def finer(self, u: Array, lines: list[Array]) -> Array:
        """Return the fine functions of every input c through its response lines[c] (L,), (T, sum P_c)."""
        return np.hstack([convolved(f.values(u[:, c]), lines[c][:, None])[:, 0] for c, f in enumerate(self.fine)])

    def filtered(self, u: Array, responses: Array) -> Array:
        """Filter the standardised inputs (T + L - 1, m) with responses (L, q, m) and add them up, (T, q)."""
        return np.sum([convolved((u[:, [c]] - f.centre) / f.spread, responses[:, :, c])[:, :, 0]
                       for c, f in enumerate(self.families)], axis=0)
