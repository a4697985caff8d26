"""The models: what they say, what they predict, their gauges, units and exports."""

from importlib import import_module
from typing import Any

from optid.models import files
from optid.models.hammerstein_ss import HammersteinSS
from optid.models.hammerstein_tf import HammersteinTF
from optid.models.kalman import NoiseCovariances
from optid.models.nonlinearity import Nonlinearity

__all__ = ["HammersteinSS", "HammersteinTF", "NoiseCovariances", "Nonlinearity"]


def _physical(content: dict[str, Any], functions: Any) -> Any:
    """Build a physical model; CasADi, which runs its equations, is imported when there is one."""
    return import_module("optid.models.physical").PhysicalModel.from_dict(content, functions)


def _process(content: dict[str, Any], functions: Any) -> Any:
    """Build a process model; its kernels are imported when there is one."""
    return import_module("optid.models.process").ProcessModel.from_dict(content, functions)


files.KINDS["PhysicalModel"] = _physical
files.KINDS["ProcessModel"] = _process
