"""Proofs of global optimality for least squares in rank-one blocks, under constraints too."""

from optid.certificate.ladder import certify

__all__ = ["certify"]
