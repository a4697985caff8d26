"""Signal subspaces: streaming trackers, the theorems behind them, certificates and reconstruction."""

from optid.lazy import on_first_use

_HOME = {
    "tracker": ["SubspaceTracker"],
    "geometry": ["principal_angles", "projection_loss", "loss_gradient", "loss_hessian", "stationary_point",
                 "stationary_points"],
    "reconstruction": ["fantope_certificate", "FantopeCertificate", "Reconstruction", "optimal_reconstruction",
                       "suboptimal_reconstruction", "constrained_reconstruction", "surviving", "oblique_projector",
                       "filled"],
}

__getattr__, __dir__ = on_first_use(__name__, _HOME)
