"""The models: what they say, what they predict, their gauges, units and exports."""

from optid.models.hammerstein_ss import HammersteinSS
from optid.models.hammerstein_tf import HammersteinTF
from optid.models.kalman import NoiseCovariances
from optid.models.nonlinearity import Nonlinearity

HammersteinARX = HammersteinTF
"""The name of a transfer-function model with the noise it has by default: D = A, C = 1."""

__all__ = ["HammersteinARX", "HammersteinSS", "HammersteinTF", "NoiseCovariances", "Nonlinearity"]
