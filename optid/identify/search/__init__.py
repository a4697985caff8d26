"""The search for a structure: blocks, lags, candidates, trials, the choice."""

from optid.identify.search.search import Identification, identify

__all__ = ["Identification", "identify"]
