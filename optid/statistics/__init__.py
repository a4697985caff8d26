"""Lagged regressors that are never formed: layout, sufficient statistics, residuals."""

from optid.statistics.regression import Layout, Statistics, accumulate, collect, factorise, residuals

__all__ = ["Layout", "Statistics", "accumulate", "collect", "factorise", "residuals"]
