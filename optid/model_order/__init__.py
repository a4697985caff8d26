"""Orders and lags before a model: singular values and their distribution, criteria, hold-out, scan of lags."""

from optid.model_order.ranks import RankTest, choose_order, rank_test

__all__ = ["RankTest", "choose_order", "rank_test"]
