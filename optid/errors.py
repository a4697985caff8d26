"""Named errors: every refusal says which channel, sample, argument or constraint is wrong and what to do."""

from collections.abc import Iterable
from difflib import get_close_matches

MOST_LISTED = 80  # words that a message lists


class OptidError(Exception):
    """Base class of everything optid raises on purpose."""


class DataError(OptidError, ValueError):
    """The record cannot be used as it is: shape, missing or impossible samples, time stamps, units."""


class RankError(DataError):
    """The record does not determine the parameters: too few rows, no excitation, unvisited basis functions."""


class StructureError(OptidError, ValueError):
    """An argument that describes the model is wrong: na, nb, nk, basis, constraint, gauge."""


class LookupFailed(OptidError, LookupError):  # noqa: N818 - reads as the outcome of a look-up
    """No formulation, solver, constraint, basis or example has this name."""


class InfeasibleError(OptidError, RuntimeError):
    """No model satisfies all constraints; the message lists a smallest conflicting subset."""


class UnboundedError(OptidError, RuntimeError):
    """The programme has no minimum."""


class SolverMissing(OptidError, RuntimeError):  # noqa: N818
    """The solver exists but is not installed; the message has the pip line."""


class SolverRefused(StructureError):  # noqa: N818
    """The solver cannot take this programme; the message names the part, or what solves such a programme."""


class SolverFailed(OptidError, RuntimeError):  # noqa: N818
    """The solver crashed, ran out of time or returned a point that our residuals refuse."""


class ClusterError(OptidError, RuntimeError):
    """A Dask cluster cannot be used: no scheduler answers, no worker, other package versions, or its workers die."""


class StudyError(OptidError, ValueError):
    """The description of a study is wrong, or its database belongs to another; the message lists every problem."""


class DatabaseError(OptidError, RuntimeError):
    """The database of a study cannot be used: missing, another's, of another version, in use, or the disk is full."""


class ModelFileError(OptidError, ValueError):
    """A model file is truncated, of another version, or not a model."""


class DataWarning(UserWarning):
    """Something weakens the answer without making it meaningless; the text has the number."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a sentence that names the known word nearest to the one written, or all known words."""
    words = sorted(known)
    likely = words if len(words) <= 5000 else [word for word in words if word[:1] == name[:1]][:5000]  # for its time
    close = get_close_matches(name[:80], likely, n=1, cutoff=0.5)
    more = f", and {len(words) - MOST_LISTED} more" if len(words) > MOST_LISTED else ""
    return f"Did you mean {close[0]!r}?" if close else "Known: " + ", ".join(words[:MOST_LISTED]) + more + "."


def __dir__() -> list[str]:
    return sorted(name for name, value in globals().items() if getattr(value, "__module__", None) == __name__)
