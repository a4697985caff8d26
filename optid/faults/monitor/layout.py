"""Where the numbers of the monitor stand in the arrays that its compiled steps share.

A few arrays instead of many named ones: what passes between compiled functions is compiled with each of them. Small
matrices share one array (number, row, column), vectors one array (number, entry), and everything that has one number
per onset one array (row, onset), so that the loops over the onsets run over contiguous numbers.
"""

from typing import NamedTuple

import numpy as np

from optid.arrays import Array

LASTING, DRIFT, JUMP, DRIVEN = range(4)
"""The course of a column after its onset: 1, 1 2 3 .., 1 0 0 .., minus f of the input."""


class Tables(NamedTuple):
    """What never changes; n states, l outputs, r functions, D columns of C candidates, M of them driven, window W.

    Attributes:
        m: small matrices: those of the model, `ROOT` (whitening), `INTO_STATE` (n, D) and `INTO_OUTPUT` (l, D) of the
            columns that are not driven, and from `DRIVES` on M (n, r) and then M (l, r) of those that are.
        v: vectors of numbers: offsets, `THRESHOLD` (C,), `RULE`.
        i: vectors of whole numbers: sizes and rows (`DIM`), and what belongs to a column or a candidate.
        w: (rows, W) by age, the youngest last: l n rows H, what a jolt of the state leaves in the whitened innovation;
            l l rows N, what one of the output leaves; signatures (D l), their products and the inverse roots of these.
    """

    m: Array
    v: Array
    i: np.ndarray
    w: Array


class State(NamedTuple):
    """What every sample changes.

    Attributes:
        counts: single whole numbers.
        m: small matrices.
        v: vectors of numbers.
        i: vectors of whole numbers.
        w: (rows, length) by onset: correlations (D), products, what driven columns add to the state (M n) and to the
            output (M l), which readings are there (l), energy of the innovation, and what the estimates of carried
            faults take of a unit of each column (room D).
        c: (rows, W) scratch: signatures of this sample (D l), H and N of a window with missing readings, two lines.
    """

    counts: np.ndarray
    m: Array
    v: Array
    i: np.ndarray
    w: Array
    c: Array


# Tables.m
A, B, C, D, E, L, GAIN, ROOT, COVARIANCE, INTO_STATE, INTO_OUTPUT, DRIVES = range(12)
# Tables.v
OFFSET_X, OFFSET_Y, THRESHOLD, RULE = range(4)
# Tables.i
DIM, OUTPUT_OF, COURSE, WHICH, COLUMN_OF, FIRST_OF, SIZE, PAIR, ROOT_AT, LEAST, ADDITIVE = range(11)
# Tables.i[DIM]: sizes, then first rows in Tables.w (T_), State.w (S_) and State.c (C_)
(NX, NY, NF, NFED, COLUMNS, CANDIDATES, NDRIVEN, WINDOW, LENGTH, ROOM, T_N, T_TRACE, T_GRAM, T_ROOT, S_GRAM, S_STATE,
 S_OUTPUT, S_SHOWN, S_ENERGY, S_TAKEN, C_H, C_N, C_LINE, C_OTHER) = range(24)
# Tables.v[RULE]
CERTAINTY, RELEASE, PATIENCE, SETTLE, STILL, FADED, LEARNED, FORGIVEN, WIDE, ODD = range(10)

# State.counts
NOW, FIRST, DIRTY, PHASE, ALARM, NAMED, NAMED_AT, QUIET, ACTIVE, PLACE, BEGUN, SUMMED = range(12)
"""Samples seen, first onset of the window, last sample with a missing reading or a carried fault, phase, sample of the
alarm, candidate named, when, samples below the release level, number of carried directions, place of the newest onset
in the arrays, first sample after the last missing input, whether products of all candidates are summed."""
# State.m
V, P, S0, Z, RAW, TAKE, TURN, WHITENING, M, T, SPREAD, TAKEN = range(12)
# State.v
(X, NU, GROWN, GROWTH, POWER, HELD, SLOPE, BEFORE, STATISTIC, R, PREDICTED, Z1, SIZES, LATER, MOVED, INPUT,
 READING) = range(17)
# State.i
COLUMN, OWNER, TESTED, PEAK, INDEX = range(5)

WATCHING, NAMING, SETTLING, LOST = range(4)
"""Phases: no alarm; alarm, not named; named, the size still growing sharp; an alarm that no candidate explains."""

ALARMED, ISOLATED, CLEARED, UNTESTABLE, TESTABLE, STRANGE = range(6)
"""Kinds of events."""

NOTHING, AGAIN = -1, -2
"""No candidate is named; the alarm is one that no candidate has explained before."""

START = -1
"""Owner of the directions of an unknown state."""
