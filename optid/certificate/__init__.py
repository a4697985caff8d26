"""Proofs of global optimality for least squares in rank-one blocks, under constraints too."""

from optid.certificate.ladder import certify, solve_certified

__all__ = ["certify", "solve_certified"]
