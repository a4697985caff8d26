"""Functions of the inputs that the samples of a record determine."""

from typing import Any

import numpy as np

from optid.arrays import Array
from optid.bases import parse
from optid.data.record import Data

FEWEST = 0.3  # samples that must determine every function of a basis: the largest of a record determines the end
LINE = "linear"  # the basis of one function


def binary(data: Data) -> bool:
    """Whether no input has more than two levels, between which static functions cannot be told apart."""
    return all(np.unique(np.concatenate(_runs(data, c))).size <= 2 for c in range(data.m))


def determined_bases(data: Data, word: str, apart: bool = False) -> Any:
    """Return a basis for all inputs, with as many functions as the samples of each determine.

    With every experiment `apart` each has its own level, which hides what differs between them.
    """
    runs = [_runs(data, c) for c in range(data.m)]
    found = [_determined(word, several if apart else [np.concatenate(several)]) for several in runs]
    return found[0] if len(set(found)) == 1 else found


def _determined(word: str, runs: list[Array]) -> str:
    """Return a basis, or the largest of its family that the samples of runs determine; else a straight line.

    Every combination of its functions must vary within the runs as much as one does that is one at `FEWEST` samples.
    """
    family, _, size = word.partition(":")
    u = np.concatenate(runs)
    if np.unique(u).size <= 2:
        return LINE
    for count in range(int(size), 1, -1):
        basis = parse(f"{family}:{count}").with_interval(float(u.min()), float(u.max()))
        values = [basis.values(run) for run in runs if run.size]
        changes = np.vstack([one - one.mean(axis=0) for one in values])
        if np.linalg.svd(changes, compute_uv=False)[-1] ** 2 >= FEWEST:
            return f"{family}:{count}"
    return LINE


def _runs(data: Data, c: int) -> list[Array]:
    """Return the samples of an input in every experiment but those that are missing."""
    return [u[np.isfinite(u)] for u in (e.u[:, c] for e in data.experiments)]
