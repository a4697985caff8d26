"""Test for a fault of any course at one place, with a known probability of rejecting the true place (F7).

The signatures of impulses at all samples of a window span the signatures of all waveforms at a place. The residual of
the window after projection on that space is chi-square distributed if the fault is at that place, whatever its course.
All places that pass are the consistent set. The response to an unknown initial state is projected out, too.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_probability
from optid.data.record import Data
from optid.errors import DataError, LookupFailed, StructureError, nearest
from optid.faults.readings import LostReadings
from optid.faults.screening import flat_lines
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened, check_window
from optid.phrases import p_value

RANK = 1e-10
"""Singular values below this share of the largest count as zero."""

LONGEST = 6000
"""Readings of a window at most: the cost grows with their cube."""


class Consistency(NamedTuple):
    """Whether a fault of any course at a place explains the window."""

    name: str  # of the place, as in `Fault`
    labels: tuple[str, ...]  # of the candidates there
    energy: float  # of the residual, chi-square distributed with `freedom` if the fault is there
    freedom: int  # degrees of freedom
    limit: float  # the quantile
    p_value: float  # probability of more than this energy if the fault is there
    course: Array  # (N, d) the estimated waveform; NaN in samples without effect on a reading

    @property
    def consistent(self) -> bool:
        """Whether the place is not rejected."""
        return self.energy <= self.limit


@dataclass(frozen=True, eq=False)
class WaveformTest:
    """Every place, tested for a fault of any course.

    Attributes:
        places: the results, most probable first.
        probability: with which the set contains the true place.
        healthy: the test of a plant without a fault.
        onset: first sample that the fault can change.
        untested: {label: reason} of the candidates with as many directions as outputs, or of noise.
        flat: sensors with identical readings, where the record was given.
    """

    places: tuple[Consistency, ...]
    probability: float
    healthy: Consistency
    onset: int
    untested: dict[str, str] = field(default_factory=dict)
    flat: tuple[LostReadings, ...] = ()

    @property
    def consistent(self) -> tuple[str, ...]:
        """Places that are not rejected, most probable first; only the frozen sensors where there are some."""
        if self.flat:
            return tuple(dict.fromkeys(line.name for line in self.flat))
        return tuple(place.name for place in self.places if place.consistent)

    @property
    def best(self) -> str:
        """The most probable place; `StructureError` where nothing was tested."""
        if not self.flat and not self.places:
            raise StructureError("No place was tested.")
        return self.consistent[0] if self.flat else self.places[0].name

    def __getitem__(self, name: str) -> Consistency:
        """Return the result of a place or of a candidate there; `LookupFailed` with the reason where not tested."""
        for place in self.places:
            if name == place.name or name in place.labels:
                return place
        if name in self.untested:
            raise LookupFailed(f"{name!r} was not tested: {self.untested[name]}.")
        raise LookupFailed(f"{name!r} was not tested. {nearest(name, [place.name for place in self.places])}")

    def __str__(self) -> str:
        lines = [f"a fault of any course from sample {self.onset} on; set with probability {self.probability:g}",
                 f"  {'place':<34}{'energy left':>12}{'limit':>9}{'p-value':>10}"]
        for place in (*self.places, self.healthy):
            numbers = f"{place.energy:>12.1f}{place.limit:>9.1f}{p_value(place.p_value):>10}"
            lines.append(f"  {place.name[:33]:<34}{numbers}  {'in the set' if place.consistent else 'ruled out'}"[:80])
        lines += [f"  not tested: {label[:24]}, {why}"[:80] for label, why in self.untested.items()]
        return "\n".join([*lines, *map(str, self.flat)])


def waveform_test(
    found: Dictionary, whitened: Whitened, probability: float = 0.99, *, onset: int = 0,
    data: Data | None = None,
) -> WaveformTest:
    """Test every place of a dictionary for a fault of any course.

    Losses and stuck actuators are courses of their actuator; a frozen sensor is a course of its sensor.

    Args:
        found: the candidates.
        whitened: the window; one experiment.
        probability: with which the set is to contain the true place.
        onset: first sample that the fault can change; a later one makes the test more powerful.
        data: the record of the window, for the flat-line test of frozen sensors.

    Raises:
        DataError: too few readings for a test, or other outputs than the model's.
        StructureError: one output only, several experiments, a window that is too long.
    """
    check_probability(probability, "probability")
    check_window(found.model, whitened, "The waveform test", onset, LONGEST)
    if found.model.l < 2:
        raise StructureError(
            "Not isolable with one output: a fault of any course in any place explains it. Faults of a known course "
            "(bias, drift, loss) are isolable by the exact search.")
    start = start_matrix(whitened)
    tested, untested = [], {}
    for candidate in found.candidates:
        if candidate.fault_kind.without_course:
            untested[candidate.label] = candidate.fault_kind.without_course
        elif candidate.into_state.shape[1] >= found.model.l:
            untested[candidate.label] = "as many directions as outputs explain anything"
        else:
            tested.append(candidate)
    places = []
    for name, here in by_place(tested).items():
        matrix = waveform_matrix(found, here[0], whitened, onset)
        fitted = _fitted(name, matrix, start, whitened, probability, here[0].into_state.shape[1])
        places.append(fitted._replace(labels=tuple(c.label for c in here)))
    places.sort(key=lambda place: (-place.p_value, place.energy - 2 * place.freedom))
    healthy = _fitted("healthy", start[:, :0], start, whitened, probability, 1)
    flat = () if data is None else flat_lines(data)
    return WaveformTest(tuple(places), probability, healthy, onset, untested, flat)


def waveform_matrix(found: Dictionary, candidate: Candidate, whitened: Whitened, onset: int = 0,
                    u: ArrayLike | None = None) -> Array:
    """Return the signatures of unit impulses at every sample from the onset on, (N l, (N - onset) d).

    The impulses are in units of a bias at the place of the candidate; with the inputs u (N, m) those of a loss are in
    units of the share lost.
    """
    count = len(whitened.r)
    state, output = (np.broadcast_to(part, (count, *part.shape)) for part in
                     (candidate.into_state, candidate.into_output))
    if u is not None and candidate.fault_kind.driven:
        state, output = found.additions(candidate, count, 0, u)
    d, at = state.shape[2], np.arange(count - onset)
    into_state, into_output = (np.zeros((count, part.shape[1], count - onset, d)) for part in (state, output))
    into_state[at + onset, :, at], into_output[at + onset, :, at] = state[onset:], output[onset:]
    response = whitened.predictor.respond(
        into_state.reshape(count, found.model.nx, -1), into_output.reshape(count, found.model.l, -1), whitened.present)
    return np.asarray(whitened.whiten_signature(response).reshape(whitened.r.size, -1))


def start_matrix(whitened: Whitened) -> Array:
    """Return the signatures of the initial state, (N l, n)."""
    return whitened.whiten_signature(whitened.predictor.jumps(0, whitened.present)).reshape(whitened.r.size, -1)


def _fitted(name: str, matrix: Array, start: Array, whitened: Whitened, probability: float, d: int) -> Consistency:
    from scipy.linalg import lstsq
    from scipy.special import chdtrc, chdtri

    whole, r, readings = np.hstack([matrix, start]), whitened.r.ravel(), int(whitened.present.sum())
    sizes = np.linalg.norm(whole, axis=0)
    seen = sizes > RANK * max(float(sizes.max(initial=0.0)), 1e-300)
    course, rank, rest = np.full(whole.shape[1], np.nan), 0, r
    if seen.any():
        columns = whole[:, seen] / sizes[seen]
        found: Any = lstsq(columns, r, cond=RANK, lapack_driver="gelsy")
        solved, rank = found[0], int(found[2])
        rest, course[seen] = r - columns @ solved, solved / sizes[seen]
    freedom = readings - rank
    if freedom < 1:
        raise DataError(
            f"{name}: {readings} readings are too few to test a waveform of {rank} values: use a longer window.")
    energy = float(rest @ rest)
    return Consistency(name, (), energy, freedom, float(chdtri(freedom, 1 - probability)),
                       float(chdtrc(freedom, energy)), course[: matrix.shape[1]].reshape(-1, d))


def by_place(candidates: Iterable[Candidate]) -> dict[str, list[Candidate]]:
    """Return candidates by the name of their place: those whose waveforms are the same are in one."""
    found: dict[str, list[tuple[Array, Candidate]]] = {}
    for candidate in candidates:
        enters = np.vstack([candidate.into_state, candidate.into_output])
        place = next((name for name, here in found.items() if enters.shape == here[0][0].shape
                      and np.allclose(enters, here[0][0], rtol=1e-12, atol=0)), " | ".join(candidate.places))
        found.setdefault(place, []).append((enters, candidate))
    return {name: [candidate for _, candidate in here] for name, here in found.items()}
