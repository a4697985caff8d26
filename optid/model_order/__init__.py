"""Orders and lags before a model: singular values and their distribution, criteria, hold-out, scan of lags."""

from optid.model_order.lags import Lags, LagScan, scan_lags
from optid.model_order.ranks import RankTest, rank_test
from optid.model_order.signals import order_test
from optid.model_order.study import OrderStudy, order

__all__ = ["LagScan", "Lags", "OrderStudy", "RankTest", "order", "order_test", "rank_test", "scan_lags"]
