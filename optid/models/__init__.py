"""The models: what they say, what they predict, their gauges, units and exports."""

from optid.models.hammerstein_arx import HammersteinARX, Nonlinearity
from optid.models.hammerstein_ss import HammersteinSS
from optid.models.hammerstein_tf import HammersteinTF
from optid.models.noise_covariances import NoiseCovariances

__all__ = ["HammersteinARX", "HammersteinSS", "HammersteinTF", "NoiseCovariances", "Nonlinearity"]
