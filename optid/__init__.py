"""optid: identification of Hammerstein systems by optimisation with constraints.

The public names are loaded on first use, so that ``import optid`` stays fast.
"""

from optid.lazy import on_first_use

__version__ = "0.1.0"

_HOME = {
    "Data": "data.record",
    "read": "data.readers",
    "open_stream": "data.readers",
    "Stream": "data.streams",
    "Transform": "data.channels",
    "Triangular": "bases",
    "Trigonometric": "bases",
    "Polynomial": "bases",
    "BSpline": "bases",
    "PiecewiseConstant": "bases",
    "Linear": "bases",
    "UserFunctions": "bases",
    "Nonlinearity": "models",
    "HammersteinSS": "models",
    "NoiseCovariances": "models",
    "HammersteinTF": "models",
    "Program": "program.program",
    "Status": "program.solution",
    "Solution": "program.solution",
    "Bound": "program.solution",
    "solve": "solving.solve",
    "fit": "identify.fitting",
    "resolve": "identify.fitting",
    "path": "identify.selection",
    "fit_by_holdout": "identify.selection",
    "Fit": "identify.fitting",
    "validate": "identify.validation",
    "compare_models": "identify.validation",
    "fit_by_horizon": "identify.validation",
    "order": "identify.order",
    "OrderStudy": "identify.order",
    "load": "models.files",
    "RecursiveARX": "identify.recursive",
    "Fault": "faults",
    "bootstrap": "identify.resampling",
    "Study": "studies.definition.description",
    "design": "identify.design",
    "frequency_response": "identify.design",
}
_MODULES = {name: name for name in ("signals", "bases", "errors", "examples", "plants", "faults", "studies")} | {
    "plots": "show.plots", "report": "show.report", "noise": "identify.noise", "tracking": "identify.tracking"}

__getattr__, __dir__ = on_first_use(__name__, _HOME, _MODULES)
