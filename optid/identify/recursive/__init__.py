"""Recursive identification: Algorithm 3.2, its state, traces and files."""

from optid.identify.recursive.recursive_arx import RecursiveARX

__all__ = ["RecursiveARX"]
