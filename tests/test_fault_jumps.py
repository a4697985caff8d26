"""Jumps of the whole state by dynamic programming: equal to brute force over all segmentations."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from fault_plants import record, refused
from scipy.stats import chi2
from test_fault_injection import small

from optid.errors import DataError, StructureError
from optid.faults import Fault, dictionary, scan, state_jumps, thresholds, whiten


@pytest.fixture(scope="module")
def found():
    return dictionary(small())


def window(found, count, seed, faults=(), missing=0.0):
    return whiten(found.model, record(found.model, seed, faults, missing, count), x0="zero")


def brute(found, white, onsets):
    """Energy left with jumps at given onsets, by dense least squares on the signatures of the dictionary."""
    r = white.r.ravel()
    if not onsets:
        return float(r @ r)
    G = np.concatenate([found.signature("state", len(white.r), k, present=white.present).reshape(r.size, -1)
                        for k in onsets], axis=1)
    return float(np.sum((r - G @ np.linalg.lstsq(G, r, rcond=1e-10)[0]) ** 2))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("missing", [0.0, 0.15])
@pytest.mark.parametrize("seed", [0, 1])
def test_equal_to_brute_force_over_all_segmentations(found, seed, missing):
    count = 16
    white = window(found, count, seed, [Fault.jump("state", 5, [0.6, -0.3, 0.2])], missing)
    result = state_jumps(found, white, 3, penalty=0.0)
    for jumps in range(4):
        values = {onsets: brute(found, white, onsets) for onsets in combinations(range(count), jumps)}
        least = min(values.values())
        assert result.energies[jumps] == pytest.approx(least, rel=1e-7, abs=1e-9)
        assert values[result.best[jumps]] == pytest.approx(least, rel=1e-7, abs=1e-9)


def test_one_jump_is_the_scan(found):
    white = window(found, 80, 3, [Fault.jump("state", 40, [1.0, 0.5, -0.5])])
    s = scan(found, white)
    result = state_jumps(found, white, 1, penalty=0.0)
    assert result.onsets == (s.peak("state"),)
    assert result.energies[0] - result.energies[1] == pytest.approx(np.nanmax(s.statistic[s.index("state")]), rel=1e-8)
    np.testing.assert_allclose(result.sizes[0], s.estimate("state", result.onsets[0]).nu, rtol=1e-6)


def test_three_large_jumps_are_found_and_measured(found):
    sizes = [[2.0, -1.0, 1.0], [-1.5, 2.0, 0.5], [1.0, 1.0, -2.0]]
    white = window(found, 150, 4, [Fault.jump("state", k, size) for k, size in zip((30, 75, 110), sizes)])
    result = state_jumps(found, white, 5)
    assert result.onsets == (30, 75, 110) and result.margin > 0 and result.gain > 0
    G = np.concatenate([found.signature("state", 150, k).reshape(300, -1) for k in result.onsets], axis=1)
    off = np.sum((G @ np.ravel(result.sizes - np.array(sizes))) ** 2)
    assert off < chi2.isf(1e-4, 9)
    assert "3 jumps" in str(result) and max(map(len, str(result).splitlines())) <= 80
    assert np.all(np.diff(result.energies) <= 1e-9)


def test_a_healthy_window_has_none(found):
    limits = thresholds(found, 60, draws=5000)
    none = sum(not state_jumps(found, window(found, 60, seed), 2, penalty=limits).onsets for seed in range(40))
    assert none >= 38
    assert not state_jumps(found, window(found, 60, 0), 0).onsets


def test_bad_input(found):
    white = window(found, 30, 0)
    untested = replace(thresholds(found, 30, draws=5000), q=np.full(len(found.labels), np.nan))
    bad = replace(white, r=np.where((np.arange(30)[:, None] == 4) & [False, True], np.inf, white.r))
    refused(
        *((StructureError, "most must be a nonnegative", lambda k=k: state_jumps(found, white, k)) for k in (-1, 1.5)),
        (StructureError, "penalty=", lambda: state_jumps(found, white, penalty=float("nan"))),
        (StructureError, "none for a jump", lambda: state_jumps(found, white, penalty=untested)),
        (StructureError, "one experiment", lambda: state_jumps(found, (white, white))),
        (StructureError, "ties all segments", lambda: state_jumps(found, replace(white, nuisance=lambda r: r))),
        (DataError, "'y2' at sample 4", lambda: state_jumps(found, bad)),
        (StructureError, "too many", lambda: state_jumps(found, replace(white, r=np.zeros((3001, 2))))),
    )
