"""Studies: a grid of formulations, solvers, data and seeds, run cell by cell into a database.

A leaf: nothing in optid imports it but the command line and the public name `optid.Study`.
"""

from optid.lazy import on_first_use

_HOME = {
    "study": ["Study"],
    "grid": ["Cell"],
    "verdicts.verdict": ["conclude", "Verdict"],
}

__getattr__, __dir__ = on_first_use(__name__, _HOME)
