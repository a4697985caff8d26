"""Signal subspaces: streaming trackers, the theorems behind them, certificates and reconstruction."""

from importlib import import_module
from typing import Any

_HOME = {
    "SubspaceTracker": "tracker",
    "load_tracker": "file",
    "principal_angles": "geometry",
    "projection_loss": "geometry",
    "loss_gradient": "geometry",
    "loss_hessian": "geometry",
    "stationary_point": "geometry",
    "stationary_points": "geometry",
    "fantope_certificate": "fantope",
    "FantopeCertificate": "fantope",
    "Reconstruction": "reconstruction",
    "optimal_reconstruction": "reconstruction",
    "suboptimal_reconstruction": "reconstruction",
    "constrained_reconstruction": "reconstruction",
    "surviving": "reconstruction",
    "oblique_projector": "reconstruction",
    "filled": "reconstruction",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"optid.tracking.{_HOME[name]}"), name)
    raise AttributeError(f"module 'optid.tracking' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(_HOME)
