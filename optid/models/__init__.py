"""The models: what they say, what they predict, their gauges, units and exports."""

from optid.models.hammerstein_arx import HammersteinARX, Nonlinearity
from optid.models.hammerstein_tf import HammersteinTF

__all__ = ["HammersteinARX", "HammersteinTF", "Nonlinearity"]
