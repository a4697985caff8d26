"""The columns of the structure test: functions of inputs through a few filters, stretch by stretch of a record."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.data.record import Data
from optid.data.stretches import interpolated
from optid.identify.validation.lag_filters import Family, convolved, delay_of, orthonormal_filters, poles_of

DEGREE, HATS, SAMPLES = 3, 5, 250
"""Powers and, at most, hats of an input that every filter sees; samples for each of these hats and each input."""

FINE_DEGREE, FINE_HATS, FINE_SAMPLES = 7, 20, 40
"""The same for the leading filter: there f is known to a few tenths of a percent."""

EXTRA = 3  # pulses beyond the order of the filters
LONGEST = 600  # samples after which the filters are cut, at most
CHUNK = 16384
PRESENT = 0.9
"""Missing input samples are interpolated; rows are left out while this share of the energy of the filters passes."""


@dataclass(frozen=True, eq=False)
class Design:
    """What the columns of all regressions are made of.

    Attributes:
        data: the record.
        u: its inputs, missing samples interpolated, one array per experiment.
        families: functions of each input.
        fine: more functions of each input.
        filters: (L, J) orthonormal impulse responses.
        heavy: samples after a missing input until most of its effect has passed.
    """

    data: Data
    u: tuple[Array, ...]
    families: tuple[Family, ...]
    fine: tuple[Family, ...]
    filters: Array
    heavy: int

    @classmethod
    def of(cls, data: Data) -> "Design":
        """Estimate delay and poles, and place the functions."""
        delay = delay_of(data)
        longest = int(np.clip(data.n_samples // 5, 20, LONGEST))
        filters = orthonormal_filters(poles_of(data, delay), EXTRA, delay, longest)
        energy = np.cumsum(np.sum(filters**2, axis=1))
        each = data.n_samples // data.m
        hats, fine = int(np.clip(each // SAMPLES, 0, HATS)), int(np.clip(each // FINE_SAMPLES, 2, FINE_HATS))
        return cls(
            data, tuple(interpolated(e.u) for e in data.experiments),
            families=tuple(Family.of(data, c, DEGREE, hats) for c in range(data.m)),
            fine=tuple(Family.of(data, c, FINE_DEGREE, fine) for c in range(data.m)),
            filters=filters, heavy=int(np.searchsorted(energy, PRESENT * energy[-1])) + 1)

    @property
    def blocks(self) -> tuple[tuple[int, int], ...]:
        """Functions and filters by input."""
        return tuple((family.size, self.filters.shape[1]) for family in self.families)

    def stretches(self, o: int, before: int = 0, among: Sequence[int] | None = None
                  ) -> Iterator[tuple[Array, Array, NDArray[np.bool_]]]:
        """Yield inputs (L - 1 + T, m), output o (T,) and which of its samples count, (T,).

        Args:
            o: the output.
            before: rows repeated from the stretch before.
            among: experiments; all when not given.
        """
        reach = len(self.filters) - 1
        for i in range(len(self.u)) if among is None else among:
            e, u = self.data.experiments[i], self.u[i]
            lost = np.isnan(e.u).any(axis=1).astype(float)
            valid = (np.convolve(lost, np.ones(self.heavy))[: len(u)] < 0.5) & ~np.isnan(e.y[:, o])
            for start in range(reach + before, len(u), CHUNK):
                rows = slice(start - before, min(start + CHUNK, len(u)))
                yield u[rows.start - reach : rows.stop], e.y[rows, o], valid[rows]

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
