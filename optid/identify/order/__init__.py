"""Estimation of orders and lags: test of singular values, criteria, hold-out, scan of lags."""

from optid.identify.order.lags import Lags, LagScan, scan_lags
from optid.identify.order.ranks import RankTest, order_test, rank_test
from optid.identify.order.study import OrderStudy, order

__all__ = ["LagScan", "Lags", "OrderStudy", "RankTest", "order", "order_test", "rank_test", "scan_lags"]
