"""Signal subspaces: streaming trackers, stationary points of their loss, certificates and reconstruction."""

from optid.identify.tracking.subspaces import (
    FantopeCertificate,
    Reconstruction,
    constrained_reconstruction,
    fantope_certificate,
    loss_derivatives,
    optimal_reconstruction,
    principal_angles,
    projection_loss,
    stationary_point,
    stationary_points,
    suboptimal_reconstruction,
    surviving,
)
from optid.identify.tracking.tracker import SubspaceTracker

__all__ = ["FantopeCertificate", "Reconstruction", "SubspaceTracker", "constrained_reconstruction",
           "fantope_certificate", "loss_derivatives", "optimal_reconstruction", "principal_angles", "projection_loss",
           "stationary_point", "stationary_points", "suboptimal_reconstruction", "surviving"]
