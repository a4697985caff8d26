"""Nuclear-norm approximation of block Hankel matrices: the structured least-squares problem and our own ADMM for it."""

from optid.nuclear_norm.admm import Minimum, minimise
from optid.nuclear_norm.problem import NuclearProblem, Predictor

__all__ = ["Minimum", "NuclearProblem", "Predictor", "minimise"]
