"""optid: identification of Hammerstein systems by optimisation with constraints.

The public names are loaded on first use, so that ``import optid`` stays fast.
"""

import threading
from typing import Any

from optid.lazy import import_cvxpy, on_first_use

__version__ = "0.1.0"

_HOME = {
    "data.record": ["Data"],
    "data.readers": ["Format", "read", "open_stream"],
    "data.streams": ["Stream"],
    "data.channels": ["Transform"],
    "bases": ["Triangular", "Trigonometric", "Polynomial", "BSpline", "PiecewiseConstant", "Linear", "UserFunctions"],
    "models": ["Nonlinearity", "HammersteinSS", "NoiseCovariances", "HammersteinTF"],
    "core.problem": ["Problem"],
    "program.solution": ["Status", "Solution", "Bound"],
    "solving.solve": ["solve"],
    "identify.fitting": ["fit", "resolve", "Fit"],
    "identify.search": ["Identification"],
    "identify.selection": ["path", "fit_by_holdout"],
    "identify.validation": ["validate", "compare_models", "fit_by_horizon"],
    "identify.order": ["order", "OrderStudy"],
    "models.equations": ["Equations"],
    "models.files": ["load"],
    "identify.recursive": ["RecursiveARX"],
    "faults": ["Fault"],
    "identify.resampling": ["bootstrap"],
    "studies.study": ["Study"],
    "identify.design": ["design", "frequency_response"],
}
_MODULES = {name: name for name in ("signals", "bases", "errors", "examples", "plants", "faults", "studies")} | {
    "plots": "show.plots", "report": "show.report", "identify": "identify", "noise": "identify.noise",
    "tracking": "identify.tracking"}

_POSED = {name for home in ("core.problem", "solving.solve", "identify.fitting", "identify.selection")
          for name in _HOME[home]}

_load, __dir__ = on_first_use(__name__, _HOME, _MODULES)


def __getattr__(name: str) -> Any:
    if name in _POSED and threading.active_count() == 1:
        import_cvxpy()
    return _load(name)
