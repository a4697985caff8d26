"""Lagged regressors that are never formed: layout, sufficient statistics, residuals."""

from optid.statistics.experiments import ExperimentMeans, collect_by_experiment
from optid.statistics.regression import Layout, Statistics, accumulate, collect, factorise, residuals

__all__ = ["ExperimentMeans", "Layout", "Statistics", "accumulate", "collect", "collect_by_experiment", "factorise",
           "residuals"]
