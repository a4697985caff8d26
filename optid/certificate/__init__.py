"""Proofs of global optimality for least squares in rank-one blocks, under constraints too."""
