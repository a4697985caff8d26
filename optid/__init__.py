"""optid: identification of Hammerstein systems by optimisation with constraints.

The public names are loaded on first use, so that ``import optid`` stays fast.
"""

from optid.lazy import on_first_use

__version__ = "0.1.0"

_HOME = {
    "Data": "data",
    "read": "readers",
    "open_stream": "readers",
    "Stream": "streams",
    "Transform": "channels",
    "Triangular": "bases",
    "Trigonometric": "bases",
    "Polynomial": "bases",
    "BSpline": "bases",
    "PiecewiseConstant": "bases",
    "Linear": "bases",
    "UserFunctions": "bases",
    "Nonlinearity": "models",
    "HammersteinARX": "models",
    "HammersteinSS": "models",
    "NoiseCovariances": "models",
    "HammersteinTF": "models",
    "Program": "program",
    "Status": "solution",
    "Solution": "solution",
    "Bound": "solution",
    "solve": "solving",
    "fit": "fitting",
    "resolve": "fitting",
    "path": "selection",
    "fit_by_holdout": "selection",
    "Fit": "fitting",
    "validate": "validation",
    "compare_models": "validation",
    "fit_by_horizon": "validation",
    "order": "model_order",
    "OrderStudy": "model_order",
    "load": "io",
    "RecursiveARX": "recursion",
    "Fault": "faults",
    "bootstrap": "resampling",
    "Study": "studies.definition.description",
    "design": "experiment",
    "frequency_response": "experiment",
}
_MODULES = {"signals", "bases", "plots", "report", "errors", "examples", "plants", "noise", "faults", "tracking",
            "studies"}

__getattr__, __dir__ = on_first_use(__name__, _HOME, _MODULES)
