"""Signal subspaces: streaming trackers, the theorems behind them, certificates and reconstruction."""

from optid.lazy import on_first_use

_HOME = {
    "SubspaceTracker": "tracker",
    "principal_angles": "geometry",
    "projection_loss": "geometry",
    "loss_gradient": "geometry",
    "loss_hessian": "geometry",
    "stationary_point": "geometry",
    "stationary_points": "geometry",
    "fantope_certificate": "reconstruction",
    "FantopeCertificate": "reconstruction",
    "Reconstruction": "reconstruction",
    "optimal_reconstruction": "reconstruction",
    "suboptimal_reconstruction": "reconstruction",
    "constrained_reconstruction": "reconstruction",
    "surviving": "reconstruction",
    "oblique_projector": "reconstruction",
    "filled": "reconstruction",
}

__getattr__, __dir__ = on_first_use(__name__, _HOME)
