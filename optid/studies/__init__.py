"""Studies: a grid of formulations, solvers, data and seeds, run cell by cell into a database.

A leaf: nothing in optid imports it but the command line and the public name `optid.Study`.
"""

from importlib.util import find_spec

from optid.errors import StudyError
from optid.lazy import on_first_use

for _package in ("pydantic", "tomlkit"):
    if find_spec(_package) is None:
        raise StudyError(f'studies and optid compare need {_package}: pip install "optid[study]"')

_HOME = {
    "study": ["Study"],
    "grid": ["Cell"],
    "verdicts.verdict": ["conclude", "Verdict"],
}

__getattr__, __dir__ = on_first_use(__name__, _HOME)
