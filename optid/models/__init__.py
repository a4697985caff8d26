"""The models: what they say, what they predict, their gauges, units and exports."""

from optid.models.hammerstein_ss import HammersteinSS
from optid.models.hammerstein_tf import HammersteinTF
from optid.models.kalman import NoiseCovariances
from optid.models.nonlinearity import Nonlinearity

__all__ = ["HammersteinSS", "HammersteinTF", "NoiseCovariances", "Nonlinearity"]
