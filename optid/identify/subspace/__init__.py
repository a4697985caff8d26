"""Subspace identification from moments of block Hankel matrices, which are never formed."""
