"""Least squares in rank-one blocks: the problem, its reduction, whitening and local solution."""

from optid.rank_one.problem import Array, Core, Point, RankOne, block_slices, matrices, reduce

__all__ = ["Array", "Core", "Point", "RankOne", "block_slices", "matrices", "reduce"]
