"""The Hammerstein-ARX model: what it says, what it predicts, its gauges, units and exports."""

from optid.models.hammerstein_arx import HammersteinARX, Nonlinearity

__all__ = ["HammersteinARX", "Nonlinearity"]
