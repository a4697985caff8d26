"""Subspace identification: statistics of block Hankel matrices that are never formed, and what is read off them."""
